//! The resolved plan: everything a federate process needs to know, as JSON. Written by `ictus-deploy` from a
//! manifest, read by every program; there is no YAML, host or image in it.

use ictus_core::Duration;
use serde::{Deserialize, Serialize};

/// The format version in [`Plan::ictus`] and in [`crate::describe::ProgramDescription::ictus`].
pub const FORMAT: &str = "v1";

/// How long a host may answer nothing at all, when nobody says how long: longer than a wireless network takes to find its way
/// again, and short for a machine that others steer.
pub const FAILURE_TIMEOUT: Duration = Duration::from_secs(10);

const fn failure_timeout_ns() -> i64 {
    FAILURE_TIMEOUT.as_nanos()
}

/// One federation, resolved: names are checked, multiports are expanded to channels, delays are nanoseconds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(
    clippy::struct_excessive_bools,
    reason = "each is a key of the manifest, independent of the others"
)]
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
    /// Run ahead of physical time. Never with decentralized coordination, physical actions or physical connections.
    #[serde(default)]
    pub fast: bool,
    /// Go on when no event is left.
    #[serde(default)]
    pub keepalive: bool,
    /// How far, in logical nanoseconds, a federate without upstreams (or a fast one) may run ahead of its slowest
    /// downstream's LTC; absent: no limit. Only between our own federates under centralized coordination.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_lead_ns: Option<i64>,
    /// How long a host may answer nothing at all before its federates, or the RTI, count as lost, in nanoseconds.
    #[serde(default = "failure_timeout_ns")]
    pub failure_timeout_ns: i64,
    /// How clocks are synchronized.
    #[serde(default)]
    pub clock: ClockPlan,
    /// Whether the RTI is ours, so that extension messages may be sent; false for LF's.
    #[serde(default)]
    pub extensions: bool,
    /// The layout of the messages that differ between LF's releases.
    #[serde(default)]
    pub wire: Wire,
    /// Whether federates and RTI prove to each other that they know the federation id (HMAC) before they join.
    #[serde(default)]
    pub authentication: bool,
    /// Federates in order of their id on the wire.
    pub federates: Vec<FederatePlan>,
    /// Connections in the order of the manifest.
    pub connections: Vec<ConnectionPlan>,
}

impl Default for Plan {
    fn default() -> Self {
        Self {
            ictus: FORMAT.to_owned(),
            federation: String::new(),
            coordination: Coordination::Centralized,
            timeout_ns: None,
            fast: false,
            keepalive: false,
            max_lead_ns: None,
            failure_timeout_ns: failure_timeout_ns(),
            clock: ClockPlan::default(),
            extensions: false,
            wire: Wire::default(),
            authentication: false,
            federates: Vec::new(),
            connections: Vec::new(),
        }
    }
}

/// How tags are granted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Coordination {
    /// By the RTI (LTC, NET, TAG): consistency first.
    #[default]
    Centralized,
    /// By each federate's clock and STP offsets (PTIDES), messages from federate to federate: availability first.
    Decentralized,
}

/// The layout of ADDRESS_QUERY and P2P_SENDING_FED_ID, which LF 0.13 changed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Wire {
    /// LF 0.10 to 0.12.
    #[default]
    #[serde(rename = "0.12")]
    V0_12,
    /// LF 0.13: one more byte in both, whether the federate is transient.
    #[serde(rename = "0.13")]
    V0_13,
}

/// Clock synchronization: the built-in one, against the RTI's clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ClockPlan {
    /// When clocks are compared.
    pub sync: ClockSync,
    /// The time between two continuous exchanges with one federate, in nanoseconds.
    pub period_ns: i64,
    /// Exchanges at start (TCP), and per correction (UDP); both sides must count the same.
    pub trials: u32,
    /// The part of a measured error that one correction takes away is 1 / attenuation.
    pub attenuation: u32,
    /// Start is refused, or warned of, when a federate's error bound is greater; nanoseconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_error_ns: Option<i64>,
    /// What happens when a bound exceeds `max_error_ns`.
    pub on_exceed: OnExceed,
}

impl Default for ClockPlan {
    fn default() -> Self {
        Self {
            sync: ClockSync::Off,
            period_ns: 10_000_000,
            trials: 10,
            attenuation: 10,
            max_error_ns: None,
            on_exceed: OnExceed::Refuse,
        }
    }
}

/// When clocks are compared with the RTI's.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ClockSync {
    /// Never; the host's clock is taken as it is.
    #[default]
    Off,
    /// T1/T3/T4 exchanges over TCP while joining.
    Init,
    /// Those, and coded probes over UDP from the start on.
    On,
    /// The host's own service (chrony, ptp4l, timesyncd) is trusted and read; nothing is corrected.
    External,
}

/// What happens when a clock's error bound is greater than it may be.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OnExceed {
    /// The federate does not start.
    #[default]
    Refuse,
    /// It says so and starts.
    Warn,
}

/// One federate: a top-level instance.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
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
    /// The STP offset S in nanoseconds, declared or solved; decentralized coordination only. 0 is the least.
    #[serde(default)]
    pub stp_offset_ns: i64,
    /// What its loss does to the others.
    #[serde(default)]
    pub on_failure: OnFailure,
    /// The STP violation of this number (1: the first) makes the federate stop the federation; absent: they are counted only.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_stp_violations: Option<u64>,
    /// Tests only: the federate's clock is off by this much when it begins, in nanoseconds...
    #[serde(default)]
    pub test_clock_offset_ns: i64,
    /// ... and gains this many nanoseconds a second (1000: 1 ppm).
    #[serde(default)]
    pub test_clock_drift_ppb: i64,
}

/// What a federate's loss does to the others.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OnFailure {
    /// A stop tag is agreed at once.
    #[default]
    StopFederation,
    /// They go on: nothing comes from it any more, as if it had resigned.
    Continue,
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
    /// Whether the tag is dropped: the receiver's clock gives a new one, `after` added.
    #[serde(default)]
    pub physical: bool,
    /// How long after a tag's time, by its clock, the receiver waits for this connection's message or absence, in
    /// nanoseconds; absent: the receiver's own offset. Decentralized coordination only.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stp_offset_ns: Option<i64>,
    /// How much longer the receiver waits before it takes this input for absent at a tag that it has begun (LF's
    /// `absent_after`), in nanoseconds.
    #[serde(default)]
    pub absent_after_ns: i64,
    /// The declared bounds of which the offset is made; absent when none is declared.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bounds: Option<Bounds>,
}

impl Default for ConnectionPlan {
    fn default() -> Self {
        Self {
            from: Endpoint::default(),
            to: Endpoint::default(),
            after_ns: None,
            serializer: "native".to_owned(),
            port_id: 0,
            physical: false,
            stp_offset_ns: None,
            absent_after_ns: 0,
            bounds: None,
        }
    }
}

/// Declared bounds of one connection, in nanoseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Bounds {
    /// L: from the time at which the sender may begin a tag to the time at which the message leaves.
    pub launch_lag_ns: i64,
    /// N: on the network.
    pub latency_ns: i64,
    /// E: how far the two clocks are apart.
    pub clock_error_ns: i64,
}

/// A channel of a port of a federate.
#[derive(Clone, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
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
