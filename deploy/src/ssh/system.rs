//! The system's `ssh` as the way to a host: for what libssh2 lacks (FIDO keys, certificates, patterns, `Match`).

use std::collections::VecDeque;
use std::io::ErrorKind;
use std::path::PathBuf;
use std::process::Stdio;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncReadExt as _};
use tokio::process::{Child, ChildStdin, ChildStdout, Command};
use tokio::sync::OwnedSemaphorePermit;
use tokio::task::JoinHandle;
use tokio::time::timeout;

use super::Options;
use super::error::SshError;
use super::known_hosts::{Known, fingerprint_at, known_name};
use super::pipe::{End, STDERR_MAX};
use super::route::{Route, jumps};
use super::target::Target;

/// What `ssh` exits with when it failed itself.
const OWN_FAILURE: i32 = 255;
/// How long a program that has ended may hold its standard error open through others.
const STDERR_LINGER: Duration = Duration::from_secs(1);

/// The system's client for one host.
#[derive(Clone, Debug)]
pub(super) struct System {
    target: Target,
    options: Options,
    route: Route,
}

/// A running `ssh`.
#[derive(Debug)]
pub(super) struct Process {
    pub(super) stdin: Option<ChildStdin>,
    pub(super) stdout: ChildStdout,
    stderr: Arc<Mutex<VecDeque<u8>>>,
    reader: JoinHandle<()>,
    child: Child,
    system: Arc<System>,
    _permit: OwnedSemaphorePermit,
}

impl System {
    /// Asks `ssh -G` what it would do, without connecting.
    pub(super) async fn new(target: &Target, options: &Options) -> Result<Self, SshError> {
        let mut command = base(target, options);
        command
            .args(["-G", "--", &target.host])
            .stdin(Stdio::null());
        let output = match timeout(options.connect_timeout, command.output()).await {
            Ok(Ok(output)) => output,
            Ok(Err(error)) => return Err(missing(&error)),
            Err(_) => {
                return Err(SshError::Timeout {
                    host: target.to_string(),
                    doing: "asking `ssh -G`".to_owned(),
                    seconds: options.connect_timeout.as_secs(),
                });
            }
        };
        if !output.status.success() {
            return Err(SshError::Config {
                file: options
                    .config
                    .clone()
                    .unwrap_or_else(|| PathBuf::from("ssh_config")),
                line: 0,
                what: last_lines(&output.stderr),
            });
        }
        let route = route(target, options, &String::from_utf8_lossy(&output.stdout))?;
        Ok(Self {
            target: target.clone(),
            options: options.clone(),
            route,
        })
    }

    pub(super) fn route(&self) -> &Route {
        &self.route
    }

    /// Starts a command line that was validated.
    pub(super) fn start(
        self: &Arc<Self>,
        line: &str,
        permit: OwnedSemaphorePermit,
    ) -> Result<Process, SshError> {
        let mut command = base(&self.target, &self.options);
        command
            .arg("-o")
            .arg(known_hosts_option(&self.route.known_hosts))
            .args(["-T", "--", &self.target.host])
            .args(line.split(' '));
        command.stdin(Stdio::piped());
        let mut child = command.spawn().map_err(|error| missing(&error))?;
        let (Some(stdout), Some(stderr)) = (child.stdout.take(), child.stderr.take()) else {
            return Err(missing(&ErrorKind::BrokenPipe.into()));
        };
        let tail = Arc::new(Mutex::new(VecDeque::new()));
        let reader = tokio::spawn(keep_tail(stderr, Arc::clone(&tail)));
        Ok(Process {
            stdin: child.stdin.take(),
            stdout,
            stderr: tail,
            reader,
            child,
            system: Arc::clone(self),
            _permit: permit,
        })
    }

    /// What `ssh` itself failed at, from what it printed; none when the command's own exit code was 255.
    fn classify(&self, text: &str) -> Option<SshError> {
        if text.contains("REVOKED HOST KEY") || text.contains("is marked as revoked") {
            return Some(self.revoked());
        }
        if text.contains("REMOTE HOST IDENTIFICATION HAS CHANGED") {
            return Some(self.changed(text));
        }
        let unknown = ["host key is known for", "Host key verification failed"];
        if let Some(line) = line_with(text, &unknown) {
            let kind = line
                .strip_prefix("No ")
                .and_then(|rest| rest.split(' ').next());
            let file = self.route.known_hosts.first();
            return Some(SshError::UnknownHostKey {
                host: self.known_name(),
                kind: kind.unwrap_or_default().to_owned(),
                fingerprint: "that ssh does not print".to_owned(),
                known_hosts: file.map_or_else(String::new, |file| file.display().to_string()),
            });
        }
        let denied = ["Permission denied (", "Too many authentication failures"];
        if let Some(line) = line_with(text, &denied) {
            return Some(SshError::Auth {
                host: self.route.name(),
                user: self.route.user.clone(),
                tried: format!("what the system's ssh tries: {line}"),
            });
        }
        self.classify_network(text)
    }

