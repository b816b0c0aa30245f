//! What a manifest says of what a federate needs from its host.

use schemars::JsonSchema;
use serde::Deserialize;

use super::words::RealtimePolicyWord;
use crate::placement::RealtimePolicy;

/// Realtime scheduling.
#[derive(Clone, Copy, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct RealtimeText {
    /// The kernel's scheduling policy.
    #[schemars(required, with = "RealtimePolicyWord")]
    pub(crate) policy: Option<RealtimePolicy>,
    /// Among realtime threads; the largest comes first.
    #[schemars(required, range(min = 1, max = 99))]
    pub(crate) priority: Option<u8>,
    /// Its memory is never swapped out.
    #[serde(default)]
    pub(crate) lock_memory: bool,
}

/// A directory of the host that a container sees.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct VolumeText {
    /// The directory on the host; absolute.
    #[schemars(required)]
    pub(crate) host: Option<String>,
    /// Where the federate finds it; absolute.
    #[schemars(required)]
    pub(crate) at: Option<String>,
    /// It may only be read.
    #[serde(default)]
    pub(crate) read_only: bool,
}

/// A secret: the name of an environment variable of whoever starts the federation, or a name with a file.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(untagged)]
#[schemars(inline)]
pub(crate) enum Secret {
    /// From the environment.
    Name(String),
    /// From a file.
    Entry(SecretEntry),
}

/// A secret from a file.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct SecretEntry {
    /// Its name; the federate finds the file in `NAME_FILE`.
    #[schemars(required)]
    pub(crate) name: Option<String>,
    /// The file that has it when the federation is started; relative to the manifest, or below `~/`.
    #[schemars(required)]
    pub(crate) file: Option<String>,
}
