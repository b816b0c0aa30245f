//! Where the daemon keeps things: state (records, logs) and run files (sockets, lock).

use std::ffi::OsString;
use std::fs::{self, DirBuilder, Permissions};
use std::io;
use std::os::unix::ffi::{OsStrExt, OsStringExt};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::Gid;

use crate::accounts;
use crate::installation::{self, Shared};

/// The longest socket path the kernel takes: `sun_path` has 108 bytes, the last one a zero.
const SOCKET_PATH_BYTES_MAX: usize = 107;
/// The longest name of a socket in the run directory: `/`, 32 hexadecimal digits, `.sock`.
const SOCKET_NAME_BYTES_MAX: usize = 38;

/// The two directories of a daemon: of one user's, or of the whole host's.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Paths {
    /// Records and logs; survives reboots.
    pub state: PathBuf,
    /// Sockets; private (mode 0700), of the whole host's for its group (0750).
    pub run: PathBuf,
    /// Whose they are.
    pub owner: Owner,
}

/// Whose daemon it is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Owner {
    /// The user's who runs it.
    User,
    /// The whole host's; what its owner has decided is known once it serves.
    Host(Option<Shared>),
}

/// Why the daemon has no place.
#[derive(Debug, thiserror::Error)]
pub enum PathsError {
    /// None of the variables that say where is set. Set `HOME`.
    #[error("neither ICTUS_STATE_DIR, XDG_STATE_HOME nor HOME is set")]
    NoHome,
    /// A variable names a relative directory. Give an absolute one.
    #[error("{path} is not an absolute path", path = path.display())]
    Relative {
        /// The directory.
        path: PathBuf,
    },
    /// Socket paths in this directory would be longer than the kernel takes. Set a shorter one.
    #[error(
        "{path} is too long for sockets: {bytes} bytes, and the kernel takes {SOCKET_PATH_BYTES_MAX}",
        path = path.display()
    )]
    TooLong {
        /// The run directory.
        path: PathBuf,
        /// The length of the longest socket path in it.
        bytes: usize,
    },
    /// The run directory belongs to somebody else, who could answer in our name.
    #[error("{path} belongs to uid {uid}, not to this user", path = path.display())]
    NotOurs {
        /// The run directory.
        path: PathBuf,
        /// Its owner.
        uid: u32,
    },
    /// The directory cannot be made or read.
    #[error("cannot prepare {path}", path = path.display())]
    Unusable {
        /// The directory.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
}

impl Paths {
    /// Those of the whole host, for a program of that installation; otherwise what `ICTUS_STATE_DIR`, `XDG_STATE_HOME`,
    /// `XDG_RUNTIME_DIR` and `HOME` say.
    ///
    /// # Errors
    /// See [`PathsError`].
    pub fn from_env() -> Result<Self, PathsError> {
        if std::env::current_exe().is_ok_and(|program| installation::has(&program)) {
            return Ok(Self {
                state: installation::STATE.into(),
                run: installation::RUN.into(),
                owner: Owner::Host(None),
            });
        }
        Self::from_variables(|name| std::env::var_os(name).filter(|value| !value.is_empty()))
    }

    /// The same from any source of variables.
    ///
    /// # Errors
    /// See [`PathsError`].
    pub fn from_variables(variable: impl Fn(&str) -> Option<OsString>) -> Result<Self, PathsError> {
        let paths = if let Some(state) = variable("ICTUS_STATE_DIR") {
            let state = PathBuf::from(state);
            Self {
                run: state.join("run"),
                state,
                owner: Owner::User,
            }
        } else {
            let home = variable("HOME").map(|home| PathBuf::from(home).join(".local/state"));
            let home = variable("XDG_STATE_HOME").map(PathBuf::from).or(home);
            let state = home.ok_or(PathsError::NoHome)?.join("ictus");
            let run = variable("XDG_RUNTIME_DIR")
                .map_or_else(|| state.join("run"), |run| PathBuf::from(run).join("ictus"));
            let owner = Owner::User;
            Self { state, run, owner }
        };
        paths.checked()
    }

    fn checked(self) -> Result<Self, PathsError> {
        for path in [&self.state, &self.run] {
            if !path.is_absolute() {
                return Err(PathsError::Relative { path: path.clone() });
            }
        }
        let bytes = self.run.as_os_str().as_bytes().len() + SOCKET_NAME_BYTES_MAX;
        if bytes > SOCKET_PATH_BYTES_MAX {
            return Err(PathsError::TooLong {
                path: self.run,
                bytes,
            });
        }
        Ok(self)
    }

    /// Whether the daemon is the whole host's.
    #[must_use]
    pub fn of_host(&self) -> bool {
        matches!(self.owner, Owner::Host(_))
    }

    /// What the owner of the host has decided; absent for a user's own daemon, and for who only asks.
    #[must_use]
    pub fn shared(&self) -> Option<&Shared> {
        match &self.owner {
            Owner::Host(shared) => shared.as_ref(),
            Owner::User => None,
        }
    }

