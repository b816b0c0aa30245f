//! Programs that were sent, by their SHA-256: what is there is never sent again, and is never another one.

use std::collections::BTreeSet;
use std::fs::{self, DirBuilder, File, Permissions};
use std::io::{self, Read, Write};
use std::os::unix::fs::{DirBuilderExt, PermissionsExt};
use std::path::{Path, PathBuf};

use ictus_deploy::image::hex;
use sha2::{Digest, Sha256};

/// The directory of blobs.
#[derive(Clone, Debug)]
pub(crate) struct Blobs(PathBuf);

/// Why a blob was not taken.
#[derive(Debug, thiserror::Error)]
pub(crate) enum BlobError {
    /// The name is no SHA-256. Send 64 hexadecimal digits.
    #[error("`{0}` is no SHA-256")]
    Name(String),
    /// The bytes are others than promised: they were changed on the way, or the file was while it was read.
    #[error("the bytes that came have the SHA-256 {found}, not {wanted}")]
    Different { wanted: String, found: String },
    /// The disk does not take it.
    #[error("cannot write {path}", path = path.display())]
    Io { path: PathBuf, source: io::Error },
}

/// The SHA-256 of what is read, in hexadecimal digits.
///
/// # Errors
/// When it cannot be read.
pub fn digest(mut from: impl Read) -> io::Result<String> {
    let mut hasher = Sha256::new();
    let mut buffer = vec![0; 64 << 10];
    loop {
        match from.read(&mut buffer) {
            Ok(0) => return Ok(hex(&hasher.finalize())),
            Ok(count) => hasher.update(&buffer[..count]),
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
}

impl Blobs {
    pub(crate) fn new(directory: PathBuf) -> Self {
        Self(directory)
    }

    /// Those of these that are not there; names that are none are refused.
    pub(crate) fn missing(&self, digests: &[String]) -> Result<Vec<String>, BlobError> {
        let mut missing = Vec::new();
        for digest in digests {
            if !self.path(digest)?.is_file() {
                missing.push(digest.clone());
            }
        }
        Ok(missing)
    }

    /// Writes a blob; nothing is left of one whose bytes are others than promised, or that does not end.
    pub(crate) fn write(&self, digest: &str, mut from: impl Read) -> Result<(), BlobError> {
        let path = self.path(digest)?;
        let at = |path: &Path| {
            let path = path.to_path_buf();
            move |source| BlobError::Io { path, source }
        };
        let mut directory = DirBuilder::new();
        directory
            .recursive(true)
            .mode(0o700)
            .create(&self.0)
            .map_err(at(&self.0))?;
        let mut file = tempfile::NamedTempFile::new_in(&self.0).map_err(at(&self.0))?;
        let mut hashed = Hashed(file.as_file_mut(), Sha256::new());
        io::copy(&mut from, &mut hashed).map_err(at(&path))?;
        let found = hex(&hashed.1.finalize());
        if found != digest {
            return Err(BlobError::Different {
                wanted: digest.to_owned(),
                found,
            });
        }
        let executable = Permissions::from_mode(0o755);
        file.as_file()
            .set_permissions(executable)
            .map_err(at(&path))?;
        file.as_file().sync_all().map_err(at(&path))?;
        file.persist(&path)
            .map_err(|error| at(&path)(error.error))?;
        Ok(())
    }

    /// Removes those that nobody needs, and the directory when it is empty.
    pub(crate) fn keep_only(&self, needed: &BTreeSet<String>) -> io::Result<()> {
        for entry in fs::read_dir(&self.0).into_iter().flatten().flatten() {
            let name = entry.file_name();
            if name.to_str().is_none_or(|name| !needed.contains(name)) {
                fs::remove_file(entry.path())?;
            }
        }
        // Fails when something is in it.
        fs::remove_dir(&self.0).ok();
        Ok(())
    }

    fn path(&self, digest: &str) -> Result<PathBuf, BlobError> {
        let hexadecimal = |byte: u8| byte.is_ascii_digit() || (b'a'..=b'f').contains(&byte);
        if digest.len() == 64 && digest.bytes().all(hexadecimal) {
            Ok(self.0.join(digest))
        } else {
            Err(BlobError::Name(digest.chars().take(80).collect()))
        }
    }
}

/// Hashes what it writes.
struct Hashed<'a>(&'a mut File, Sha256);

impl Write for Hashed<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.0.write(bytes)?;
        self.1.update(&bytes[..written]);
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.0.flush()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_blob_is_there_whole_or_not_at_all() {
        let directory = tempfile::tempdir().unwrap();
        let blobs = Blobs::new(directory.path().join("blobs"));
        let good = digest(&b"program"[..]).unwrap();
        let one = std::slice::from_ref(&good);
        assert_eq!(blobs.missing(one).unwrap(), one);
        let error = blobs.write(&good, &b"pr0gram"[..]).unwrap_err();
        assert!(matches!(error, BlobError::Different { .. }), "{error}");
        let left = || {
            fs::read_dir(directory.path().join("blobs"))
                .unwrap()
                .count()
        };
        assert_eq!(left(), 0);
        blobs.write(&good, &b"program"[..]).unwrap();
        assert!(blobs.missing(one).unwrap().is_empty());
        let mode = fs::metadata(blobs.path(&good).unwrap()).unwrap();
        assert_eq!(mode.permissions().mode() & 0o777, 0o755);
        // Sent once more, in a race: the same.
        blobs.write(&good, &b"program"[..]).unwrap();
        blobs.keep_only(&BTreeSet::from([good.clone()])).unwrap();
        assert_eq!(left(), 1);
        blobs.keep_only(&BTreeSet::new()).unwrap();
        assert!(!directory.path().join("blobs").exists());
    }

    #[test]
    fn names_cannot_leave_the_directory() {
        let blobs = Blobs::new("/nowhere".into());
        let long = "a".repeat(65);
        for bad in ["", "../x", &"A".repeat(64), &long, &"/".repeat(64)] {
            assert!(blobs.missing(&[bad.to_owned()]).is_err(), "{bad}");
            assert!(blobs.write(bad, &b""[..]).is_err(), "{bad}");
        }
    }
}
