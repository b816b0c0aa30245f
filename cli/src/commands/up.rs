//! `ictus up`: from a manifest to a healthy federation.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use clap::Args;
use ictus_deploy::{Checked, Deploy, Placement};
use ictusd::api::secret::StartCall;
use ictusd::api::{ErrorCode, Event, Happening, Outcome};
use ictusd::client::{Client, ClientError, Stream, is_already_running};
use ictusd::stamp;

use super::events::{describe, describe_outcome};
use super::logs;
use crate::args::{ManifestArgs, duration};
use crate::error::{CliError, Kind};
use crate::hosts::ways;
use crate::interrupts::Interrupts;
use crate::rollout::{Executor, Rollout, SavedPlan, patience, size};
use crate::secrets::Secrets;
use crate::session::{Session, checked, count, request, succeed};
use crate::stack::Stack;
use crate::ui::Ui;

/// How often `--attach` finds the daemon again before it gives up.
const REATTACH_MAX: u32 = 5;

/// How long undoing a start may take: the daemon's own bounds are shorter.
const UNDO_MAX: Duration = Duration::from_secs(30);

/// Start a federation; returns when it is healthy
///
/// Checks and builds, starts the RTI and every federate where the manifest says, and reports each stage from what they
/// say themselves: processes of this machine, processes or containers of its `hosts`, or services of docker-compose.
/// Ctrl-C before it is healthy undoes everything.
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
    /// Carry out exactly the plan that `ictus plan --out FILE` wrote; refused when a host or the manifest has moved on
    #[arg(long, value_name = "FILE", conflicts_with_all = ["manifest", "set", "trace", "attach"])]
    plan: Option<PathBuf>,
    /// How long it may take to become healthy once it is built
    #[arg(long, value_name = "TIME", default_value = "5m", value_parser = duration)]
    timeout: Duration,
}