    /// Makes both directories; the run directory is private to this user, or to the host's group.
    ///
    /// # Errors
    /// When one cannot be made, or the run directory is somebody else's.
    pub fn create(&self) -> Result<(), PathsError> {
        let unusable = |path: &Path| {
            let path = path.to_path_buf();
            move |source| PathsError::Unusable { path, source }
        };
        let private = |path: &Path| {
            DirBuilder::new()
                .recursive(true)
                .mode(0o700)
                .create(path)
                .map_err(unusable(path))
        };
        private(&self.state)?;
        private(&self.run)?;
        let found = fs::symlink_metadata(&self.run).map_err(unusable(&self.run))?;
        if found.uid() != rustix::process::geteuid().as_raw() || !found.is_dir() {
            return Err(PathsError::NotOurs {
                path: self.run.clone(),
                uid: found.uid(),
            });
        }
        if !self.of_host() && found.mode() & 0o077 != 0 {
            fs::set_permissions(&self.run, Permissions::from_mode(0o700))
                .map_err(unusable(&self.run))?;
        }
        self.admit_group(&self.run, 0o750)
            .map_err(unusable(&self.run))
    }

    /// Lets the host's group come to one of our own; does nothing for a user's daemon.
    pub(crate) fn admit_group(&self, path: &Path, mode: u32) -> io::Result<()> {
        let group = accounts::group(installation::GROUP);
        let Some(group) = group.filter(|_| self.of_host()) else {
            return Ok(());
        };
        // Group first: nobody else's is let in meanwhile.
        rustix::fs::chown(path, None, Some(Gid::from_raw(group)))?;
        fs::set_permissions(path, Permissions::from_mode(mode))
    }

    /// The daemon's socket.
    #[must_use]
    pub fn socket(&self) -> PathBuf {
        self.run.join("ictusd.sock")
    }

    /// The socket of whoever may only look, beside the daemon's.
    #[must_use]
    pub fn viewer_socket(&self) -> PathBuf {
        viewer_socket(&self.socket())
    }

    /// The daemon's lock: who holds it is the daemon of this state directory, and has written its socket's path
    /// there. Sessions may differ in `XDG_RUNTIME_DIR`, so the run directory would not do.
    #[must_use]
    pub fn lock(&self) -> PathBuf {
        self.state.join("ictusd.lock")
    }

    /// The socket of the daemon that holds the lock, wherever it is.
    #[must_use]
    pub fn socket_in_lock(&self) -> Option<PathBuf> {
        let path = fs::read(self.lock()).ok()?;
        (!path.is_empty()).then(|| PathBuf::from(OsString::from_vec(path)))
    }

    /// The socket of the supervisor with this instance id.
    #[must_use]
    pub fn supervisor_socket(&self, instance: &str) -> PathBuf {
        self.run.join(format!("{instance}.sock"))
    }

    /// The socket of a supervisor in a container: in a directory of its own, which the container sees.
    #[must_use]
    pub fn contained_socket(&self, instance: &str) -> PathBuf {
        self.run.join(instance).join("s")
    }

    /// The directory of programs that were sent, by their SHA-256.
    #[must_use]
    pub fn blobs(&self) -> PathBuf {
        self.state.join("blobs")
    }

    /// Who holds which lease, and the last number given.
    #[must_use]
    pub fn leases(&self) -> PathBuf {
        self.state.join("leases.json")
    }

    /// The key of this host's MACs of secrets.
    #[must_use]
    pub fn secrets_key(&self) -> PathBuf {
        self.state.join("secrets.key")
    }

    /// The on-demand daemon's own log.
    #[must_use]
    pub fn daemon_log(&self) -> PathBuf {
        self.state.join("ictusd.log")
    }

    /// The directory of all federations.
    #[must_use]
    pub fn federations(&self) -> PathBuf {
        self.state.join("federations")
    }
}

/// The socket of whoever may only look, of the daemon with this socket.
#[must_use]
pub fn viewer_socket(socket: &Path) -> PathBuf {
    socket.with_file_name("viewer.sock")
}

#[cfg(test)]
mod tests {
    use std::ffi::OsString;

    use super::{Paths, PathsError};

    fn paths(variables: &[(&str, &str)]) -> Result<Paths, PathsError> {
        Paths::from_variables(|name| {
            variables
                .iter()
                .find(|(key, _)| *key == name)
                .map(|(_, value)| OsString::from(value))
        })
    }

    #[test]
    fn the_runtime_directory_is_preferred_for_sockets() {
        let found = paths(&[("HOME", "/home/a"), ("XDG_RUNTIME_DIR", "/run/user/7")]).unwrap();
        assert_eq!(
            found.socket().to_str(),
            Some("/run/user/7/ictus/ictusd.sock")
        );
        assert_eq!(
            found.federations().to_str(),
            Some("/home/a/.local/state/ictus/federations")
        );
        let found = paths(&[("HOME", "/home/a")]).unwrap();
        assert_eq!(
            found.socket().to_str(),
            Some("/home/a/.local/state/ictus/run/ictusd.sock")
        );
        let found = paths(&[
            ("ICTUS_STATE_DIR", "/s"),
            ("XDG_RUNTIME_DIR", "/run/user/7"),
        ])
        .unwrap();
        assert_eq!(found.socket().to_str(), Some("/s/run/ictusd.sock"));
    }

    #[test]
    fn bad_places_are_refused() {
        assert!(matches!(paths(&[]), Err(PathsError::NoHome)));
        assert!(matches!(
            paths(&[("HOME", "x")]),
            Err(PathsError::Relative { .. })
        ));
        let long = format!("/{}", "x".repeat(100));
        assert!(matches!(
            paths(&[("ICTUS_STATE_DIR", &long)]),
            Err(PathsError::TooLong { bytes: 143, .. })
        ));
    }
}
