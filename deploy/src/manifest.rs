//! The manifest as it is written: the types behind the JSON Schema. Nothing is checked here but form.

mod host;
mod needs;
mod scalar;
mod words;

use ictus_coord::plan::{ClockSync, Coordination, OnExceed, OnFailure, Wire};
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::Deserialize;
use serde_json::Value;

use crate::check::Deploy;

pub(crate) use self::host::{Host, PortsText};
pub(crate) use self::needs::{RealtimeText, Secret, VolumeText};
pub(crate) use self::scalar::{
    Address, ByteSize, LinkMap, Named, OffsetText, OneOrMany, Port, Scalar, SignedSpan, TimeSpan,
    split_link,
};
use self::scalar::{CountWord, Name};
use self::words::{
    ClockSyncWord, CoordinationWord, DeployWord, OnExceedWord, OnFailureWord, SecurityWord,
    WireWord,
};
use crate::placement::Security;

/// A federation: what runs, how it is connected, and how long.
///
/// Every `$name` that stands alone as a value is replaced by the value of `let.name`.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(title = "Ictus federation manifest")]
pub(crate) struct Manifest {
    /// The format's version.
    #[schemars(required, schema_with = "version")]
    #[expect(dead_code, reason = "the schema has checked it")]
    pub(crate) ictus: Option<String>,
    /// The federation's name; one word.
    #[schemars(required, with = "Name")]
    pub(crate) federation: Option<String>,
    /// How tags are granted.
    #[schemars(with = "Option<CoordinationWord>")]
    pub(crate) coordination: Option<Coordination>,
    /// Which of Lingua Franca's releases the messages between federates are like.
    #[serde(default)]
    #[schemars(with = "WireWord")]
    pub(crate) wire: Wire,
    /// Federates and coordinator prove to each other that they know the federation's id before they join.
    #[serde(default)]
    pub(crate) authentication: bool,
    /// The federation stops this long after its start tag; without it, it runs until it is stopped.
    pub(crate) timeout: Option<TimeSpan>,
    /// Run ahead of physical time, as fast as the machine can.
    #[serde(default)]
    pub(crate) fast: bool,
    /// Go on when no event is left.
    #[serde(default)]
    pub(crate) keepalive: bool,
    /// How far, in logical time, a federate without upstreams may run ahead of its slowest downstream.
    pub(crate) max_lead: Option<TimeSpan>,
    /// Clock synchronization.
    #[serde(default)]
    pub(crate) clock: Clock,
    /// What holds for every connection, as far as nothing else is said: the offsets of decentralized coordination
    /// are made of it.
    #[serde(default)]
    pub(crate) bounds: AllBounds,
    /// Who starts it: the daemons of the hosts, or docker-compose on this machine.
    #[serde(default)]
    #[schemars(with = "DeployWord")]
    pub(crate) deploy: Deploy,
    /// Where it runs; left out, everything runs on this machine as processes.
    #[serde(default)]
    pub(crate) hosts: Named<Host>,
    /// What protects the messages between hosts.
    #[schemars(with = "Option<SecurityWord>")]
    pub(crate) security: Option<Security>,
    /// The coordinator.
    #[serde(default)]
    pub(crate) rti: Rti,
    /// Where the daemon serves what it has measured.
    #[serde(default)]
    pub(crate) metrics: Metrics,
    /// Values used as `$name` elsewhere; `--set name=value` replaces them.
    #[serde(default, rename = "let")]
    #[expect(dead_code, reason = "replaced in the document before it is read")]
    pub(crate) lets: Named<Scalar>,
    /// Where the federates' code comes from.
    #[serde(default)]
    pub(crate) programs: Named<Program>,
    /// What runs: each federate is a process.
    #[serde(default)]
    #[schemars(required)]
    pub(crate) federates: Named<Federate>,
    /// Which output feeds which input.
    #[serde(default)]
    pub(crate) connections: Vec<Connection>,
    /// What holds for the whole run.
    #[serde(default)]
    pub(crate) defaults: Defaults,
    /// What `ictus timing` reports.
    #[serde(default)]
    pub(crate) timing: Timing,
}

