//! Runs of a federation under names of their own, from start to the end of their timeout.

use std::path::PathBuf;
use std::process::Stdio;
use std::time::Duration;

use ictus_coord::plan::Plan;
use ictus_deploy::Checked;
use ictusd::api::recorded::FileKind;
use ictusd::api::secret::StartCall;
use ictusd::api::{Event, Happening, Outcome, StartRequest};
use ictusd::store::Directory;

use crate::error::{CliError, Kind};
use crate::hosts::copied::Copied;
use crate::interrupts::Interrupts;
use crate::secrets::Secrets;
use crate::session::{Abroad, Session, request, succeed};
use crate::ui::Ui;

mod abroad;

/// How much longer than its timeout a run may take: start, consensus, slow reactions.
const SLACK: Duration = Duration::from_secs(60);

/// Where a run's files are; copies of other hosts' are removed with this.
#[derive(Debug)]
pub(crate) struct Files {
    pub(crate) trace: PathBuf,
    pub(crate) timing: PathBuf,
    /// Kept for what it removes.
    _copied: Option<Copied>,
}

/// Runs that are removed when this is.
#[derive(Debug)]
pub(crate) struct Runs<'a> {
    session: &'a Session,
    checked: &'a Checked,
    limit: Duration,
    interrupts: Interrupts,
    names: Vec<String>,
    /// Runs over hosts.
    abroad: Vec<Abroad>,
    /// The run that failed: its logs stay.
    failed: Option<String>,
}

impl<'a> Runs<'a> {
    /// Prepares runs of a federation that ends by itself.
    pub(crate) async fn new(session: &'a Session, checked: &'a Checked) -> Result<Self, CliError> {
        let timeout = checked
            .plan
            .timeout_ns
            .and_then(|ns| u64::try_from(ns).ok());
        let Some(timeout) = timeout else {
            let message = format!(
                "{} has no timeout, so it never ends",
                checked.manifest.display()
            );
            return Err(CliError::new(Kind::Manifest, message).hint("add a line `timeout: 10 s`"));
        };
        let limit = Duration::from_nanos(timeout).saturating_add(SLACK);
        Ok(Self {
            session,
            checked,
            limit,
            interrupts: Interrupts::new()?,
            names: Vec::new(),
            abroad: Vec::new(),
            failed: None,
        })
    }

    /// Runs the federation once, by a plan of it, on this machine or over its hosts; gives what it left.
    pub(crate) async fn federated(&mut self, plan: &Plan, trace: bool) -> Result<Files, CliError> {
        let own = &self.checked.plan.federation;
        let number = self.names.len() + self.abroad.len() + 1;
        let name = format!("{own}.{}.{number}", std::process::id());
        if let Some(placement) = &self.checked.placement {
            return self.over_hosts(&name, (plan, placement), trace).await;
        }
        // Asked for anew each time: one that has owned nothing for long may have ended.
        let client = self.session.daemon().await?;
        let call = StartCall {
            request: StartRequest {
                plan: plan.clone(),
                ..request(self.checked, trace)
            },
            secrets: Secrets::read(&self.checked.federates).complete()?,
        };
        let mut stream = client.start_with(&name, &call).await?;
        self.names.push(name.clone());
        let outcome = async {
            while let Some(Happening { event, .. }) = stream.next().await? {
                if let Event::Ended { outcome } = event {
                    return Ok(outcome);
                }
            }
            Err(CliError::failed("the daemon went away"))
        };
        let outcome = self.bounded(outcome).await?;
        if let Err(error) = succeed(&name, &outcome) {
            self.failed = Some(name);
            return Err(error);
        }
        if outcome != Outcome::Completed {
            return Err(CliError::failed(format!(
                "run `{name}` was stopped from outside"
            )));
        }
        Ok(Files::of(self.session, &name))
    }

