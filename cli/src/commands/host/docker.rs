//! `ictus host add --install-docker`: an engine that the host's ictusd may use, on Debian and Ubuntu. Each step is an argv of
//! constant words; none goes through a script.

use std::time::{Duration, Instant};

use ictus_deploy::ssh::{Connection, Options};
use ictusd::api::part::HostFacts;

use super::root::{By, holds, powerless};
use super::{At, run};
use crate::error::CliError;
use crate::hosts::unreachable_host;
use crate::session::Session;
use crate::ui::Ui;

/// Where engines listen.
const SOCKET: &str = "/var/run/docker.sock";
/// Where programs of the system are, also for whoever is not root.
const PATH: &str = "PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin";
/// How long one step may take: it may load 100 MB over a slow line.
const STEP_MAX: Duration = Duration::from_mins(30);
/// How long an engine or the next ictusd may take to answer.
const ANSWER_MAX: Duration = Duration::from_secs(60);
const ANSWER_PERIOD: Duration = Duration::from_millis(200);

/// What a host whose ictusd cannot use the engine has of one.
#[derive(Clone, Copy, Debug)]
struct Seen<'a> {
    /// The text of `/etc/os-release`; empty when there is none.
    os_release: &'a str,
    /// Whether the engine's program is installed.
    program: bool,
    socket: Socket,
    /// Whether its daemon runs as root, which needs nobody's leave.
    root: bool,
}

/// Where an engine listens, as whoever logs in finds it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Socket {
    Absent,
    Denied,
    Open,
}

/// What root is to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Step {
    Update,
    Install,
    /// Lets the user in.
    Join,
    /// Only if the engine does not answer by then.
    Start,
}

/// A host that gets an engine.
struct Installer<'a> {
    host: &'a str,
    connection: Connection,
    /// The user that its ictusd runs as.
    user: &'a str,
    by: Option<By>,
}

/// Sees to an engine, and to an ictusd that may use it.
pub(super) async fn install(ui: &mut Ui, session: &Session, at: &At) -> Result<(), CliError> {
    let client = at.daemon(session).await?;
    let facts = client.host().await?;
    if let Ok(docker) = &facts.docker {
        let version = &docker.version;
        ui.stage(
            "docker",
            &format!("{}: version {version} is there", at.host),
        );
        return Ok(());
    }
    let installer = Installer::open(at, &facts).await?;
    let steps = installer.steps(facts.gives.uid == 0).await?;
    let now = steps.iter().filter(|step| **step != Step::Start);
    for step in now {
        installer.perform(ui, *step, &steps).await?;
    }
    let root = facts.gives.uid == 0;
    let before = client.info().await?.pid;
    if !root {
        // Only a new login is of the group.
        client.give_way().await?;
    }
    let mut facts = asked(at, session, |pid, _| root || pid != before).await?;
    if facts.docker.is_err() && steps.contains(&Step::Start) {
        installer.perform(ui, Step::Start, &[Step::Start]).await?;
        facts = asked(at, session, |_, facts| facts.docker.is_ok()).await?;
    }
    match facts.docker {
        Ok(_) => Ok(()),
        Err(why) => Err(CliError::failed(format!("host `{}`: {why}", at.host))),
    }
}

/// What the host says once it is enough, or when the time is up.
async fn asked(
    at: &At,
    session: &Session,
    enough: impl Fn(u32, &HostFacts) -> bool,
) -> Result<HostFacts, CliError> {
    let end = Instant::now() + ANSWER_MAX;
    loop {
        let answer = async {
            let client = at.daemon(session).await?;
            Ok::<_, CliError>((client.info().await?.pid, client.host().await?))
        };
        let late = Instant::now() >= end;
        match answer.await {
            Ok((pid, facts)) if late || enough(pid, &facts) => return Ok(facts),
            Err(error) if late => return Err(error),
            // The one before may be about to end.
            Ok(_) | Err(_) => tokio::time::sleep(ANSWER_PERIOD).await,
        }
    }
}

impl<'a> Installer<'a> {
    async fn open(at: &'a At, facts: &'a HostFacts) -> Result<Self, CliError> {
        let options = Options {
            command_timeout: STEP_MAX,
            ..at.options()
        };
        let connection = Connection::open(&at.target()?, &options).await;
        let connection = connection.map_err(|error| unreachable_host(&at.host, &error))?;
        let mut installer = Self {
            host: &at.host,
            connection,
            user: &facts.user,
            by: None,
        };
        installer.by = By::of(installer.host, &installer.connection).await?;
        Ok(installer)
    }

    async fn is_true(&self, command: &[&str]) -> Result<bool, CliError> {
        holds(self.host, &self.connection, command).await
    }

    /// Looks, and decides.
    async fn steps(&self, root: bool) -> Result<Vec<Step>, CliError> {
        let os_release = self.connection.run(&["cat", "/etc/os-release"], &[]).await;
        let os_release = os_release.map_err(|error| unreachable_host(self.host, &error))?;
        let os_release = String::from_utf8_lossy(&os_release.stdout);
        let socket = if !self.is_true(&["test", "-S", SOCKET]).await? {
            Socket::Absent
        } else if self.is_true(&["test", "-w", SOCKET]).await? {
            Socket::Open
        } else {
            Socket::Denied
        };
        let seen = Seen {
            os_release: &os_release,
            program: self.is_true(&["env", PATH, "dockerd", "--version"]).await?,
            socket,
            root,
        };
        steps(&seen).map_err(|distribution| {
            let what = format!(
                "host `{}` runs {distribution}: Docker is installed from here on Debian and Ubuntu only",
                self.host
            );
            CliError::failed(what).hint(format!(
                "install it there (docs.docker.com/engine/install), let the user in (`sudo usermod -aG docker {}`), then \
                 run this again",
                self.user
            ))
        })
    }

