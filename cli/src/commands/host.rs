//! `ictus host`: machines that run federations for us.

use std::io::{IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::{Args, Subcommand};
use ictus_deploy::gives::{Denied, Gives, ranges};
use ictus_deploy::image::elf::{Architecture, Machine};
use ictus_deploy::placement::{SshClient, Way};
use ictus_deploy::ssh::{Connection, HostKey, SshError, Target, host_keys, pin};
use ictusd::api::part::HostFacts;
use ictusd::client::Client;
use ictusd::installation::PROGRAM;

use crate::error::{CliError, Kind};
use crate::hosts::known::{self, KnownHost};
use crate::hosts::{INSTALLED, connect, options, target, unreachable_host};
use crate::rollout::size;
use crate::session::Session;
use crate::ui::{Table, Ui};

mod boot;
mod docker;
mod keys;
mod packed;
mod root;
mod system;
mod version;

/// What an upgrade sends and keeps while it is under way.
const INSTALLED_NEW: &str = ".local/share/ictus/bin/ictusd.new";
const INSTALLED_OLD: &str = ".local/share/ictus/bin/ictusd.old";

/// How long an ictusd that was asked to may take to end.
const ENDING_MAX: Duration = Duration::from_secs(10);
const ENDING_PERIOD: Duration = Duration::from_millis(20);

/// Who is let in on a host.
const AUTHORIZED_KEYS: &str = ".ssh/authorized_keys";

/// The directories that `add` and the daemon make, innermost first.
const DIRECTORIES: [&str; 5] = [
    ".local/share/ictus/bin",
    ".local/share/ictus",
    ".local/share",
    ".local/state",
    ".local",
];

/// Get hosts ready for federations, look at them, and leave them as they were
#[derive(Debug, Args)]
pub(crate) struct Host {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    /// Pin the host's key after showing it, put this program there as ictusd, and say what the host can do
    Add(Add),
    /// List the hosts that were added from here
    Ls,
    /// Say what a host can do
    Check(At),
    /// Put this version there in place of the one that is; what runs goes on. One that does not come up is taken back
    Upgrade(Upgrade),
    /// Remove ictusd and all that it kept; refused while something runs
    Rm(At),
    /// Print the systemd unit that `add` installs
    Unit {
        /// That of `add --system`, not that of `add --at-boot`
        #[arg(long)]
        system: bool,
    },
}

#[derive(Debug, Args)]
struct At {
    /// `[USER@]HOST[:PORT]`, or an alias of ssh_config
    host: String,
    /// Have the system's `ssh` make the connection: security keys, certificates, all of ssh_config
    #[arg(long)]
    system_ssh: bool,
    /// The key to log in with
    #[arg(long, value_name = "FILE")]
    identity: Option<PathBuf>,
}

#[derive(Debug, Args)]
struct Add {
    #[command(flatten)]
    at: At,
    #[command(flatten)]
    trust: Trust,
    /// Have systemd start ictusd there, also while nobody is logged in (a unit of the user's own)
    #[arg(long)]
    at_boot: bool,
    /// Install it for the whole host, as root's (or by `sudo`): whoever is in its group `ictus` may use it, which are
    /// root's rights, and federates are a user of their own
    #[arg(long, conflicts_with = "at_boot")]
    system: bool,
    /// Have root there install Docker where it is missing (Debian, Ubuntu) and let the user in: by root's login, or `sudo` without a password
    #[arg(long)]
    install_docker: bool,
}

/// Which key of a host's is trusted.
#[derive(Debug, Args)]
struct Trust {
    /// Trust the key that the host shows, without asking
    #[arg(long)]
    accept_new: bool,
    /// Trust the host's key if it has this fingerprint (`SHA256:...`)
    #[arg(long, value_name = "SHA256:...", conflicts_with = "accept_new")]
    fingerprint: Option<String>,
}

#[derive(Debug, Args)]
struct Upgrade {
    #[command(flatten)]
    at: At,
    /// Send this program in place of this very one
    #[arg(long, value_name = "FILE")]
    program: Option<PathBuf>,
}

impl Host {
    pub(crate) fn run(&self, ui: &mut Ui) -> Result<(), CliError> {
        let session = Session::new()?;
        session.block_on(async {
            match &self.what {
                What::Add(add) => add.run(ui, &session).await,
                What::Check(at) => at.check(ui, &session).await,
                What::Upgrade(upgrade) => upgrade.run(ui, &session).await,
                What::Rm(at) => at.remove(ui, &session).await,
                What::Ls => list(ui, &session),
                What::Unit { system } => {
                    let unit = if *system { system::UNIT } else { boot::UNIT };
                    ui.result(&unit, || unit.to_owned())
                }
            }
        })
    }
}

impl Add {
    async fn run(&self, ui: &mut Ui, session: &Session) -> Result<(), CliError> {
        let at = &self.at;
        let connection = match at.open().await {
            Err(SshError::UnknownHostKey { .. }) => {
                self.trust(ui).await?;
                at.open().await
            }
            other => other,
        };
        let connection = connection.map_err(|error| unreachable_host(&at.host, &error))?;
        for remark in connection.remarks() {
            ui.message(remark);
        }
        let installed = if self.system { PROGRAM } else { INSTALLED };
        version::refuse_newer(&at.host, &connection, installed).await?;
        let own = std::env::current_exe().map_err(CliError::failed)?;
        if self.system {
            system::install(ui, (&at.host, &connection), &own).await?;
        } else {
            install(ui, &at.host, (&connection, &own, INSTALLED)).await?;
        }
        if self.at_boot {
            // The unit's is the one that is to serve.
            at.daemon(session).await?.give_way().await?;
            boot::install(ui, &at.host, &connection).await?;
        }
        known::change(&session.paths.state, |known| {
            let host = KnownHost {
                client: at.client(),
                identity: at.identity.clone(),
            };
            known.insert(at.host.clone(), host);
        })?;
        if self.install_docker {
            docker::install(ui, session, at).await?;
        }
        at.check(ui, session).await
    }

    /// Shows the host's keys and pins the one that is trusted.
    async fn trust(&self, ui: &mut Ui) -> Result<(), CliError> {
        let (target, options) = (self.at.target()?, self.at.options());
        let keys = host_keys(&target, &options).await;
        let keys = keys.map_err(|error| unreachable_host(&self.at.host, &error))?;
        for key in &keys {
            ui.stage(
                "key",
                &format!("{} {} {}", self.at.host, key.kind, key.fingerprint),
            );
        }
        let trusted: Vec<&HostKey> = match &self.trust.fingerprint {
            Some(wanted) => keys
                .iter()
                .filter(|key| key.fingerprint == *wanted)
                .collect(),
            None if self.trust.accept_new || confirmed(&self.at.host)? => keys.iter().collect(),
            None => Vec::new(),
        };
        if trusted.is_empty() {
            let message = format!("the key of host `{}` is not trusted", self.at.host);
            return Err(CliError::new(Kind::Unreachable, message).hint(
                "compare it with what `ssh-keygen -lf /etc/ssh/ssh_host_ed25519_key.pub` prints there, then give \
                 `--fingerprint SHA256:...` or, where nobody can be in between, `--accept-new`",
            ));
        }
        for key in trusted {
            pin(&options.known_hosts, &target, key).map_err(CliError::failed)?;
        }
        ui.stage("pinned", &options.known_hosts.display().to_string());
        Ok(())
    }
}

impl At {
    fn client(&self) -> SshClient {
        if self.system_ssh {
            SshClient::System
        } else {
            SshClient::Ssh2
        }
    }

    fn target(&self) -> Result<Target, CliError> {
        target(&self.host)
    }

    fn options(&self) -> ictus_deploy::ssh::Options {
        options(self.client(), self.identity.as_deref())
    }

    async fn open(&self) -> Result<Connection, SshError> {
        Connection::open(&self.host.parse()?, &self.options()).await
    }

    async fn daemon(&self, session: &Session) -> Result<Client, CliError> {
        let way = Way::Ssh {
            target: self.host.clone(),
            client: self.client(),
            identity: self.identity.clone(),
        };
        connect(session, &self.host, &way).await
    }

    /// Says what the host can do, and what is dangerous there.
    async fn check(&self, ui: &mut Ui, session: &Session) -> Result<(), CliError> {
        let client = self.daemon(session).await?;
        show(ui, &self.host, &client.host().await?)?;
        let connection = self.open().await;
        let connection = connection.map_err(|error| unreachable_host(&self.host, &error))?;
        // Whoever is let in with a fixed command gets something else than the file, or nothing.
        let keys = connection.run(&["cat", AUTHORIZED_KEYS], &[]).await;
        let text = keys.map_or_else(|_| Vec::new(), |output| output.stdout);
        for key in keys::unrestricted(&String::from_utf8_lossy(&text)) {
            ui.warning(&format!(
                "{}: ~/{AUTHORIZED_KEYS}:{}: the key of {} has `command=` without `restrict`: it opens every socket of this user; \
                 begin the line with `restrict,`",
                self.host, key.line, key.whose
            ));
        }
        Ok(())
    }

    async fn remove(&self, ui: &mut Ui, session: &Session) -> Result<(), CliError> {
        let client = self.daemon(session).await?;
        let connection = self.open().await;
        let connection = connection.map_err(|error| unreachable_host(&self.host, &error))?;
        let root = match client.host().await?.run_as {
            Some(_) => Some(system::Root::of(&self.host, &connection).await?),
            None => None,
        };
        let names: Vec<_> = client
            .federations()
            .await?
            .into_iter()
            .map(|it| it.name)
            .collect();
        if !names.is_empty() {
            let message = format!("host `{}` has federations: {}", self.host, names.join(", "));
            let hint = format!("`ictus down NAME --host {} --purge` removes one", self.host);
            return Err(CliError::failed(message).hint(hint));
        }
        for name in client.names().await? {
            client.remove(&name, true).await?;
        }
        let pid = client.info().await?.pid;
        if !client.end().await? {
            let message = format!("host `{}`: somebody deploys to it", self.host);
            return Err(CliError::new(Kind::Held, message)
                .hint(format!("`ictus lock --host {}` shows who", self.host)));
        }
        // It removes what it kept as the last thing it does.
        let process = format!("/proc/{pid}");
        let until = Instant::now() + ENDING_MAX;
        while Instant::now() < until
            && root::holds(&self.host, &connection, &["test", "-e", &process]).await?
        {
            tokio::time::sleep(ENDING_PERIOD).await;
        }
        if let Some(root) = root {
            system::remove(&root).await?;
        } else {
            boot::remove(&self.host, &connection).await?;
            for program in [INSTALLED, INSTALLED_NEW, INSTALLED_OLD] {
                run(&self.host, &connection, &["rm", "-f", program]).await?;
            }
            for directory in DIRECTORIES {
                // What somebody else put there stays.
                connection.run(&["rmdir", directory], &[]).await.ok();
            }
        }
        known::change(&session.paths.state, |known| drop(known.remove(&self.host)))?;
        ui.stage("removed", &format!("{}: ictusd", self.host));
        Ok(())
    }
}

impl Upgrade {
    /// Sends the program beside the one that is there, which then tries it.
    async fn run(&self, ui: &mut Ui, session: &Session) -> Result<(), CliError> {
        let at = &self.at;
        let connection = at.open().await;
        let connection = connection.map_err(|error| unreachable_host(&at.host, &error))?;
        let own = std::env::current_exe().map_err(CliError::failed)?;
        let program = self.program.as_deref().unwrap_or(&own);
        let facts = at.daemon(session).await?.host().await?;
        if facts.run_as.is_some() {
            system::upgrade(ui, (&at.host, &connection), program).await?;
        } else {
            install(ui, &at.host, (&connection, program, INSTALLED_NEW)).await?;
            ui.progress("trying", &at.host);
            run(&at.host, &connection, &[INSTALLED, "swap"]).await?;
        }
        at.check(ui, session).await
    }
}

/// Puts a program, or its like for the host's processor, into the home directory.
async fn install(
    ui: &mut Ui,
    name: &str,
    (connection, own, to): (&Connection, &Path, &str),
) -> Result<(), CliError> {
    run(name, connection, &["mkdir", "-p", DIRECTORIES[0]]).await?;
    let sizes = send(ui, name, (connection, own, to)).await?;
    ui.stage("installed", &format!("{name}: ~/{to} ({sizes})"));
    Ok(())
}

/// Sends a program, or its like for the host's processor; gives its size, and how much of it was sent.
async fn send(
    ui: &mut Ui,
    name: &str,
    (connection, own, to): (&Connection, &Path, &str),
) -> Result<String, CliError> {
    let said = run(name, connection, &["uname", "-m"]).await?;
    let machine = String::from_utf8_lossy(&said).trim().to_owned();
    let program = program_for(name, own, &machine)?;
    let whole = std::fs::metadata(&program).map_or(0, |found| found.len());
    let mut told = |sent: u64, of: u64| {
        ui.progress(
            "sending",
            &format!("{name}: {} of {}", size(sent), size(of)),
        );
    };
    let sent = packed::send((name, connection), &program, to, &mut told).await?;
    Ok(format!("{}, {} sent", size(whole), size(sent)))
}

/// The hosts that were added.
fn list(ui: &mut Ui, session: &Session) -> Result<(), CliError> {
    let known = known::read(&session.paths.state)?;
    if known.is_empty() {
        ui.message("no host; `ictus host add` adds one");
    }
    ui.result(&known, || {
        if known.is_empty() {
            return String::new();
        }
        let mut table = Table::new(&["HOST", "BY", "KEY"]);
        for (host, at) in &known {
            let by = match at.client {
                SshClient::Ssh2 => "ssh2",
                SshClient::System => "the system's ssh",
            };
            let key = at.identity.as_ref().map(|key| key.display().to_string());
            let key = key.unwrap_or_else(|| "-".to_owned());
            table.row([host.clone(), by.to_owned(), key]);
        }
        table.text()
    })
}

/// This program, or that of another processor beside it.
fn program_for(name: &str, own: &Path, machine: &str) -> Result<PathBuf, CliError> {
    let wanted = Architecture::from_rust(machine);
    let program = if wanted == Architecture::own() {
        own.to_path_buf()
    } else {
        let beside = own.parent().unwrap_or(Path::new("/"));
        beside.join("../lib/ictus").join(machine).join("ictus")
    };
    let found = Machine::of(&program);
    let build = wanted.map_or("", Architecture::target);
    let build = format!(
        "`RUSTFLAGS='-C target-feature=+crt-static' cargo build --release -p ictus-cli --target {build}` makes one"
    );
    match found {
        Ok(found) if found.interpreter.is_none() => Ok(program),
        Ok(_) => {
            let message = format!(
                "{} is not static, so host `{name}` may not be able to run it",
                program.display()
            );
            Err(CliError::failed(message).hint(build))
        }
        Err(_) => {
            let message = format!(
                "host `{name}` is a {machine}, and there is no ictus for it at {}",
                program.display()
            );
            Err(CliError::failed(message).hint(build))
        }
    }
}

async fn run(name: &str, connection: &Connection, command: &[&str]) -> Result<Vec<u8>, CliError> {
    let output = connection.run(command, &[]).await;
    let output = output.map_err(|error| unreachable_host(name, &error))?;
    if output.code == 0 {
        return Ok(output.stdout);
    }
    let said = String::from_utf8_lossy(&output.stderr).trim().to_owned();
    let command = command.join(" ");
    Err(CliError::failed(format!(
        "host `{name}`: `{command}` failed: {said}"
    )))
}

/// Asks whoever sits at the terminal.
fn confirmed(host: &str) -> Result<bool, CliError> {
    if !std::io::stdin().is_terminal() {
        return Ok(false);
    }
    let mut out = std::io::stderr();
    write!(out, "is that the key of {host}? [y/N] ").map_err(CliError::failed)?;
    let mut line = String::new();
    std::io::stdin()
        .read_line(&mut line)
        .map_err(CliError::failed)?;
    Ok(matches!(line.trim(), "y" | "Y" | "yes"))
}

fn show(ui: &mut Ui, host: &str, facts: &HostFacts) -> Result<(), CliError> {
    ui.result(facts, || {
        let yes = |it: bool| if it { "yes" } else { "no" };
        let docker = match &facts.docker {
            Ok(docker) => format!(
                "Docker {} (API {}, {}, cgroup v{})",
                docker.version, docker.api, docker.storage_driver, docker.cgroup_version
            ),
            Err(why) => format!("no Docker: {why}"),
        };
        let run_as = facts.run_as.as_ref();
        let run_as = run_as.map_or_else(String::new, |user| format!("\n  federates are: {user}"));
        format!(
            "{host}: {} as {}, ictusd {}\n  {} with {} processors ({}), Linux {}, {} free\n  {docker}\n{}\n  starts at boot: {}",
            facts.hostname,
            facts.user,
            facts.version,
            facts.arch,
            facts.cpus,
            ranges(&facts.gives.cpus),
            facts.kernel,
            size(facts.disk_free),
            given(&facts.gives) + &run_as,
            yes(facts.starts_at_boot),
        )
    })
}

/// What federates may need: a line each, with the reason and the fix when they do not get it.
fn given(gives: &Gives) -> String {
    let line = |what: &str, given: Result<String, &Denied>| match given {
        Ok(given) => format!("  {what}: {given}"),
        Err(Denied { why, fix }) => format!("  {what}: no: {why}; {fix}"),
    };
    let priority = |highest: &u8| format!("up to priority {highest}");
    let others = match gives.uid {
        0 if gives.refuses_root => "yes, but not as root".to_owned(),
        0 => "yes, it is root".to_owned(),
        uid => format!("in containers only: its daemon runs as user {uid}"),
    };
    let (processes, containers) = (gives.realtime.as_ref(), gives.realtime_contained.as_ref());
    let locked = gives.lock_memory.as_ref().map(|()| "yes".to_owned());
    let secrets = gives.secrets.as_ref();
    [
        line("realtime scheduling", processes.map(priority)),
        line(
            "realtime scheduling of containers",
            containers.map(priority),
        ),
        line("locked memory", locked),
        line(
            "secrets",
            secrets.map(|path| format!("in {}", path.display())),
        ),
        format!("  federates as other users: {others}"),
    ]
    .join("\n")
}
