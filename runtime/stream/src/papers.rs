//! What a member shows and keeps: three files of one directory.

use serde::{Deserialize, Serialize};
use std::fmt;
use std::fs::{self, DirBuilder, OpenOptions};
use std::io::{self, Write as _};
use std::os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _};
use std::path::Path;

/// A member's certificate and key, and the authority that signed it: PEM. Shown, it hides the key.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Papers {
    /// The authority's certificate.
    pub authority: String,
    /// The member's certificate.
    pub certificate: String,
    /// The member's private key: a secret.
    pub key: String,
}

impl Papers {
    /// The files of a member's directory: authority, certificate, key.
    pub const FILES: [&str; 3] = ["authority.pem", "certificate.pem", "key.pem"];

    /// Writes the three files into a directory of mode 0700, which is made; their mode is 0600. What is there is replaced.
    ///
    /// # Errors
    ///
    /// When the disk does not take them.
    pub fn write(&self, directory: &Path) -> io::Result<()> {
        DirBuilder::new()
            .recursive(true)
            .mode(0o700)
            .create(directory)?;
        for (name, text) in Self::FILES
            .iter()
            .zip([&self.authority, &self.certificate, &self.key])
        {
            let path = directory.join(name);
            match fs::remove_file(&path) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                Ok(()) | Err(_) => {}
            }
            let mut options = OpenOptions::new();
            let options = options.write(true).create_new(true).mode(0o600);
            options.open(&path)?.write_all(text.as_bytes())?;
        }
        Ok(())
    }

    /// Reads the three files.
    ///
    /// # Errors
    ///
    /// The first file that cannot be read, and why.
    pub fn read(directory: &Path) -> Result<Self, (std::path::PathBuf, io::Error)> {
        let read = |name| {
            let path = directory.join(name);
            fs::read_to_string(&path).map_err(|error| (path, error))
        };
        let [authority, certificate, key] = Self::FILES;
        Ok(Self {
            authority: read(authority)?,
            certificate: read(certificate)?,
            key: read(key)?,
        })
    }
}

impl fmt::Debug for Papers {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Papers")
            .field("certificate", &self.certificate)
            .finish_non_exhaustive()
    }
}
