//! A private state directory, a daemon in it, and federations of fake federates.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader};
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use ictus_coord::plan::{FederatePlan, Plan};
use ictus_deploy::{FederateKind, FederateRun, Settings, TimingSpec};
use ictusd::api::{Event, Happening, Outcome, StartRequest};
use ictusd::client::{Client, Stream};
use ictusd::paths::{Owner, Paths};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::process::{Pid, PidfdFlags, Signal, kill_process, pidfd_open, pidfd_send_signal};
use tempfile::TempDir;

/// How long any one thing may take.
pub(crate) const BOUND: Duration = Duration::from_secs(20);
/// A daemon's own sockets: for its user, and for those who may only look.
pub(crate) const OWN_SOCKETS: usize = 2;

pub(crate) fn fakes() -> &'static Path {
    Path::new(env!("CARGO_BIN_EXE_ictusd-fakes"))
}

/// A process that is watched through its pidfd.
#[derive(Debug)]
pub(crate) struct Process {
    pub(crate) pid: u32,
    pidfd: OwnedFd,
}

impl Process {
    pub(crate) fn of(pid: u32) -> Self {
        let raw = Pid::from_raw(i32::try_from(pid).unwrap()).unwrap();
        Self {
            pid,
            pidfd: pidfd_open(raw, PidfdFlags::empty()).unwrap(),
        }
    }

    pub(crate) fn kill(&self) {
        pidfd_send_signal(&self.pidfd, Signal::KILL).unwrap();
    }

    pub(crate) fn stop(&self) {
        pidfd_send_signal(&self.pidfd, Signal::STOP).unwrap();
    }

    pub(crate) fn go_on(&self) {
        pidfd_send_signal(&self.pidfd, Signal::CONT).unwrap();
    }

    pub(crate) fn ended(&self, within: Duration) -> bool {
        let bound = Timespec::try_from(within).unwrap();
        let mut fds = [PollFd::new(&self.pidfd, PollFlags::IN)];
        poll(&mut fds, Some(&bound)).unwrap() == 1
    }

    #[track_caller]
    pub(crate) fn assert_ends(&self) {
        assert!(self.ended(BOUND), "process {} lives on", self.pid);
    }

    #[track_caller]
    pub(crate) fn assert_lives(&self) {
        assert!(
            !self.ended(Duration::ZERO),
            "process {} has ended",
            self.pid
        );
    }
}

/// A daemon that is killed with the test, and what it supervises with it.
#[derive(Debug)]
pub(crate) struct World {
    pub(crate) paths: Paths,
    pub(crate) daemon: Child,
    pub(crate) client: Client,
    program: Program,
    _directory: TempDir,
}

/// What the daemon is, and where it finds its Docker engine.
#[derive(Clone, Debug)]
pub(crate) struct Program {
    pub(crate) executable: PathBuf,
    pub(crate) engine: Option<PathBuf>,
}

impl Default for Program {
    fn default() -> Self {
        Self {
            executable: fakes().to_path_buf(),
            engine: None,
        }
    }
}

impl World {
    pub(crate) async fn new() -> Self {
        Self::of(Program::default()).await
    }

    pub(crate) async fn of(program: Program) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let state = directory.path().join("ictus");
        let paths = Paths {
            run: state.join("run"),
            state,
            owner: Owner::User,
        };
        let daemon = spawn(&program, &paths, "60000");
        let client = Client::find(&paths).await.unwrap();
        Self {
            paths,
            daemon,
            client,
            program,
            _directory: directory,
        }
    }

    /// SIGKILLs the daemon and starts another one.
    pub(crate) async fn replace_daemon(&mut self) {
        self.kill_daemon();
        self.replace_daemon_after_end().await;
    }

    pub(crate) async fn replace_daemon_after_end(&mut self) {
        self.daemon = spawn(&self.program, &self.paths, "60000");
        self.client = Client::find(&self.paths).await.unwrap();
    }

    pub(crate) fn kill_daemon(&mut self) {
        self.daemon.kill().unwrap();
        self.daemon.wait().unwrap();
    }

    /// Starts a federation and waits until it is healthy; gives its processes by name.
    pub(crate) async fn start_healthy(&self, name: &str, request: &StartRequest) -> Started {
        let mut stream = self.client.start(name, request).await.unwrap();
        let mut processes = BTreeMap::new();
        loop {
            match next(&mut stream).await.event {
                Event::Started { member, pid, .. } => {
                    processes.insert(member, Process::of(pid));
                }
                Event::Healthy => return Started { processes, stream },
                Event::Ended { outcome } => panic!("not healthy: {outcome:?}"),
                _ => {}
            }
        }
    }

    pub(crate) fn directory(&self, name: &str) -> PathBuf {
        self.paths.federations().join(name)
    }

    pub(crate) fn record(&self, name: &str) -> serde_json::Value {
        let text = std::fs::read(self.directory(name).join("record.json")).unwrap();
        serde_json::from_slice(&text).unwrap()
    }
}

