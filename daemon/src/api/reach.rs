//! Whether other hosts can connect to this one: asked before anything is deployed, so no lease is needed.
//!
//! | call | answer |
//! |---|---|
//! | `POST /v1/reach/listen` with a [`ListenRequest`] | [`Listening`]; it ends by itself, or when the host has said the word to itself |
//! | `POST /v1/reach/probe` with a [`ProbeRequest`] | [`Reached`] |

use std::net::{Ipv4Addr, SocketAddrV4};

use ictus_deploy::placement::PortRange;
use serde::{Deserialize, Serialize};

/// The longest that a host listens, in milliseconds.
pub const LISTEN_MS_MAX: u32 = 30_000;
/// The longest that one probe takes, in milliseconds.
pub const PROBE_MS_MAX: u32 = 10_000;

/// Asks a host to listen, TCP and UDP, and to give back what says the right word.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ListenRequest {
    /// Its data address.
    pub address: Ipv4Addr,
    /// One of these ports; absent: any.
    pub ports: Option<PortRange>,
    /// The word, at most 64 bytes; a secret of who asks.
    pub word: String,
    /// For how long, in milliseconds; at most [`LISTEN_MS_MAX`].
    pub for_ms: u32,
}

/// Where it listens.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Listening {
    /// The port, of TCP and UDP both.
    pub port: u16,
}

/// Asks a host to say the word to another one.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProbeRequest {
    /// From its data address.
    pub from: Ipv4Addr,
    /// To where the other listens.
    pub to: SocketAddrV4,
    /// The word.
    pub word: String,
    /// How long an answer may take, in milliseconds; at most [`PROBE_MS_MAX`].
    pub limit_ms: u32,
}

/// What came of it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Reached {
    /// Over TCP, or why not.
    pub tcp: Result<(), String>,
    /// Over UDP, or why not.
    pub udp: Result<(), String>,
}