    /// The part of [`Self::classify`] that is about the way and the protocol.
    fn classify_network(&self, text: &str) -> Option<SshError> {
        let host = self.route.name();
        if line_with(text, &["Connection timed out", "Operation timed out"]).is_some() {
            return Some(SshError::Timeout {
                host,
                doing: "connecting".to_owned(),
                seconds: self.options.connect_timeout.as_secs(),
            });
        }
        let unreachable = [
            "Could not resolve hostname",
            "Connection refused",
            "No route to host",
            "Network is unreachable",
        ];
        if let Some(cause) = line_with(text, &unreachable) {
            return Some(SshError::Unreachable { host, cause });
        }
        let closed = [
            "Connection closed by",
            "Connection reset by",
            "kex_exchange_identification",
            "not responding",
            "client_loop: send disconnect",
        ];
        if let Some(cause) = line_with(text, &closed) {
            return Some(SshError::Closed { host, cause });
        }
        let refused = [
            "Unable to negotiate",
            "channel 0: open failed",
            "exec request failed",
        ];
        line_with(text, &refused).map(|cause| SshError::Refused {
            host,
            what: "the system's ssh".to_owned(),
            cause,
        })
    }

    fn known_name(&self) -> String {
        known_name(&self.route.host, self.route.port)
    }

    fn revoked(&self) -> SshError {
        let known = Known::read(&self.route.known_hosts, &self.route.host, self.route.port)
            .unwrap_or_default();
        let (file, line, fingerprint) = known.first_revoked().unwrap_or_default();
        SshError::Revoked {
            host: self.known_name(),
            file,
            line,
            fingerprint,
        }
    }

    /// `Offending ED25519 key in FILE:LINE` and the fingerprint that follows `sent by the remote host is`.
    fn changed(&self, text: &str) -> SshError {
        let place = text
            .lines()
            .find(|line| line.starts_with("Offending "))
            .and_then(|line| {
                let (file, line) = line.split_once(" key in ")?.1.rsplit_once(':')?;
                Some((PathBuf::from(file), line.trim().parse().ok()?))
            });
        let (file, line) = place.unwrap_or_default();
        let found = text
            .split_whitespace()
            .find(|word| word.starts_with("SHA256:"))
            .unwrap_or_default();
        SshError::HostKeyChanged {
            host: self.known_name(),
            expected: fingerprint_at(&file, line).unwrap_or_default(),
            file,
            line,
            found: found.trim_end_matches('.').to_owned(),
        }
    }
}

impl Process {
    /// Waits until `ssh` has ended.
    pub(super) async fn end(&mut self) -> Result<End, SshError> {
        self.stdin = None;
        let status = self.child.wait().await.map_err(|error| missing(&error))?;
        // A connection that is shared may hold the pipe: what is there by then is enough.
        let whole = timeout(STDERR_LINGER, &mut self.reader).await.is_ok();
        if !whole {
            self.reader.abort();
        }
        let stderr: Vec<u8> = tail(&self.stderr).iter().copied().collect();
        if status.code() == Some(OWN_FAILURE)
            && let Some(error) = self.system.classify(&String::from_utf8_lossy(&stderr))
        {
            return Err(error);
        }
        Ok(End {
            code: status.code(),
            signal: status.code().is_none().then(|| "of its own ssh".to_owned()),
            stderr,
        })
    }
}

/// `ssh` with everything that makes it ask nothing and trust nothing new.
fn base(target: &Target, options: &Options) -> Command {
    let mut command = Command::new("ssh");
    let default = options.home.as_ref().map(|home| home.join(".ssh/config"));
    match &options.config {
        // Its own default also reads /etc/ssh/ssh_config.
        Some(file) if Some(file) == default.as_ref() => {}
        Some(file) if file.exists() => {
            command.arg("-F").arg(file);
        }
        Some(_) | None => {
            command.args(["-F", "none"]);
        }
    }
    for option in [
        "BatchMode=yes",
        "StrictHostKeyChecking=yes",
        "UpdateHostKeys=no",
        "ControlMaster=no",
        "ClearAllForwardings=yes",
        "RequestTTY=no",
        "RemoteCommand=none",
        "PermitLocalCommand=no",
        "ServerAliveInterval=10",
        "ServerAliveCountMax=3",
    ] {
        command.args(["-o", option]);
    }
    let seconds = options.connect_timeout.as_secs().max(1);
    command.arg("-o").arg(format!("ConnectTimeout={seconds}"));
    match &options.agent {
        Some(agent) => command.env("SSH_AUTH_SOCK", agent),
        None => command.env_remove("SSH_AUTH_SOCK"),
    };
    if let Some(identity) = &options.identity {
        command
            .arg("-o")
            .arg("IdentitiesOnly=yes")
            .arg("-i")
            .arg(identity);
    }
    if let Some(user) = &target.user {
        command.arg("-l").arg(user);
    }
    if let Some(port) = target.port {
        command.arg("-p").arg(port.to_string());
    }
    // Whatever still wants to ask, such as an `ssh` to a host on the way, asks a program that fails.
    command
        .env("LC_ALL", "C")
        .env("SSH_ASKPASS", "/bin/false")
        .env("SSH_ASKPASS_REQUIRE", "force");
    command
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .kill_on_drop(true);
    command
}

