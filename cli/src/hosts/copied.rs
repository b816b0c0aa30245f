//! Traces and timing files of several hosts, copied into one directory here.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::path::PathBuf;

use ictus_coord::plan::Plan;
use ictus_deploy::TimingSpec;
use ictusd::api::recorded::{FileKind, Recorded};
use ictusd::client::Client;
use ictusd::store;
use tempfile::TempDir;

use super::Clients;
use crate::error::CliError;

/// Bytes that a federate may have written between being measured and being copied.
const WRITTEN_SINCE_MAX: u64 = 256 << 20;

/// What the hosts have written of a federation's last run, as far as it was copied; removed with this.
#[derive(Debug)]
pub(crate) struct Copied {
    federation: String,
    directory: TempDir,
    /// Bytes that are here already, by file.
    here: BTreeMap<(FileKind, String), u64>,
    pub(crate) plan: Plan,
    pub(crate) timing: TimingSpec,
}

impl Copied {
    /// Looks at what there is; copies nothing yet.
    pub(crate) async fn new(clients: &Clients, federation: &str) -> Result<Self, CliError> {
        let directory = tempfile::Builder::new().prefix("ictus-").tempdir();
        let directory = directory.map_err(CliError::failed)?;
        for kind in [FileKind::Trace, FileKind::Timing] {
            std::fs::create_dir(directory.path().join(kind.name())).map_err(CliError::failed)?;
        }
        let client = clients.values().next();
        let client = client.ok_or_else(|| CliError::failed("the federation has no hosts"))?;
        let recorded = client.recorded(federation).await?;
        Ok(Self {
            federation: federation.to_owned(),
            directory,
            here: BTreeMap::new(),
            plan: recorded.plan,
            timing: recorded.timing,
        })
    }

    /// The directory of the files of a kind.
    pub(crate) fn path(&self, kind: FileKind) -> PathBuf {
        self.directory.path().join(kind.name())
    }

    /// Copies what was written since the last time.
    pub(crate) async fn update(
        &mut self,
        clients: &Clients,
        kind: FileKind,
    ) -> Result<(), CliError> {
        for client in clients.values() {
            let recorded = client.recorded(&self.federation).await?;
            self.plan = recorded.plan.clone();
            for (federate, bytes) in of_kind(recorded, kind) {
                // A name becomes a path here; a host is not trusted with those.
                if !store::is_name(&federate) {
                    let message =
                        format!("a host speaks of a federate `{federate}`, which is no name");
                    return Err(CliError::failed(message));
                }
                self.copy(client, (kind, federate), bytes).await?;
            }
        }
        Ok(())
    }

    async fn copy(
        &mut self,
        client: &Client,
        key: (FileKind, String),
        bytes: u64,
    ) -> Result<(), CliError> {
        let here = self.here.get(&key).copied().unwrap_or(0);
        let (kind, federate) = &key;
        let path = self.path(*kind).join(format!("{federate}.{}", kind.name()));
        // A file that has shrunk is that of another run.
        let (file, from) = if bytes < here {
            (File::create(&path), 0)
        } else {
            let file = OpenOptions::new().append(true).create(true).open(&path);
            (file, here)
        };
        let mut file = file.map_err(CliError::failed)?;
        // A member may have written a little more since.
        let bytes = bytes.saturating_add(WRITTEN_SINCE_MAX);
        let part = (*kind, federate.as_str(), from);
        let mut file = Announced {
            file: &mut file,
            left: bytes.saturating_sub(from),
        };
        let copied = client
            .copy_recorded(&self.federation, part, &mut file)
            .await?;
        self.here.insert(key, from + copied);
        Ok(())
    }
}

/// A file that takes no more than was announced.
struct Announced<'f> {
    file: &'f mut File,
    left: u64,
}

impl Write for Announced<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let taken = u64::try_from(bytes.len()).unwrap_or(u64::MAX);
        if taken > self.left {
            return Err(io::Error::other("the host sends more than it has said"));
        }
        self.left -= taken;
        self.file.write_all(bytes)?;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

fn of_kind(recorded: Recorded, kind: FileKind) -> BTreeMap<String, u64> {
    match kind {
        FileKind::Trace => recorded.traces,
        FileKind::Timing => recorded.timings,
    }
}
