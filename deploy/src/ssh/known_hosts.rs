//! The known_hosts files: which keys are pinned for a host, and whether the one it shows is among them.
//!
//! Ours, because libssh2 reports wildcard patterns, `@cert-authority` and `@revoked` lines as "not found", does not say which line
//! matched, and cannot tell which key types are known before the handshake.

use std::fs::{self, File};
use std::io::{ErrorKind, Read as _, Write as _};
use std::os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

use base64::Engine as _;
use base64::engine::general_purpose::{STANDARD, STANDARD_NO_PAD};
use hmac::{Hmac, KeyInit as _, Mac as _};
use sha1::Sha1;
use sha2::{Digest as _, Sha256};

use super::error::SshError;
use super::target::Target;

/// Bytes that are read of one file.
const FILE_MAX: u64 = 16 << 20;

/// What libssh2 can verify, best first; SHA-1 signatures are left out.
const ALGORITHMS: &[(&str, &str)] = &[
    ("ssh-ed25519", "ssh-ed25519"),
    ("ecdsa-sha2-nistp256", "ecdsa-sha2-nistp256"),
    ("ecdsa-sha2-nistp384", "ecdsa-sha2-nistp384"),
    ("ecdsa-sha2-nistp521", "ecdsa-sha2-nistp521"),
    ("ssh-rsa", "rsa-sha2-512,rsa-sha2-256"),
];

/// A key that a host shows, not yet trusted.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HostKey {
    /// The host as known_hosts names it: `host`, or `[host]:port` when the port is not 22.
    pub name: String,
    /// Its type, such as `ssh-ed25519`.
    pub kind: String,
    /// `SHA256:` and 43 characters, as OpenSSH prints it.
    pub fingerprint: String,
    blob: Vec<u8>,
}

impl HostKey {
    /// The key of the host `name` as it comes over the wire; none when it is not one.
    pub(super) fn new(name: &str, blob: &[u8]) -> Option<Self> {
        Some(Self {
            name: name.to_owned(),
            kind: kind_of(blob)?,
            fingerprint: fingerprint(blob),
            blob: blob.to_vec(),
        })
    }

    /// The line of known_hosts that pins it.
    #[must_use]
    pub fn line(&self) -> String {
        format!(
            "{} {} {}",
            self.name,
            self.kind,
            STANDARD.encode(&self.blob)
        )
    }
}

/// What the files say about one host.
#[derive(Clone, Debug, Default)]
pub(super) struct Known {
    host: String,
    files: Vec<PathBuf>,
    /// Keys under the very name of the host.
    pinned: Vec<Entry>,
    /// Keys under its name without the port: good when they match, silent when they do not, as in OpenSSH.
    portless: Vec<Entry>,
    revoked: Vec<Entry>,
    /// The first line that matches and that only the system's client understands.
    pub(super) foreign: Option<Foreign>,
}

/// A line that only the system's client understands.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Foreign {
    pub(super) file: PathBuf,
    pub(super) line: usize,
    pub(super) what: &'static str,
}

#[derive(Clone, Debug, PartialEq, Eq)]
struct Entry {
    file: PathBuf,
    line: usize,
    marker: Marker,
    names: Names,
    kind: String,
    blob: Vec<u8>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Marker {
    None,
    Revoked,
    /// `@cert-authority`, and whatever else may come.
    Other,
}

#[derive(Clone, Debug, PartialEq, Eq)]
enum Names {
    Hashed { salt: Vec<u8>, hash: Vec<u8> },
    Patterns(Vec<String>),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Hit {
    Name,
    Pattern,
}

impl Known {
    /// Reads what the files say about a host; a file that does not exist says nothing.
    pub(super) fn read(files: &[PathBuf], host: &str, port: u16) -> Result<Self, SshError> {
        let mut known = Self {
            host: known_name(host, port),
            files: files.to_vec(),
            ..Self::default()
        };
        let portless = known_name(host, 22);
        for file in files {
            for entry in entries(file, &read_text(file)?) {
                known.sort_in(entry, &portless);
            }
        }
        Ok(known)
    }

