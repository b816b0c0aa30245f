//! Test hosts: containers that each run their own sshd *and* their own Docker engine, on one network, with fixed addresses.
//!
//! One [`Rig`] per work tree at a time (a lock in `target/rig` sees to it). Everything it makes on the machine's engine
//! carries its name as a label; what a killed run left is swept away before the next begins.

mod engine;
mod host;
mod leaks;

pub use host::{Host, Traffic};
pub use leaks::{LeakChecker, Snapshot};

use crate::root;
use engine::{docker, in_parallel, ok};
use sha2::{Digest, Sha256};
use std::fs::{self, File, Permissions, TryLockError};
use std::io::Read as _;
use std::net::Ipv4Addr;
use std::os::unix::fs::PermissionsExt as _;
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::process::Command;
use std::thread;
use std::time::{Duration, Instant};

/// How long a rig waits for another one of this work tree to end.
const LOCK_WAIT: Duration = Duration::from_mins(10);

/// The user of every host, in group `docker`, who gets in by key.
pub const USER: &str = "robot";

/// Hosts on a network of their own, and a key that opens them; all of it goes with the value.
#[derive(Debug)]
pub struct Rig {
    name: String,
    hosts: Vec<Host>,
    gateway: Ipv4Addr,
    directory: PathBuf,
    /// Held as long as the rig lives.
    _lock: File,
}

impl Rig {
    /// Brings `count` hosts up (1 to 100), called `h1`, `h2`, ...: some seconds, and two minutes once for their image.
    ///
    /// Panics when that fails; whether it can work at all is what [`missing`] says.
    #[must_use]
    pub fn new(count: u8) -> Self {
        let name = name();
        let lock = lock();
        sweep();
        let image = image();
        let directory = directory();
        fs::create_dir_all(&directory).unwrap();
        fs::set_permissions(&directory, Permissions::from_mode(0o700)).unwrap();
        let key = directory.join("id_ed25519");
        ok(Command::new("ssh-keygen")
            .args(["-q", "-t", "ed25519", "-N", "", "-C", &name, "-f"])
            .arg(&key));
        let network = engine::make_network(&name);
        let gateway = network.gateway();
        // From here on, a panic takes everything down again.
        let rig = Self {
            hosts: (1..=count)
                .map(|n| Host::planned(&name, n, network.host(n)))
                .collect(),
            name,
            gateway,
            directory,
            _lock: lock,
        };
        let public = fs::read_to_string(rig.key().with_extension("pub")).unwrap();
        let keys = in_parallel(&rig.hosts, |host| {
            host.start(&image);
            host.admit(&public);
            host.public_keys()
        });
        let known: String = rig
            .hosts
            .iter()
            .zip(keys)
            .flat_map(|(host, keys)| {
                let line = |key: &str| format!("{} {key}\n", host.address);
                keys.lines().map(line).collect::<Vec<_>>()
            })
            .collect();
        fs::write(rig.known_hosts(), known).unwrap();
        rig
    }

    /// What everything of it is called: no other work tree's is called so.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The hosts, in order.
    #[must_use]
    pub fn hosts(&self) -> &[Host] {
        &self.hosts
    }

    /// The address by which the hosts see this machine: where the operator's ssh comes from.
    #[must_use]
    pub const fn gateway(&self) -> Ipv4Addr {
        self.gateway
    }

    /// The private key (ed25519, no passphrase) that every host lets in.
    #[must_use]
    pub fn key(&self) -> PathBuf {
        self.directory.join("id_ed25519")
    }

    /// A `known_hosts` file with every key of every host, by address.
    #[must_use]
    pub fn known_hosts(&self) -> PathBuf {
        self.directory.join("known_hosts")
    }

    /// `ssh robot@HOST`, strict, without the user's own configuration or agent; arguments are to be added.
    #[must_use]
    pub fn ssh(&self, host: &Host) -> Command {
        let mut command = engine::bounded("ssh");
        command
            .args(["-F", "none", "-T", "-o", "BatchMode=yes", "-o"])
            .args(["IdentitiesOnly=yes", "-o", "StrictHostKeyChecking=yes"])
            .args(["-o", "ConnectTimeout=10", "-o", "GlobalKnownHostsFile=none"])
            .arg("-o")
            .arg(format!(
                "UserKnownHostsFile={}",
                self.known_hosts().display()
            ))
            .arg("-i")
            .arg(self.key())
            .arg(format!("{USER}@{}", host.address))
            .env_remove("SSH_AUTH_SOCK");
        command
    }

    /// Takes back every cut on every host and plugs every cable in again.
    pub fn heal(&self) {
        in_parallel(&self.hosts, |host| {
            host.heal();
            host.restore_cable();
        });
    }

    /// What every host holds now, in the order of the hosts.
    #[must_use]
    pub fn snapshots(&self) -> Vec<Snapshot> {
        in_parallel(&self.hosts, Snapshot::take)
    }

    /// What is other than it was on any host, as text; empty when nothing is. What just ends gets 5 s for it.
    #[must_use]
    pub fn leaks(&self, before: &[Snapshot]) -> String {
        let pairs: Vec<_> = self.hosts.iter().zip(before).collect();
        let texts = in_parallel(&pairs, |(host, before)| {
            let diff = LeakChecker::since(host, (*before).clone()).diff();
            if diff.is_empty() {
                return diff;
            }
            format!("{} is not as it was before:\n{diff}", host.name)
        });
        texts.concat()
    }

