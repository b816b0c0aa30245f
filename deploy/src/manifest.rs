//! The manifest as it is written: the types behind the JSON Schema. Nothing is checked here but form.

use std::fmt;
use std::marker::PhantomData;

use ictus_coord::plan::{ClockSync, Coordination};
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::{Deserializer, MapAccess, Visitor};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::quantity;

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
    /// The coordinator.
    #[serde(default)]
    pub(crate) rti: Rti,
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
    /// `off` takes the host's clock as it is; `init` compares it with the coordinator's while joining.
    #[serde(default)]
    #[schemars(with = "ClockSyncWord")]
    pub(crate) sync: ClockSync,
}

/// The coordinator.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Rti {
    /// Its TCP port on the loopback address; `auto` takes a free one.
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

/// One federate: a class of a program, or a prebuilt Lingua Franca federate (`binary`).
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
    /// Foreign: arguments after those that every LF federate gets.
    #[serde(default)]
    pub(crate) args: Vec<String>,
    /// Foreign: the federate id that was compiled in.
    pub(crate) id: Option<u16>,
    /// Foreign: its ports.
    #[serde(default)]
    pub(crate) ports: Ports,
    /// Environment variables to add.
    #[serde(default)]
    pub(crate) env: Named<Scalar>,
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
}

/// What holds for the whole run.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Defaults {
    /// How long an ordered stop may take before processes are killed.
    pub(crate) stop_grace: Option<TimeSpan>,
    /// How long federates may take to join.
    pub(crate) join_timeout: Option<TimeSpan>,
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

/// One text or a list of them.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(untagged)]
#[schemars(inline)]
pub(crate) enum OneOrMany {
    /// One.
    One(String),
    /// Several.
    Many(Vec<String>),
}

impl OneOrMany {
    /// The texts.
    pub(crate) fn as_slice(&self) -> &[String] {
        match self {
            Self::One(one) => std::slice::from_ref(one),
            Self::Many(many) => many,
        }
    }

    /// Whether it was written as a list.
    pub(crate) fn is_list(&self) -> bool {
        matches!(self, Self::Many(_))
    }
}

/// A text, number or boolean, as a text.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(untagged)]
#[schemars(inline)]
pub(crate) enum Scalar {
    /// A boolean.
    Bool(bool),
    /// An integer.
    Integer(i64),
    /// A number.
    Number(f64),
    /// A text.
    Text(String),
}

impl fmt::Display for Scalar {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Bool(value) => value.fmt(f),
            Self::Integer(value) => value.fmt(f),
            Self::Number(value) => value.fmt(f),
            Self::Text(value) => value.fmt(f),
        }
    }
}

/// A TCP port, or `auto`.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(untagged)]
#[schemars(inline)]
pub(crate) enum Port {
    /// This one.
    Number(#[schemars(range(min = 1, max = 65535))] u16),
    /// `auto`.
    Word(AutoWord),
}

/// The word `auto`.
#[derive(Clone, Copy, Debug, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
#[schemars(inline)]
pub(crate) enum AutoWord {
    /// Any free one.
    Auto,
}

/// A mapping from names, in the order of the text.
#[derive(Clone, Debug)]
pub(crate) struct Named<T>(pub(crate) Vec<(String, T)>);

impl<T> Default for Named<T> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<T> Named<T> {
    /// The value of a name.
    pub(crate) fn get(&self, name: &str) -> Option<&T> {
        self.0
            .iter()
            .find(|(have, _)| have == name)
            .map(|(_, value)| value)
    }

    /// The names.
    pub(crate) fn names(&self) -> impl Iterator<Item = &str> {
        self.0.iter().map(|(name, _)| name.as_str())
    }

    /// Whether there is none.
    pub(crate) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}

impl<'de, T: Deserialize<'de>> Deserialize<'de> for Named<T> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct NamedVisitor<T>(PhantomData<T>);
        impl<'de, T: Deserialize<'de>> Visitor<'de> for NamedVisitor<T> {
            type Value = Named<T>;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a mapping")
            }
            fn visit_unit<E>(self) -> Result<Named<T>, E> {
                Ok(Named::default())
            }
            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Named<T>, A::Error> {
                let mut entries = Vec::new();
                while let Some(entry) = map.next_entry()? {
                    entries.push(entry);
                }
                Ok(Named(entries))
            }
        }
        deserializer.deserialize_map(NamedVisitor(PhantomData))
    }
}

impl<T: JsonSchema> JsonSchema for Named<T> {
    fn inline_schema() -> bool {
        true
    }
    fn schema_name() -> std::borrow::Cow<'static, str> {
        format!("Named{}", T::schema_name()).into()
    }
    fn json_schema(generator: &mut SchemaGenerator) -> Schema {
        json_schema!({
            "type": "object",
            "propertyNames": Name::json_schema(generator),
            "additionalProperties": generator.subschema_for::<T>(),
        })
    }
}

macro_rules! text_with_format {
    ($(#[$doc:meta])* $name:ident($inner:ty), $format:literal, $pattern:literal) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
        pub(crate) struct $name(pub(crate) $inner);

        impl JsonSchema for $name {
            fn inline_schema() -> bool {
                true
            }
            fn schema_name() -> std::borrow::Cow<'static, str> {
                $format.into()
            }
            fn json_schema(_: &mut SchemaGenerator) -> Schema {
                json_schema!({ "type": "string", "format": $format, "pattern": $pattern })
            }
        }
    };
}

text_with_format! {
    /// A duration in nanoseconds, written `10 ms`.
    TimeSpan(i64), "ictus-duration",
    r"^\s*[0-9]+(\.[0-9]+)?\s*(ns|nsec|us|usec|ms|msec|s|sec|min|h)\s*$"
}
text_with_format! {
    /// A size in bytes, written `10 MiB`.
    ByteSize(u64), "ictus-size", r"^\s*[0-9]+(\.[0-9]+)?\s*(B|kB|KiB|MB|MiB|GB|GiB)\s*$"
}
text_with_format! {
    /// A name: a letter, then letters, digits, `_` and `-`.
    Name(()), "ictus-name", r"^[A-Za-z][A-Za-z0-9_-]{0,63}$"
}

impl<'de> Deserialize<'de> for TimeSpan {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        let span = quantity::duration(&text).map_err(serde::de::Error::custom)?;
        Ok(Self(span.as_nanos()))
    }
}

impl<'de> Deserialize<'de> for ByteSize {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        quantity::size(&text)
            .map(Self)
            .map_err(serde::de::Error::custom)
    }
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

/// The words of [`Coordination`], for the schema.
#[derive(JsonSchema)]
#[serde(rename_all = "lowercase")]
#[schemars(inline)]
#[expect(dead_code, reason = "only its schema is used")]
enum CoordinationWord {
    /// By the RTI: consistency first.
    Centralized,
}

/// The words of [`ClockSync`], for the schema.
#[derive(JsonSchema)]
#[serde(rename_all = "lowercase")]
#[schemars(inline)]
#[expect(dead_code, reason = "only its schema is used")]
enum ClockSyncWord {
    /// No exchanges; the host's clock is taken as it is.
    Off,
    /// Ten exchanges with the coordinator while joining.
    Init,
}

/// The JSON Schema of [`Manifest`].
pub(crate) fn schema() -> Value {
    schemars::schema_for!(Manifest).to_value()
}
