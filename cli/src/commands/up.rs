//! `ictus up`: from a manifest to a healthy federation.

use std::time::{Duration, Instant};

use clap::Args;
use ictus_coord::plan::Plan;
use ictusd::api::{Event, Happening, Outcome};
use ictusd::client::{Client, Stream, is_already_running};
use ictusd::stamp;

use super::events::{describe, describe_outcome};
use super::logs;
use crate::args::{ManifestArgs, duration};
use crate::error::CliError;
use crate::session::{Session, checked, count, request, succeed};
use crate::ui::Ui;

/// How long undoing a start may take: the daemon's own bounds are shorter.
const UNDO_MAX: Duration = Duration::from_secs(30);

/// Start a federation; returns when it is healthy
///
/// Checks and builds, starts the RTI and every federate as a process of this machine, and reports each stage from what
/// they say themselves. Ctrl-C before it is healthy undoes everything.
#[derive(Debug, Args)]
pub(crate) struct Up {
    #[command(flatten)]
    manifest: ManifestArgs,
    /// Stay, show the logs, and stop the federation on Ctrl-C; a second Ctrl-C kills it
    #[arg(long)]
    attach: bool,
    /// Have federates write their logical traces
    #[arg(long)]
    trace: bool,
    /// How long it may take to become healthy once it is built
    #[arg(long, value_name = "TIME", default_value = "5m", value_parser = duration)]
    timeout: Duration,
}

/// How the wait for `healthy` ended.
enum Start {
    Healthy,
    Ended(Outcome),
    Interrupted,
    TooLate,
}

impl Up {
    pub(crate) fn run(&self, ui: &mut Ui) -> Result<(), CliError> {
        let session = Session::new()?;
        let checked = checked(ui, &self.manifest, true)?;
        let request = request(&checked, self.trace);
        let name = checked.plan.federation.clone();
        session.block_on(async {
            let client = session.daemon().await?;
            let mut stream = match client.start(&name, &request).await {
                Ok(stream) => stream,
                Err(error) if is_already_running(&error) => {
                    ui.message(&format!("{name} is already running from the same plan"));
                    return self.already(ui, &client, &name).await;
                }
                Err(error) => {
                    let hint = format!("`ictus down {name}` stops the one that runs");
                    let conflict = error.refusal().is_some_and(is_conflict);
                    let error = CliError::from(error);
                    return Err(if conflict { error.hint(hint) } else { error });
                }
            };
            let begun = Instant::now();
            match self.wait(ui, &mut stream, &checked.plan).await? {
                Start::Healthy => {}
                Start::Ended(outcome) => return ended_early(ui, &name, &outcome),
                Start::Interrupted => return undo(ui, &client, &name, stream).await,
                Start::TooLate => {
                    undo(ui, &client, &name, stream).await.ok();
                    let seconds = self.timeout.as_secs_f64();
                    let message = format!("federation `{name}` was not healthy within {seconds} s");
                    return Err(CliError::new(crate::error::Kind::Timeout, message)
                        .hint("everything was undone; `--timeout` gives it more time"));
                }
            }
            ui.stage(
                "healthy",
                &format!("after {:.1} s", begun.elapsed().as_secs_f64()),
            );
            self.summary(ui, &client, &name).await?;
            if self.attach {
                attach(ui, &client, &name, stream).await
            } else {
                Ok(())
            }
        })
    }

    async fn already(&self, ui: &mut Ui, client: &Client, name: &str) -> Result<(), CliError> {
        self.summary(ui, client, name).await
    }

    /// Reports stages until it is healthy, or will not be.
    async fn wait(
        &self,
        ui: &mut Ui,
        stream: &mut Stream<Happening>,
        plan: &Plan,
    ) -> Result<Start, CliError> {
        let mut stages = Stages {
            all_started: false,
            joined: 0,
            of: plan.federates.len(),
        };
        let deadline = tokio::time::sleep(self.timeout);
        tokio::pin!(deadline);
        loop {
            let happening = tokio::select! {
                next = stream.next() => next?,
                _ = tokio::signal::ctrl_c() => return Ok(Start::Interrupted),
                () = &mut deadline => return Ok(Start::TooLate),
            };
            let Some(Happening { event, .. }) = happening else {
                return Err(CliError::failed(
                    "the daemon went away while it was starting",
                ));
            };
            stages.report(ui, &event);
            if event == Event::Healthy {
                return Ok(Start::Healthy);
            }
            if let Event::Ended { outcome } = event {
                return Ok(Start::Ended(outcome));
            }
        }
    }

    async fn summary(&self, ui: &mut Ui, client: &Client, name: &str) -> Result<(), CliError> {
        let view = client.federation(name).await?;
        ui.result(&view, || {
            let federates = count(view.federates.len(), "federate");
            let port = view.rti_port.map(|port| format!(", RTI on 127.0.0.1:{port}"));
            format!(
                "{name} runs: {federates}{}\n  ictus ps\n  ictus logs -f {name}\n  ictus timing {name}\n  \
                 ictus down {name}",
                port.unwrap_or_default()
            )
        })
    }
}

