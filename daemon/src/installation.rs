//! The installation for a whole host (`ictus host add --system`): root's daemon, asked by the members of a group, and
//! federates that are a user of their own.
//!
//! Which installation a program is of is told by where it lies, and by nothing that a caller could say.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use crate::accounts::{self, Account};

/// The directory of its programs.
pub const PROGRAMS: &str = "/usr/local/lib/ictus";
/// Its program.
pub const PROGRAM: &str = "/usr/local/lib/ictus/ictusd";
/// Its records and logs.
pub const STATE: &str = "/var/lib/ictus";
/// Its sockets.
pub const RUN: &str = "/run/ictus";
/// What the host's owner decides, and no manifest.
pub const CONFIG: &str = "/etc/ictus/ictusd.toml";
/// Whoever is in this group has the daemon's rights, which are root's.
pub const GROUP: &str = "ictus";
/// Who federates are, unless [`CONFIG`] says otherwise.
pub const RUN_AS: &str = "ictus-run";

/// What the owner of a host has decided for all who deploy to it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Shared {
    /// Who RTI and federates are that the manifest gives no `user`.
    pub run_as: Account,
    /// Whether a manifest may make a federate root.
    pub allow_root: bool,
}

/// The file, as it is written.
#[derive(Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Config {
    run_as: String,
    allow_root: bool,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            run_as: RUN_AS.to_owned(),
            allow_root: false,
        }
    }
}

/// Why the file cannot be gone by.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// It cannot be read.
    #[error("cannot read {path}", path = path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// It is no configuration: see the place that is named.
    #[error("{path}: {what}", path = path.display())]
    Wrong {
        /// The file.
        path: PathBuf,
        /// What is wrong, with its line.
        what: String,
    },
    /// The user for federates is not there. Make one, or name another.
    #[error("{path}: `run_as`: {why}", path = path.display())]
    NoUser {
        /// The file.
        path: PathBuf,
        /// Which.
        why: String,
    },
    /// Federates would be root, and nobody has allowed it.
    #[error("{path}: `run_as` is root, which needs `allow_root = true`", path = path.display())]
    Root {
        /// The file.
        path: PathBuf,
    },
}

impl Shared {
    /// Reads the host's file; without one, what it says by default.
    ///
    /// # Errors
    /// See [`ConfigError`].
    pub fn read() -> Result<Self, ConfigError> {
        Self::read_from(Path::new(CONFIG), &accounts::find)
    }

    fn read_from(
        path: &Path,
        find: &dyn Fn(&str) -> Result<Account, String>,
    ) -> Result<Self, ConfigError> {
        let text = match fs::read_to_string(path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => String::new(),
            text => text.map_err(|source| ConfigError::Unreadable {
                path: path.to_path_buf(),
                source,
            })?,
        };
        let path = path.to_path_buf();
        let config: Config = match toml::from_str(&text) {
            Ok(config) => config,
            Err(error) => {
                let what = error.to_string().trim_end().to_owned();
                return Err(ConfigError::Wrong { path, what });
            }
        };
        let run_as = match find(&config.run_as) {
            Ok(account) => account,
            Err(why) => return Err(ConfigError::NoUser { path, why }),
        };
        if run_as.uid == 0 && !config.allow_root {
            return Err(ConfigError::Root { path });
        }
        Ok(Self {
            run_as,
            allow_root: config.allow_root,
        })
    }
}

/// Whether a program is of the installation for the whole host.
#[must_use]
pub fn has(program: &Path) -> bool {
    program.parent() == Some(Path::new(PROGRAMS))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Shared, String> {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("ictusd.toml");
        fs::write(&path, text).unwrap();
        let find = |user: &str| match user {
            "root" => Ok(account(0)),
            RUN_AS => Ok(account(900)),
            "bob" => Ok(account(1000)),
            _ => Err(format!("there is no user `{user}` on this host")),
        };
        Shared::read_from(&path, &find).map_err(|error| error.to_string())
    }

    fn account(uid: u32) -> Account {
        Account {
            uid,
            gid: uid,
            groups: Vec::new(),
        }
    }

    #[test]
    fn the_owner_of_a_host_decides_who_federates_are() {
        let decided = |uid, allow_root| {
            Ok(Shared {
                run_as: account(uid),
                allow_root,
            })
        };
        assert_eq!(read(""), decided(900, false));
        assert_eq!(read("run_as = \"bob\"\n"), decided(1000, false));
        assert_eq!(read("allow_root = true\n"), decided(900, true));
        let both = "run_as = \"root\"\nallow_root = true\n";
        assert_eq!(read(both), decided(0, true));
        let absent = Shared::read_from(Path::new("/nowhere/x.toml"), &|_| Ok(account(7)));
        assert_eq!(absent.unwrap().run_as.uid, 7);
    }

    #[test]
    fn a_file_with_mistakes_is_refused_with_the_place() {
        for (text, said) in [
            ("run_as = \"root\"\n", "needs `allow_root = true`"),
            ("run_as = \"eve\"\n", "there is no user `eve`"),
            ("\nrun-as = \"bob\"\n", "line 2"),
            ("allow_root = 1\n", "invalid type"),
        ] {
            let error = read(text).unwrap_err();
            assert!(
                error.contains(said) && error.contains("ictusd.toml"),
                "{error}"
            );
        }
    }

    #[test]
    fn a_program_is_of_the_installation_in_whose_directory_it_lies() {
        for (program, expected) in [
            (PROGRAM, true),
            ("/usr/local/lib/ictus/ictusd.old (deleted)", true),
            ("/home/robot/.local/share/ictus/bin/ictusd", false),
            ("/usr/local/lib/ictus/x/ictusd", false),
        ] {
            assert_eq!(has(Path::new(program)), expected, "{program}");
        }
    }
}
