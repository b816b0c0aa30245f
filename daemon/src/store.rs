//! What is on disk of each federation: `STATE/federations/NAME/`.

use std::collections::BTreeMap;
use std::fs::{self, DirBuilder, OpenOptions};
use std::io::{self, Write};
use std::net::SocketAddrV4;
use std::os::unix::fs::{DirBuilderExt, PermissionsExt};
use std::path::{Path, PathBuf};

use ictus_coord::plan::Plan;
use ictus_deploy::TimingSpec;
use serde::{Deserialize, Serialize};

use crate::api::recorded::Kept;
use crate::api::{FederationMeasures, FederationView, Happening, StartRequest};
use crate::files;
use crate::identity::ProcessIdentity;
use crate::secrets::KeptSecrets;
use crate::supervisor::spec::PROTOCOL;

/// The longest federation or federate name.
const NAME_BYTES_MAX: usize = 100;
/// Bytes of `events.ndjson`; later events are told but not kept.
const EVENTS_BYTES_MAX: u64 = 4 << 20;

/// The directory of one federation's last run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Directory(PathBuf);

/// What a later daemon needs to take a run over.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// Always [`PROTOCOL`]; a newer one is refused.
    pub protocol: u32,
    /// Members by name; each is entered before its supervisor is started.
    pub members: BTreeMap<String, Supervised>,
    /// Where the RTI listens, when that is another host.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rti: Option<SocketAddrV4>,
    /// Where the run's secrets are, and their MACs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub secrets: Option<KeptSecrets>,
    /// Ports that were chosen for federates of this host, by name.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub ports: BTreeMap<String, u16>,
    /// The federation as it was when the record was written.
    pub view: FederationView,
}

/// A supervisor that was started.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Supervised {
    /// The random id it answers with.
    pub instance: String,
    /// Where it listens.
    pub socket: PathBuf,
    /// The container whose first process it is, by name (engine docker).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub container: Option<String>,
    /// The process as this host sees it, once it has answered.
    pub supervisor: Option<ProcessIdentity>,
}

/// What stays of a run that is removed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Leave {
    /// What a person may want to read, and the generations.
    Logs,
    /// The generations only.
    History,
    /// Nothing.
    Nothing,
}

/// Why a stored run cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// A file cannot be read or written.
    #[error("cannot use {path}", path = path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// Another user has written there, whose files this one cannot remove: a container with a `user` of its own.
    #[error(
        "cannot remove {path}: another user has written there, as federates with `user` may; `sudo rm -r {path}` on that host removes it",
        path = path.display()
    )]
    Others {
        /// The directory.
        path: PathBuf,
    },
    /// A file is not what it should be.
    #[error("{path} is damaged", path = path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// How.
        source: serde_json::Error,
    },
    /// The record was written by a newer version. Use that one.
    #[error("{path} is of protocol {found}; this is {PROTOCOL}", path = path.display())]
    Newer {
        /// The file.
        path: PathBuf,
        /// Its version.
        found: u32,
    },
}

/// Whether a name may be a federation's or federate's: letters, digits, `_`, `-`, `.`; it must not begin with
/// `.` or `-`.
#[must_use]
pub fn is_name(name: &str) -> bool {
    let allowed = |byte: u8| byte.is_ascii_alphanumeric() || b"_-.".contains(&byte);
    !name.is_empty()
        && name.len() <= NAME_BYTES_MAX
        && name.bytes().all(allowed)
        && !name.starts_with(['.', '-'])
}

/// Names of federations with anything on disk, sorted.
#[must_use]
pub fn names(federations: &Path) -> Vec<String> {
    let entries = fs::read_dir(federations).into_iter().flatten().flatten();
    let names = entries.filter_map(|entry| entry.file_name().into_string().ok());
    let mut names: Vec<_> = names.filter(|name| is_name(name)).collect();
    names.sort();
    names
}

impl Directory {
    /// The directory of this federation, whether it exists or not.
    #[must_use]
    pub fn of(federations: &Path, name: &str) -> Self {
        Self(federations.join(name))
    }

    /// Itself.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// The plan that federates read.
    #[must_use]
    pub fn plan(&self) -> PathBuf {
        self.0.join("plan.json")
    }

    /// What `ictus timing` is to print.
    #[must_use]
    pub fn timing_spec(&self) -> PathBuf {
        self.0.join("timing.json")
    }

    /// Logs.
    #[must_use]
    pub fn logs(&self) -> PathBuf {
        self.0.join("logs")
    }

    /// Logical traces.
    #[must_use]
    pub fn trace(&self) -> PathBuf {
        self.0.join("trace")
    }

    /// Timing files.
    #[must_use]
    pub fn timing(&self) -> PathBuf {
        self.0.join("timing")
    }

    /// A member's exit record.
    #[must_use]
    pub fn exit_record(&self, member: &str) -> PathBuf {
        self.0.join("exit").join(format!("{member}.json"))
    }