fn is_conflict(refusal: &ictusd::api::ApiError) -> bool {
    refusal.code == ictusd::api::ErrorCode::Conflict
}

/// What has been reported.
struct Stages {
    all_started: bool,
    joined: usize,
    of: usize,
}

impl Stages {
    fn report(&mut self, ui: &mut Ui, event: &Event) {
        match event {
            Event::Started { member, .. } if member == "rti" => {}
            Event::Started { started, of, .. } => self.started(ui, *started, *of),
            Event::Listening { port } => {
                ui.stage(
                    "started",
                    &format!("the RTI, listening on 127.0.0.1:{port}"),
                );
            }
            Event::Joined { joined, of, .. } => {
                self.joined = *joined;
                if joined == of {
                    self.started(ui, *of, *of);
                }
                counted(ui, "joined", *joined, *of);
            }
            Event::StartTag { start_ns } => ui.stage("agreed", &start_tag(*start_ns)),
            Event::Running { running, of, .. } => counted(ui, "running", *running, *of),
            Event::Healthy | Event::Ended { .. } => {}
            // A refused stranger or a federate that ended: said now, decided by the daemon.
            Event::Rejected { .. }
            | Event::StopRequested { .. }
            | Event::StopTag { .. }
            | Event::Resigned { .. }
            | Event::Lost { .. }
            | Event::Exited { .. }
            | Event::Signalled { .. }
            | Event::Foreign { .. } => {
                let (said, Self { joined, of, .. }) = (describe(event), self);
                ui.stage("", &format!("{said} (joined {joined}/{of})"));
            }
        }
    }
}

impl Stages {
    /// The RTI may hear from a federate before its supervisor is heard: started comes before joined all the same.
    fn started(&mut self, ui: &mut Ui, started: usize, of: usize) {
        if !self.all_started {
            self.all_started = started == of;
            counted(ui, "started", started, of);
        }
    }
}

/// A stage that is reached when everybody has reached it.
fn counted(ui: &mut Ui, stage: &str, reached: usize, of: usize) {
    let detail = format!("{reached}/{of} federates");
    if reached < of {
        ui.progress(stage, &detail);
    } else {
        ui.stage(stage, &detail);
    }
}

fn start_tag(start_ns: i64) -> String {
    format!("on the start tag {}", stamp::text(start_ns))
}

fn ended_early(ui: &mut Ui, name: &str, outcome: &Outcome) -> Result<(), CliError> {
    ui.stage("ended", &describe_outcome(outcome));
    succeed(name, outcome)
}

/// Ctrl-C or too late: has the daemon undo the start and waits for it, in vain after a second Ctrl-C.
async fn undo(
    ui: &mut Ui,
    client: &Client,
    name: &str,
    mut stream: Stream<Happening>,
) -> Result<(), CliError> {
    ui.stage("undoing", name);
    let ended = async {
        client.stop(name, false).await?;
        while let Some(happening) = stream.next().await? {
            if matches!(happening.event, Event::Ended { .. }) {
                break;
            }
        }
        Ok::<(), CliError>(())
    };
    tokio::select! {
        ended = tokio::time::timeout(UNDO_MAX, ended) => {
            if let Ok(ended) = ended {
                ended?;
                ui.stage("undone", "nothing runs");
            }
        }
        _ = tokio::signal::ctrl_c() => {}
    }
    Err(CliError::failed(format!(
        "federation `{name}` was not started"
    )))
}

/// Shows logs until the federation ends; the first Ctrl-C stops it, the second kills it.
async fn attach(
    ui: &mut Ui,
    client: &Client,
    name: &str,
    mut stream: Stream<Happening>,
) -> Result<(), CliError> {
    let lines = client.logs(name, &[], true, None).await?;
    let mut interrupts = 0;
    let (mut printed, mut outcome) = (false, None);
    let printing = logs::print(ui, lines);
    tokio::pin!(printing);
    while outcome.is_none() || !printed {
        tokio::select! {
            result = &mut printing, if !printed => {
                result?;
                printed = true;
            }
            happening = stream.next(), if outcome.is_none() => match happening? {
                Some(Happening { event: Event::Ended { outcome: how }, .. }) => outcome = Some(how),
                Some(_) => {}
                None => return Err(CliError::failed("the daemon went away; the federation goes on")),
            },
            _ = tokio::signal::ctrl_c() => {
                interrupts += 1;
                // Its stream is not needed: the end is seen above.
                client.stop(name, interrupts > 1).await?;
            }
        }
    }
    let outcome = outcome.unwrap_or(Outcome::Completed);
    succeed(name, &outcome)
}
