//! Secrets of a run on this host: a file each on a tmpfs, and a keyed MAC in the record by which a changed value is seen.
//!
//! Values are in memory while they are written, and in their files; nowhere else. After the host was started again the
//! files are gone, and the run waits for the next `up`.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, DirBuilder, OpenOptions, Permissions};
use std::io::{self, Write};
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt, PermissionsExt, chown};
use std::path::{Path, PathBuf};

use hmac::{Hmac, KeyInit, Mac};
use ictus_deploy::FederateRun;
use ictus_deploy::gives::Denied;
use ictus_deploy::image::hex;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use zeroize::Zeroizing;

use crate::accounts::Account;
use crate::api::secret::{SECRET_BYTES_MAX, SecretValue, SecretValues, SecretsChanged};
use crate::files;
use crate::paths::Paths;

/// Where a container has its secrets.
pub(crate) const INSIDE: &str = "/run/secrets";

/// A tmpfs that every Linux has.
const SHARED_MEMORY: &str = "/dev/shm";
/// What statfs says of a tmpfs, and of a ramfs.
const MEMORY_FILE_SYSTEMS: [i64; 2] = [0x0102_1994, 0x8584_58f6];
/// Bytes of the host's key.
const KEY_BYTES: usize = 32;

/// What a record holds of a run's secrets.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct KeptSecrets {
    /// The run's directory on a tmpfs: `FEDERATE/NAME` below it.
    pub directory: PathBuf,
    /// The keyed MAC of each value, by federate and name.
    pub macs: BTreeMap<String, BTreeMap<String, String>>,
}

/// Why secrets cannot be handed over.
#[derive(Debug, thiserror::Error)]
pub(crate) enum SecretsError {
    /// A value did not come. `ictus up` sends it.
    #[error(
        "the value of secret `{name}` of federate `{federate}` did not come; `ictus up` sends it"
    )]
    Missing { federate: String, name: String },
    /// A value is too long. Give a shorter one.
    #[error("secret `{name}` of federate `{federate}` has more than {SECRET_BYTES_MAX} bytes")]
    TooLong { federate: String, name: String },
    /// There is no tmpfs.
    #[error("secrets cannot be kept here: {}; {}", .0.why, .0.fix)]
    NoPlace(Denied),
    /// The directory is somebody else's. Have its owner remove it.
    #[error("{path} belongs to user {uid}, who could read secrets there; remove it", path = path.display())]
    NotOurs { path: PathBuf, uid: u32 },
    /// A file or directory cannot be made.
    #[error("cannot use {path}", path = path.display())]
    Io { path: PathBuf, source: io::Error },
}

/// The directory of all federations' secrets on this host, for this daemon.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Place(PathBuf);

impl Place {
    /// The first directory on a tmpfs that can be had; it need not be there yet.
    pub(crate) fn find(paths: &Paths) -> Result<Self, Denied> {
        let root = rustix::process::geteuid().is_root();
        Self::among(&candidates(paths, root), &is_in_memory)
    }

    fn among(candidates: &[PathBuf], in_memory: &dyn Fn(&Path) -> bool) -> Result<Self, Denied> {
        let parents: Vec<_> = candidates
            .iter()
            .map(|path| path.parent().unwrap_or(path).display().to_string())
            .collect();
        let found = candidates.iter().find(|path| in_memory(path));
        found.cloned().map(Self).ok_or_else(|| Denied {
            why: format!(
                "no tmpfs at {}, and secrets must not come to a disk",
                parents.join(" or ")
            ),
            fix: format!("`mount -t tmpfs -o mode=1777,nosuid,nodev tmpfs {SHARED_MEMORY}` there"),
        })
    }

    pub(crate) fn path(&self) -> &Path {
        &self.0
    }

    /// Makes the directory, or makes sure that the one that is there is ours.
    fn create(&self) -> Result<(), SecretsError> {
        let root = rustix::process::geteuid().is_root();
        // Root's federates may have users of their own, who must come to their files.
        let mode = if root { 0o711 } else { 0o700 };
        let at = |path: &Path| io_at(path);
        if let Some(parent) = self.0.parent() {
            let mut builder = DirBuilder::new();
            let made = builder.recursive(true).mode(0o700).create(parent);
            made.map_err(at(parent))?;
        }
        match DirBuilder::new().mode(mode).create(&self.0) {
            Err(error) if error.kind() != io::ErrorKind::AlreadyExists => {
                return Err(at(&self.0)(error));
            }
            Ok(()) | Err(_) => {}
        }
        let found = fs::symlink_metadata(&self.0).map_err(at(&self.0))?;
        if !found.is_dir() || found.uid() != rustix::process::geteuid().as_raw() {
            let (path, uid) = (self.0.clone(), found.uid());
            return Err(SecretsError::NotOurs { path, uid });
        }
        fs::set_permissions(&self.0, Permissions::from_mode(mode)).map_err(at(&self.0))
    }
}