    fn sort_in(&mut self, entry: Entry, portless: &str) {
        let hit = entry.names.hit(&self.host);
        let foreign = match (entry.marker, hit) {
            (Marker::Revoked, Some(_)) => return self.revoked.push(entry),
            (Marker::Other, Some(_)) => "@cert-authority",
            (Marker::None, Some(Hit::Name)) => return self.pinned.push(entry),
            (Marker::None, Some(Hit::Pattern)) => "a pattern",
            (Marker::Revoked, None) if entry.names.hit(portless).is_some() => {
                return self.revoked.push(entry);
            }
            (Marker::None, None) if entry.names.hit(portless) == Some(Hit::Name) => {
                return self.portless.push(entry);
            }
            (Marker::None | Marker::Revoked | Marker::Other, None) => return,
        };
        self.foreign.get_or_insert(Foreign {
            file: entry.file,
            line: entry.line,
            what: foreign,
        });
    }

    /// The host-key algorithms to ask for, so that the host shows a key of a type that is known; none when no key is pinned.
    pub(super) fn algorithms(&self) -> Option<String> {
        let entries = if self.pinned.is_empty() {
            &self.portless
        } else {
            &self.pinned
        };
        let known: Vec<&str> = ALGORITHMS
            .iter()
            .filter(|(kind, _)| entries.iter().any(|entry| entry.kind == *kind))
            .map(|(_, algorithms)| *algorithms)
            .collect();
        (!entries.is_empty()).then(|| known.join(","))
    }

    /// The place of the first revoked key and its fingerprint.
    pub(super) fn first_revoked(&self) -> Option<(PathBuf, usize, String)> {
        let entry = self.revoked.first()?;
        Some((entry.file.clone(), entry.line, fingerprint(&entry.blob)))
    }