    /// Writes what every host can tell to `target/rig-logs/NAME/`, one file a host, and returns that directory.
    #[must_use]
    pub fn gather_logs(&self, name: &str) -> PathBuf {
        let directory = root().join("target/rig-logs").join(name);
        // Called when something is wrong already: what cannot be had is left out.
        drop(fs::create_dir_all(&directory));
        in_parallel(&self.hosts, |host| {
            let file = directory.join(&host.name).with_extension("txt");
            drop(fs::write(file, host.gather_logs()));
        });
        directory
    }
}

impl Drop for Rig {
    fn drop(&mut self) {
        if thread::panicking() {
            let logs = self.gather_logs("panic");
            engine::tell(&format!(
                "the logs of the test hosts are in {}",
                logs.display()
            ));
        }
        remove(&self.name);
    }
}

/// Why no test host can be had on this machine, in one line; nothing when they can.
#[must_use]
pub fn missing() -> Option<String> {
    let version = docker(&["version", "--format", "{{.Server.Version}}"]).output();
    if !version.is_ok_and(|output| output.status.success()) {
        return Some(
            "no Docker engine answers: `.ci/setup` as root installs and starts it".to_owned(),
        );
    }
    let image = Command::new(root().join(".ci/hosts-image")).output();
    match image {
        Ok(output) if output.status.success() => None,
        Ok(output) => {
            let said = String::from_utf8_lossy(&output.stderr);
            let last = said.lines().last().unwrap_or_default();
            Some(format!(
                "no image of the test hosts: {}",
                last.trim_start_matches("ictus: ")
            ))
        }
        Err(error) => Some(format!("no image of the test hosts: {error}")),
    }
}

/// Removes everything of this work tree's rigs when the user or CI ends this process with SIGINT or SIGTERM.
pub fn sweep_on_signal() {
    let (mut receiver, sender) = UnixStream::pair().unwrap();
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        signal_hook::low_level::pipe::register(signal, sender.try_clone().unwrap()).unwrap();
    }
    thread::spawn(move || {
        drop(receiver.read(&mut [0]));
        engine::tell("stopped: removing the test hosts");
        sweep();
        #[expect(clippy::exit, reason = "the tests that run are without hosts now")]
        std::process::exit(130);
    });
}

/// Removes everything that rigs of this work tree have made, whoever left it.
fn sweep() {
    remove(&name());
}

/// Removes everything that carries the label `ictus.rig=NAME`, cgroups and keys included; what fails is left to the next sweep.
fn remove(name: &str) {
    let label = format!("label=ictus.rig={name}");
    let running = listed(&["ps", "--filter", &label, "--format", "{{.Names}}"]);
    // The inner containers go first: with their engine dead, their cgroups would stay on the machine.
    in_parallel(&running, |host| {
        drop(docker(&["exec", host, "host", "down"]).output());
    });
    let remove_all = |remove: &[&str], list: &[&str]| {
        let found = listed(&[list, &["--filter", &label]].concat());
        if !found.is_empty() {
            drop(docker(remove).args(found).output());
        }
    };
    remove_all(&["rm", "--force", "--volumes"], &["ps", "--all", "--quiet"]);
    remove_all(&["network", "rm"], &["network", "ls", "--quiet"]);
    remove_all(&["volume", "rm"], &["volume", "ls", "--quiet"]);
    engine::remove_cgroups(name);
    drop(fs::remove_dir_all(directory()));
}

/// Everything a rig of this work tree has made is called or labelled so.
fn name() -> String {
    let hash = Sha256::digest(root().as_os_str().as_encoded_bytes());
    let hex: String = hash
        .iter()
        .take(4)
        .map(|byte| format!("{byte:02x}"))
        .collect();
    format!("ictus-rig-{hex}")
}

/// Where the keys lie, in `target`.
fn directory() -> PathBuf {
    root().join("target/rig")
}

/// Waits until no other rig of this work tree lives.
fn lock() -> File {
    fs::create_dir_all(root().join("target")).unwrap();
    let path = root().join("target/rig.lock");
    let file = File::create(&path).unwrap();
    let end = Instant::now() + LOCK_WAIT;
    loop {
        match file.try_lock() {
            Ok(()) => return file,
            Err(TryLockError::WouldBlock) => assert!(
                Instant::now() < end,
                "another run of this work tree has held {} for {LOCK_WAIT:?}: end it first",
                path.display()
            ),
            Err(TryLockError::Error(error)) => panic!("{}: {error}", path.display()),
        }
        thread::sleep(Duration::from_millis(200));
    }
}

/// The name of the hosts' image, which is made when there is none.
fn image() -> String {
    let said = ok(&mut Command::new(root().join(".ci/hosts-image")));
    said.trim().to_owned()
}

/// The lines of a listing of the machine's engine; none when it does not answer.
fn listed(args: &[&str]) -> Vec<String> {
    let output = docker(args).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    text.lines().map(str::to_owned).collect()
}
