//! What a program says of itself: `PROGRAM --describe [INSTANCES.json]`, JSON on standard output.

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

/// The answer to `--describe`: every class with its default parameters.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ProgramDescription {
    /// Always [`crate::plan::FORMAT`].
    pub ictus: String,
    /// Classes in the order in which the program lists them.
    pub classes: Vec<ClassDescription>,
}

/// A class, or an instance of it with given parameters (widths may depend on them).
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ClassDescription {
    /// The class name.
    pub class: String,
    /// Parameters in order of declaration.
    pub parameters: Vec<ParameterDescription>,
    /// Inputs in order of declaration.
    pub inputs: Vec<PortDescription>,
    /// Outputs in order of declaration.
    pub outputs: Vec<PortDescription>,
    /// Which output may be set at the very tag at which which input is present: `(input, output)` port names.
    pub zero_delay: Vec<(String, String)>,
    /// Whether a physical action exists anywhere inside.
    pub physical: bool,
    /// `path#index name` of every reaction, path relative to the instance (`""` is the instance itself).
    pub reactions: Vec<ReactionDescription>,
    /// Why the instance cannot be built with the given parameters; then all but `class` is empty.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
}

/// A parameter of a class.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ParameterDescription {
    /// The parameter's name.
    pub name: String,
    /// The Rust type as written.
    #[serde(rename = "type")]
    pub type_name: String,
    /// Whether the manifest must give it.
    pub required: bool,
}

/// A port of a class.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PortDescription {
    /// The port's name.
    pub name: String,
    /// The number of channels of a multiport; absent for a plain port.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub width: Option<u32>,
    /// The type's identity; two ports may be connected only when it is equal.
    #[serde(rename = "type")]
    pub type_identity: TypeIdentity,
    /// Serializers that the type offers, best first: `native`, `postcard`.
    pub serializers: Vec<String>,
}

/// The identity of a port type.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TypeIdentity {
    /// The declared name, without module path.
    pub name: String,
    /// 16 hexadecimal digits made from the layout: field names, types and order.
    pub fingerprint: String,
}

/// A reaction of an instance.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReactionDescription {
    /// The reactor's path below the instance; empty for the instance itself.
    pub path: String,
    /// Position among the reactor's reactions, from 0: declared order.
    pub index: u32,
    /// The method's name.
    pub name: String,
}

/// One line of the file given to `--describe FILE`: a JSON array of these.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InstanceRequest {
    /// The federate's name.
    pub name: String,
    /// The class to build.
    pub class: String,
    /// Its parameters.
    #[serde(default)]
    pub parameters: Map<String, Value>,
}

/// The answer to `--describe FILE`: one description per request, in order.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct InstanceDescriptions {
    /// Always [`crate::plan::FORMAT`].
    pub ictus: String,
    /// One per request, in order.
    pub instances: Vec<ClassDescription>,
}
