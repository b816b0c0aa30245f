//! A federation that docker-compose runs (`deploy: compose`): the file is kept, and every command runs on it.
//!
//! Only arguments are handed over, and there is no shell.

use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Output, Stdio};
use std::time::Duration;

use ictus_deploy::compose::{Compose, ComposeOptions};
use ictus_deploy::{Checked, Deploy};
use ictusd::blobs;
use ictusd::images::Local;
use ictusd::store;
use tokio::process::Command;

use crate::commands::compose::{load, of, write};
use crate::error::CliError;
use crate::session::{Session, name_in, unbuilt, within};
use crate::ui::Ui;

/// How long docker-compose may take to say its version.
const VERSION_MAX: Duration = Duration::from_secs(30);

/// A federation of this machine that Compose runs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Stack {
    pub(crate) name: String,
    /// Where its file is.
    directory: PathBuf,
}

impl Stack {
    /// Where a federation's file is, or would be.
    pub(crate) fn of(session: &Session, name: &str) -> Self {
        Self {
            name: name.to_owned(),
            directory: directory(session).join(name),
        }
    }

    /// Those whose file is there, sorted.
    pub(crate) fn all(session: &Session) -> Vec<Self> {
        let mut all = Self::known(session);
        all.retain(Self::is_there);
        all
    }

    /// Those that are there or have left something, sorted.
    fn known(session: &Session) -> Vec<Self> {
        let entries = fs::read_dir(directory(session)).into_iter().flatten();
        let names = entries.filter_map(|entry| entry.ok()?.file_name().into_string().ok());
        let mut known: Vec<_> = names.map(|name| Self::of(session, &name)).collect();
        known.sort_by(|a, b| a.name.cmp(&b.name));
        known
    }

    /// Whether it was started and not taken down.
    pub(crate) fn is_there(&self) -> bool {
        self.file().is_file()
    }

    /// Whether anything of it is left, such as its images.
    fn is_known(&self) -> bool {
        self.directory.is_dir()
    }

    /// Where federates write their traces when they are to.
    fn trace(&self) -> PathBuf {
        self.directory.join("trace")
    }

    fn file(&self) -> PathBuf {
        self.directory.join("compose.yaml")
    }

    /// Makes images and file, and starts everything; what does not start is taken away again.
    pub(crate) async fn up(
        &self,
        ui: &mut Ui,
        (checked, trace): (&Checked, bool),
        limit: Duration,
    ) -> Result<(), CliError> {
        let tool = Tool::find().await?;
        let options = ComposeOptions {
            monitoring: false,
            trace: trace.then(|| self.trace()),
        };
        let compose: Compose = of(checked, &options)?;
        self.prepare(trace)?;
        load(ui, &compose).await?;
        write(&self.file(), &compose.text)?;
        let up = tool.run(self, &["up", "--detach", "--remove-orphans"]);
        let started = within(limit, "docker-compose up", up).await;
        if let Err(error) = started {
            ui.stage("undoing", &self.name);
            let undone = match self.down(limit).await {
                Ok(()) => "everything was undone".to_owned(),
                Err(also) => format!("it could not be undone: {also}"),
            };
            return Err(error.hint(undone));
        }
        ui.stage("started", &format!("by {}", tool.name()));
        Ok(())
    }

    fn prepare(&self, trace: bool) -> Result<(), CliError> {
        use std::os::unix::fs::PermissionsExt;
        let directory = if trace {
            self.trace()
        } else {
            self.directory.clone()
        };
        let failed =
            |error| CliError::failed(format!("cannot make {}: {error}", directory.display()));
        fs::create_dir_all(&directory).map_err(failed)?;
        if trace {
            // Federates are other users in their containers; the parent directories are private.
            let open = fs::Permissions::from_mode(0o1777);
            fs::set_permissions(&directory, open).map_err(failed)?;
        }
        Ok(())
    }

    /// Stops and removes containers, network and volumes, and forgets the file; does nothing when that was done.
    pub(crate) async fn down(&self, limit: Duration) -> Result<(), CliError> {
        if !self.is_there() {
            return Ok(());
        }
        let tool = Tool::find().await?;
        let down = tool.run(self, &["down", "--volumes", "--remove-orphans"]);
        within(limit, "docker-compose down", down).await?;
        let failed =
            |error| CliError::failed(format!("cannot remove {}: {error}", self.file().display()));
        fs::remove_file(self.file()).map_err(failed)
    }