    /// Whether the host may show this key.
    pub(super) fn judge(&self, key: &HostKey) -> Result<(), SshError> {
        if let Some(entry) = self.revoked.iter().find(|entry| entry.blob == key.blob) {
            return Err(SshError::Revoked {
                host: self.host.clone(),
                file: entry.file.clone(),
                line: entry.line,
                fingerprint: key.fingerprint.clone(),
            });
        }
        let mut trusted = self.pinned.iter().chain(&self.portless);
        if trusted.any(|entry| entry.blob == key.blob) {
            return Ok(());
        }
        let same_kind = self.pinned.iter().find(|entry| entry.kind == key.kind);
        if let Some(entry) = same_kind.or(self.pinned.first()) {
            return Err(SshError::HostKeyChanged {
                host: self.host.clone(),
                file: entry.file.clone(),
                line: entry.line,
                expected: fingerprint(&entry.blob),
                found: key.fingerprint.clone(),
            });
        }
        Err(SshError::UnknownHostKey {
            host: self.host.clone(),
            kind: key.kind.clone(),
            fingerprint: key.fingerprint.clone(),
            known_hosts: self
                .files
                .first()
                .map_or_else(String::new, |file| file.display().to_string()),
        })
    }
}

impl Names {
    fn hit(&self, name: &str) -> Option<Hit> {
        match self {
            Self::Hashed { salt, hash } => {
                let mac = Hmac::<Sha1>::new_from_slice(salt).ok()?;
                let same = mac.chain_update(name).verify_slice(hash).is_ok();
                same.then_some(Hit::Name)
            }
            Self::Patterns(patterns) => {
                let mut hit = None;
                for pattern in patterns {
                    if let Some(not) = pattern.strip_prefix('!') {
                        if matches(not, name) {
                            return None;
                        }
                    } else if pattern == name {
                        hit = Some(Hit::Name);
                    } else if hit.is_none() && matches(pattern, name) {
                        hit = Some(Hit::Pattern);
                    }
                }
                hit
            }
        }
    }
}

/// Every key that the file's text holds, well formed; other lines are passed over, as OpenSSH does.
fn entries(file: &Path, text: &str) -> Vec<Entry> {
    (1..)
        .zip(text.lines())
        .filter_map(|(line, text)| entry(file, line, text))
        .collect()
}

fn entry(file: &Path, line: usize, text: &str) -> Option<Entry> {
    let mut words = text.split_ascii_whitespace();
    let mut names = words.next().filter(|word| !word.starts_with('#'))?;
    let mut marker = Marker::None;
    if names.starts_with('@') {
        marker = if names == "@revoked" {
            Marker::Revoked
        } else {
            Marker::Other
        };
        names = words.next()?;
    }
    let kind = words.next()?;
    let blob = STANDARD.decode(words.next()?).ok()?;
    if kind_of(&blob)? != kind {
        return None;
    }
    let names = match names.strip_prefix("|1|") {
        Some(hashed) => {
            let (salt, hash) = hashed.split_once('|')?;
            Names::Hashed {
                salt: STANDARD.decode(salt).ok()?,
                hash: STANDARD.decode(hash).ok()?,
            }
        }
        None => Names::Patterns(names.split(',').map(str::to_ascii_lowercase).collect()),
    };
    Some(Entry {
        file: file.to_owned(),
        line,
        marker,
        names,
        kind: kind.to_owned(),
        blob,
    })
}

/// The host's name in known_hosts.
pub(super) fn known_name(host: &str, port: u16) -> String {
    let host = host.to_ascii_lowercase();
    if port == 22 {
        host
    } else {
        format!("[{host}]:{port}")
    }
}

/// Every host-key algorithm that is acceptable, best first.
pub(super) fn all_algorithms() -> String {
    let all: Vec<&str> = ALGORITHMS
        .iter()
        .map(|(_, algorithms)| *algorithms)
        .collect();
    all.join(",")
}

/// The algorithms by family, so that a host shows one key of each.
pub(super) fn algorithm_groups() -> [String; 3] {
    let of = |family: &str| {
        let group: Vec<&str> = ALGORITHMS
            .iter()
            .filter(|(kind, _)| kind.starts_with(family))
            .map(|(_, algorithms)| *algorithms)
            .collect();
        group.join(",")
    };
    [of("ssh-ed25519"), of("ecdsa-"), of("ssh-rsa")]
}

/// Whether a name matches a pattern of `*` and `?`, in time linear in the product of their lengths.
pub(super) fn matches(pattern: &str, name: &str) -> bool {
    let (pattern, name) = (pattern.as_bytes(), name.as_bytes());
    // Reached[i]: pattern[..i] can match what was read of the name.
    let mut reached = vec![false; pattern.len() + 1];
    let stars = |reached: &mut Vec<bool>| {
        for (at, byte) in pattern.iter().enumerate() {
            if *byte == b'*' && reached[at] {
                reached[at + 1] = true;
            }
        }
    };
    reached[0] = true;
    stars(&mut reached);
    for byte in name {
        let mut next = vec![false; pattern.len() + 1];
        for (at, wanted) in pattern.iter().enumerate() {
            if *wanted == b'*' {
                next[at] |= reached[at];
                next[at + 1] |= reached[at];
            } else if *wanted == b'?' || wanted == byte {
                next[at + 1] |= reached[at];
            }
        }
        reached = next;
        stars(&mut reached);
    }
    reached.last() == Some(&true)
}

/// `SHA256:...` as OpenSSH prints it.
pub(super) fn fingerprint(blob: &[u8]) -> String {
    format!("SHA256:{}", STANDARD_NO_PAD.encode(Sha256::digest(blob)))
}

/// The type that a key states in its first field.
pub(super) fn kind_of(blob: &[u8]) -> Option<String> {
    let (length, rest) = blob.split_first_chunk::<4>()?;
    let length = usize::try_from(u32::from_be_bytes(*length)).ok()?;
    let kind = str::from_utf8(rest.get(..length)?).ok()?;
    let plain = kind.bytes().all(|b| b.is_ascii_graphic());
    (plain && !kind.is_empty() && rest.len() > length).then(|| kind.to_owned())
}

/// The fingerprint of the key in a line of a file, when there is one.
pub(super) fn fingerprint_at(file: &Path, line: usize) -> Option<String> {
    let text = read_text(file).ok()?;
    let entry = entry(file, line, text.lines().nth(line.checked_sub(1)?)?)?;
    Some(fingerprint(&entry.blob))
}

fn read_text(file: &Path) -> Result<String, SshError> {
    let config = |what: String| SshError::Config {
        file: file.to_owned(),
        line: 0,
        what,
    };
    let mut bytes = Vec::new();
    match File::open(file) {
        Ok(open) => open.take(FILE_MAX + 1).read_to_end(&mut bytes),
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(String::new()),
        Err(error) => Err(error),
    }
    .map_err(|error| {
        config(format!(
            "cannot read the known hosts: {error}; make it readable for you"
        ))
    })?;
    if u64::try_from(bytes.len()).is_ok_and(|length| length > FILE_MAX) {
        return Err(config(
            "more than 16 MiB of known hosts; give ictus a shorter file".to_owned(),
        ));
    }
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}

/// Pins a key: from now on the host must show it. Twice is once; the file is made when it is not there (mode 0600).
///
/// # Errors
/// [`SshError::HostKeyChanged`] when another key of that type is pinned, [`SshError::Revoked`] when this one is revoked,
/// [`SshError::Config`] when the file cannot be written.
pub fn pin(known_hosts: &Path, target: &Target, key: &HostKey) -> Result<(), SshError> {
    let config = |what: String| SshError::Config {
        file: known_hosts.to_owned(),
        line: 0,
        what,
    };
    let text = read_text(known_hosts)?;
    let mut known = Known {
        host: key.name.clone(),
        ..Known::default()
    };
    for entry in entries(known_hosts, &text) {
        known.sort_in(entry, &key.name);
    }
    // Another type of key may well be pinned already: only the same type is a change.
    known.pinned.retain(|entry| entry.kind == key.kind);
    match known.judge(key) {
        Ok(()) => return Ok(()),
        Err(SshError::UnknownHostKey { .. }) => {}
        Err(error) => return Err(error),
    }
    let written = |error: std::io::Error| {
        config(format!(
            "cannot pin the key of host `{target}`: {error}; make the file writable for you"
        ))
    };
    if let Some(directory) = known_hosts.parent().filter(|directory| !directory.exists()) {
        fs::DirBuilder::new()
            .recursive(true)
            .mode(0o700)
            .create(directory)
            .map_err(written)?;
    }
    let mut line = key.line();
    line.push('\n');
    if !text.is_empty() && !text.ends_with('\n') {
        line.insert(0, '\n');
    }
    let mut options = fs::OpenOptions::new();
    let mut file = options
        .append(true)
        .create(true)
        .mode(0o600)
        .open(known_hosts)
        .map_err(written)?;
    // One write, so that two who pin at once do not mix their lines.
    file.write_all(line.as_bytes()).map_err(written)?;
    file.sync_all().map_err(written)
}

#[cfg(test)]
mod tests {
    use super::{HostKey, Known, SshError, fingerprint, kind_of, matches, pin};
    use base64::Engine as _;
    use base64::engine::general_purpose::STANDARD;
    use proptest::prelude::*;
    use std::fs;

