//! A compose file's own words, as far as they are used.

use std::collections::BTreeMap;

use serde::{Serialize, Serializer};
use serde_saphyr::{FlowSeq, RcAnchor, ser_options};

use super::ComposeError;

/// A mapping in the order in which it was written down.
#[derive(Clone, Debug)]
pub(super) struct Table<T>(pub(super) Vec<(String, T)>);

impl<T> Table<T> {
    fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}

impl<T> Default for Table<T> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<T: Serialize> Serialize for Table<T> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(self.0.iter().map(|(name, value)| (name, value)))
    }
}

/// The whole file.
#[derive(Debug, Serialize)]
pub(super) struct File {
    #[serde(rename = "x-plan")]
    pub(super) plan: RcAnchor<String>,
    pub(super) services: Table<Service>,
    #[serde(skip_serializing_if = "Table::is_empty")]
    pub(super) volumes: Table<NamedVolume>,
    #[serde(skip_serializing_if = "Table::is_empty")]
    pub(super) secrets: Table<SecretFile>,
}

impl File {
    pub(super) fn yaml(&self) -> Result<String, ComposeError> {
        let options = ser_options! {
            anchor_generator: Some(|_| "plan".to_owned()),
            prefer_block_scalars: false,
            compact_list_indent: false
        };
        serde_saphyr::to_string_with_options(self, options)
            .map_err(|error| ComposeError::Unwritable(error.to_string()))
    }
}

/// A container.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct Service {
    /// Who else is to make the image: Compose, from a folder.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) build: Option<Build>,
    pub(super) image: String,
    #[serde(skip_serializing_if = "Line::is_empty")]
    pub(super) command: Line,
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub(super) environment: BTreeMap<String, Variable>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) user: Option<String>,
    #[serde(skip_serializing_if = "Table::is_empty")]
    pub(super) depends_on: Table<Depends>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) healthcheck: Option<Healthcheck>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(super) ports: Vec<String>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(super) volumes: Vec<Mount>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(super) secrets: Vec<MountedSecret>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(super) devices: Vec<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) cpuset: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) mem_limit: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) memswap_limit: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) pids_limit: Option<u32>,
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub(super) ulimits: BTreeMap<&'static str, i64>,
    #[serde(skip_serializing_if = "Line::is_empty")]
    pub(super) cap_drop: Line,
    #[serde(skip_serializing_if = "Line::is_empty")]
    pub(super) security_opt: Line,
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub(super) read_only: bool,
    #[serde(skip_serializing_if = "Line::is_empty")]
    pub(super) tmpfs: Line,
    pub(super) restart: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) stop_grace_period: Option<String>,
    pub(super) logging: Logging,
}

/// A folder of which Compose builds an image.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Build {
    pub(super) context: String,
    pub(super) dockerfile: String,
}

/// A sequence on one line.
#[derive(Clone, Debug, Default)]
pub(super) struct Line(pub(super) Vec<String>);

impl Line {
    /// Of these words.
    pub(super) fn of<const N: usize>(words: [&str; N]) -> Self {
        Self(words.map(str::to_owned).into())
    }

    fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}

impl Serialize for Line {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        FlowSeq(&self.0).serialize(serializer)
    }
}

/// A variable's value.
#[derive(Clone, Debug, Serialize)]
#[serde(untagged)]
pub(super) enum Variable {
    /// The plan, which stands in the file once.
    Plan(RcAnchor<String>),
    /// Another one.
    Text(String),
}

/// What another service must be before this one is started.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Depends {
    condition: &'static str,
}

impl Depends {
    pub(super) const HEALTHY: Self = Self {
        condition: "service_healthy",
    };
}

/// How it is known that a service works.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Healthcheck {
    test: Line,
    interval: &'static str,
    timeout: &'static str,
    retries: u32,
}

impl Healthcheck {
    /// `ictus` is there and listens, or serves whom it has accepted. There is no shell in the image, and no connection is
    /// made that would be a stranger's.
    pub(super) fn of_port(port: u16) -> Self {
        let test = ["CMD", crate::image::PROGRAM, "health", &port.to_string()];
        Self {
            test: Line::of(test),
            interval: "2s",
            timeout: "10s",
            retries: 15,
        }
    }
}

/// The bounds of a container's log.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct Logging {
    driver: &'static str,
    options: BTreeMap<&'static str, String>,
}

impl Logging {
    pub(super) fn files(bytes: u64, files: u32) -> Self {
        let options = [
            ("max-size", bytes.to_string()),
            ("max-file", files.max(1).to_string()),
        ];
        Self {
            driver: "json-file",
            options: options.into(),
        }
    }
}

/// What is mounted.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Mount {
    r#type: &'static str,
    source: String,
    target: String,
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    read_only: bool,
}

impl Mount {
    /// A directory of the host, which must be there.
    pub(super) fn bind(source: String, target: impl Into<String>) -> Self {
        Self {
            r#type: "bind",
            source,
            target: target.into(),
            read_only: false,
        }
    }

    /// A volume of the file.
    pub(super) fn volume(source: &str, target: &str) -> Self {
        Self {
            r#type: "volume",
            ..Self::bind(source.to_owned(), target)
        }
    }

    /// The same, but it can only be read.
    pub(super) fn read_only(self, read_only: bool) -> Self {
        Self { read_only, ..self }
    }
}

/// A volume of the file.
#[derive(Clone, Debug, Serialize)]
pub(super) struct NamedVolume {
    driver: &'static str,
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    driver_opts: BTreeMap<&'static str, &'static str>,
}

impl NamedVolume {
    /// In memory, for whoever mounts it, as long as somebody does.
    pub(super) fn shared_memory() -> Self {
        let options = [
            ("type", "tmpfs"),
            ("device", "tmpfs"),
            ("o", "mode=1777,size=1m"),
        ];
        Self {
            driver: "local",
            driver_opts: options.into(),
        }
    }

    /// On disk, until `down -v`.
    pub(super) fn kept() -> Self {
        Self {
            driver: "local",
            driver_opts: BTreeMap::new(),
        }
    }
}

/// A secret in a container.
#[derive(Clone, Debug, Serialize)]
pub(super) struct MountedSecret {
    pub(super) source: String,
    pub(super) target: String,
}

/// A secret of the file: where it is, never what.
#[derive(Clone, Debug, Serialize)]
pub(super) struct SecretFile {
    pub(super) file: String,
}