/// Clock synchronization.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Clock {
    /// When clocks are compared with the coordinator's.
    #[serde(default)]
    #[schemars(with = "ClockSyncWord")]
    pub(crate) sync: ClockSync,
    /// The time between two exchanges with one federate, with `sync: on`.
    pub(crate) period: Option<TimeSpan>,
    /// Exchanges while joining, and per correction.
    #[schemars(range(min = 1, max = 1000))]
    pub(crate) trials: Option<u32>,
    /// One correction takes away the measured error divided by this.
    #[schemars(range(min = 1, max = 1000))]
    pub(crate) attenuation: Option<u32>,
    /// The largest error bound with which a federate may start.
    pub(crate) max_error: Option<TimeSpan>,
    /// What happens when a bound is larger.
    #[serde(default)]
    #[schemars(with = "OnExceedWord")]
    pub(crate) on_exceed: OnExceed,
}

/// The bounds of every connection.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct AllBounds {
    /// L: from the time at which the sender may begin a tag to the time at which the message leaves.
    pub(crate) launch_lag: Option<TimeSpan>,
    /// N: on the network.
    pub(crate) latency: Option<TimeSpan>,
    /// E: how far the two clocks are apart.
    pub(crate) clock_error: Option<TimeSpan>,
    /// Bounds between two federates, by `SENDER -> RECEIVER`; they come before those of the sender and of all.
    #[serde(default)]
    pub(crate) links: LinkMap<Bounds>,
}

/// Bounds that hold in place of the general ones.
#[derive(Clone, Copy, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Bounds {
    /// L: from the time at which the sender may begin a tag to the time at which the message leaves.
    pub(crate) launch_lag: Option<TimeSpan>,
    /// N: on the network.
    pub(crate) latency: Option<TimeSpan>,
    /// E: how far the two clocks are apart.
    pub(crate) clock_error: Option<TimeSpan>,
}

/// Where the daemon serves what it has measured.
#[derive(Clone, Copy, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Metrics {
    /// An address and port for Prometheus, read only; left out, only the daemon's own socket.
    pub(crate) listen: Option<Address>,
}

/// The coordinator.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Rti {
    /// The host on which it runs.
    pub(crate) host: Option<String>,
    /// Its TCP port; `auto` takes a free one.
    pub(crate) port: Option<Port>,
}

/// Where code comes from: a cargo package that is built, or an executable that exists.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Program {
    /// The folder of a cargo package, relative to the manifest.
    pub(crate) package: Option<String>,
    /// The package's binary, when it has several.
    pub(crate) bin: Option<String>,
    /// An executable, relative to the manifest.
    pub(crate) binary: Option<String>,
}

/// One federate: a class of a program, or a prebuilt Lingua Franca federate (`binary`, `image` or `build`).
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Federate {
    /// The program that has the class; may be left out when there is only one.
    pub(crate) program: Option<String>,
    /// The reactor class to instantiate.
    pub(crate) class: Option<String>,
    /// The class's parameters; durations are texts with a unit.
    #[serde(default)]
    pub(crate) parameters: Named<Value>,
    /// Foreign: the executable, relative to the manifest.
    pub(crate) binary: Option<String>,
    /// Foreign: in place of `binary`, an image with the executable (engine docker).
    pub(crate) image: Option<String>,
    /// Foreign: in place of `image`, a folder with a Dockerfile, of which it is built (engine docker).
    pub(crate) build: Option<ImageBuild>,
    /// Foreign: arguments after those that every LF federate gets.
    #[serde(default)]
    pub(crate) args: Vec<String>,
    /// Foreign: the federate id that was compiled in.
    pub(crate) id: Option<u16>,
    /// Foreign: its ports.
    #[serde(default)]
    pub(crate) ports: Ports,
    /// The host on which it runs; may be left out when there is only one, or `defaults.host`.
    pub(crate) host: Option<String>,
    /// Environment variables to add; they come before those of `env_file`.
    #[serde(default)]
    pub(crate) env: Named<Scalar>,
    /// Files of lines `KEY=VALUE`, relative to the manifest; of one key, the last counts.
    #[serde(default)]
    pub(crate) env_file: Vec<String>,
    /// What is handed over as a file, which `NAME_FILE` names: never part of a record, log or command line.
    #[serde(default)]
    pub(crate) secrets: Vec<Secret>,
    /// The processors it may run on; left out, all.
    #[serde(default)]
    #[schemars(inner(range(min = 0, max = 4095)))]
    pub(crate) cpus: Vec<u32>,
    /// The most memory (engine docker).
    pub(crate) memory: Option<ByteSize>,
    /// The most processes and threads (engine docker).
    #[schemars(range(min = 1, max = 4_194_304))]
    pub(crate) pids: Option<u32>,
    /// Who it runs as: `UID`, `UID:GID`, or names; left out, the daemon's user.
    pub(crate) user: Option<String>,
    /// Device files, absolute (engine docker).
    #[serde(default)]
    pub(crate) devices: Vec<String>,
    /// Directories of the host that it sees (engine docker).
    #[serde(default)]
    pub(crate) volumes: Vec<VolumeText>,
    /// Realtime scheduling.
    pub(crate) realtime: Option<RealtimeText>,
    /// How long after a tag's time it waits for messages (decentralized coordination); `auto` solves it from the bounds.
    pub(crate) stp_offset: Option<OffsetText>,
    /// L of everything it sends.
    pub(crate) launch_lag: Option<TimeSpan>,
    /// What its loss does to the others.
    #[schemars(with = "Option<OnFailureWord>")]
    pub(crate) on_failure: Option<OnFailure>,
    /// What a message that comes too late does (decentralized coordination).
    pub(crate) on_stp_violation: Option<ViolationPolicy>,
    /// Tests only: a clock that is wrong on purpose.
    #[serde(default)]
    pub(crate) clock: TestClock,
}

