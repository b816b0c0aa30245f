//! What a manifest asks for, without anything that differs from one operator's machine to another's.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use crate::check::{Checked, FederateRun, Settings};
use crate::image::hex;
use crate::placement::{Engine, HostSpec, Needs, Placement, SecretSource, Way};

/// Hexadecimal digits of a facet's digest: enough to tell two apart, few enough to keep with every record.
const FACET_DIGITS: usize = 16;

/// Added to `join_timeout`: images and containers of a slow host begin, first tags are completed.
const START_MARGIN: Duration = Duration::from_secs(60);

/// Added to `stop_grace`: SIGTERM, SIGKILL and the records come after it.
const STOP_MARGIN: Duration = Duration::from_secs(30);

/// A federation as its manifest asks for it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Desired {
    /// The version of whoever plans.
    pub version: String,
    /// The federation.
    pub federation: String,
    /// SHA-256 over all facets, in hexadecimal digits. Two manifests with the same digest run the same.
    pub digest: String,
    /// A digest of each thing that matters, by what it is: `federate/NAME/parameters`, `connections`. A host that keeps
    /// them lets a later plan say what has changed.
    pub facets: BTreeMap<String, String>,
    /// Each host that runs something.
    pub hosts: BTreeMap<String, DesiredHost>,
    /// How long a part may take from its commit until it is healthy, in milliseconds.
    pub start_limit_ms: u64,
    /// How long an ordered stop may take, in milliseconds.
    pub stop_limit_ms: u64,
}

/// What one host is to run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DesiredHost {
    /// What runs its members.
    pub engine: Engine,
    /// Whether the RTI runs there.
    pub rti: bool,
    /// Its federates, in the plan's order.
    pub federates: Vec<String>,
    /// What its federates need from it, by name; those without needs are missing.
    pub needs: BTreeMap<String, Needs>,
    /// The program files that have to be there, by digest; empty for this machine.
    pub blobs: Vec<Blob>,
    /// The images that have to be there.
    #[serde(default)]
    pub images: Vec<Image>,
}

/// An image that a host needs.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Image {
    /// As people call it.
    pub name: String,
    /// Its id where it is deployed from; absent when it is not there, and the host has it or pulls it.
    pub id: Option<String>,
    /// The machine that it is for, as Rust names it, when that is known.
    pub arch: Option<String>,
    /// Its size, when that is known.
    pub bytes: u64,
    /// The federates that run in it.
    pub federates: Vec<String>,
}

impl Image {
    /// What a host is asked for: the id, or the name.
    #[must_use]
    pub fn asked_for(&self) -> &str {
        self.id.as_ref().unwrap_or(&self.name)
    }
}

/// What is known of a federate's image where it is deployed from.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ImageFile {
    /// As people call it.
    pub name: String,
    /// Its id; absent when it is not there.
    pub id: Option<String>,
    /// The machine that it is for, as Rust names it.
    pub arch: Option<String>,
    /// Its size.
    pub bytes: u64,
}

/// A program file that a host needs.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Blob {
    /// Its SHA-256 in hexadecimal digits.
    pub digest: String,
    /// Its size.
    pub bytes: u64,
    /// The machine that it is for, as Rust names it.
    pub arch: String,
    /// The federates that execute it.
    pub federates: Vec<String>,
}

/// What a program file is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ProgramFile {
    /// Its SHA-256 in hexadecimal digits.
    pub digest: String,
    /// Its size.
    pub bytes: u64,
    /// The machine that it is for, as Rust names it: `x86_64`, `aarch64`.
    pub arch: String,
}

