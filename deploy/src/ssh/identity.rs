//! Showing the host who we are: the agent's keys, then key files. A passphrase is never asked for.

use std::fs;
use std::path::{Path, PathBuf};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use ssh2::{Error, ErrorCode, Session};

use super::error::SshError;
use super::known_hosts::kind_of;
use super::route::Route;

/// Keys of the agent that are tried without being asked for: sshd takes six attempts, the files want some of them.
const AGENT_KEYS_MAX: usize = 4;
/// Files looked for in ~/.ssh when nothing names one.
pub(super) const DEFAULT_FILES: &[&str] = &["id_ed25519", "id_ecdsa", "id_rsa"];
/// Bytes of a key file.
const KEY_MAX: usize = 64 << 10;

/// libssh2's codes for a key that was refused; others end the session.
const REFUSED: &[i32] = &[-16, -18, -19, -33, -34, -42, -48];

/// What a key file holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum KeyFile {
    Plain,
    /// Only an agent can use it without asking.
    Encrypted,
    /// A FIDO key or a format that libssh2 does not read.
    Foreign,
}

/// Authenticates the session, or says what was tried.
pub(super) fn authenticate(session: &Session, route: &Route) -> Result<(), SshError> {
    let methods = session.auth_methods(&route.user).unwrap_or_default();
    if session.authenticated() {
        return Ok(());
    }
    let mut tried = Vec::new();
    if methods.is_empty() || methods.split(',').any(|method| method == "publickey") {
        if with_agent(session, route, &mut tried)? || with_files(session, route, &mut tried)? {
            return Ok(());
        }
    } else {
        tried.push(format!("none: the host takes only {methods}"));
    }
    if tried.is_empty() {
        tried.push("none: there is no key file and no agent".to_owned());
    }
    Err(SshError::Auth {
        host: route.host.clone(),
        user: route.user.clone(),
        tried: tried.join(", "),
    })
}

/// Tries the agent's keys: those of the named key files first.
fn with_agent(session: &Session, route: &Route, tried: &mut Vec<String>) -> Result<bool, SshError> {
    let Some(socket) = &route.agent else {
        return Ok(false);
    };
    let mut try_keys = || -> Result<bool, Error> {
        let mut agent = session.agent()?;
        agent.set_identity_path(socket)?;
        agent.connect()?;
        agent.list_identities()?;
        let named: Vec<Vec<u8>> = route
            .identities
            .iter()
            .filter_map(|file| public_key(file))
            .collect();
        let (mut keys, others): (Vec<_>, Vec<_>) = agent
            .identities()?
            .into_iter()
            .partition(|key| named.iter().any(|blob| blob == key.blob()));
        if !route.only_identities {
            keys.extend(others.into_iter().take(AGENT_KEYS_MAX));
        }
        for key in keys {
            match agent.userauth(&route.user, &key) {
                Ok(()) => return Ok(true),
                Err(error) if refused(&error) => tried.push(format!("agent: {}", key.comment())),
                Err(error) => return Err(error),
            }
        }
        Ok(false)
    };
    match try_keys() {
        Ok(done) => Ok(done),
        Err(error) if is_agent(&error) => {
            tried.push(format!("agent: {}", error.message()));
            Ok(false)
        }
        Err(error) => Err(ended(route, tried, &error)),
    }
}

fn with_files(session: &Session, route: &Route, tried: &mut Vec<String>) -> Result<bool, SshError> {
    for file in &route.identities {
        let name = file.display();
        let text = match fs::read(file) {
            Ok(bytes) if bytes.len() <= KEY_MAX => String::from_utf8_lossy(&bytes).into_owned(),
            Ok(_) => {
                tried.push(format!("{name}: too long for a key"));
                continue;
            }
            Err(_) if !route.identities_named => continue,
            Err(error) => {
                tried.push(format!("{name}: {error}"));
                continue;
            }
        };
        match inspect(&text) {
            KeyFile::Plain => {}
            KeyFile::Encrypted => {
                tried.push(format!(
                    "{name}: encrypted and not in the agent: `ssh-add {name}` loads it"
                ));
                continue;
            }
            KeyFile::Foreign => {
                tried.push(format!("{name}: only the system's ssh can use it: say `client: system` in the host's entry"));
                continue;
            }
        }
        match session.userauth_pubkey_file(&route.user, None, file, None) {
            Ok(()) => return Ok(true),
            Err(error) if refused(&error) => tried.push(format!("{name}: {}", error.message())),
            Err(error) => return Err(ended(route, tried, &error)),
        }
    }
    Ok(false)
}

fn refused(error: &Error) -> bool {
    REFUSED
        .iter()
        .any(|code| error.code() == ErrorCode::Session(*code))
}

/// Whether the agent is the matter, not the host: LIBSSH2_ERROR_AGENT_PROTOCOL and what its socket gives.
fn is_agent(error: &Error) -> bool {
    [-42, -39, -45]
        .iter()
        .any(|code| error.code() == ErrorCode::Session(*code))
}