/// A folder of which an image is built, by the Docker engine of whoever deploys.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct ImageBuild {
    /// The folder that the build sees, relative to the manifest.
    #[schemars(required)]
    pub(crate) context: Option<String>,
    /// The Dockerfile in it; left out, `Dockerfile`.
    pub(crate) dockerfile: Option<String>,
}

/// What messages that come too late do besides being counted.
#[derive(Clone, Copy, Debug, Deserialize, JsonSchema)]
#[serde(untagged)]
#[schemars(inline)]
pub(crate) enum ViolationPolicy {
    /// Nothing.
    Count(CountWord),
    /// Stop the federation.
    Stop(ViolationLimit),
}

/// How many messages may come too late.
#[derive(Clone, Copy, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct ViolationLimit {
    /// The federate stops the federation with this one; 1 is the first.
    #[schemars(required, range(min = 1))]
    pub(crate) stop_after: Option<u32>,
}

/// A clock that is wrong on purpose.
#[derive(Clone, Copy, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct TestClock {
    /// How far it is off when the federate begins; may be negative.
    pub(crate) test_offset: Option<SignedSpan>,
    /// Microseconds that it gains in a second; may be negative.
    #[schemars(range(min = -100_000, max = 100_000))]
    pub(crate) test_drift_ppm: Option<f64>,
}

/// The ports of a foreign federate.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Ports {
    /// Inputs by name.
    #[serde(default)]
    pub(crate) inputs: Named<ForeignInput>,
    /// Outputs by name.
    #[serde(default)]
    pub(crate) outputs: Named<ForeignOutput>,
}

/// An input of a foreign federate.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct ForeignInput {
    /// The port id that was compiled in; of a multiport, that of channel 0.
    #[schemars(required)]
    pub(crate) id: Option<u16>,
    /// The type's name; left out, the type is not checked.
    #[serde(rename = "type")]
    pub(crate) type_name: Option<String>,
    /// Channels of a multiport.
    pub(crate) width: Option<u16>,
}

/// An output of a foreign federate.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct ForeignOutput {
    /// The type's name; left out, the type is not checked.
    #[serde(rename = "type")]
    pub(crate) type_name: Option<String>,
    /// Channels of a multiport.
    pub(crate) width: Option<u16>,
}

/// One output to one or several inputs.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Connection {
    /// The output: `federate.port`, or `federate.port[channel]`.
    #[schemars(required)]
    pub(crate) from: Option<String>,
    /// The input, or a list of inputs.
    #[schemars(required)]
    pub(crate) to: Option<OneOrMany>,
    /// The logical delay; `0 s` is one microstep, left out is none.
    pub(crate) after: Option<TimeSpan>,
    /// How values cross a process border; left out, the best that both ports offer.
    pub(crate) serializer: Option<String>,
    /// The receiver's port id on the wire; only needed when a foreign sender has it compiled in.
    pub(crate) port_id: Option<u16>,
    /// The tag is dropped: the receiver's clock gives a new one, `after` added.
    #[serde(default)]
    pub(crate) physical: bool,
    /// The offset of this connection in place of its receiver's.
    pub(crate) stp_offset: Option<TimeSpan>,
    /// How much longer the receiver waits, at a tag that it has begun, before it takes this input for absent.
    pub(crate) absent_after: Option<TimeSpan>,
    /// The bounds of this connection alone.
    #[serde(default)]
    pub(crate) bounds: Bounds,
}