    /// Runs a whole plan in one process; gives the directory of its trace.
    pub(crate) async fn in_one_process(&mut self, plan: &Plan) -> Result<PathBuf, CliError> {
        let Some(program) = &self.checked.one_program else {
            let message = "the federation cannot run in one process";
            return Err(CliError::failed(message)
                .hint("every federate must come from the same program, and none may be foreign"));
        };
        let name = format!(
            "{}.{}.one",
            self.checked.plan.federation,
            std::process::id()
        );
        self.names.push(name.clone());
        let directory = Directory::of(&self.session.paths.federations(), &name);
        directory
            .prepare(&StartRequest {
                plan: plan.clone(),
                ..request(self.checked, true)
            })
            .map_err(CliError::failed)?;
        let log = directory.logs().join("one.log");
        let out = std::fs::File::create(&log).map_err(CliError::failed)?;
        let err = out.try_clone().map_err(CliError::failed)?;
        let mut command = tokio::process::Command::new(program);
        command
            .arg("--plan")
            .arg(directory.plan())
            .arg("--trace")
            .arg(directory.trace());
        for run in &self.checked.federates {
            command.envs(&run.env);
        }
        let cwd = self
            .checked
            .manifest
            .parent()
            .unwrap_or(std::path::Path::new("/"));
        command
            .current_dir(cwd)
            .stdin(Stdio::null())
            .stdout(out)
            .stderr(err)
            .kill_on_drop(true);
        let mut child = command.spawn().map_err(CliError::failed)?;
        let status = self
            .bounded(async { child.wait().await.map_err(CliError::failed) })
            .await?;
        if status.success() {
            return Ok(directory.trace());
        }
        let said = std::fs::read_to_string(&log).unwrap_or_default();
        let mut message = format!("the run in one process failed: {status}");
        for line in said.lines().take(20) {
            message.push_str(&format!("\n  | {line}"));
        }
        Err(CliError::failed(message))
    }

    /// Removes what the runs left, the logs of a failed one apart, and lets the daemon end if it has nothing else to do.
    pub(crate) async fn remove(self, ui: &mut Ui) {
        let failed = self.failed.clone();
        for abroad in &self.abroad {
            let purge = failed.as_ref() != Some(&abroad.name);
            if let Err(error) = abroad::take_down(self.session, abroad, purge).await {
                ui.warning(&format!("run `{}` was not removed: {error}", abroad.name));
            }
        }
        if self.names.is_empty() {
            return;
        }
        let client = match self.session.daemon().await {
            Ok(client) => client,
            Err(error) => return ui.warning(&format!("runs were not removed: {error}")),
        };
        for name in &self.names {
            let purge = self.failed.as_ref() != Some(name);
            if let Err(error) = client.remove(name, purge).await {
                ui.warning(&format!("run `{name}` was not removed: {error}"));
            }
        }
        // It ends by itself otherwise.
        client.end().await.ok();
    }

    async fn bounded<T>(
        &mut self,
        work: impl Future<Output = Result<T, CliError>>,
    ) -> Result<T, CliError> {
        tokio::select! {
            result = tokio::time::timeout(self.limit, work) => result.unwrap_or_else(|_| {
                let seconds = self.limit.as_secs();
                Err(CliError::new(Kind::Timeout, format!("a run did not end within {seconds} s")))
            }),
            () = self.interrupts.recv() => Err(CliError::failed("interrupted")),
        }
    }
}

impl Files {
    /// Those of a run on this machine.
    pub(crate) fn of(session: &Session, name: &str) -> Self {
        let directory = Directory::of(&session.paths.federations(), name);
        Self {
            trace: directory.trace(),
            timing: directory.timing(),
            _copied: None,
        }
    }

    /// Those that were copied from other hosts.
    fn copied(copied: Copied) -> Self {
        Self {
            trace: copied.path(FileKind::Trace),
            timing: copied.path(FileKind::Timing),
            _copied: Some(copied),
        }
    }
}
