//! A process of the federation, as far as the agent knows it.

use ictus_coord::report::FederateMeasures;

use crate::api::MemberView;
use crate::supervisor::protocol::StopSignal;

/// The RTI or a federate.
#[derive(Debug)]
#[expect(
    clippy::struct_excessive_bools,
    reason = "facts that are independent of each other"
)]
pub(super) struct Member {
    pub(super) name: String,
    pub(super) ours: bool,
    /// Whether it runs on this host.
    pub(super) here: bool,
    /// Whether the others go on without it.
    pub(super) outlived: bool,
    pub(super) process: Process,
    pub(super) pid: Option<u32>,
    pub(super) joined: bool,
    pub(super) running: bool,
    /// The last `progress` or `ended` status.
    pub(super) view: MemberView,
    pub(super) reason: Option<String>,
    pub(super) signalled: Option<StopSignal>,
    pub(super) measures: FederateMeasures,
    /// Events told that its own words caused, over and over.
    pub(super) remarks: u32,
}

/// Where a member's process stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Process {
    /// Not asked for yet.
    Waiting,
    /// Its supervisor is being started or found.
    Launching,
    Up,
    /// Ended; its supervisor is still there.
    Ended,
    /// Its supervisor is gone, too.
    Gone,
    /// Not ours; never touched.
    Foreign,
}

impl Member {
    pub(super) fn new(name: &str, ours: bool) -> Self {
        Self {
            name: name.to_owned(),
            ours,
            here: true,
            outlived: false,
            process: Process::Waiting,
            pid: None,
            joined: false,
            running: false,
            view: MemberView {
                name: name.to_owned(),
                ..MemberView::default()
            },
            reason: None,
            signalled: None,
            measures: FederateMeasures::of(name),
            remarks: 0,
        }
    }

    pub(super) fn lives(&self) -> bool {
        matches!(self.process, Process::Launching | Process::Up)
    }

    pub(super) fn view(&self) -> MemberView {
        let state = match self.process {
            Process::Waiting => "waiting",
            Process::Launching => "launching",
            Process::Up if self.running => "running",
            Process::Up if self.joined => "joined",
            Process::Up => "up",
            Process::Ended | Process::Gone => "ended",
            Process::Foreign => "foreign",
        };
        MemberView {
            state: state.to_owned(),
            pid: self.pid,
            ..self.view.clone()
        }
    }
}
