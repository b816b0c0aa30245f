//! What commands share: the way to the daemon, the checked manifest, which federation is meant.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::Args;
use ictus_deploy::placement::{SshClient, Way};
use ictus_deploy::{CheckOptions, Checked, Progress, check};
use ictusd::api::{Failure, FailureKind, FederationView, Outcome, StartRequest};
use ictusd::client::Client;
use ictusd::paths::Paths;
use ictusd::store;
use serde_json::json;
use tokio::runtime::Runtime;

use crate::args::ManifestArgs;
use crate::error::{CliError, Kind};
use crate::hosts::{Clients, connect_all, left, others, ways};
use crate::stack::{self, Stack};
use crate::ui::Ui;

/// A command's connection to this user's daemon.
#[derive(Debug)]
pub(crate) struct Session {
    pub(crate) paths: Paths,
    runtime: Runtime,
}

impl Session {
    pub(crate) fn new() -> Result<Self, CliError> {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build();
        let runtime = runtime.map_err(CliError::failed)?;
        Ok(Self {
            paths: Paths::from_env()?,
            runtime,
        })
    }

    /// Runs a command's asynchronous part.
    pub(crate) fn block_on<T>(&self, work: impl Future<Output = T>) -> T {
        self.runtime.block_on(work)
    }

    /// The daemon, started if there is none.
    pub(crate) async fn daemon(&self) -> Result<Client, CliError> {
        let executable = std::env::current_exe().map_err(CliError::failed)?;
        Ok(Client::find_or_start(&self.paths, &executable).await?)
    }

    /// Names of federations that run or have left something, sorted.
    pub(crate) fn known(&self) -> Vec<String> {
        store::names(&self.paths.federations())
    }

    /// The federation that is meant: by name, by manifest, or the only one there is.
    pub(crate) fn name(&self, given: Option<&str>) -> Result<String, CliError> {
        let known = self.known();
        let stacks: Vec<_> = Stack::all(self).into_iter().map(|it| it.name).collect();
        let Some(given) = given else {
            return match (known.as_slice(), stacks.as_slice()) {
                ([only], []) => Ok(only.clone()),
                ([], []) => Err(CliError::failed("there is no federation").hint(UP)),
                ([], [only]) => Err(of_compose(only)),
                _ => Err(CliError::failed("there are several federations: say which")
                    .hint(format!("known: {}", [known, stacks].concat().join(", ")))),
            };
        };
        let is_path = given.contains('/') || given.ends_with(".yaml") || given.ends_with(".yml");
        let name = if is_path || (!known.iter().any(|it| it == given) && Path::new(given).is_file())
        {
            name_in(Path::new(given))?
        } else {
            given.to_owned()
        };
        if known.contains(&name) {
            return Ok(name);
        }
        if stacks.contains(&name) {
            return Err(of_compose(&name));
        }
        let error = CliError::failed(format!("there is no federation `{name}`"));
        Err(match known.as_slice() {
            [] => error.hint(UP),
            _ => error.hint(format!("known: {}", known.join(", "))),
        })
    }
}

/// A command that is not for what docker-compose runs.
fn of_compose(name: &str) -> CliError {
    CliError::failed(format!("docker-compose runs `{name}`"))
        .hint("`ictus ps`, `ictus logs` and `ictus down` are for it")
}

const UP: &str = "`ictus up MANIFEST` starts one";

/// A federation over several hosts that a command means.
#[derive(Debug)]
pub(crate) struct Abroad {
    pub(crate) name: String,
    pub(crate) ways: BTreeMap<String, Way>,
}

impl Abroad {
    /// The daemons of all its hosts.
    pub(crate) async fn clients(&self, session: &Session) -> Result<Clients, CliError> {
        let connected = connect_all(session, &self.ways).await;
        connected
            .into_iter()
            .map(|(host, client)| Ok((host, client?)))
            .collect()
    }
}

/// Which federation is meant, and where to look for it.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct Whereabouts {
    /// A host on which it runs; the others are found from there. May be given several times
    #[arg(long = "host", value_name = "[USER@]HOST")]
    pub(crate) hosts: Vec<String>,
}

impl Whereabouts {
    /// The same as [`Self::find`], for those who are not asynchronous yet.
    pub(crate) fn abroad(
        &self,
        session: &Session,
        given: Option<&str>,
    ) -> Result<Option<Abroad>, CliError> {
        session.block_on(self.find(session, given))
    }

    /// The federation that is meant, when docker-compose runs it on this machine.
    pub(crate) fn stack(&self, session: &Session, given: Option<&str>) -> Option<Stack> {
        let here = self.hosts.is_empty();
        here.then(|| stack::find(session, given)).flatten()
    }

