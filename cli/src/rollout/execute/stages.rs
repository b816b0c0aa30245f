//! How far a start over several hosts is: sums of what the parts say.

use std::collections::BTreeMap;
use std::net::SocketAddrV4;

use ictusd::api::Event;
use ictusd::stamp;

use super::told;
use crate::ui::Ui;

/// Members started, joined and running, over all hosts.
#[derive(Debug)]
pub(super) struct Stages {
    of: usize,
    started: BTreeMap<String, usize>,
    running: BTreeMap<String, (usize, usize)>,
}

impl Stages {
    pub(super) fn new(of: usize) -> Self {
        Self {
            of,
            started: BTreeMap::new(),
            running: BTreeMap::new(),
        }
    }

    pub(super) fn report(
        &mut self,
        ui: &mut Ui,
        host: &str,
        event: &Event,
        rti: Option<SocketAddrV4>,
    ) {
        match event {
            Event::Started { member, .. } if member == "rti" => {}
            Event::Started { started, .. } => {
                self.started.insert(host.to_owned(), *started);
                let started = self.started.values().sum();
                ui.counted("started", started, self.of);
            }
            Event::Listening { port } => {
                let at = rti.map_or_else(|| format!("port {port}"), |rti| rti.to_string());
                ui.stage("started", &format!("the RTI on {host}, listening on {at}"));
            }
            Event::Joined { joined, of, .. } => {
                ui.counted("joined", *joined, *of);
            }
            Event::StartTag { start_ns } => {
                ui.stage(
                    "agreed",
                    &format!("on the start tag {}", stamp::text(*start_ns)),
                );
            }
            Event::Running { running, of, .. } => {
                self.running.insert(host.to_owned(), (*running, *of));
                let running: usize = self.running.values().map(|it| it.0).sum();
                ui.counted("running", running, self.of);
            }
            Event::Healthy | Event::Ended { .. } => {}
            Event::Rejected { .. }
            | Event::StopRequested { .. }
            | Event::StopTag { .. }
            | Event::Resigned { .. }
            | Event::Lost { .. }
            | Event::Exited { .. }
            | Event::StpViolation { .. }
            | Event::FallingBehind { .. }
            | Event::CaughtUp { .. }
            | Event::ClockStep { .. }
            | Event::Signalled { .. }
            | Event::Foreign { .. } => ui.stage("", &told(host, event)),
        }
    }
}