/// The host ended the session while keys were tried: most often because it takes no more of them.
fn ended(route: &Route, tried: &[String], error: &Error) -> SshError {
    if tried.is_empty() {
        return SshError::Closed {
            host: route.host.clone(),
            cause: format!("while it was shown our keys: {}", error.message()),
        };
    }
    SshError::Auth {
        host: route.host.clone(),
        user: route.user.clone(),
        tried: format!(
            "{}, then the host hung up: {}",
            tried.join(", "),
            error.message()
        ),
    }
}

/// The public half beside a key file, as the agent knows it.
fn public_key(file: &Path) -> Option<Vec<u8>> {
    let mut name = file.as_os_str().to_owned();
    name.push(".pub");
    let text = fs::read_to_string(PathBuf::from(name)).ok()?;
    STANDARD.decode(text.split_ascii_whitespace().nth(1)?).ok()
}

/// What kind of key the text of a file is, without using it.
fn inspect(text: &str) -> KeyFile {
    let lines = text.lines().map(str::trim).filter(|line| !line.is_empty());
    let body: String = lines
        .clone()
        .filter(|line| !line.starts_with("-----"))
        .collect();
    let first = lines.clone().next().unwrap_or_default();
    if first != "-----BEGIN OPENSSH PRIVATE KEY-----" {
        return match () {
            () if !first.starts_with("-----BEGIN ") || !first.ends_with("PRIVATE KEY-----") => {
                KeyFile::Foreign
            }
            () if first.contains("ENCRYPTED") || text.contains("Proc-Type: 4,ENCRYPTED") => {
                KeyFile::Encrypted
            }
            () => KeyFile::Plain,
        };
    }
    // openssh-key-v1, then: cipher, derivation, its options, how many keys, the public key.
    let Ok(bytes) = STANDARD.decode(body) else {
        return KeyFile::Foreign;
    };
    let fields = || -> Option<(&[u8], &[u8])> {
        let rest = bytes.strip_prefix(b"openssh-key-v1\0")?;
        let (cipher, rest) = field(rest)?;
        let (_, rest) = field(rest)?;
        let (_, rest) = field(rest)?;
        let (public, _) = field(rest.get(4..)?)?;
        Some((cipher, public))
    };
    let Some((cipher, public)) = fields() else {
        return KeyFile::Foreign;
    };
    match kind_of(public) {
        Some(kind) if kind.starts_with("sk-") => KeyFile::Foreign,
        Some(_) if cipher == b"none" => KeyFile::Plain,
        Some(_) => KeyFile::Encrypted,
        None => KeyFile::Foreign,
    }
}

/// A length and that many bytes; and what follows.
fn field(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let (length, rest) = bytes.split_first_chunk::<4>()?;
    rest.split_at_checked(usize::try_from(u32::from_be_bytes(*length)).ok()?)
}

#[cfg(test)]
mod tests {
    use super::{KeyFile, inspect};
    use base64::Engine as _;
    use base64::engine::general_purpose::STANDARD;
    use proptest::prelude::*;

    fn openssh(cipher: &str, kind: &str) -> String {
        let mut public = Vec::new();
        let put = |to: &mut Vec<u8>, bytes: &[u8]| {
            to.extend(u32::try_from(bytes.len()).unwrap().to_be_bytes());
            to.extend(bytes);
        };
        put(&mut public, kind.as_bytes());
        public.extend([7; 36]);
        let mut bytes = b"openssh-key-v1\0".to_vec();
        for text in [cipher, "bcrypt", ""] {
            put(&mut bytes, text.as_bytes());
        }
        bytes.extend(1_u32.to_be_bytes());
        put(&mut bytes, &public);
        let body = STANDARD.encode(bytes);
        format!("-----BEGIN OPENSSH PRIVATE KEY-----\n{body}\n-----END OPENSSH PRIVATE KEY-----\n")
    }

    #[test]
    fn key_files_of_all_forms() {
        let table = [
            (openssh("none", "ssh-ed25519"), KeyFile::Plain),
            (openssh("aes256-ctr", "ssh-ed25519"), KeyFile::Encrypted),
            (
                openssh("none", "sk-ssh-ed25519@openssh.com"),
                KeyFile::Foreign,
            ),
            (
                "-----BEGIN RSA PRIVATE KEY-----\nAA==\n".to_owned(),
                KeyFile::Plain,
            ),
            (
                "-----BEGIN RSA PRIVATE KEY-----\nProc-Type: 4,ENCRYPTED\n".to_owned(),
                KeyFile::Encrypted,
            ),
            (
                "-----BEGIN ENCRYPTED PRIVATE KEY-----\nAA==\n".to_owned(),
                KeyFile::Encrypted,
            ),
            ("ssh-ed25519 AAAA me".to_owned(), KeyFile::Foreign),
            (String::new(), KeyFile::Foreign),
        ];
        for (text, expected) in table {
            assert_eq!(inspect(&text), expected, "{text}");
        }
    }

    proptest! {
        #[test]
        fn no_text_breaks_the_inspection(bytes: Vec<u8>, text in "\\PC{0,40}") {
            inspect(&text);
            inspect(&format!("-----BEGIN OPENSSH PRIVATE KEY-----\n{}\n", STANDARD.encode(&bytes)));
            let magic = [b"openssh-key-v1\0".as_slice(), &bytes].concat();
            inspect(&format!("-----BEGIN OPENSSH PRIVATE KEY-----\n{}\n", STANDARD.encode(magic)));
        }
    }
}
