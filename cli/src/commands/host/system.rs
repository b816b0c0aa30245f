//! The installation for a whole host: root's ictusd, a group that may use it, and a user that federates are.

use std::io::Write;
use std::path::Path;

use ictus_deploy::ssh::Connection;
use ictusd::installation::{CONFIG, GROUP, PROGRAM, PROGRAMS, RUN, RUN_AS, STATE};

use super::root::{By, holds, powerless};
use super::{boot, run, send};
use crate::error::CliError;
use crate::hosts::{INSTALLED, unreachable_host};
use crate::ui::Ui;

/// What `ictus host unit --system` prints.
pub(super) const UNIT: &str = include_str!("ictusd-system.service");

const UNIT_NAME: &str = "ictusd.service";
const UNIT_PATH: &str = "/etc/systemd/system/ictusd.service";
/// What a host has until its owner decides otherwise.
const CONFIG_TEXT: &str = include_str!("ictusd.toml");
/// What an upgrade sends and keeps while it is under way.
const PROGRAM_NEW: &str = "/usr/local/lib/ictus/ictusd.new";
const PROGRAM_OLD: &str = "/usr/local/lib/ictus/ictusd.old";

/// A host on which whoever logs in may be root.
pub(super) struct Root<'c> {
    host: &'c str,
    connection: &'c Connection,
    by: By,
}

impl<'c> Root<'c> {
    /// Finds out how.
    pub(super) async fn of(host: &'c str, connection: &'c Connection) -> Result<Self, CliError> {
        let Some(by) = By::of(host, connection).await? else {
            let user = &connection.peer().user;
            return Err(CliError::failed(powerless(host, connection)).hint(format!(
                "log in as root, or have root write `{user} ALL=(ALL) NOPASSWD: ALL` into /etc/sudoers.d/ictus there"
            )));
        };
        Ok(Self {
            host,
            connection,
            by,
        })
    }

    /// Runs a command that has to succeed.
    async fn run(&self, command: &[&str]) -> Result<(), CliError> {
        let done = run(self.host, self.connection, &self.by.command(command)).await;
        done.map(drop)
    }

    /// Whether a command succeeds.
    async fn holds(&self, command: &[&str]) -> Result<bool, CliError> {
        holds(self.host, self.connection, &self.by.command(command)).await
    }

    /// Puts a file there that whoever logs in has sent.
    async fn place(&self, sent: &str, to: &str, mode: &str) -> Result<(), CliError> {
        self.run(&["install", "-D", "-m", mode, sent, to]).await
    }
}

/// Makes group and user, puts program, configuration and unit there, and has it serve.
pub(super) async fn install(
    ui: &mut Ui,
    (host, connection): (&str, &Connection),
    program: &Path,
) -> Result<(), CliError> {
    let root = Root::of(host, connection).await?;
    if holds(host, connection, &["test", "-e", INSTALLED]).await? {
        let user = &connection.peer().user;
        let message = format!("host `{host}`: `{user}` has an ictusd of its own at ~/{INSTALLED}");
        let hint = format!("`ictus host rm {host}` removes that one");
        return Err(CliError::failed(message).hint(hint));
    }
    make_accounts(&root).await?;
    with_sent(ui, &root, program, async |sent| {
        // In one step: an older one may be running.
        root.place(sent, PROGRAM_NEW, "755").await?;
        root.run(&["mv", "-f", PROGRAM_NEW, PROGRAM]).await
    })
    .await?;
    ui.stage("installed", &format!("{host}: {PROGRAM}"));
    if !root.holds(&["test", "-e", CONFIG]).await? {
        write(&root, CONFIG_TEXT, CONFIG).await?;
    }
    if boot::has_systemd(host, connection).await? {
        write(&root, UNIT, UNIT_PATH).await?;
        root.run(&["systemctl", "daemon-reload"]).await?;
        root.run(&["systemctl", "enable", UNIT_NAME]).await?;
        root.run(&["systemctl", "restart", UNIT_NAME]).await?;
        ui.stage("enabled", &format!("{host}: {UNIT_PATH}"));
        return Ok(());
    }
    // Starts one unless one serves, which goes on with the program that it has.
    root.run(&[PROGRAM, "dial-stdio"]).await
}

