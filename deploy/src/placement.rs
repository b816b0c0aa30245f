//! Where the parts of a federation run, and what each needs there.

use std::collections::BTreeMap;
use std::net::Ipv4Addr;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// What runs a host's members.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Engine {
    /// A supervisor process each.
    #[default]
    Process,
    /// A container each, whose first process is the supervisor.
    Docker,
}

/// TCP and UDP ports that may be used on a host; both ends are included.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PortRange {
    /// The first; at least 1.
    pub first: u16,
    /// The last; not below the first.
    pub last: u16,
}

/// What protects the messages between hosts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Security {
    /// Nothing but the network; or there are none.
    #[default]
    TrustedNetwork,
    /// TLS 1.3, and a certificate at both ends that is made for the run.
    Mtls,
}

/// Which program speaks ssh.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SshClient {
    /// This one, with libssh2.
    #[default]
    Ssh2,
    /// The system's `ssh`: security keys, certificates, all of ssh_config.
    System,
}

/// How a host is reached.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Way {
    /// It is this machine.
    Local,
    /// Over ssh.
    Ssh {
        /// `[USER@]HOST[:PORT]`, or an alias of ssh_config.
        target: String,
        /// Who speaks it.
        #[serde(default)]
        client: SshClient,
        /// The key file, when it is not the usual one.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        identity: Option<PathBuf>,
    },
}

/// A host of the manifest.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HostSpec {
    /// Its name in the manifest.
    pub name: String,
    /// How it is reached.
    pub way: Way,
    /// Where its federates are reached by those of other hosts; loopback when there is no other.
    pub address: Ipv4Addr,
    /// What runs its members.
    pub engine: Engine,
    /// The ports that may be used; absent: any.
    pub ports: Option<PortRange>,
}

/// Which member runs where.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Placement {
    /// Sorted by name, without those that run nothing.
    pub hosts: Vec<HostSpec>,
    /// Index of the RTI's host.
    pub rti: usize,
    /// Index of each federate's host, in the plan's order.
    pub federates: Vec<usize>,
    /// What protects the messages between them.
    #[serde(default)]
    pub security: Security,
}

/// A scheduling policy of the kernel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RealtimePolicy {
    /// `SCHED_FIFO`.
    Fifo,
    /// `SCHED_RR`.
    RoundRobin,
}

/// Realtime scheduling.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Realtime {
    /// The policy.
    pub policy: RealtimePolicy,
    /// From 1 to 99.
    pub priority: u8,
    /// Whether its memory is locked.
    pub lock_memory: bool,
}

/// A directory of the host that a container sees.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Volume {
    /// On the host; absolute.
    pub host: PathBuf,
    /// In the container; absolute.
    pub at: PathBuf,
    /// Whether it may only be read.
    pub read_only: bool,
}

/// Where a secret's value comes from when the federation is started.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SecretSource {
    /// The environment variable of the same name, of whoever starts it.
    Environment,
    /// A file, absolute.
    File(PathBuf),
}

/// What a federate needs from its host.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Needs {
    /// Processors it may run on; empty: all.
    pub cpus: Vec<u32>,
    /// Bytes of memory (engine docker).
    pub memory: Option<u64>,
    /// Processes and threads (engine docker).
    pub pids: Option<u32>,
    /// `UID`, `UID:GID` or names; absent: the daemon's.
    pub user: Option<String>,
    /// Device files, absolute (engine docker).
    pub devices: Vec<PathBuf>,
    /// Directories (engine docker).
    pub volumes: Vec<Volume>,
    /// Realtime scheduling.
    pub realtime: Option<Realtime>,
    /// Secrets by name; a federate finds the file of each in `NAME_FILE`.
    pub secrets: BTreeMap<String, SecretSource>,
    /// An image of its own in place of a program (engine docker): its name, or the id of one that was sent.
    pub image: Option<String>,
    /// A folder of which such an image is built first.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub build: Option<ImageBuild>,
}

/// A folder of which an image is built.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImageBuild {
    /// What the build sees; absolute.
    pub context: PathBuf,
    /// The Dockerfile in it.
    pub dockerfile: String,
}

impl Needs {
    /// Whether it runs in an image of its own.
    #[must_use]
    pub const fn has_image(&self) -> bool {
        self.image.is_some() || self.build.is_some()
    }
}