    /// A member's supervisor's spec.
    #[must_use]
    pub fn spec(&self, member: &str) -> PathBuf {
        self.specs().join(format!("{member}.json"))
    }

    /// A member's certificate and key: [`ictus_stream::Papers::FILES`].
    pub(crate) fn papers(&self, member: &str) -> PathBuf {
        self.all_papers().join(member)
    }

    /// The certificates and keys of all members.
    pub(crate) fn all_papers(&self) -> PathBuf {
        self.0.join("tls")
    }

    pub(crate) fn specs(&self) -> PathBuf {
        self.0.join("spec")
    }

    /// The working directory of the members of a part.
    pub(crate) fn work(&self) -> PathBuf {
        self.0.join("work")
    }

    /// The generations: runs that were committed here.
    pub(crate) fn history(&self) -> PathBuf {
        self.0.join("history")
    }

    fn request(&self) -> PathBuf {
        self.0.join("request.json")
    }

    fn measures(&self) -> PathBuf {
        self.0.join("measures.json")
    }

    fn record(&self) -> PathBuf {
        self.0.join("record.json")
    }

    fn events(&self) -> PathBuf {
        self.0.join("events.ndjson")
    }

    /// Clears what an earlier run left and writes what this one needs.
    ///
    /// # Errors
    /// When the disk does not take it.
    pub fn prepare(&self, request: &StartRequest) -> Result<(), StoreError> {
        self.clear()?;
        let exit = self.0.join("exit");
        for directory in [
            self.logs(),
            self.trace(),
            self.timing(),
            exit,
            self.specs(),
            self.work(),
        ] {
            let mut builder = DirBuilder::new();
            builder
                .recursive(true)
                .mode(0o700)
                .create(&directory)
                .map_err(io_at(&directory))?;
        }
        write(&self.plan(), &request.plan)?;
        write(&self.timing_spec(), &request.timing)?;
        write(&self.request(), request)?;
        // Federates of other users come into the directory, but have no business with each other's environment.
        let private = fs::Permissions::from_mode(0o600);
        fs::set_permissions(self.request(), private).map_err(io_at(&self.request()))
    }

    /// Reads the plan, and what `ictus timing` is to print; they stay when a run is taken down.
    ///
    /// # Errors
    /// When one cannot be read.
    pub fn read_plan(&self) -> Result<(Plan, TimingSpec), StoreError> {
        Ok((read(&self.plan())?, read(&self.timing_spec())?))
    }

    /// Removes all but the generations, and the directory when there are none.
    fn clear(&self) -> Result<(), StoreError> {
        let entries = fs::read_dir(&self.0).into_iter().flatten().flatten();
        for path in entries.map(|entry| entry.path()) {
            if path != self.history() {
                files::remove(&path).map_err(kept_at(&path))?;
            }
        }
        // Fails when something is in it.
        fs::remove_dir(self.history()).ok();
        fs::remove_dir(&self.0).ok();
        Ok(())
    }

    /// Reads what the run was started from.
    ///
    /// # Errors
    /// When it cannot be read.
    pub fn read_request(&self) -> Result<StartRequest, StoreError> {
        read(&self.request())
    }

    /// Reads the record; absent when there is none.
    ///
    /// # Errors
    /// When it is damaged or from a newer version.
    pub fn read_record(&self) -> Result<Option<Record>, StoreError> {
        let path = self.record();
        if !path.exists() {
            return Ok(None);
        }
        let value: serde_json::Value = read(&path)?;
        let found = value.get("protocol").and_then(serde_json::Value::as_u64);
        if let Some(found) = found.and_then(|it| u32::try_from(it).ok())
            && found > PROTOCOL
        {
            return Err(StoreError::Newer { path, found });
        }
        let damaged = |source| StoreError::Damaged { path, source };
        serde_json::from_value(value).map(Some).map_err(damaged)
    }

    /// Writes the record durably.
    ///
    /// # Errors
    /// When the disk does not take it.
    pub fn write_record(&self, record: &Record) -> Result<(), StoreError> {
        write(&self.record(), record)
    }

    /// Writes what was measured, at the end of a run.
    ///
    /// # Errors
    /// When the disk does not take it.
    pub fn write_measures(&self, measures: &FederationMeasures) -> Result<(), StoreError> {
        write(&self.measures(), measures)
    }

    /// What was measured in a run that has ended; nothing when that was not kept.
    #[must_use]
    pub fn read_measures(&self) -> FederationMeasures {
        read(&self.measures()).unwrap_or_default()
    }

    /// Keeps an event.
    ///
    /// # Errors
    /// When the disk does not take it.
    pub fn append_event(&self, happening: &Happening) -> io::Result<()> {
        let mut file = OpenOptions::new()
            .append(true)
            .create(true)
            .open(self.events())?;
        if file.metadata()?.len() > EVENTS_BYTES_MAX {
            return Ok(());
        }
        let mut line = serde_json::to_vec(happening)?;
        line.push(b'\n');
        file.write_all(&line)
    }

