//! `ictus events`: what happened to federations.

use std::collections::BTreeMap;

use clap::Args;
use ictusd::api::{Event, Happening, Outcome};
use ictusd::stamp;

use crate::error::CliError;
use crate::hosts::merge::Merged;
use crate::session::{Abroad, Session, Whereabouts};
use crate::ui::{Ui, nanoseconds, one_line};

/// Show what happened to federations
#[derive(Debug, Args)]
pub(crate) struct Events {
    /// Go on until Ctrl-C
    #[arg(short, long)]
    follow: bool,
    /// Only of this federation: its name or manifest
    name: Option<String>,
    #[command(flatten)]
    at: Whereabouts,
}

impl Events {
    pub(crate) fn run(&self, ui: &mut Ui) -> Result<(), CliError> {
        let session = Session::new()?;
        if let Some(abroad) = self.at.abroad(&session, self.name.as_deref())? {
            return session.block_on(self.everywhere(ui, &session, &abroad));
        }
        let name = self
            .name
            .as_deref()
            .map(|name| session.name(Some(name)))
            .transpose()?;
        if !self.follow && session.known().is_empty() {
            return Ok(());
        }
        session.block_on(async {
            let client = session.daemon().await?;
            let mut events = client.events(name.as_deref(), self.follow).await?;
            while let Some(happening) = events.next().await? {
                let federation = &happening.federation;
                print(ui, &happening, federation)?;
            }
            Ok(())
        })
    }

    /// Those of all hosts: what is kept by time, what comes as it comes.
    async fn everywhere(
        &self,
        ui: &mut Ui,
        session: &Session,
        abroad: &Abroad,
    ) -> Result<(), CliError> {
        let name = Some(abroad.name.as_str());
        let (mut merged, mut kept) = (Merged::new(), Vec::new());
        // A stream that follows begins with what is kept: so much of it was shown already.
        let mut shown: BTreeMap<String, usize> = BTreeMap::new();
        for (host, client) in abroad.clients(session).await? {
            if self.follow {
                merged.add(host.clone(), client.events(name, true).await?);
            }
            let mut stream = client.events(name, false).await?;
            while let Some(happening) = stream.next().await? {
                *shown.entry(host.clone()).or_default() += 1;
                kept.push((happening.at_ns, host.clone(), happening));
            }
        }
        // Of one host in the order in which it told them.
        kept.sort_by_key(|(at_ns, ..)| *at_ns);
        for (_, host, happening) in &kept {
            print(ui, happening, host)?;
        }
        while let Some((host, happening)) = merged.next().await {
            let happening = happening?;
            match shown.get_mut(&host) {
                Some(left @ 1..) => *left -= 1,
                Some(0) | None => print(ui, &happening, &host)?,
            }
        }
        Ok(())
    }
}

/// One line: when, where, what.
fn print(ui: &mut Ui, happening: &Happening, place: &str) -> Result<(), CliError> {
    ui.result(happening, || {
        let Happening { at_ns, event, .. } = happening;
        format!("{} {place}: {}", stamp::text(*at_ns), describe(event))
    })
}

/// An event in words.
#[expect(clippy::too_many_lines, reason = "an arm for each event")]
pub(crate) fn describe(event: &Event) -> String {
    match event {
        Event::Started { member, pid, .. } => format!("{member} was started (pid {pid})"),
        Event::Listening { port } => format!("the RTI listens on port {port}"),
        Event::Joined {
            federate,
            joined,
            of,
        } => format!("{federate} joined ({joined}/{of})"),
        Event::StartTag { start_ns } => format!("the start tag is {}", stamp::text(*start_ns)),
        Event::Running {
            federate,
            running,
            of,
        } => format!("{federate} runs ({running}/{of})"),
        Event::Healthy => "healthy".to_owned(),
        Event::Rejected { peer, reason } => format!("the RTI refused {peer}: {reason}"),
        Event::StopRequested { by } => format!("{by} asked for a stop"),
        Event::StopTag {
            elapsed_ns,
            microstep,
        } => {
            format!(
                "the stop tag is {} after the start, microstep {microstep}",
                nanoseconds(*elapsed_ns)
            )
        }
        Event::Resigned { federate } => format!("{federate} resigned"),
        Event::Lost { federate, reason } => format!("{federate} was lost: {reason}"),
        Event::Exited {
            member,
            how,
            reason: None,
        } => format!("{member} ended: {how}"),
        Event::Exited {
            member,
            how,
            reason: Some(reason),
        } => {
            format!("{member} ended: {how} ({})", one_line(reason))
        }
        Event::StpViolation {
            federate,
            upstream,
            lateness_ns,
            count,
        } => format!(
            "{federate} got a message from {upstream} {} late ({count} so far)",
            nanoseconds(*lateness_ns)
        ),
        Event::FallingBehind { federate, lag_ns } => {
            format!(
                "{federate} falls behind: its lag is {} and grows",
                nanoseconds(*lag_ns)
            )
        }
        Event::CaughtUp { federate, lag_ns } => {
            format!(
                "{federate} has caught up: its lag is {}",
                nanoseconds(*lag_ns)
            )
        }
        Event::ClockStep { federate, by_ns } => {
            format!("{federate} noticed a clock step of {}", nanoseconds(*by_ns))
        }
        Event::Signalled { signal, members } => {
            format!(
                "did not end in time and got {signal}: {}",
                members.join(", ")
            )
        }
        Event::Foreign { member, why } => format!("{member} is foreign and left alone: {why}"),
        Event::Ended { outcome } => format!("ended: {}", describe_outcome(outcome)),
    }
}

/// An outcome in words.
pub(crate) fn describe_outcome(outcome: &Outcome) -> String {
    match outcome {
        Outcome::Completed => "completed".to_owned(),
        Outcome::Stopped { missed } if missed.is_empty() => "stopped at the stop tag".to_owned(),
        Outcome::Stopped { missed } => {
            format!(
                "stopped; did not reach the stop tag in time: {}",
                missed.join(", ")
            )
        }
        Outcome::Failed { failure, .. } => {
            let who = failure.member.as_deref().unwrap_or("the federation");
            format!("failed: {who}: {}", one_line(&failure.words()))
        }
        Outcome::Aborted => "undone before it was healthy".to_owned(),
    }
}