/// A start that was asked for.
#[derive(Debug)]
struct Begun {
    client: Client,
    name: String,
    stream: Stream<Happening>,
    interrupts: Interrupts,
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
        if let Some(plan) = &self.plan {
            let saved = SavedPlan::read(plan)?;
            return self.follow_plan(ui, &session, saved);
        }
        let checked = checked(ui, &self.manifest, true)?;
        if checked.deploy == Deploy::Compose {
            return session.block_on(self.compose(ui, &session, &checked));
        }
        if let Some(placement) = &checked.placement {
            let work = self.roll_out(ui, &session, (&checked, placement), None);
            return session.block_on(work);
        }
        let call = StartCall {
            request: request(&checked, self.trace),
            secrets: Secrets::read(&checked.federates).complete()?,
        };
        let name = checked.plan.federation.clone();
        session.block_on(async {
            let interrupts = Interrupts::new()?;
            let client = session.daemon().await?;
            let timing = !checked.timing.is_empty();
            let stream = match client.start_with(&name, &call).await {
                Ok(stream) => stream,
                Err(error) if is_already_running(&error) => {
                    ui.message(&format!("{name} is already running from the same plan"));
                    let said = summary(ui, &client, &name, timing).await;
                    if !self.attach {
                        return said;
                    }
                    let stream = client.events(Some(&name), true).await?;
                    let begun = Begun {
                        client,
                        name,
                        stream,
                        interrupts,
                    };
                    return begun.attach(ui, &session, said).await;
                }
                Err(error) => return Err(refused(error, &name)),
            };
            let begun = Begun {
                client,
                name,
                stream,
                interrupts,
            };
            let of = checked.plan.federates.len();
            let Some(begun) = self.follow(ui, begun, of).await? else {
                return Ok(());
            };
            let said = summary(ui, &begun.client, &begun.name, timing).await;
            if self.attach {
                begun.attach(ui, &session, said).await
            } else {
                said
            }
        })
    }

    /// The same by a plan that was saved.
    fn follow_plan(
        &self,
        ui: &mut Ui,
        session: &Session,
        saved: SavedPlan,
    ) -> Result<(), CliError> {
        let manifest = ManifestArgs {
            manifest: saved.manifest.clone(),
            set: saved.set.clone(),
        };
        let checked = checked(ui, &manifest, true)?;
        let Some(placement) = &checked.placement else {
            let message = format!("{} names no hosts any more", manifest.manifest.display());
            return Err(CliError::new(Kind::Stale, message));
        };
        let work = self.roll_out(ui, session, (&checked, placement), Some(saved));
        session.block_on(work)
    }

    /// The same by docker-compose.
    async fn compose(
        &self,
        ui: &mut Ui,
        session: &Session,
        checked: &Checked,
    ) -> Result<(), CliError> {
        if self.attach {
            let message = "`--attach` is for federations that the daemon starts";
            return Err(CliError::failed(message).hint("`ictus logs -f` shows what they say"));
        }
        let name = &checked.plan.federation;
        let stack = Stack::of(session, name);
        stack.up(ui, (checked, self.trace), self.timeout).await?;
        ui.result(&serde_json::json!({ "federation": name }), || {
            let federates = count(checked.federates.len(), "federate");
            format!(
                "{name} was started: {federates}\n  ictus ps {name}\n  ictus logs -f {name}\n  ictus down {name}"
            )
        })
    }

    /// The same over the manifest's hosts.
    async fn roll_out(
        &self,
        ui: &mut Ui,
        session: &Session,
        (checked, placement): (&Checked, &Placement),
        saved: Option<SavedPlan>,
    ) -> Result<(), CliError> {
        if self.attach {
            let message = "`--attach` is for federations of this machine";
            return Err(CliError::failed(message).hint("`ictus logs -f` shows what they say"));
        }
        // Before anybody is asked for anything.
        Secrets::read(&checked.federates).complete()?;
        let since = Instant::now();
        let mut interrupts = Interrupts::new()?;
        let trace = saved.as_ref().map_or(self.trace, |saved| saved.trace);
        let name = &checked.plan.federation;
        let mut rollout = match Rollout::new(session, checked, placement, trace).await {
            Err(refusal) if refusal.kind == Kind::Held => {
                let at = (name.as_str(), &ways(placement));
                patience::outlive(ui, session, at, &mut interrupts, refusal).await?;
                Rollout::new(session, checked, placement, trace).await?
            }
            rollout => rollout?,
        };
        if let Some(saved) = saved {
            rollout.follow(saved)?;
        }
        if rollout.is_done() {
            ui.message(&format!("{name} is already running from the same manifest"));
        } else {
            ui.stage(
                "planned",
                rollout.plan.to_string().lines().next().unwrap_or(name),
            );
            let executor = Executor::up(rollout)?;
            let verdict = executor.run(ui, &mut interrupts, self.timeout).await?;
            let mut detail = format!("after {:.1} s", since.elapsed().as_secs_f64());
            if let Some(commit) = verdict.commit {
                detail.push_str(&format!(", {:.1} s from commit", commit.as_secs_f64()));
            }
            detail.push_str(&format!(", {} sent", size(verdict.sent)));
            ui.stage("healthy", &detail);
        }
        let hosts = placement.hosts.iter().map(|host| host.name.clone());
        let hosts: Vec<_> = hosts.collect();
        let manifest = match self.plan {
            Some(_) => checked.manifest.display(),
            None => self.manifest.manifest.display(),
        };
        ui.result(&serde_json::json!({ "federation": name, "hosts": hosts }), || {
            let federates = count(checked.federates.len(), "federate");
            format!(
                "{name} runs: {federates} on {}\n  ictus ps {manifest}\n  ictus logs -f {manifest}\n  ictus down {manifest}",
                hosts.join(", ")
            )
        })
    }

    /// Waits until it is healthy; nothing is left to do when it has ended by itself.
    async fn follow(
        &self,
        ui: &mut Ui,
        mut begun: Begun,
        of: usize,
    ) -> Result<Option<Begun>, CliError> {
        let since = Instant::now();
        match begun.wait(ui, self.timeout, of).await? {
            Start::Healthy => {}
            Start::Ended(outcome) => {
                ui.stage("ended", &describe_outcome(&outcome));
                return succeed(&begun.name, &outcome).map(|()| None);
            }
            Start::Interrupted => {
                let message = format!("federation `{}` was not started", begun.name);
                begun.undo(ui).await?;
                return Err(CliError::failed(message));
            }
            Start::TooLate => {
                let (name, seconds) = (begun.name.clone(), self.timeout.as_secs_f64());
                begun.undo(ui).await?;
                let message = format!("federation `{name}` was not healthy within {seconds} s");
                return Err(CliError::new(Kind::Timeout, message)
                    .hint("everything was undone; `--timeout` gives it more time"));
            }
        }
        ui.stage(
            "healthy",
            &format!("after {:.1} s", since.elapsed().as_secs_f64()),
        );
        Ok(Some(begun))
    }
}