    fn blob(kind: &str, body: u8) -> Vec<u8> {
        let mut blob = u32::try_from(kind.len()).unwrap().to_be_bytes().to_vec();
        blob.extend_from_slice(kind.as_bytes());
        blob.extend([body; 32]);
        blob
    }

    fn key(name: &str, kind: &str, body: u8) -> HostKey {
        HostKey::new(name, &blob(kind, body)).unwrap()
    }

    fn text(names: &str, kind: &str, body: u8) -> String {
        format!(
            "{names} {kind} {} comment\n",
            STANDARD.encode(blob(kind, body))
        )
    }

    fn known(text: &str, host: &str, port: u16) -> Known {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("known_hosts");
        fs::write(&file, text).unwrap();
        Known::read(&[file], host, port).unwrap()
    }

    const ED: &str = "ssh-ed25519";

    #[test]
    fn names_of_all_forms_are_found() {
        let table = [
            ("pi", "pi", 22, true),
            ("PI", "pi", 22, true),
            ("other,pi,10.0.0.1", "10.0.0.1", 22, true),
            ("[pi]:2222", "pi", 2222, true),
            ("[pi]:2222", "pi", 22, false),
            ("[pi]:2222", "pi", 2223, false),
            // As in OpenSSH, a key without a port is good for other ports too.
            ("pi", "pi", 2222, true),
            // `ssh-keygen -H` of `pi.example` and of `[pi.example]:2222`.
            (
                "|1|MDEyMzQ1Njc4OTAxMjM0NTY3ODk=|U7gH5zSOn3IxJaLPi3W/xVdzMQQ=",
                "other",
                22,
                false,
            ),
        ];
        for (names, host, port, expected) in table {
            let known = known(&text(names, ED, 1), host, port);
            assert_eq!(
                known.judge(&key("x", ED, 1)).is_ok(),
                expected,
                "{names} {host} {port}"
            );
            assert_eq!(known.foreign, None);
        }
    }

