//! `ictusd swap`: what `ictus host upgrade` has the installed program do on its host. It outlives the connection, tries the
//! program beside it, and takes its own place back when that one does not come up. Where systemd starts the daemon, it does
//! so here, too.

use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use ictusd::client::Client;
use ictusd::daemon::READY;
use ictusd::paths::Paths;
use tokio::io::{AsyncBufReadExt, BufReader};

use crate::error::CliError;
use crate::session::Session;

/// What an upgrade sends, beside the installed program.
pub(crate) const NEW: &str = "ictusd.new";
/// The program before an upgrade, as long as that is under way.
pub(crate) const OLD: &str = "ictusd.old";

/// How long a new daemon may take to serve.
const READY_MAX: Duration = Duration::from_secs(30);

/// Between two looks at whether one serves.
const LOOK_EVERY: Duration = Duration::from_millis(200);
/// What `ictus host add` has systemd start.
const UNIT: &str = "ictusd.service";

/// Why the new program did not take over.
#[derive(Debug)]
struct Broken(String);

pub(crate) fn run() -> Result<(), CliError> {
    // Fails only for a group leader; whoever asked may go away, and this goes on.
    rustix::process::setsid().ok();
    let own = std::env::current_exe().map_err(CliError::failed)?;
    let session = Session::new()?;
    session.block_on(swap(&session.paths, &own))
}

async fn swap(paths: &Paths, own: &Path) -> Result<(), CliError> {
    let beside = |name: &str| -> PathBuf { own.with_file_name(name) };
    let (new, old) = (beside(NEW), beside(OLD));
    let unit = Unit::of(paths).await;
    std::fs::remove_file(&old).ok();
    std::fs::hard_link(own, &old).map_err(CliError::failed)?;
    std::fs::rename(&new, own).map_err(CliError::failed)?;
    let Err(Broken(why)) = take_over(paths, own, unit).await else {
        return std::fs::remove_file(&old).map_err(CliError::failed);
    };
    std::fs::rename(&old, own).map_err(CliError::failed)?;
    let back = match unit {
        Some(unit) => unit.serve(paths).await,
        None => {
            let back = Client::find_or_start(paths, own).await.map(drop);
            back.map_err(|error| Broken(error.to_string()))
        }
    };
    let then = match back {
        Ok(()) => "the one before serves again".to_owned(),
        Err(Broken(error)) => format!("the one before is back, but does not serve: {error}"),
    };
    Err(CliError::failed(format!(
        "the new ictusd does not come up: {why}; {then}"
    )))
}

/// Has the daemon give way, and starts the next one from this program.
async fn take_over(paths: &Paths, program: &Path, unit: Option<Unit>) -> Result<(), Broken> {
    if let Some(client) = Client::find(paths).await {
        let gone = client.give_way().await;
        gone.map_err(|error| Broken(error.to_string()))?;
    }
    match unit {
        Some(unit) => unit.serve(paths).await,
        None => start(paths, program).await,
    }
}

/// systemd's part in the daemon's life, where it has one.
#[derive(Clone, Copy, Debug)]
enum Unit {
    /// Of the user's own manager.
    User,
    /// Of the system's.
    System,
}

impl Unit {
    /// The one that is to start the daemon.
    async fn of(paths: &Paths) -> Option<Self> {
        let unit = if paths.of_host() {
            Self::System
        } else {
            Self::User
        };
        let enabled = unit.systemctl("is-enabled").await;
        enabled.is_ok().then_some(unit)
    }

    /// Starts what is not running, and waits until it serves.
    async fn serve(self, paths: &Paths) -> Result<(), Broken> {
        // One that failed again and again is not started for a while.
        self.systemctl("reset-failed").await.ok();
        self.systemctl("restart").await?;
        let serves = async {
            while Client::find(paths).await.is_none() {
                if self.systemctl("is-failed").await.is_ok() {
                    let why = "it ended as often as systemd started it";
                    return Err(Broken(why.to_owned()));
                }
                tokio::time::sleep(LOOK_EVERY).await;
            }
            Ok(())
        };
        let served = tokio::time::timeout(READY_MAX, serves).await;
        let late = |_| Broken(format!("it did not serve within {} s", READY_MAX.as_secs()));
        served.map_err(late)?
    }

    async fn systemctl(self, verb: &str) -> Result<(), Broken> {
        let whose: &[&str] = match self {
            Self::User => &["--user"],
            Self::System => &[],
        };
        let mut command = tokio::process::Command::new("systemctl");
        command.args(whose).args([verb, UNIT]).stdin(Stdio::null());
        let output = command.output().await;
        let output = output.map_err(|error| Broken(format!("systemctl: {error}")))?;
        if output.status.success() {
            return Ok(());
        }
        let said = String::from_utf8_lossy(&output.stderr).trim().to_owned();
        Err(Broken(format!("`systemctl {verb} {UNIT}`: {said}")))
    }
}

/// Starts a daemon and waits until it serves; one that does not is ended.
async fn start(paths: &Paths, program: &Path) -> Result<(), Broken> {
    paths.create().map_err(|error| Broken(error.to_string()))?;
    let log = std::fs::OpenOptions::new()
        .append(true)
        .create(true)
        .mode(0o600)
        .open(paths.daemon_log());
    let log = log.map_err(|error| Broken(error.to_string()))?;
    let mut command = tokio::process::Command::new(program);
    command
        .arg("daemon")
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(log);
    let mut child = command.spawn().map_err(|error| Broken(error.to_string()))?;
    let mut line = String::new();
    let read = async {
        match child.stdout.take() {
            Some(out) => BufReader::new(out).read_line(&mut line).await.is_ok(),
            None => false,
        }
    };
    let answered = tokio::time::timeout(READY_MAX, read).await;
    if answered.is_ok() && line.trim_end() == READY && Client::find(paths).await.is_some() {
        return Ok(());
    }
    // It may have ended by itself.
    child.kill().await.ok();
    let seconds = READY_MAX.as_secs();
    Err(Broken(match answered {
        Ok(_) => "it ended, or said something else than that it is ready".to_owned(),
        Err(_) => format!("it was not ready within {seconds} s"),
    }))
}