/// What `ssh -G` printed, as a route.
fn route(target: &Target, options: &Options, text: &str) -> Result<Route, SshError> {
    let value = |keyword: &str| {
        text.lines().find_map(|line| {
            line.strip_prefix(keyword)?
                .strip_prefix(' ')
                .map(str::to_owned)
        })
    };
    let bad = |what: &str| SshError::Config {
        file: PathBuf::from("ssh -G"),
        line: 0,
        what: format!("what it prints for `{target}` has no {what}; is `ssh` OpenSSH's?"),
    };
    Ok(Route {
        host: value("hostname").ok_or_else(|| bad("hostname"))?,
        port: value("port")
            .and_then(|port| port.parse().ok())
            .ok_or_else(|| bad("port"))?,
        user: value("user").ok_or_else(|| bad("user"))?,
        identities: Vec::new(),
        identities_named: false,
        only_identities: false,
        agent: options.agent.clone(),
        known_hosts: known_hosts(value("userknownhostsfile").as_deref(), options),
        jumps: jumps(value("proxyjump").as_deref())
            .map_err(|_| bad("jump host that we understand"))?,
    })
}

/// The files that ssh_config names, if it does, and ours.
fn known_hosts(value: Option<&str>, options: &Options) -> Vec<PathBuf> {
    let named: Vec<&str> = value.unwrap_or_default().split(' ').collect();
    // What `ssh` takes when nothing is said is not what somebody said.
    let default = matches!(named[..], [one, two] if one.ends_with("/.ssh/known_hosts") && two.ends_with("/.ssh/known_hosts2"));
    let named = named
        .into_iter()
        .filter(|name| !default && !name.is_empty() && *name != "none");
    let mut files: Vec<PathBuf> = named.map(PathBuf::from).collect();
    if !files.contains(&options.known_hosts) {
        files.push(options.known_hosts.clone());
    }
    files
}

/// The files as an option of `ssh`, which would expand `%`.
fn known_hosts_option(files: &[PathBuf]) -> String {
    let quoted: Vec<String> = files
        .iter()
        .map(|file| format!("\"{}\"", file.display().to_string().replace('%', "%%")))
        .collect();
    format!("UserKnownHostsFile={}", quoted.join(" "))
}

/// The first line that has the first of these parts that occurs.
fn line_with(text: &str, parts: &[&str]) -> Option<String> {
    let line = |part: &&str| text.lines().find(|line| line.contains(part));
    parts
        .iter()
        .find_map(line)
        .map(|line| line.trim().to_owned())
}

/// Keeps the last bytes of a stream.
async fn keep_tail(mut stream: impl AsyncRead + Unpin, kept: Arc<Mutex<VecDeque<u8>>>) {
    let mut chunk = vec![0; 8 << 10];
    while let Ok(count @ 1..) = stream.read(&mut chunk).await {
        let mut kept = tail(&kept);
        kept.extend(&chunk[..count]);
        let over = kept.len().saturating_sub(STDERR_MAX);
        kept.drain(..over);
    }
}

fn tail(kept: &Mutex<VecDeque<u8>>) -> std::sync::MutexGuard<'_, VecDeque<u8>> {
    kept.lock().unwrap_or_else(PoisonError::into_inner)
}

fn missing(error: &std::io::Error) -> SshError {
    SshError::Local {
        what: "cannot run the system's `ssh`".to_owned(),
        cause: if error.kind() == ErrorKind::NotFound {
            "it is not installed: `sudo apt-get install openssh-client`, or leave `client: system` out".to_owned()
        } else {
            error.to_string()
        },
    }
}

/// The last three lines of what a program said, in one.
pub(super) fn last_lines(stderr: &[u8]) -> String {
    let text = String::from_utf8_lossy(stderr);
    let lines: Vec<&str> = text
        .lines()
        .map(str::trim)
        .filter(|line| !line.is_empty())
        .collect();
    lines[lines.len().saturating_sub(3)..].join("; ")
}