/// What holds for the whole run.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Defaults {
    /// The host of everything that names none.
    pub(crate) host: Option<String>,
    /// How long an ordered stop may take before processes are killed.
    pub(crate) stop_grace: Option<TimeSpan>,
    /// How long federates may take to join.
    pub(crate) join_timeout: Option<TimeSpan>,
    /// How long a host may answer nothing at all before what runs there counts as lost, from 1 s to 1 h; left out, 10 s.
    pub(crate) failure_timeout: Option<TimeSpan>,
    /// The `stp_offset` of federates that have none of their own; left out, `auto`.
    pub(crate) stp_offset: Option<OffsetText>,
    /// The `on_failure` of federates that have none of their own; left out, `stop-federation`.
    #[schemars(with = "Option<OnFailureWord>")]
    pub(crate) on_failure: Option<OnFailure>,
    /// The `on_stp_violation` of federates that have none of their own; left out, `count`.
    pub(crate) on_stp_violation: Option<ViolationPolicy>,
    /// The bounds of the log files.
    #[serde(default)]
    pub(crate) logs: Logs,
}

/// The bounds of the log files.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Logs {
    /// The size at which a log file is rotated.
    pub(crate) max_size: Option<ByteSize>,
    /// Log files kept per federate.
    #[schemars(range(min = 1, max = 1000))]
    pub(crate) max_files: Option<u32>,
}

/// What `ictus timing` reports. Reactions are named `federate.reaction` or `federate.reactor.reaction`.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Timing {
    /// Which of two reactions of one federate runs first at each tag.
    #[serde(default)]
    pub(crate) order: Vec<Order>,
    /// In which order reactions run between two ticks, pair by pair.
    #[serde(default)]
    pub(crate) pairs: Vec<Pairs>,
    /// Latency along chains of reactions.
    #[serde(default)]
    pub(crate) end_to_end: Vec<Chain>,
}

/// Which of two reactions runs first at each tag.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Order {
    /// Two reactions, the expected first one first.
    #[schemars(required)]
    pub(crate) reactions: Option<Vec<String>>,
}

/// In which order reactions run between two ticks.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Pairs {
    /// What the report calls it; left out, the tick's federate.
    pub(crate) name: Option<String>,
    /// The reaction whose executions divide the run.
    #[schemars(required)]
    pub(crate) tick: Option<String>,
    /// The reactions that are compared.
    #[schemars(required)]
    pub(crate) reactions: Option<Vec<String>>,
}

/// A chain of reactions, from the start of the first to the end of the last.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Chain {
    /// What the report calls it.
    #[schemars(required)]
    pub(crate) name: Option<String>,
    /// The reaction that starts it.
    #[schemars(required)]
    pub(crate) from: Option<String>,
    /// Reactions between, in order.
    #[serde(default)]
    pub(crate) through: Vec<Hop>,
    /// The reaction that ends it; of several, the later one.
    #[schemars(required)]
    pub(crate) to: Option<OneOrMany>,
}

/// A reaction that a chain passes.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Hop {
    /// The reaction; of several, whichever runs.
    #[schemars(required)]
    pub(crate) reaction: Option<OneOrMany>,
    /// It takes at a later tag what the hop before left behind, so it must run strictly later.
    #[serde(default)]
    pub(crate) sampled: bool,
}

/// The name under which logs, events and exits speak of the RTI; no federate has it.
pub const COORDINATOR: &str = "rti";

/// Whether a text can be the name of a federate, program, port or parameter.
pub(crate) fn is_name(text: &str) -> bool {
    let mut bytes = text.bytes();
    bytes
        .next()
        .is_some_and(|first| first.is_ascii_alphabetic())
        && text.len() <= 64
        && bytes.all(|byte| byte.is_ascii_alphanumeric() || byte == b'_' || byte == b'-')
}

fn version(_: &mut SchemaGenerator) -> Schema {
    json_schema!({ "type": "string", "const": ictus_coord::plan::FORMAT })
}

/// The JSON Schema of [`Manifest`].
pub(crate) fn schema() -> Value {
    schemars::schema_for!(Manifest).to_value()
}