    /// The same, or what is left of one that was taken down.
    pub(crate) fn stack_or_left(&self, session: &Session, given: Option<&str>) -> Option<Stack> {
        let left = || stack::find_left(session, given).filter(|_| self.hosts.is_empty());
        self.stack(session, given).or_else(left)
    }

    /// The hosts that are meant, by `--host` or by a manifest with hosts; absent: this machine.
    pub(crate) async fn find(
        &self,
        session: &Session,
        given: Option<&str>,
    ) -> Result<Option<Abroad>, CliError> {
        if !self.hosts.is_empty() {
            return self.ask(session, given).await.map(Some);
        }
        let manifest = given
            .map(Path::new)
            .filter(|path| path.is_file() || path.is_dir());
        let Some(manifest) = manifest else {
            return Ok(None);
        };
        let checked = unbuilt(manifest)?;
        let abroad = checked.placement.map(|placement| Abroad {
            name: checked.plan.federation,
            ways: ways(&placement),
        });
        Ok(abroad)
    }

    /// Asks the hosts that are given for the others.
    async fn ask(&self, session: &Session, given: Option<&str>) -> Result<Abroad, CliError> {
        let given_ways = self.hosts.iter().map(|target| {
            let way = Way::Ssh {
                target: target.clone(),
                client: SshClient::default(),
                identity: None,
            };
            (target.clone(), way)
        });
        let given_ways: BTreeMap<String, Way> = given_ways.collect();
        let (mut views, mut clients) = (Vec::new(), Vec::new());
        // What was taken down has logs and generations yet.
        let mut names = BTreeSet::new();
        for (_, client) in connect_all(session, &given_ways).await {
            let client = client?;
            views.extend(client.federations().await?);
            names.extend(client.names().await?);
            clients.push(client);
        }
        let running: BTreeSet<&str> = views.iter().map(|view| view.name.as_str()).collect();
        let all: BTreeSet<&str> = names.iter().map(String::as_str).collect();
        let known = if given.is_some() || running.is_empty() {
            all
        } else {
            running
        };
        let known = known.into_iter().collect::<Vec<_>>();
        let name = match (given, known.as_slice()) {
            (Some(given), _) if known.contains(&given) => given.to_owned(),
            (None, [only]) => (*only).to_owned(),
            (None, [_, _, ..]) => {
                return Err(CliError::failed("there are several federations: say which")
                    .hint(format!("known: {}", known.join(", "))));
            }
            (Some(given), _) => {
                let error = CliError::failed(format!("there is no federation `{given}` there"));
                return Err(error.hint(format!("known: {}", known.join(", "))));
            }
            (None, []) => return Err(CliError::failed("there is no federation there")),
        };
        let mut found = others(&views, &name);
        if found.is_empty() {
            found = left(&clients, &name).await;
        }
        if found.values().any(|way| *way == Way::Local) {
            check_here(session, &clients, &name).await?;
        }
        // One that is whole on its host has no record of others.
        let ways = if found.is_empty() { given_ways } else { found };
        Ok(Abroad { name, ways })
    }
}

/// A record that speaks of "this machine" means the one from which it was deployed: that must be this one.
async fn check_here(session: &Session, clients: &[Client], name: &str) -> Result<(), CliError> {
    let runs = async |client: &Client| -> BTreeSet<String> {
        let running = client.federation(name).await.ok().map(|view| view.id);
        let ended = client.history(name).await.unwrap_or_default();
        running
            .into_iter()
            .chain(ended.into_iter().map(|run| run.id))
            .collect()
    };
    let here = runs(&session.daemon().await?).await;
    for client in clients {
        if !runs(client).await.is_disjoint(&here) {
            return Ok(());
        }
    }
    let message =
        format!("federation `{name}` has a part on the machine from which it was started");
    Err(CliError::failed(message).hint("that is not this one: give the command there"))
}

/// A manifest as far as it can be known without building.
pub(crate) fn unbuilt(manifest: &Path) -> Result<Checked, CliError> {
    let manifest = ManifestArgs {
        manifest: manifest.to_path_buf(),
        set: Vec::new(),
    }
    .path()?;
    let options = CheckOptions {
        build: false,
        ..CheckOptions::default()
    };
    Ok(check(&manifest, &options, &mut |_| {})?)
}

/// The federation's name in a manifest.
pub(crate) fn name_in(manifest: &Path) -> Result<String, CliError> {
    Ok(unbuilt(manifest)?.plan.federation)
}

/// Checks a manifest, building its programs, and says so stage by stage.
pub(crate) fn checked(ui: &mut Ui, args: &ManifestArgs, build: bool) -> Result<Checked, CliError> {
    let options = CheckOptions {
        build,
        ..CheckOptions::default()
    };
    checked_as(ui, args, options)
}