    /// Removes its images and its directory.
    pub(crate) async fn purge(&self) -> Result<(), CliError> {
        let engine = Local::connect().await.map_err(CliError::failed)?;
        let removed = engine.remove_of_compose(&self.name).await;
        removed.map_err(CliError::failed)?;
        match fs::remove_dir_all(&self.directory) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                let message = format!("cannot remove {}: {error}", self.directory.display());
                Err(CliError::failed(message))
            }
            Ok(()) | Err(_) => Ok(()),
        }
    }

    /// Runs a command that only shows something, on our own standard output.
    pub(crate) async fn show(
        &self,
        ui: &Ui,
        arguments: &[impl AsRef<OsStr>],
    ) -> Result<(), CliError> {
        if ui.json() {
            let message = format!("docker-compose runs `{}`, and shows it as text", self.name);
            return Err(CliError::failed(message).hint("leave `-o json` out"));
        }
        let tool = Tool::find().await?;
        let mut command = tool.command(self, arguments);
        let status = command.status().await.map_err(CliError::failed)?;
        if status.success() {
            return Ok(());
        }
        Err(CliError::failed(format!(
            "{} failed: {status}",
            tool.name()
        )))
    }

    /// What Compose calls it: lower case only, so that others get a digest.
    fn project(&self) -> String {
        let lower = self.name.to_lowercase();
        if lower == self.name {
            return format!("ictus-{lower}");
        }
        let digest = blobs::digest(self.name.as_bytes()).unwrap_or_default();
        format!("ictus-{lower}-{}", digest.get(..8).unwrap_or_default())
    }
}

fn directory(session: &Session) -> PathBuf {
    session.paths.state.join("compose")
}

/// Compose v2 or docker-compose.
#[derive(Clone, Copy, Debug)]
struct Tool(&'static [&'static str]);

impl Tool {
    /// The first that is there.
    async fn find() -> Result<Self, CliError> {
        for words in [&["docker", "compose"][..], &["docker-compose"]] {
            let tool = Self(words);
            let mut version = tool.bare();
            version
                .arg("version")
                .stdout(Stdio::null())
                .stderr(Stdio::null());
            let status = tokio::time::timeout(VERSION_MAX, version.status()).await;
            if matches!(status, Ok(Ok(status)) if status.success()) {
                return Ok(tool);
            }
        }
        let message = "neither `docker compose` nor `docker-compose` is there";
        Err(CliError::failed(message)
            .hint("install one, for example `sudo apt-get install docker-compose`"))
    }

    fn name(self) -> String {
        self.0.join(" ")
    }

    fn bare(self) -> Command {
        let (program, words) = self.0.split_first().unwrap_or((&"docker-compose", &[]));
        let mut command = Command::new(program);
        command.args(words).stdin(Stdio::null()).kill_on_drop(true);
        command
    }

    fn command(self, stack: &Stack, arguments: &[impl AsRef<OsStr>]) -> Command {
        let mut command = self.bare();
        command.args(["--project-name", &stack.project(), "--file"]);
        command.arg(stack.file()).args(arguments);
        command
    }

    /// Runs a command to its end; its words are the error's.
    async fn run(self, stack: &Stack, arguments: &[&str]) -> Result<(), CliError> {
        let mut command = self.command(stack, arguments);
        let Output { status, stderr, .. } = command.output().await.map_err(CliError::failed)?;
        if status.success() {
            return Ok(());
        }
        let said = String::from_utf8_lossy(&stderr);
        let last: Vec<_> = said
            .lines()
            .filter(|line| !line.trim().is_empty())
            .collect();
        let last = last
            .get(last.len().saturating_sub(10)..)
            .unwrap_or_default();
        let message = format!(
            "{} {}: {status}\n  | {}",
            self.name(),
            arguments.join(" "),
            last.join("\n  | ")
        );
        Err(CliError::failed(message))
    }
}

/// The federation that a command means, when Compose runs it: by name, by manifest, or the only one there is.
pub(crate) fn find(session: &Session, given: Option<&str>) -> Option<Stack> {
    let stack = match given {
        Some(given) => {
            let path = Path::new(given);
            let by_name = Stack::of(session, given);
            if is_name(given) && by_name.is_there() {
                by_name
            } else if path.exists() {
                Stack::of(session, &name_in(path).ok()?)
            } else {
                return None;
            }
        }
        None => match (session.known().as_slice(), Stack::all(session).as_slice()) {
            ([], [only]) => only.clone(),
            _ => return None,
        },
    };
    stack.is_there().then_some(stack)
}

/// The same for one that was taken down and not purged; the daemon's of that name goes before it.
pub(crate) fn find_left(session: &Session, given: Option<&str>) -> Option<Stack> {
    let known = session.known();
    let stack = match given {
        Some(given) if is_name(given) && Stack::of(session, given).is_known() => {
            Stack::of(session, given)
        }
        Some(manifest) => {
            let checked = unbuilt(Path::new(manifest)).ok()?;
            if checked.deploy != Deploy::Compose {
                return None;
            }
            Stack::of(session, &checked.plan.federation)
        }
        None => match Stack::known(session).as_slice() {
            [only] if known.is_empty() => only.clone(),
            _ => return None,
        },
    };
    (stack.is_known() && !known.contains(&stack.name)).then_some(stack)
}

/// Whether it can be a name and not a path.
fn is_name(given: &str) -> bool {
    store::is_name(given) && !given.contains('.')
}