/// In the order in which they are tried.
fn candidates(paths: &Paths, root: bool) -> Vec<PathBuf> {
    let state = Sha256::digest(paths.state.as_os_str().as_bytes());
    let uid = rustix::process::geteuid().as_raw();
    // Daemons of other state directories have others.
    let shared = format!("ictus-{uid}-{}", hex(&state[..3]));
    let shared = Path::new(SHARED_MEMORY).join(shared);
    match root {
        // Nobody else could enter a run directory of root's.
        true => vec![shared],
        false => vec![paths.run.join("secrets"), shared],
    }
}

/// Whether the nearest directory that is there lies in memory.
fn is_in_memory(path: &Path) -> bool {
    let there = path.ancestors().find(|path| path.exists());
    let found = there.and_then(|path| rustix::fs::statfs(path).ok());
    found.is_some_and(|found| MEMORY_FILE_SYSTEMS.contains(&found.f_type))
}

/// Where a federate finds a secret: on the host, or in its container.
pub(crate) fn file(kept: &KeptSecrets, federate: &str, name: &str, contained: bool) -> PathBuf {
    match contained {
        true => Path::new(INSIDE).join(name),
        false => directory(kept, federate).join(name),
    }
}

/// Where a federate's secrets are on the host.
pub(crate) fn directory(kept: &KeptSecrets, federate: &str) -> PathBuf {
    kept.directory.join(federate)
}

/// Writes the values that these federates need; nothing is left of them when that fails. Absent when they need none.
pub(crate) fn hand_over(
    paths: &Paths,
    federation: &str,
    federates: &[(&FederateRun, Option<Account>)],
    values: &SecretValues,
) -> Result<Option<KeptSecrets>, SecretsError> {
    remove(paths, federation, None)?;
    if federates
        .iter()
        .all(|(run, _)| run.needs.secrets.is_empty())
    {
        return Ok(None);
    }
    let place = Place::find(paths).map_err(SecretsError::NoPlace)?;
    place.create()?;
    let mut kept = KeptSecrets {
        directory: place.0.join(federation),
        macs: BTreeMap::new(),
    };
    let key = key(&paths.secrets_key()).map_err(io_at(&paths.secrets_key()))?;
    let written = write_all(&mut kept, federation, federates, (values, &key));
    if let Err(error) = written {
        remove(paths, federation, Some(&kept))?;
        return Err(error);
    }
    Ok(Some(kept))
}

fn write_all(
    kept: &mut KeptSecrets,
    federation: &str,
    federates: &[(&FederateRun, Option<Account>)],
    (values, key): (&SecretValues, &Key),
) -> Result<(), SecretsError> {
    let open = fs::symlink_metadata(kept.directory.parent().unwrap_or(&kept.directory));
    let mode = open.map_or(0o700, |found| found.mode() & 0o777);
    make_directory(&kept.directory, mode)?;
    for (run, account) in federates {
        if run.needs.secrets.is_empty() {
            continue;
        }
        let directory = directory(kept, &run.name);
        make_directory(&directory, 0o700)?;
        for name in run.needs.secrets.keys() {
            let (federate, name) = (run.name.clone(), name.clone());
            let Some(value) = values.value(&federate, &name) else {
                return Err(SecretsError::Missing { federate, name });
            };
            if value.bytes().len() > SECRET_BYTES_MAX {
                return Err(SecretsError::TooLong { federate, name });
            }
            let path = directory.join(&name);
            write(&path, value, account.as_ref()).map_err(io_at(&path))?;
            let mac = mac(key, [federation, &federate, &name], value);
            kept.macs.entry(federate).or_default().insert(name, mac);
        }
        give(&directory, account.as_ref()).map_err(io_at(&directory))?;
    }
    Ok(())
}

/// Removes a run's files, where the record says that they are and where they would be made; that there are none is no
/// error.
pub(crate) fn remove(
    paths: &Paths,
    federation: &str,
    kept: Option<&KeptSecrets>,
) -> Result<(), SecretsError> {
    let root = rustix::process::geteuid().is_root();
    let places = candidates(paths, root);
    let mut directories: BTreeSet<_> = places.iter().map(|it| it.join(federation)).collect();
    directories.extend(kept.map(|kept| kept.directory.clone()));
    for directory in directories {
        files::remove(&directory).map_err(io_at(&directory))?;
        if let Some(place) = directory.parent() {
            // Succeeds with the last one.
            fs::remove_dir(place).ok();
        }
    }
    Ok(())
}