/// The group of those who may use it, with whoever logs in, and the user that federates are.
async fn make_accounts(root: &Root<'_>) -> Result<(), CliError> {
    if !root.holds(&["getent", "group", GROUP]).await? {
        let add = ["/usr/sbin/groupadd", "--system", GROUP];
        root.run(&add).await?;
    }
    if !root.holds(&["getent", "passwd", RUN_AS]).await? {
        let add = ["/usr/sbin/useradd", "--system", "--user-group"];
        let nowhere = ["--no-create-home", "--home-dir", "/nonexistent"];
        let shell = ["--shell", "/usr/sbin/nologin", RUN_AS];
        root.run(&[add, nowhere, shell].concat()).await?;
    }
    if root.by == By::Sudo {
        let user = root.connection.peer().user.as_str();
        let join = ["/usr/sbin/usermod", "--append", "--groups", GROUP, user];
        root.run(&join).await?;
    }
    Ok(())
}

/// Sends a program to a directory of whoever logs in, uses it there, and removes it again.
async fn with_sent(
    ui: &mut Ui,
    root: &Root<'_>,
    program: &Path,
    then: impl AsyncFnOnce(&str) -> Result<(), CliError>,
) -> Result<(), CliError> {
    let (host, connection) = (root.host, root.connection);
    let made = run(host, connection, &["mktemp", "-d"]).await?;
    let directory = String::from_utf8_lossy(&made).trim().to_owned();
    let sent = format!("{directory}/sent");
    let done = match send(ui, host, (connection, program, &sent)).await {
        Ok(sizes) => {
            ui.stage("sent", &format!("{host}: {sizes}"));
            then(&sent).await
        }
        Err(error) => Err(error),
    };
    // The first error is the one to tell.
    connection.run(&["rm", "-f", &sent], &[]).await.ok();
    connection.run(&["rmdir", &directory], &[]).await.ok();
    done
}

/// Writes a text that everybody may read.
async fn write(root: &Root<'_>, text: &str, to: &str) -> Result<(), CliError> {
    let mut file = tempfile::NamedTempFile::new().map_err(CliError::failed)?;
    file.write_all(text.as_bytes()).map_err(CliError::failed)?;
    let (host, connection) = (root.host, root.connection);
    let made = run(host, connection, &["mktemp"]).await?;
    let there = String::from_utf8_lossy(&made).trim().to_owned();
    let sent = connection
        .upload(file.path(), &there, 0o600, &mut |_| {})
        .await;
    let done = match sent {
        Ok(()) => root.place(&there, to, "644").await,
        Err(error) => Err(unreachable_host(host, &error)),
    };
    connection.run(&["rm", "-f", &there], &[]).await.ok();
    done
}

/// Sends a program beside the one that is there, which then tries it.
pub(super) async fn upgrade(
    ui: &mut Ui,
    (host, connection): (&str, &Connection),
    program: &Path,
) -> Result<(), CliError> {
    let root = Root::of(host, connection).await?;
    with_sent(ui, &root, program, async |sent| {
        root.place(sent, PROGRAM_NEW, "755").await
    })
    .await?;
    ui.progress("trying", host);
    root.run(&[PROGRAM, "swap"]).await
}

/// Takes it all back; ictusd has ended.
pub(super) async fn remove(root: &Root<'_>) -> Result<(), CliError> {
    if root.holds(&["test", "-e", UNIT_PATH]).await? {
        root.run(&["systemctl", "disable", "--now", UNIT_NAME])
            .await?;
        root.run(&["rm", "-f", UNIT_PATH]).await?;
        root.run(&["systemctl", "daemon-reload"]).await?;
    }
    root.run(&["rm", "-f", PROGRAM, PROGRAM_NEW, PROGRAM_OLD, CONFIG])
        .await?;
    for directory in [PROGRAMS, "/etc/ictus", STATE, RUN] {
        // What somebody else put there stays.
        root.holds(&["rmdir", directory]).await?;
    }
    if root.holds(&["getent", "passwd", RUN_AS]).await? {
        root.run(&["/usr/sbin/userdel", RUN_AS]).await?;
    }
    if root.holds(&["getent", "group", GROUP]).await? {
        root.run(&["/usr/sbin/groupdel", GROUP]).await?;
    }
    Ok(())
}
