//! The words of the plan's enumerations, for the schema: what each means to who writes a manifest.

use schemars::JsonSchema;

/// How tags are granted.
#[derive(JsonSchema)]
#[serde(rename_all = "lowercase")]
#[schemars(inline)]
#[expect(dead_code, reason = "only its schema is used")]
pub(crate) enum CoordinationWord {
    /// By the coordinator: consistency first.
    Centralized,
    /// By each federate's clock and offset, messages from federate to federate: availability first.
    Decentralized,
}

/// Who starts a federation.
#[derive(JsonSchema)]
#[serde(rename_all = "lowercase")]
#[schemars(inline)]
#[expect(dead_code, reason = "only its schema is used")]
pub(crate) enum DeployWord {
    /// The daemons of the hosts, or of this machine.
    Ictusd,
    /// docker-compose on this machine, from the file that `ictus compose` prints.
    Compose,
}

/// Layouts of messages.
#[derive(JsonSchema)]
#[schemars(inline)]
#[expect(dead_code, reason = "only its schema is used")]
pub(crate) enum WireWord {
    /// Lingua Franca 0.10 to 0.12.
    #[serde(rename = "0.12")]
    V0_12,
    /// Lingua Franca 0.13.
    #[serde(rename = "0.13")]
    V0_13,
}

/// When clocks are compared.
#[derive(JsonSchema)]
#[serde(rename_all = "lowercase")]
#[schemars(inline)]
#[expect(dead_code, reason = "only its schema is used")]
pub(crate) enum ClockSyncWord {
    /// Never; the host's clock is taken as it is.
    Off,
    /// While joining.
    Init,
    /// While joining, and all the time from then on.
    On,
    /// The host's own service (chrony, ptp4l, timesyncd) is trusted and read.
    External,
}

/// What happens when a clock's error bound is too large.
#[derive(JsonSchema)]
#[serde(rename_all = "lowercase")]
#[schemars(inline)]
#[expect(dead_code, reason = "only its schema is used")]
pub(crate) enum OnExceedWord {
    /// The federate does not start.
    Refuse,
    /// It says so and starts.
    Warn,
}

/// What a federate's loss does to the others.
#[derive(JsonSchema)]
#[serde(rename_all = "kebab-case")]
#[schemars(inline)]
#[expect(dead_code, reason = "only its schema is used")]
pub(crate) enum OnFailureWord {
    /// They agree on a stop tag at once.
    StopFederation,
    /// They go on; nothing comes from it any more.
    Continue,
}

/// What runs a host's federates.
#[derive(JsonSchema)]
#[serde(rename_all = "lowercase")]
#[schemars(inline)]
#[expect(dead_code, reason = "only its schema is used")]
pub(crate) enum EngineWord {
    /// A process each.
    Process,
    /// A container each.
    Docker,
}

/// Which program speaks ssh.
#[derive(JsonSchema)]
#[serde(rename_all = "lowercase")]
#[schemars(inline)]
#[expect(dead_code, reason = "only its schema is used")]
pub(crate) enum SshClientWord {
    /// Ictus itself.
    Ssh2,
    /// The system's `ssh`: security keys, certificates, all of ssh_config.
    System,
}

/// What protects the messages between hosts.
#[derive(JsonSchema)]
#[serde(rename_all = "kebab-case")]
#[schemars(inline)]
#[expect(dead_code, reason = "only its schema is used")]
pub(crate) enum SecurityWord {
    /// Nothing but the network: whoever is on it can read and disturb.
    TrustedNetwork,
    /// TLS with certificates that `ictus up` makes; the default.
    Mtls,
}

/// The kernel's realtime policies.
#[derive(JsonSchema)]
#[serde(rename_all = "kebab-case")]
#[schemars(inline)]
#[expect(dead_code, reason = "only its schema is used")]
pub(crate) enum RealtimePolicyWord {
    /// Runs until it waits.
    Fifo,
    /// Takes turns with those of its priority.
    RoundRobin,
}
