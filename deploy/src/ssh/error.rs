//! What can go wrong on the way to a host, in words that name the host, the cause and the fix.

use std::path::PathBuf;

/// Why a host could not be reached or used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SshError {
    /// The text is no `[user@]host[:port]`; raised by parsing.
    #[error(
        "`{text}` is not a host: {why}; write `host`, `user@host`, `host:port` or `user@[IPv6]:port`"
    )]
    BadTarget {
        /// What was given.
        text: String,
        /// What is wrong with it.
        why: &'static str,
    },
    /// A word of a command line holds what a remote shell could interpret; raised before anything is sent.
    #[error("`{word}` may not be part of a remote command: {why}")]
    BadCommand {
        /// The word.
        word: String,
        /// What is wrong with it.
        why: &'static str,
    },
    /// No connection: the name does not resolve, nobody listens, or no route leads there.
    #[error(
        "cannot reach host `{host}`: {cause}; check that it is up, its name and port, and the network between"
    )]
    Unreachable {
        /// The host, with its port when it is not 22.
        host: String,
        /// What the system says.
        cause: String,
    },
    /// The host was reached but did not answer in time.
    #[error(
        "host `{host}` did not answer within {seconds} s while {doing}; check that its sshd works and is not overloaded"
    )]
    Timeout {
        /// The host.
        host: String,
        /// What was under way.
        doing: String,
        /// The bound.
        seconds: u64,
    },
    /// No known_hosts file has a key of this host.
    #[error(
        "host `{host}` is not known: it shows the {kind} key {fingerprint}, and {known_hosts} has no key for it; \
         compare the fingerprint with the host's own, then run `ictus host add`"
    )]
    UnknownHostKey {
        /// The host as known_hosts would name it.
        host: String,
        /// The type of the key, such as `ssh-ed25519`; empty when the system's client did not say.
        kind: String,
        /// `SHA256:...` as OpenSSH prints it, or what is known of it.
        fingerprint: String,
        /// The file (the first of several) that was looked at.
        known_hosts: String,
    },
    /// The host shows another key than the one that is pinned.
    #[error(
        "the key of host `{host}` has changed: {file}:{line} says {expected}, the host shows {found}; \
         either the host was installed anew or someone is in between: if it was, remove that line and run `ictus host add`",
        file = file.display()
    )]
    HostKeyChanged {
        /// The host as known_hosts names it.
        host: String,
        /// The file of the pinned key.
        file: PathBuf,
        /// Its line, from 1; 0 when it is not known.
        line: usize,
        /// Fingerprint of the pinned key.
        expected: String,
        /// Fingerprint of the key shown.
        found: String,
    },
    /// The host shows a key that a `@revoked` line forbids.
    #[error(
        "host `{host}` shows the key {fingerprint}, which {file}:{line} revokes; it is never used: give the host a new key",
        file = file.display()
    )]
    Revoked {
        /// The host as known_hosts names it.
        host: String,
        /// The file with the `@revoked` line.
        file: PathBuf,
        /// Its line, from 1; 0 when it is not known.
        line: usize,
        /// Fingerprint of the key shown.
        fingerprint: String,
    },
    /// The host takes none of our keys.
    #[error(
        "host `{host}` lets user `{user}` in with none of the keys tried ({tried}); add one of them to its \
         ~/.ssh/authorized_keys (`ssh-copy-id`), load yours into ssh-agent, or name it in the host's entry"
    )]
    Auth {
        /// The host.
        host: String,
        /// The user on the host.
        user: String,
        /// What was tried and why it did not do.
        tried: String,
    },
    /// A file of the ssh configuration cannot be read or asks for what is not there.
    #[error("{file}:{line}: {what}", file = file.display())]
    Config {
        /// The file.
        file: PathBuf,
        /// Its line, from 1; 0 for the file as a whole.
        line: usize,
        /// What is wrong and what to do.
        what: String,
    },
    /// The host speaks ssh but refuses: no common algorithm, no channel, no command.
    #[error("host `{host}` refuses {what}: {cause}")]
    Refused {
        /// The host.
        host: String,
        /// What it refuses.
        what: String,
        /// What it or the protocol says.
        cause: String,
    },
    /// A command on the host failed.
    #[error("`{command}` on host `{host}` failed: {cause}")]
    Remote {
        /// The host.
        host: String,
        /// The command line.
        command: String,
        /// Its exit code and what it wrote to standard error.
        cause: String,
    },
    /// All channels to the host stayed in use.
    #[error(
        "all channels to host `{host}` stayed in use for {seconds} s; end one of the commands that run on it"
    )]
    Busy {
        /// The host.
        host: String,
        /// How long was waited.
        seconds: u64,
    },
    /// The connection ended.
    #[error("the connection to host `{host}` was lost: {cause}")]
    Closed {
        /// The host.
        host: String,
        /// What was seen.
        cause: String,
    },
    /// Something on this machine is missing or cannot be read.
    #[error("{what}: {cause}")]
    Local {
        /// The file or program.
        what: String,
        /// What the system says and what to do.
        cause: String,
    },
}

impl SshError {
    /// Whether the host itself is out of reach: nobody answers, in time or at all, or the connection was lost.
    #[must_use]
    pub fn is_unreachable(&self) -> bool {
        matches!(
            self,
            Self::Unreachable { .. } | Self::Timeout { .. } | Self::Closed { .. }
        )
    }
}