impl Begun {
    /// Reports stages until it is healthy, or will not be.
    async fn wait(&mut self, ui: &mut Ui, limit: Duration, of: usize) -> Result<Start, CliError> {
        let mut stages = Stages::new(of);
        let deadline = tokio::time::sleep(limit);
        tokio::pin!(deadline);
        loop {
            let happening = tokio::select! {
                next = self.stream.next() => next?,
                _ = self.interrupts.recv() => return Ok(Start::Interrupted),
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

    /// Has the daemon undo the start and waits for it; a second Ctrl-C does not wait.
    async fn undo(mut self, ui: &mut Ui) -> Result<(), CliError> {
        ui.stage("undoing", &self.name);
        self.client.stop(&self.name, false).await?;
        let stream = &mut self.stream;
        let ended = async {
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
            _ = self.interrupts.recv() => {}
        }
        Ok(())
    }

    /// Shows logs until the federation ends; the first Ctrl-C stops it, the second kills it. A daemon that goes away is
    /// followed by the next. `said` tells whether anybody reads.
    async fn attach(
        mut self,
        ui: &mut Ui,
        session: &Session,
        said: Result<(), CliError>,
    ) -> Result<(), CliError> {
        let mut shown = Shown::default();
        match said {
            // Found again below.
            Err(error) if error.daemon_gone() => {}
            Err(error) => self.nobody_reads(&mut shown, error).await?,
            Ok(()) => {}
        }
        let mut found_again = 0;
        loop {
            match self.show(ui, &mut shown).await {
                Ok(outcome) => return succeed(&self.name, &outcome),
                Err(error) if error.daemon_gone() && found_again < REATTACH_MAX => {
                    found_again += 1;
                    ui.message("the daemon went away; attached to the next one");
                    self.client = session.daemon().await?;
                    self.stream = self.client.events(Some(&self.name), true).await?;
                }
                Err(error) => return Err(error),
            }
        }
    }

    /// Stops the federation when standard output is closed, as if it were a terminal.
    async fn nobody_reads(&mut self, shown: &mut Shown, error: CliError) -> Result<(), CliError> {
        if error.kind != Kind::BrokenPipe {
            return Err(error);
        }
        (shown.unread, shown.stopping) = (true, true);
        self.client.stop(&self.name, false).await?;
        Ok(())
    }

    async fn show(&mut self, ui: &mut Ui, shown: &mut Shown) -> Result<Outcome, CliError> {
        let tail = shown.again.then_some(0);
        let mut lines = self.client.logs(&self.name, &[], true, tail).await?;
        let (mut more, mut outcome) = (true, None);
        loop {
            if let Some(outcome) = outcome.take_if(|_| !more || shown.unread) {
                return Ok(outcome);
            }
            tokio::select! {
                line = lines.next(), if more => match line? {
                    Some(_) if shown.unread => {}
                    Some(line) => {
                        shown.again = true;
                        if let Err(error) = shown.printer.print(ui, &line) {
                            self.nobody_reads(shown, error).await?;
                        }
                    }
                    None => more = false,
                },
                happening = self.stream.next(), if outcome.is_none() => match happening? {
                    Some(Happening { event: Event::Ended { outcome: how }, .. }) => outcome = Some(how),
                    Some(_) => {}
                    None => return Err(CliError::new(Kind::DaemonGone, "the daemon went away")),
                },
                () = self.interrupts.recv() => {
                    let kill = std::mem::replace(&mut shown.stopping, true);
                    ui.message(if kill { "killing" } else { "stopping; again kills" });
                    // Its stream is not needed: the end is seen above.
                    self.client.stop(&self.name, kill).await?;
                }
            }
        }
    }
}

/// What `--attach` has shown and done, whichever daemon serves it.
#[derive(Debug, Default)]
struct Shown {
    printer: logs::Printer,
    /// Its first lines were shown already.
    again: bool,
    /// Standard output is closed.
    unread: bool,
    stopping: bool,
}

async fn summary(ui: &mut Ui, client: &Client, name: &str, timing: bool) -> Result<(), CliError> {
    let view = client.federation(name).await?;
    ui.result(&view, || {
        let federates = count(view.federates.len(), "federate");
        let port = view
            .rti_port
            .map(|port| format!(", RTI on 127.0.0.1:{port}"));
        let port = port.unwrap_or_default();
        let timing = if timing {
            format!("\n  ictus timing {name}")
        } else {
            String::new()
        };
        format!(
            "{name} runs: {federates}{port}\n  ictus ps\n  ictus logs -f {name}{timing}\n  ictus down {name}"
        )
    })
}

fn refused(error: ClientError, name: &str) -> CliError {
    let conflict = error
        .refusal()
        .is_some_and(|refusal| refusal.code == ErrorCode::Conflict);
    let error = CliError::from(error);
    if conflict {
        return error.hint(format!("`ictus down {name}` stops the one that runs"));
    }
    error
}

/// How far everybody is. Members are heard independently of each other; the stages are said in order all the same.
#[derive(Debug)]
struct Stages {
    of: usize,
    /// The first stage that is not reached.
    at: Stage,
    port: Option<u16>,
    started: usize,
    joined: usize,
    start_ns: Option<i64>,
    /// Federates that have completed their first tag, of those that say so.
    running: (usize, usize),
}

#[derive(Clone, Copy, Debug)]
enum Stage {
    Listening,
    Started,
    Joined,
    Agreed,
    Running,
    Done,
}

impl Stages {
    fn new(of: usize) -> Self {
        let (port, start_ns) = (None, None);
        Self {
            of,
            at: Stage::Listening,
            port,
            started: 0,
            joined: 0,
            start_ns,
            running: (0, of),
        }
    }

    fn report(&mut self, ui: &mut Ui, event: &Event) {
        match event {
            Event::Started { member, .. } if member == "rti" => {}
            Event::Started { started, .. } => self.started = *started,
            Event::Listening { port } => self.port = Some(*port),
            Event::Joined { joined, .. } => self.joined = *joined,
            Event::StartTag { start_ns } => self.start_ns = Some(*start_ns),
            Event::Running { running, of, .. } => self.running = (*running, *of),
            Event::Healthy | Event::Ended { .. } => {}
            // A refused stranger or a federate that ended: said now, decided by the daemon.
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
            | Event::Foreign { .. } => ui.stage("", &describe(event)),
        }
        while self.advance(ui) {}
    }

    /// Says the first stage that is not reached, or that it is; true when another may be.
    fn advance(&mut self, ui: &mut Ui) -> bool {
        let (next, reached) = match self.at {
            Stage::Listening => {
                let Some(port) = self.port else { return false };
                ui.stage(
                    "started",
                    &format!("the RTI, listening on 127.0.0.1:{port}"),
                );
                (Stage::Started, true)
            }
            Stage::Started => (Stage::Joined, ui.counted("started", self.started, self.of)),
            Stage::Joined => (Stage::Agreed, ui.counted("joined", self.joined, self.of)),
            Stage::Agreed => {
                let Some(start_ns) = self.start_ns else {
                    return false;
                };
                ui.stage(
                    "agreed",
                    &format!("on the start tag {}", stamp::text(start_ns)),
                );
                (Stage::Running, true)
            }
            Stage::Running => {
                let (running, of) = self.running;
                (Stage::Done, ui.counted("running", running, of))
            }
            Stage::Done => return false,
        };
        if reached {
            self.at = next;
        }
        reached
    }
}