/// Why nothing can be asked for.
#[derive(Debug, thiserror::Error)]
pub enum DesiredError {
    /// The manifest names no hosts.
    #[error(
        "the manifest names no hosts: everything runs on this machine, and nothing is rolled out"
    )]
    NoHosts,
    /// It was checked without building.
    #[error("federate `{federate}` was not built; check with building")]
    NotBuilt {
        /// The first that was not.
        federate: String,
    },
    /// A program file cannot be read.
    #[error("cannot read the program of federate `{federate}`, {path}", path = path.display())]
    Program {
        /// The first federate that executes it.
        federate: String,
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// Something of the manifest cannot be written as JSON.
    #[error("cannot digest the manifest")]
    Unwritable(#[from] serde_json::Error),
}

impl Desired {
    /// What a checked manifest asks for; `trace` says whether logical traces are written, `program` what a file is.
    ///
    /// The digest depends on no path of this machine, no time and no secret's value or source; of secrets the names count.
    ///
    /// # Errors
    /// When there are no hosts, or a program was not built or cannot be read.
    pub fn of(
        checked: &Checked,
        trace: bool,
        program: &mut dyn FnMut(&Path) -> io::Result<ProgramFile>,
    ) -> Result<Self, DesiredError> {
        let placement = checked.placement.as_ref().ok_or(DesiredError::NoHosts)?;
        let files = program_files(checked, program)?;
        let facets = facets(checked, placement, trace, &files)?;
        let whole = json!({ "federation": checked.plan.federation, "facets": facets });
        let (start_limit_ms, stop_limit_ms) = Self::limits(&checked.settings);
        Ok(Self {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            federation: checked.plan.federation.clone(),
            digest: digest(&whole),
            hosts: hosts(checked, placement, &files),
            facets,
            start_limit_ms,
            stop_limit_ms,
        })
    }

    /// How long a part may take until it is healthy, and how long an ordered stop may take, in milliseconds.
    #[must_use]
    pub fn limits(settings: &Settings) -> (u64, u64) {
        (
            milliseconds(settings.join_timeout + START_MARGIN),
            milliseconds(settings.stop_grace + STOP_MARGIN),
        )
    }

    /// Takes over what is known of the images of federates, by federate: another id is another program.
    #[must_use]
    pub fn with_images(mut self, images: &BTreeMap<String, ImageFile>) -> Self {
        for host in self.hosts.values_mut() {
            for federate in &host.federates {
                let Some(image) = images.get(federate) else {
                    continue;
                };
                let same = |known: &&mut Image| known.name == image.name && known.id == image.id;
                if let Some(known) = host.images.iter_mut().find(same) {
                    known.federates.push(federate.clone());
                    continue;
                }
                host.images.push(Image {
                    name: image.name.clone(),
                    id: image.id.clone(),
                    arch: image.arch.clone(),
                    bytes: image.bytes,
                    federates: vec![federate.clone()],
                });
            }
        }
        for (federate, image) in images {
            let asked_for = image.id.as_ref().unwrap_or(&image.name);
            let facet = short(&json!({ "file": null, "image": asked_for }));
            self.facets
                .insert(format!("federate/{federate}/program"), facet);
        }
        let whole = json!({ "federation": self.federation, "facets": self.facets });
        self.digest = digest(&whole);
        self
    }

    /// Federates on all hosts.
    #[must_use]
    pub fn federates(&self) -> usize {
        self.hosts.values().map(|host| host.federates.len()).sum()
    }
}

/// The file of each federate that executes one, by its path.
fn program_files(
    checked: &Checked,
    program: &mut dyn FnMut(&Path) -> io::Result<ProgramFile>,
) -> Result<BTreeMap<PathBuf, ProgramFile>, DesiredError> {
    if let Some(federate) = checked.plan.federates.get(checked.federates.len()) {
        let federate = federate.name.clone();
        return Err(DesiredError::NotBuilt { federate });
    }
    let mut files = BTreeMap::new();
    let runs = checked.federates.iter();
    for run in runs.filter(|run| !run.needs.has_image()) {
        let path = &run.executable;
        if files.contains_key(path) {
            continue;
        }
        let file = program(path).map_err(|source| DesiredError::Program {
            federate: run.name.clone(),
            path: path.clone(),
            source,
        })?;
        files.insert(path.clone(), file);
    }
    Ok(files)
}

fn hosts(
    checked: &Checked,
    placement: &Placement,
    files: &BTreeMap<PathBuf, ProgramFile>,
) -> BTreeMap<String, DesiredHost> {
    let host = |(index, spec): (usize, &HostSpec)| {
        let runs = || {
            let all = checked.federates.iter().zip(&placement.federates);
            all.filter(move |(_, host)| **host == index)
                .map(|(run, _)| run)
        };
        let needs = runs().filter(|run| run.needs != Needs::default());
        let host = DesiredHost {
            engine: spec.engine,
            rti: placement.rti == index,
            federates: runs().map(|run| run.name.clone()).collect(),
            needs: needs
                .map(|run| (run.name.clone(), without_sources(&run.needs)))
                .collect(),
            images: Vec::new(),
            blobs: match spec.way {
                Way::Local => Vec::new(),
                Way::Ssh { .. } => blobs(runs(), files),
            },
        };
        (spec.name.clone(), host)
    };
    placement.hosts.iter().enumerate().map(host).collect()
}

/// Where a secret's value comes from is the operator's business.
fn without_sources(needs: &Needs) -> Needs {
    let mut needs = needs.clone();
    for source in needs.secrets.values_mut() {
        *source = SecretSource::Environment;
    }
    needs
}

/// One for each program, however many execute it.
fn blobs<'a>(
    runs: impl Iterator<Item = &'a FederateRun>,
    files: &BTreeMap<PathBuf, ProgramFile>,
) -> Vec<Blob> {
    let mut blobs: BTreeMap<&str, Blob> = BTreeMap::new();
    for run in runs.filter(|run| !run.needs.has_image()) {
        let Some(file) = files.get(&run.executable) else {
            continue;
        };
        let blob = blobs.entry(&file.digest).or_insert_with(|| Blob {
            digest: file.digest.clone(),
            bytes: file.bytes,
            arch: file.arch.clone(),
            federates: Vec::new(),
        });
        blob.federates.push(run.name.clone());
    }
    blobs.into_values().collect()
}