impl Drop for World {
    fn drop(&mut self) {
        self.daemon.kill().ok();
        self.daemon.wait().ok();
        for name in ictusd::store::names(&self.paths.federations()) {
            let record = std::fs::read(self.directory(&name).join("record.json"));
            let record = record
                .ok()
                .and_then(|text| serde_json::from_slice(&text).ok());
            let record: serde_json::Value = record.unwrap_or_default();
            let members = record["members"].as_object().cloned().unwrap_or_default();
            for (_, member) in members {
                let identity = serde_json::from_value(member["supervisor"].clone());
                let identity: Result<ictusd::identity::ProcessIdentity, _> = identity;
                if let Ok(identity) = identity
                    && identity.lives()
                {
                    // Its federate dies with it.
                    let pid = i32::try_from(identity.pid).ok().and_then(Pid::from_raw);
                    pid.and_then(|pid| kill_process(pid, Signal::KILL).ok());
                }
            }
        }
    }
}

/// A healthy federation.
#[derive(Debug)]
pub(crate) struct Started {
    pub(crate) processes: BTreeMap<String, Process>,
    pub(crate) stream: Stream<Happening>,
}

pub(crate) fn spawn_daemon(paths: &Paths, idle_ms: &str) -> Child {
    spawn(&Program::default(), paths, idle_ms)
}

fn spawn(program: &Program, paths: &Paths, idle_ms: &str) -> Child {
    let mut command = Command::new(&program.executable);
    command
        .arg("daemon")
        .env_clear()
        .env("ICTUS_STATE_DIR", &paths.state);
    command.env(ictusd::daemon::IDLE_VARIABLE, idle_ms);
    if let Some(engine) = &program.engine {
        command.env("DOCKER_HOST", format!("unix://{}", engine.display()));
    }
    if paths.run != paths.state.join("run") {
        // As a login session would: STATE is below its parent, RUN too.
        command.env_remove("ICTUS_STATE_DIR");
        command.env("XDG_STATE_HOME", paths.state.parent().unwrap());
        command.env("XDG_RUNTIME_DIR", paths.run.parent().unwrap());
    }
    let mut child = command
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap())
        .read_line(&mut line)
        .unwrap();
    assert_eq!(line.trim_end(), ictusd::daemon::READY);
    child
}

/// The next event; the stream must not end before.
pub(crate) async fn next(stream: &mut Stream<Happening>) -> Happening {
    let next = tokio::time::timeout(BOUND, stream.next()).await;
    next.expect("in time")
        .unwrap()
        .expect("an event before the end of the stream")
}

pub(crate) async fn outcome(stream: &mut Stream<Happening>) -> Outcome {
    loop {
        if let Event::Ended { outcome } = next(stream).await.event {
            return outcome;
        }
    }
}

/// A federation of fake federates: names and manners.
pub(crate) fn federation(members: &[(&str, &str)]) -> StartRequest {
    let plan = |(name, _): &(&str, &str)| FederatePlan {
        name: (*name).to_owned(),
        class: Some("Fake".to_owned()),
        program: Some("fakes".to_owned()),
        ..FederatePlan::default()
    };
    let run = |((name, manner), id): (&(&str, &str), u16)| FederateRun {
        id,
        name: (*name).to_owned(),
        executable: fakes().to_path_buf(),
        kind: FederateKind::Ours,
        env: BTreeMap::from([("FAKE".to_owned(), (*manner).to_owned())]),
        needs: ictus_deploy::Needs::default(),
        portable: false,
    };
    StartRequest {
        manifest: PathBuf::from("/m/federation.yaml"),
        cwd: PathBuf::from("/"),
        plan: Plan {
            federation: "fake".to_owned(),
            extensions: true,
            federates: members.iter().map(plan).collect(),
            ..Plan::default()
        },
        federates: members.iter().zip(0..).map(run).collect(),
        settings: Settings {
            stop_grace: Duration::from_secs(1),
            ..Settings::default()
        },
        timing: TimingSpec::default(),
        trace: true,
        part: None,
    }
}
