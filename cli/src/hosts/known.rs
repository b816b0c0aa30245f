//! The hosts that this user has added: what `ictus host ls` lists. How they are trusted stands in known_hosts alone.

use std::collections::BTreeMap;
use std::fs::File;
use std::io;
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};

use ictus_deploy::placement::SshClient;
use rustix::fs::{FlockOperation, flock};
use serde::{Deserialize, Serialize};

use crate::error::CliError;
use crate::files::write_whole;

/// How an added host is reached, by how it was named.
pub(crate) type Known = BTreeMap<String, KnownHost>;

/// How an added host is reached.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct KnownHost {
    pub(crate) client: SshClient,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) identity: Option<PathBuf>,
}

/// Reads the list; one that is not there is empty.
pub(crate) fn read(state: &Path) -> Result<Known, CliError> {
    let path = file(state);
    let text = match std::fs::read(&path) {
        Ok(text) => text,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Known::new()),
        Err(error) => return Err(unusable(&path, &error)),
    };
    serde_json::from_slice(&text).map_err(|error| unusable(&path, &error))
}

/// Changes the list, one at a time; an empty one leaves no file.
pub(crate) fn change(state: &Path, change: impl FnOnce(&mut Known)) -> Result<(), CliError> {
    let path = file(state);
    let failed = |error: io::Error| unusable(&path, &error);
    let _lock = lock(state).map_err(failed)?;
    let before = read(state)?;
    let mut known = before.clone();
    change(&mut known);
    if known != before && !known.is_empty() {
        let text = serde_json::to_vec_pretty(&known).map_err(|error| unusable(&path, &error))?;
        return write_whole(&path, &text, 0o600).map_err(failed);
    }
    if known != before {
        std::fs::remove_file(&path).map_err(failed)?;
    }
    if known.is_empty() {
        // Only when nothing else is there.
        std::fs::remove_dir(state).ok();
    }
    Ok(())
}

/// Holds the directory, which is made, against others that change the list.
fn lock(state: &Path) -> io::Result<File> {
    loop {
        let mut directory = std::fs::DirBuilder::new();
        directory.recursive(true).mode(0o700).create(state)?;
        let held = File::open(state)?;
        flock(&held, FlockOperation::LockExclusive)?;
        // Whoever held it before may have removed it.
        if std::fs::metadata(state)
            .is_ok_and(|it| it.ino() == held.metadata().map_or(0, |it| it.ino()))
        {
            return Ok(held);
        }
    }
}

fn file(state: &Path) -> PathBuf {
    state.join("hosts.json")
}

fn unusable(path: &Path, error: &dyn std::fmt::Display) -> CliError {
    CliError::failed(format!("cannot use {}: {error}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Several at once lose nothing, and the last one removes the directory.
    #[test]
    fn changes_come_one_after_the_other() {
        let directory = tempfile::tempdir().unwrap();
        let state = directory.path().join("state");
        let host = || KnownHost {
            client: SshClient::System,
            identity: None,
        };
        std::thread::scope(|scope| {
            for who in 0..4 {
                let state = &state;
                scope.spawn(move || {
                    for turn in 0..20 {
                        let name = format!("h{who}.{turn}");
                        change(state, |known| drop(known.insert(name.clone(), host()))).unwrap();
                        if turn % 2 == 0 {
                            change(state, |known| drop(known.remove(&name))).unwrap();
                        }
                    }
                });
            }
        });
        assert_eq!(read(&state).unwrap().len(), 40);
        change(&state, Known::clear).unwrap();
        assert!(!state.exists());
    }

    #[test]
    fn the_list_is_there_as_long_as_it_has_something() {
        let directory = tempfile::tempdir().unwrap();
        let state = directory.path().join("state");
        let add = |known: &mut Known| {
            let host = KnownHost {
                client: SshClient::System,
                identity: None,
            };
            known.insert("ann@nuc".to_owned(), host);
        };
        change(&state, |_| {}).unwrap();
        assert!(!state.exists());
        change(&state, add).unwrap();
        change(&state, add).unwrap();
        assert_eq!(read(&state).unwrap()["ann@nuc"].client, SshClient::System);
        change(&state, |known| drop(known.remove("ann@nuc"))).unwrap();
        assert!(!state.exists(), "nothing is left");
        std::fs::create_dir(&state).unwrap();
        std::fs::write(file(&state), "no list").unwrap();
        let error = read(&state).unwrap_err().to_string();
        assert!(error.contains("hosts.json"), "{error}");
    }
}
