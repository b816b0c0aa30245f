//! A host's part of a federation over several hosts: prepared everywhere, then committed.
//!
//! | call | answer |
//! |---|---|
//! | `GET /v1/host` | [`HostFacts`] |
//! | `GET /v1/foreign?federation=NAME` | a list of [`Foreign`] |
//! | `POST /v1/leases/NAME` with a [`LeaseRequest`] | [`Lease`]; held by somebody else: [`super::ErrorCode::Held`] |
//! | `PUT /v1/leases/NAME?fence=F` | renews it: [`Lease`] |
//! | `DELETE /v1/leases/NAME?fence=F`, or `?break=WHO` | releases it, or breaks it whoever holds it |
//! | `GET /v1/leases` | a list of [`LeaseView`] |
//! | `POST /v1/blobs` with a list of digests | those that are not there |
//! | `PUT /v1/blobs/DIGEST?fence=F&federation=NAME` with the bytes | nothing; refused when they are others |
//! | `POST /v1/images` with a list of names and ids | those that are there, each with an [`ImageFacts`] |
//! | `POST /v1/images/layers` with the layers of an image, the lowest first | those that are not there |
//! | `PUT /v1/images/ID?fence=F&federation=NAME` with a compressed archive | nothing; what it leaves out must be there |
//! | `PUT /v1/federations/NAME?fence=F` with a [`PrepareRequest`] | [`Prepared`]; nothing runs yet |
//! | `POST /v1/federations/NAME/commit` with a [`CommitRequest`] | a stream of [`super::Happening`] until the part ends; closing it before `healthy` undoes the part |

use std::collections::BTreeMap;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::path::PathBuf;

use ictus_deploy::gives::Gives;
use ictus_deploy::placement::{Engine, PortRange, Security, Way};
use ictus_stream::Papers;
use serde::{Deserialize, Serialize};

use super::StartRequest;
use super::secret::SecretValues;

/// What runs on this host of a federation over several.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Part {
    /// This host's name in the manifest.
    pub host: String,
    /// Every host of the federation, by name, this one included: any of them can tell the way to the others.
    pub hosts: BTreeMap<String, HostRef>,
    /// Whether the RTI runs here.
    pub rti: bool,
    /// Ids of the federates that run here.
    pub federates: Vec<u16>,
    /// Where members of other hosts reach those of this one.
    pub address: Ipv4Addr,
    /// What runs the members.
    pub engine: Engine,
    /// Ports that may be used; absent: any.
    pub ports: Option<PortRange>,
    /// The blob that each federate of this host executes, by name: the SHA-256 in hexadecimal digits. One that is
    /// missing here executes its path.
    pub programs: BTreeMap<String, String>,
    /// What protects the messages between hosts.
    #[serde(default, skip_serializing_if = "is_clear")]
    pub security: Security,
}

/// The way to a host.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HostRef {
    /// How it was reached by who deployed.
    pub way: Way,
    /// Its data address.
    pub address: Ipv4Addr,
}

/// What a host is asked to prepare.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PrepareRequest {
    /// The run that was there when it was planned ([`super::FederationView::id`]); another one is a conflict.
    pub previous: Option<String>,
    /// The id of the new run, the same on every host.
    pub id: String,
    /// A digest of all that is deployed, by which a later `up` knows whether anything has changed.
    pub digest: String,
    /// The digest of each thing that matters, by what it is, by which a later `up` says what has changed.
    #[serde(default)]
    pub facets: BTreeMap<String, String>,
    /// The number of this run in the federation's history; absent: the next one here.
    #[serde(default)]
    pub generation: Option<u64>,
    /// What to run; has a part.
    pub request: StartRequest,
    /// The values of the secrets of this host's federates; not kept with the request.
    #[serde(default, skip_serializing_if = "SecretValues::is_empty")]
    pub secrets: SecretValues,
    /// The certificate and key of each member of this host (`rti`, or the federate's name), when there are to be any.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub papers: BTreeMap<String, Papers>,
}

#[expect(
    clippy::trivially_copy_pass_by_ref,
    reason = "serde calls it with a reference"
)]
fn is_clear(security: &Security) -> bool {
    *security == Security::TrustedNetwork
}

/// A part that waits for its commit.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Prepared {
    /// The run's id.
    pub id: String,
    /// The port that the RTI will have, if it runs here and a port was asked for or assigned.
    pub rti_port: Option<u16>,
}

/// What a prepared part is told when it is to begin.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CommitRequest {
    /// The lease's number.
    pub fence: u64,
    /// The run that was prepared.
    pub id: String,
    /// Where the RTI listens; absent where it runs here.
    pub rti: Option<SocketAddrV4>,
}

/// Who wants a lease.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LeaseRequest {
    /// Who asks, in words (`ann@laptop: up`); a hint, the daemon's user is who may.
    pub who: String,
    /// Milliseconds without renewal after which it is free.
    pub ttl_ms: u64,
}

/// A lease that was given.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Lease {
    /// Grows with every grant, also over restarts of the daemon; every changing call repeats it.
    pub fence: u64,
}

/// A lease that is held.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LeaseView {
    /// The federation.
    pub federation: String,
    /// Who holds it, in its own words.
    pub who: String,
    /// Its number.
    pub fence: u64,
    /// Milliseconds until it is free unless it is renewed.
    pub left_ms: u64,
}

/// What a host is and can do.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct HostFacts {
    /// The daemon's version.
    pub version: String,
    /// The machine, as Rust names it: `x86_64`, `aarch64`.
    pub arch: String,
    /// The kernel's release.
    pub kernel: String,
    /// Its name of itself.
    pub hostname: String,
    /// The user that the daemon runs as.
    pub user: String,
    /// Processors.
    pub cpus: u32,
    /// Free bytes where state is kept.
    pub disk_free: u64,
    /// Where that is; empty when the daemon is an older one.
    #[serde(default)]
    pub state: PathBuf,
    /// What federates may need and it gives.
    #[serde(default)]
    pub gives: Gives,
    /// The Docker engine, or why there is none that can be used, with the fix.
    pub docker: Result<DockerFacts, String>,
    /// Whether systemd starts the daemon again after a reboot.
    pub starts_at_boot: bool,
    /// Who federates are that the manifest gives no user, where the daemon is the whole host's; absent: one user's daemon,
    /// and the same user.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub run_as: Option<String>,
}

/// A Docker engine.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct DockerFacts {
    /// The engine's version.
    pub version: String,
    /// The API version that is used with it.
    pub api: String,
    /// Its storage driver.
    pub storage_driver: String,
    /// `1` or `2`.
    pub cgroup_version: String,
}

/// A container that says that it is of a federation, and is in no record of this host. It is never touched.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Foreign {
    /// Its name.
    pub container: String,
    /// What it says.
    pub federation: String,
}

/// An image of a host's engine.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ImageFacts {
    /// Its id there.
    pub id: String,
    /// What it is for, as Rust names it; Docker's name when Rust has none.
    pub arch: String,
}

/// The name under which an image is sent for a federation; absent when `id` is no `sha256:...`.
#[must_use]
pub fn sent_name(federation: &str, id: &str) -> Option<String> {
    crate::docker::sent_name(federation, id)
}