    /// The events kept, in order; lines that are none are left out.
    #[must_use]
    pub fn events_kept(&self) -> Vec<Happening> {
        let text = fs::read_to_string(self.events()).unwrap_or_default();
        text.lines()
            .filter_map(|line| serde_json::from_str(line).ok())
            .collect()
    }

    /// Removes all but what is to stay; after [`Leave::Logs`] that is what a person may want to read after the end (logs,
    /// traces, timing files, plan, events, exit records) and the generations. Gives the directories that are left, and
    /// removes those with nothing in them.
    ///
    /// # Errors
    /// When something cannot be removed.
    pub fn remove(&self, leave: Leave) -> Result<Vec<Kept>, StoreError> {
        match leave {
            Leave::Logs => {}
            Leave::History => {
                self.clear()?;
                return Ok(kept(self.history()).into_iter().collect());
            }
            Leave::Nothing => {
                files::remove(&self.0).map_err(kept_at(&self.0))?;
                return Ok(Vec::new());
            }
        }
        for path in [
            self.request(),
            self.record(),
            self.measures(),
            self.specs(),
            self.all_papers(),
        ] {
            files::remove(&path).map_err(kept_at(&path))?;
        }
        let left = [
            self.logs(),
            self.trace(),
            self.timing(),
            self.work(),
            self.history(),
        ];
        Ok(left.into_iter().filter_map(kept).collect())
    }

    /// Removes what a start that was undone needs no more: logs, events, record and exit records stay.
    ///
    /// # Errors
    /// When something cannot be removed.
    pub(crate) fn undo(&self) -> Result<(), StoreError> {
        for path in [
            self.plan(),
            self.timing_spec(),
            self.request(),
            self.measures(),
            self.specs(),
            self.all_papers(),
            self.trace(),
            self.timing(),
            self.work(),
        ] {
            files::remove(&path).map_err(kept_at(&path))?;
        }
        Ok(())
    }
}

/// Why something stays that was to be removed.
fn kept_at(path: &Path) -> impl FnOnce(io::Error) -> StoreError {
    let path = path.to_path_buf();
    move |source| {
        if source.kind() == io::ErrorKind::PermissionDenied {
            return StoreError::Others { path };
        }
        StoreError::Io { path, source }
    }
}

/// What is left of a directory, which goes when nothing is in it.
fn kept(path: PathBuf) -> Option<Kept> {
    // Succeeds when nothing is in it.
    (fs::remove_dir(&path).is_err() && path.exists()).then(|| Kept {
        bytes: bytes_below(&path),
        path,
    })
}

/// Bytes of all files below a directory; links are not followed.
fn bytes_below(directory: &Path) -> u64 {
    let entries = fs::read_dir(directory).into_iter().flatten().flatten();
    let bytes = entries.map(|entry| match entry.metadata() {
        Ok(found) if found.is_dir() => bytes_below(&entry.path()),
        Ok(found) => found.len(),
        Err(_) => 0,
    });
    bytes.sum()
}

fn write(path: &Path, value: &impl Serialize) -> Result<(), StoreError> {
    let bytes = serde_json::to_vec_pretty(value).map_err(|source| StoreError::Damaged {
        path: path.to_path_buf(),
        source,
    })?;
    files::write_durably(path, &bytes).map_err(io_at(path))
}

fn read<T: for<'de> Deserialize<'de>>(path: &Path) -> Result<T, StoreError> {
    let bytes = fs::read(path).map_err(io_at(path))?;
    serde_json::from_slice(&bytes).map_err(|source| StoreError::Damaged {
        path: path.to_path_buf(),
        source,
    })
}

fn io_at(path: &Path) -> impl Fn(io::Error) -> StoreError + use<> {
    let path = path.to_path_buf();
    move |source| StoreError::Io {
        path: path.clone(),
        source,
    }
}

#[cfg(test)]
mod tests {
    use std::io;
    use std::path::Path;

    use super::{is_name, kept_at};

    #[test]
    fn what_cannot_be_removed_is_told_with_the_way_out() {
        let told = |kind: io::ErrorKind| kept_at(Path::new("/s/work"))(kind.into()).to_string();
        assert!(
            told(io::ErrorKind::PermissionDenied).contains("`sudo rm -r /s/work` on that host")
        );
        assert_eq!(
            told(io::ErrorKind::ReadOnlyFilesystem),
            "cannot use /s/work"
        );
    }

    #[test]
    fn names_cannot_leave_their_directory() {
        for good in ["diamond", "a.b-c_d", "7"] {
            assert!(is_name(good), "{good}");
        }
        for bad in ["", ".", "..", "-x", "a/b", "a b", "ä"] {
            assert!(!is_name(bad), "{bad}");
        }
    }
}
