//! What a manifest says of the machines on which a federation runs.

use schemars::JsonSchema;
use serde::Deserialize;

use super::words::{EngineWord, SshClientWord};
use crate::placement::{Engine, SshClient};

/// A machine on which a part of the federation runs: one that is reached over ssh, or this one.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Host {
    /// How it is reached: `[USER@]HOST[:PORT]`, or an alias of ssh_config.
    pub(crate) ssh: Option<String>,
    /// It is this machine.
    #[serde(default)]
    pub(crate) local: bool,
    /// Where the other hosts reach its federates: an IPv4 address, or a name that has one; left out, that of `ssh`.
    pub(crate) address: Option<String>,
    /// What runs its federates.
    #[serde(default)]
    #[schemars(with = "EngineWord")]
    pub(crate) engine: Engine,
    /// The ports that coordinator and federates may use there, such as `15045-15099`; left out, any.
    pub(crate) ports: Option<PortsText>,
    /// Who speaks ssh; left out, `ssh2`.
    #[schemars(with = "Option<SshClientWord>")]
    pub(crate) client: Option<SshClient>,
    /// The key file, when it is not one of the usual; relative to the manifest, or below `~/`.
    pub(crate) identity: Option<String>,
    /// Its architecture; left out, that of this machine.
    pub(crate) arch: Option<Arch>,
}

/// One port, or a range of them.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(untagged)]
#[schemars(inline)]
pub(crate) enum PortsText {
    /// This one.
    One(#[schemars(range(min = 1, max = 65535))] u16),
    /// `FIRST-LAST`.
    Range(String),
}

/// A machine's architecture, as Debian calls it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
#[schemars(inline)]
pub(crate) enum Arch {
    /// 64-bit x86.
    Amd64,
    /// 64-bit ARM.
    Arm64,
    /// 64-bit RISC-V.
    Riscv64,
}

impl Arch {
    /// Its name here.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Amd64 => "amd64",
            Self::Arm64 => "arm64",
            Self::Riscv64 => "riscv64",
        }
    }

    /// Its name in Rust's target triples, and in `std::env::consts::ARCH`.
    pub(crate) fn rust(self) -> &'static str {
        match self {
            Self::Amd64 => "x86_64",
            Self::Arm64 => "aarch64",
            Self::Riscv64 => "riscv64",
        }
    }
}