/// The same with other options; those of `--set` are added.
pub(crate) fn checked_as(
    ui: &mut Ui,
    args: &ManifestArgs,
    options: CheckOptions,
) -> Result<Checked, CliError> {
    let path = args.path()?;
    let build = options.build;
    let options = CheckOptions {
        overrides: args.set.iter().cloned().collect(),
        ..options
    };
    let start = Instant::now();
    let mut built = Vec::new();
    let checked = check(&path, &options, &mut |progress| match progress {
        Progress::Building { program } => ui.progress("building", &program),
        Progress::Compiled { program, package } => {
            ui.progress("building", &format!("{program}: {package}"));
        }
        Progress::Built {
            program,
            executable,
        } => {
            let took = start.elapsed().as_secs_f64();
            let built_now = format!("{program} in {took:.1} s: {}", executable.display());
            ui.progress("built", &built_now);
            built.push(built_now);
        }
        Progress::Described { program, federates } => {
            ui.progress("checking", &format!("{program}: {federates} federates"));
        }
    });
    let checked = match checked {
        Ok(checked) => checked,
        Err(problems) => {
            // Programs that read results read these, too.
            if ui.json() {
                let answer = json!({ "valid": false, "problems": problems.0, "warnings": [] });
                ui.result(&answer, String::new)?;
            }
            return Err(problems.into());
        }
    };
    for warning in &checked.warnings {
        ui.warning(&warning.to_string());
    }
    let (federates, connections) = (checked.plan.federates.len(), checked.plan.connections.len());
    let what = count(federates, "federate");
    let how = count(connections, "connection");
    let without = if build {
        ""
    } else {
        ", without running its programs"
    };
    ui.stage(
        "checked",
        &format!("{}: {what}, {how}{without}", path.display()),
    );
    for built in &built {
        ui.stage("built", built);
    }
    Ok(checked)
}

/// What the daemon is asked to start.
pub(crate) fn request(checked: &Checked, trace: bool) -> StartRequest {
    let directory = checked
        .manifest
        .parent()
        .map_or_else(PathBuf::new, Path::to_path_buf);
    StartRequest {
        manifest: checked.manifest.clone(),
        cwd: directory,
        plan: checked.plan.clone(),
        federates: checked.federates.clone(),
        settings: checked.settings.clone(),
        timing: checked.timing.clone(),
        trace,
        part: None,
    }
}

/// An outcome as a command's result.
pub(crate) fn succeed(name: &str, outcome: &Outcome) -> Result<(), CliError> {
    match outcome {
        Outcome::Completed | Outcome::Stopped { .. } => Ok(()),
        Outcome::Aborted => Err(CliError::failed(format!(
            "federation `{name}` was not started"
        ))),
        Outcome::Failed {
            failure,
            was_healthy,
        } => Err(failed(name, failure, *was_healthy)),
    }
}

/// The first cause, its own words, and where more of them are.
fn failed(name: &str, failure: &Failure, was_healthy: bool) -> CliError {
    let who = match failure.member.as_deref() {
        Some("rti") => "the RTI".to_owned(),
        Some(member) => format!("federate `{member}`"),
        None => format!("federation `{name}`"),
    };
    let when = if was_healthy {
        ""
    } else {
        "; everything was undone"
    };
    let mut message = format!("{who}: {}{when}", failure.words());
    // Of a run that had been healthy the first words are not the last ones.
    let lines = if was_healthy { &[][..] } else { &failure.lines };
    for line in lines {
        message.push_str(&format!("\n  | {line}"));
    }
    let kind = match failure.kind {
        FailureKind::Timeout => Kind::Timeout,
        FailureKind::Process | FailureKind::Foreign | FailureKind::NewerRecord => Kind::Failed,
    };
    let error = CliError::new(kind, message);
    match &failure.log {
        Some(log) => error.hint(format!("the whole log is {}", log.display())),
        None => error.hint(format!("`ictus logs {name}` shows what the federates said")),
    }
}

/// A future's result, or a time-out that says what was waited for.
pub(crate) async fn within<T>(
    limit: Duration,
    what: &str,
    work: impl Future<Output = Result<T, CliError>>,
) -> Result<T, CliError> {
    tokio::time::timeout(limit, work).await.unwrap_or_else(|_| {
        let message = format!("{what} took longer than {} s", limit.as_secs_f64());
        Err(CliError::new(Kind::Timeout, message).hint("`--timeout` gives it more time"))
    })
}

/// `1 federate`, `2 federates`.
pub(crate) fn count(number: usize, what: &str) -> String {
    if number == 1 {
        format!("1 {what}")
    } else {
        format!("{number} {what}s")
    }
}

/// How long ago something was, as people read it.
pub(crate) fn ago(view: &FederationView) -> String {
    let seconds = ictusd::stamp::now_ns().saturating_sub(view.since_ns) / 1_000_000_000;
    match seconds {
        ..120 => format!("{seconds} s"),
        120..7200 => format!("{} min", seconds / 60),
        _ => format!("{} h", seconds / 3600),
    }
}