/// Everything that matters, digested by what it is.
fn facets(
    checked: &Checked,
    placement: &Placement,
    trace: bool,
    files: &BTreeMap<PathBuf, ProgramFile>,
) -> Result<BTreeMap<String, String>, DesiredError> {
    let host = |index: usize| placement.hosts.get(index).map(|host| host.name.as_str());
    let mut plan = serde_json::to_value(&checked.plan)?;
    let connections = take(&mut plan, "connections");
    let clock = take(&mut plan, "clock");
    let federates = take(&mut plan, "federates");
    let mut all = vec![
        ("coordination".to_owned(), plan),
        ("connections".to_owned(), connections),
        ("clock".to_owned(), clock),
        (
            "settings".to_owned(),
            serde_json::to_value(&checked.settings)?,
        ),
        ("timing".to_owned(), serde_json::to_value(&checked.timing)?),
        ("trace".to_owned(), json!(trace)),
        ("rti/host".to_owned(), json!(host(placement.rti))),
        ("security".to_owned(), json!(placement.security)),
    ];
    for spec in &placement.hosts {
        let facet = json!({ "engine": spec.engine, "address": spec.address, "ports": spec.ports });
        all.push((format!("host/{}", spec.name), facet));
    }
    let federates = federates.as_array().cloned().unwrap_or_default();
    for (index, (run, mut told)) in checked.federates.iter().zip(federates).enumerate() {
        let mut facet = |what: &str, value: Value| {
            all.push((format!("federate/{}/{what}", run.name), value));
        };
        let mut run_as = serde_json::to_value(run)?;
        let mut needs = take(&mut run_as, "needs");
        // Where a value comes from is the operator's business, its name is the federate's.
        take(&mut needs, "secrets");
        // What is built says what it is by its id.
        take(&mut needs, "build");
        take(&mut run_as, "executable");
        let secrets: BTreeSet<&String> = run.needs.secrets.keys().collect();
        let program = files.get(&run.executable).map(|file| &file.digest);
        facet(
            "program",
            json!({ "file": program, "image": take(&mut needs, "image") }),
        );
        facet("parameters", take(&mut told, "parameters"));
        facet(
            "environment",
            json!({ "env": take(&mut run_as, "env"), "secrets": secrets }),
        );
        facet("needs", needs);
        facet("behaviour", json!([told, run_as]));
        facet(
            "host",
            json!(placement.federates.get(index).copied().and_then(host)),
        );
    }
    Ok(all
        .iter()
        .map(|(key, value)| (key.clone(), short(value)))
        .collect())
}

/// The digest of a facet.
fn short(value: &Value) -> String {
    digest(value).chars().take(FACET_DIGITS).collect()
}

/// Takes a key out of an object.
fn take(value: &mut Value, key: &str) -> Value {
    let object = value.as_object_mut();
    object
        .and_then(|object| object.remove(key))
        .unwrap_or(Value::Null)
}

fn milliseconds(span: Duration) -> u64 {
    u64::try_from(span.as_millis()).unwrap_or(u64::MAX)
}

/// SHA-256 of a value's canonical JSON (keys sorted, no spaces), in hexadecimal digits.
pub(super) fn digest(value: &Value) -> String {
    let mut text = String::new();
    canonical(value, &mut text);
    hex(&Sha256::digest(text.as_bytes()))
}

/// Keys in order, whatever order `serde_json` was built to keep.
fn canonical(value: &Value, text: &mut String) {
    match value {
        Value::Object(object) => {
            let sorted: BTreeMap<_, _> = object.iter().collect();
            text.push('{');
            for (index, (key, value)) in sorted.into_iter().enumerate() {
                text.push_str(if index == 0 { "" } else { "," });
                text.push_str(&Value::from(key.as_str()).to_string());
                text.push(':');
                canonical(value, text);
            }
            text.push('}');
        }
        Value::Array(values) => {
            text.push('[');
            for (index, value) in values.iter().enumerate() {
                text.push_str(if index == 0 { "" } else { "," });
                canonical(value, text);
            }
            text.push(']');
        }
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => {
            text.push_str(&value.to_string());
        }
    }
}