/// Whether every file is still there.
pub(crate) fn are_there(kept: &KeptSecrets) -> bool {
    let mut all = kept
        .macs
        .iter()
        .flat_map(|(federate, names)| names.keys().map(move |name| (federate, name)));
    all.all(|(federate, name)| file(kept, federate, name, false).is_file())
}

/// The values that are others than the run's.
pub(crate) fn changed(
    paths: &Paths,
    federation: &str,
    kept: Option<&KeptSecrets>,
    values: &SecretValues,
) -> SecretsChanged {
    // Without its key nothing is known to be the same.
    let key = read_key(&paths.secrets_key()).ok();
    let mut changed = SecretsChanged::new();
    for (federate, values) in &values.0 {
        for (name, value) in values {
            let known = kept.and_then(|kept| kept.macs.get(federate)?.get(name));
            let same = key.as_ref().zip(known).is_some_and(|(key, known)| {
                is_mac(key, [federation, federate, name], value, known)
            });
            if !same {
                let names = changed.entry(federate.clone()).or_default();
                names.insert(name.clone());
            }
        }
    }
    changed
}

type Key = Zeroizing<Vec<u8>>;

/// The host's key, made when there is none.
fn key(path: &Path) -> io::Result<Key> {
    match read_key(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => {}
        read => return read,
    }
    let mut key = Zeroizing::new(vec![0; KEY_BYTES]);
    getrandom::fill(&mut key)?;
    let mut file = OpenOptions::new()
        .write(true)
        .create_new(true)
        .mode(0o600)
        .open(path)?;
    file.write_all(&key)?;
    file.sync_all()?;
    Ok(key)
}

fn read_key(path: &Path) -> io::Result<Key> {
    let key = Zeroizing::new(fs::read(path)?);
    if key.len() == KEY_BYTES {
        return Ok(key);
    }
    // Torn while it was written: nothing was made with it.
    fs::remove_file(path)?;
    Err(io::ErrorKind::NotFound.into())
}

fn keyed(key: &Key, about: [&str; 3], value: &SecretValue) -> Option<Hmac<Sha256>> {
    let mut mac = Hmac::<Sha256>::new_from_slice(key).ok()?;
    for text in about {
        mac.update(text.as_bytes());
        mac.update(&[0]);
    }
    mac.update(value.bytes());
    Some(mac)
}

fn mac(key: &Key, about: [&str; 3], value: &SecretValue) -> String {
    let mac = keyed(key, about, value).map(|mac| mac.finalize().into_bytes());
    mac.map(|bytes| hex(&bytes)).unwrap_or_default()
}

/// Compares in constant time.
fn is_mac(key: &Key, about: [&str; 3], value: &SecretValue, known: &str) -> bool {
    let digits = known.as_bytes().chunks(2);
    let bytes: Option<Vec<u8>> = digits
        .map(|pair| u8::from_str_radix(std::str::from_utf8(pair).ok()?, 16).ok())
        .collect();
    let mac = keyed(key, about, value).zip(bytes);
    mac.is_some_and(|(mac, bytes)| mac.verify_slice(&bytes).is_ok())
}

fn write(path: &Path, value: &SecretValue, account: Option<&Account>) -> io::Result<()> {
    let mut file = OpenOptions::new()
        .write(true)
        .create_new(true)
        .mode(0o400)
        .open(path)?;
    file.write_all(value.bytes())?;
    give(path, account)
}

fn give(path: &Path, account: Option<&Account>) -> io::Result<()> {
    account.map_or(Ok(()), |account| {
        chown(path, Some(account.uid), Some(account.gid))
    })
}

fn make_directory(path: &Path, mode: u32) -> Result<(), SecretsError> {
    let made = DirBuilder::new().mode(mode).create(path);
    made.and_then(|()| fs::set_permissions(path, Permissions::from_mode(mode)))
        .map_err(io_at(path))
}

fn io_at(path: &Path) -> impl Fn(io::Error) -> SecretsError + use<> {
    let path = path.to_path_buf();
    move |source| SecretsError::Io {
        path: path.clone(),
        source,
    }
}

#[cfg(test)]
mod tests {
    use ictus_deploy::placement::SecretSource;
    use ictus_deploy::{FederateKind, Needs};

    use super::*;

