//! The resolved plan: everything a federate process needs to know, as JSON. Written by `ictus-deploy` from a
//! manifest, read by every program; there is no YAML, host or image in it.

use serde::{Deserialize, Serialize};

/// The format version in [`Plan::ictus`] and in [`crate::describe::ProgramDescription::ictus`].
pub const FORMAT: &str = "v1";

/// One federation, resolved: names are checked, multiports are expanded to channels, delays are nanoseconds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Plan {
    /// Always [`FORMAT`].
    pub ictus: String,
    /// The federation's name.
    pub federation: String,
    /// How tags are granted.
    pub coordination: Coordination,
    /// The stop tag is this many nanoseconds after the start tag; absent: no time-out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub timeout_ns: Option<i64>,
    /// Run ahead of physical time.
    #[serde(default)]
    pub fast: bool,
    /// Go on when no event is left.
    #[serde(default)]
    pub keepalive: bool,
    /// How far, in logical nanoseconds, a federate without upstreams (or a fast one) may run ahead of its slowest
    /// downstream's LTC; absent: no limit. Only between our own federates.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_lead_ns: Option<i64>,
    /// Whether federates ask for the clock exchanges at start.
    #[serde(default)]
    pub clock_sync: ClockSync,
    /// Whether the RTI is ours, so that extension messages may be sent; false for LF's.
    #[serde(default)]
    pub extensions: bool,
    /// Federates in order of their id on the wire.
    pub federates: Vec<FederatePlan>,
    /// Connections in the order of the manifest.
    pub connections: Vec<ConnectionPlan>,
}

/// How tags are granted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Coordination {
    /// By the RTI (LTC, NET, TAG): consistency first.
    Centralized,
}

/// Whether clocks are compared with the RTI's before the start time is proposed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ClockSync {
    /// No exchanges; the host's clock is taken as it is.
    #[default]
    Off,
    /// Ten T1/T3/T4 exchanges over TCP while joining.
    Init,
}

/// One federate: a top-level instance.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FederatePlan {
    /// Unique name, the first element of every reactor path in the trace.
    pub name: String,
    /// The class to instantiate; absent for a foreign federate (a prebuilt LF binary).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub class: Option<String>,
    /// The manifest's name of the program that has the class; absent for a foreign federate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub program: Option<String>,
    /// Parameters by name, as the manifest gives them; durations are strings with a unit (`"100 ms"`).
    #[serde(default)]
    pub parameters: serde_json::Map<String, serde_json::Value>,
}

/// One channel of one output connected to one channel of one input.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ConnectionPlan {
    /// The sending end.
    pub from: Endpoint,
    /// The receiving end.
    pub to: Endpoint,
    /// `after` in nanoseconds: absent is no delay, 0 is one microstep.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub after_ns: Option<i64>,
    /// How values cross a process border: `native`, `postcard`.
    pub serializer: String,
    /// The receiver's port id on the wire; unique per receiver.
    pub port_id: u16,
}

/// A channel of a port of a federate.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Endpoint {
    /// Index into [`Plan::federates`].
    pub federate: u16,
    /// The port's name.
    pub port: String,
    /// The channel of a multiport; 0 for a plain port.
    #[serde(default)]
    pub channel: u32,
}