    /// Does one of `all` as root.
    async fn perform(&self, ui: &mut Ui, step: Step, all: &[Step]) -> Result<(), CliError> {
        let Some(by) = self.by else {
            return Err(self.powerless(all));
        };
        let command = by.command(&step.command(self.user));
        ui.stage("as root", &format!("{}: {}", self.host, command.join(" ")));
        let done = run(self.host, &self.connection, &command).await;
        match (done, step) {
            // What it knew before may do.
            (Err(error), Step::Update) => {
                ui.warning(&error.to_string());
                Ok(())
            }
            (Err(error), Step::Install | Step::Join | Step::Start) => Err(error),
            (Ok(_), _) => Ok(()),
        }
    }

    fn powerless(&self, steps: &[Step]) -> CliError {
        let what = powerless(self.host, &self.connection);
        let commands = steps.iter().map(|step| step.command(self.user).join(" "));
        let commands: Vec<_> = commands.map(|it| format!("`sudo {it}`")).collect();
        CliError::failed(what).hint(format!(
            "run there: {}; then run this again",
            commands.join(", ")
        ))
    }
}

impl Step {
    fn command(self, user: &str) -> Vec<&str> {
        match self {
            Self::Update => vec!["apt-get", "update"],
            Self::Install => vec![
                "env",
                "DEBIAN_FRONTEND=noninteractive",
                "apt-get",
                "install",
                "--yes",
                "--no-install-recommends",
                "docker.io",
            ],
            Self::Join => vec!["usermod", "-aG", "docker", user],
            Self::Start => vec!["service", "docker", "start"],
        }
    }
}

/// What is to be done, in order; the distribution's name when it cannot be done there.
fn steps(seen: &Seen<'_>) -> Result<Vec<Step>, String> {
    let mut steps = Vec::new();
    // A program of another package is not replaced, which would remove that.
    if seen.socket == Socket::Absent && !seen.program {
        if !is_debian(seen.os_release) {
            return Err(distribution(seen.os_release));
        }
        steps.extend([Step::Update, Step::Install]);
    }
    if seen.socket != Socket::Open && !seen.root {
        steps.push(Step::Join);
    }
    // One that only keeps us out is there.
    if seen.socket != Socket::Denied || seen.root {
        steps.push(Step::Start);
    }
    Ok(steps)
}

/// Whether it is Debian, Ubuntu, or made of them.
fn is_debian(os_release: &str) -> bool {
    let id = value(os_release, "ID").unwrap_or_default();
    let like = value(os_release, "ID_LIKE").unwrap_or_default();
    ["debian", "ubuntu"].contains(&id) || like.split(' ').any(|word| word == "debian")
}

fn distribution(os_release: &str) -> String {
    let named = value(os_release, "PRETTY_NAME").or_else(|| value(os_release, "ID"));
    named
        .unwrap_or("a distribution without a name")
        .chars()
        .filter(|c| !c.is_control())
        .collect()
}

/// The value of a line `KEY=VALUE`, which may be in quotes.
fn value<'a>(os_release: &'a str, key: &str) -> Option<&'a str> {
    let mut lines = os_release.lines();
    let value = lines.find_map(|line| line.strip_prefix(key)?.strip_prefix('='))?;
    Some(value.trim().trim_matches(['"', '\'']))
}

#[cfg(test)]
mod tests {
    use super::Socket::{Absent, Denied, Open};
    use super::Step::{Install, Join, Start, Update};
    use super::*;

    #[test]
    fn what_is_missing_is_what_is_done() {
        let table: [(Socket, bool, bool, &[Step]); 8] = [
            (Absent, false, false, &[Update, Install, Join, Start]),
            (Absent, false, true, &[Update, Install, Start]),
            (Absent, true, false, &[Join, Start]),
            (Absent, true, true, &[Start]),
            (Denied, true, false, &[Join]),
            (Denied, false, false, &[Join]),
            (Denied, true, true, &[Start]),
            (Open, true, false, &[Start]),
        ];
        for (socket, program, root, expected) in table {
            let seen = Seen {
                os_release: "ID=debian",
                program,
                socket,
                root,
            };
            assert_eq!(steps(&seen).as_deref(), Ok(expected), "{seen:?}");
            // Only what must be installed depends on the distribution.
            let elsewhere = Seen {
                os_release: "ID=fedora",
                ..seen
            };
            let refused = expected.contains(&Install);
            assert_eq!(steps(&elsewhere).is_err(), refused, "{elsewhere:?}");
        }
    }

    #[test]
    fn debian_and_what_is_made_of_it() {
        let table = [
            ("PRETTY_NAME=\"Debian 12\"\nID=debian\n", Ok(())),
            ("NAME=Ubuntu\nID=ubuntu\nID_LIKE=debian\n", Ok(())),
            ("ID=raspbian\nID_LIKE='debian'", Ok(())),
            ("ID=linuxmint\nID_LIKE=\"ubuntu debian\"", Ok(())),
            (
                "ID=fedora\nPRETTY_NAME=\"Fedora Linux 40\"",
                Err("Fedora Linux 40"),
            ),
            (
                "VERSION_ID=debian\nID=\"opensuse-leap\"\nID_LIKE=\"suse debianish\"",
                Err("opensuse-leap"),
            ),
            ("", Err("a distribution without a name")),
        ];
        for (os_release, expected) in table {
            let seen = Seen {
                os_release,
                program: false,
                socket: Absent,
                root: true,
            };
            let expected = expected.map_err(str::to_owned);
            assert_eq!(steps(&seen).map(drop), expected, "{os_release}");
        }
    }
}