    fn run(name: &str, secrets: &[&str]) -> FederateRun {
        let secrets = secrets
            .iter()
            .map(|it| ((*it).to_owned(), SecretSource::Environment));
        FederateRun {
            id: 0,
            name: name.to_owned(),
            executable: "/x".into(),
            kind: FederateKind::Ours,
            env: BTreeMap::new(),
            needs: Needs {
                secrets: secrets.collect(),
                ..Needs::default()
            },
            portable: false,
        }
    }

    fn values(federate: &str, name: &str, value: &str) -> SecretValues {
        let value = SecretValue::new(value.as_bytes().to_vec());
        let values = BTreeMap::from([(name.to_owned(), value)]);
        SecretValues(BTreeMap::from([(federate.to_owned(), values)]))
    }

    fn paths(directory: &tempfile::TempDir) -> Paths {
        Paths {
            state: directory.path().to_path_buf(),
            run: directory.path().join("run"),
            owner: crate::paths::Owner::User,
        }
    }

    #[test]
    fn a_secret_is_a_private_file_in_memory_until_it_is_removed() {
        let directory = tempfile::tempdir().unwrap();
        let paths = paths(&directory);
        let a = run("a", &["TOKEN"]);
        let given = values("a", "TOKEN", "canary");
        let federates = [(&a, None)];
        let kept = hand_over(&paths, "f", &federates, &given).unwrap().unwrap();
        let path = file(&kept, "a", "TOKEN", false);
        assert!(is_in_memory(&path), "{}", path.display());
        assert_eq!(fs::read(&path).unwrap(), b"canary");
        assert_eq!(path.metadata().unwrap().mode() & 0o777, 0o400);
        assert!(are_there(&kept));
        assert!(!format!("{kept:?}").contains("canary"));
        // Handed over anew, it is the new one.
        let other = values("a", "TOKEN", "other");
        assert_eq!(
            changed(&paths, "f", Some(&kept), &given),
            SecretsChanged::new()
        );
        let names = BTreeSet::from(["TOKEN".to_owned()]);
        let all = BTreeMap::from([("a".to_owned(), names)]);
        assert_eq!(changed(&paths, "f", Some(&kept), &other), all);
        assert_eq!(changed(&paths, "f", None, &given), all);
        let again = hand_over(&paths, "f", &federates, &other).unwrap().unwrap();
        assert_ne!(again.macs, kept.macs);
        remove(&paths, "f", Some(&again)).unwrap();
        assert!(!are_there(&again));
        assert!(!kept.directory.parent().unwrap().exists(), "the last one");
    }

    #[test]
    fn a_value_that_did_not_come_is_named_and_nothing_is_left() {
        let directory = tempfile::tempdir().unwrap();
        let paths = paths(&directory);
        let a = run("a", &["OTHER", "TOKEN"]);
        let given = values("a", "OTHER", "canary");
        let missing = hand_over(&paths, "f", &[(&a, None)], &given).unwrap_err();
        assert_eq!(
            missing.to_string(),
            "the value of secret `TOKEN` of federate `a` did not come; `ictus up` sends it"
        );
        let place = Place::find(&paths).unwrap();
        assert!(!place.path().exists());
        let none = hand_over(&paths, "f", &[(&run("b", &[]), None)], &given).unwrap();
        assert_eq!(none, None);
    }

    /// Two federations, federates or names with the same value have different MACs.
    #[test]
    fn a_mac_tells_nothing_about_another_secret() {
        let key = Zeroizing::new(vec![7; KEY_BYTES]);
        let value = SecretValue::new(b"v".to_vec());
        let about = [
            ["f", "a", "S"],
            ["g", "a", "S"],
            ["f", "b", "S"],
            ["f", "a", "T"],
        ];
        let macs: BTreeSet<_> = about.map(|about| mac(&key, about, &value)).into();
        assert_eq!(macs.len(), 4);
        assert!(is_mac(&key, about[0], &value, &mac(&key, about[0], &value)));
        assert!(!is_mac(
            &key,
            about[1],
            &value,
            &mac(&key, about[0], &value)
        ));
        assert!(!is_mac(&key, about[0], &value, "xy"));
    }

    #[test]
    fn without_a_tmpfs_there_is_no_place() {
        let paths = [
            "/run/user/7/ictus/secrets".into(),
            "/dev/shm/ictus-7".into(),
        ];
        let found = |wanted: &'static str| {
            Place::among(&paths, &move |path: &Path| path.starts_with(wanted))
        };
        assert_eq!(found("/run").unwrap().path(), paths[0]);
        assert_eq!(found("/dev").unwrap().path(), paths[1]);
        assert_eq!(
            found("/x").unwrap_err().why,
            "no tmpfs at /run/user/7/ictus or /dev/shm, and secrets must not come to a disk"
        );
    }
}