    #[test]
    fn a_changed_key_names_its_line() {
        let known = known(
            &format!("# comment\n\nbroken line\n{}", text("pi", ED, 1)),
            "pi",
            22,
        );
        match known.judge(&key("pi", ED, 2)) {
            Err(SshError::HostKeyChanged {
                line,
                expected,
                found,
                ..
            }) => {
                assert_eq!(line, 4);
                assert_eq!(expected, fingerprint(&blob(ED, 1)));
                assert_eq!(found, fingerprint(&blob(ED, 2)));
            }
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn algorithms_are_those_of_the_known_types() {
        let both = format!(
            "{}{}",
            text("pi", "ssh-rsa", 1),
            text("pi", "ecdsa-sha2-nistp256", 2)
        );
        let known_types = known(&both, "pi", 22).algorithms();
        assert_eq!(
            known_types.as_deref(),
            Some("ecdsa-sha2-nistp256,rsa-sha2-512,rsa-sha2-256")
        );
        assert_eq!(known(&both, "po", 22).algorithms(), None);
        let fido = known(&text("pi", "sk-ssh-ed25519@openssh.com", 1), "pi", 22).algorithms();
        assert_eq!(fido.as_deref(), Some(""));
    }

    #[test]
    fn what_only_the_system_client_understands_is_said() {
        let table = [
            (
                text("@cert-authority *.lan", ED, 1),
                Some("@cert-authority"),
            ),
            (text("*.lan", ED, 1), Some("a pattern")),
            (text("*.lan,!pi.lan", ED, 1), None),
            (text("@cert-authority *.wan", ED, 1), None),
            (text("p?.lan,pi.lan", ED, 1), None),
        ];
        for (text, expected) in table {
            let foreign = known(&text, "pi.lan", 22).foreign;
            assert_eq!(foreign.map(|foreign| foreign.what), expected, "{text}");
        }
    }

    #[test]
    fn a_revoked_key_is_refused_even_when_pinned() {
        for (names, host, port) in [
            ("*", "pi", 22),
            ("pi", "pi", 2222),
            ("[pi]:2222", "pi", 2222),
        ] {
            let text = format!(
                "{}{}",
                text("pi,[pi]:2222", ED, 1),
                text(&format!("@revoked {names}"), ED, 1)
            );
            let known = known(&text, host, port);
            let result = known.judge(&key("pi", ED, 1));
            assert!(
                matches!(result, Err(SshError::Revoked { line: 2, .. })),
                "{result:?}"
            );
        }
    }

    #[test]
    fn pinning_twice_is_once_and_another_key_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("new/known_hosts");
        let target = "robot@pi:2222".parse().unwrap();
        let name = "[pi]:2222";
        pin(&file, &target, &key(name, ED, 1)).unwrap();
        pin(&file, &target, &key(name, ED, 1)).unwrap();
        pin(&file, &target, &key(name, "ssh-rsa", 1)).unwrap();
        assert_eq!(fs::read_to_string(&file).unwrap().lines().count(), 2);
        let changed = pin(&file, &target, &key(name, ED, 2));
        assert!(
            matches!(changed, Err(SshError::HostKeyChanged { line: 1, .. })),
            "{changed:?}"
        );
        fs::write(&file, text("@revoked *", ED, 3).trim_end()).unwrap();
        let revoked = pin(&file, &target, &key(name, ED, 3));
        assert!(
            matches!(revoked, Err(SshError::Revoked { line: 1, .. })),
            "{revoked:?}"
        );
        pin(&file, &target, &key(name, ED, 4)).unwrap();
        Known::read(&[file], "pi", 2222)
            .unwrap()
            .judge(&key(name, ED, 4))
            .unwrap();
    }

    proptest! {
        #[test]
        fn patterns_match_as_the_recursive_definition(pattern in "[ab*?]{0,7}", name in "[ab]{0,7}") {
            fn slow(pattern: &[u8], name: &[u8]) -> bool {
                match (pattern.split_first(), name.split_first()) {
                    (None, rest) => rest.is_none(),
                    (Some((b'*', rest)), more) => slow(rest, name) || more.is_some_and(|(_, more)| slow(pattern, more)),
                    (Some((b'?', rest)), Some((_, more))) => slow(rest, more),
                    (Some((wanted, rest)), Some((byte, more))) => wanted == byte && slow(rest, more),
                    (Some(_), None) => false,
                }
            }
            prop_assert_eq!(matches(&pattern, &name), slow(pattern.as_bytes(), name.as_bytes()));
        }

        #[test]
        fn a_pinned_key_is_accepted_and_no_other(host in "[a-z]{1,8}", port in 1_u16.., body: u8, other: u8) {
            let name = super::known_name(&host, port);
            let known = known(&(key(&name, ED, body).line() + "\n"), &host, port);
            prop_assert_eq!(known.judge(&key(&name, ED, other)).is_ok(), body == other);
        }

        #[test]
        fn no_text_breaks_the_reader(text in "(@?[a-z-]{0,8} ?[|1a-z*!,]{0,8} ?ssh-rsa ?[A-Za-z=+/]{0,20}\n?|\\PC{0,10}){0,6}", bytes: Vec<u8>) {
            known(&text, "pi", 22).algorithms();
            kind_of(&bytes);
        }
    }
}
