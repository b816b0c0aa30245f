//! The way to other hosts: commands, byte streams and files over ssh, with strict host keys.
//!
//! A [`Connection`] is one host. Two methods behave alike: [`Method::Ssh2`] is built in (one thread owns a session that never blocks),
//! [`Method::System`] drives the system's `ssh` for what libssh2 lacks. Nothing reaches a shell but validated words, and no host is trusted whose
//! key is not pinned: [`host_keys`] shows what a host has, [`pin`] writes it down.

mod channel;
mod config;
mod error;
mod identity;
mod known_hosts;
mod pipe;
mod route;
mod session;
mod slot;
mod system;
mod target;
mod upload;
mod worker;

use std::fmt;
use std::net::IpAddr;
use std::path::PathBuf;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, oneshot};
use tokio::time::timeout;

pub use channel::Channel;
pub use error::SshError;
pub use known_hosts::{HostKey, pin};
pub use target::Target;

use channel::Handle;
use known_hosts::Known;
use pipe::Pipe;
use route::Route;
use session::Failure;
use system::System;
use worker::{Purpose, Refusal, Request};

/// Channels at once: sshd's MaxSessions is 10 by default.
const CHANNELS_MAX: usize = 8;
/// Bytes of standard output that [`Connection::run`] takes.
const OUTPUT_MAX: usize = 16 << 20;
/// Hosts on the way to a host.
const JUMPS_MAX: usize = 4;

/// Which implementation talks to the host.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Method {
    /// The built-in client (libssh2).
    #[default]
    Ssh2,
    /// The system's `ssh`: FIDO keys, certificates, `Match` and `Include`, patterns in known_hosts.
    System,
}

/// How to reach hosts.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Options {
    /// Which implementation.
    pub method: Method,
    /// The ssh_config to read; none is read without.
    pub config: Option<PathBuf>,
    /// The file with the pinned host keys; ssh_config may name more.
    pub known_hosts: PathBuf,
    /// Bound of each step until a command can run: name and connection, keys, authentication.
    pub connect_timeout: Duration,
    /// Bound of [`Connection::run`], of waiting for a free channel, and of each step of an upload.
    pub command_timeout: Duration,
    /// The only key to use; ssh_config and the default names decide without.
    pub identity: Option<PathBuf>,
    /// The socket of the agent; none is asked without.
    pub agent: Option<PathBuf>,
    /// What `~/` stands for in ssh_config, and where `.ssh` is.
    pub home: Option<PathBuf>,
}

impl Options {
    /// What the user's `ssh` would use: `~/.ssh/config`, `~/.ssh/known_hosts`, the agent of `SSH_AUTH_SOCK`; 10 s to connect, 120 s for a command.
    #[must_use]
    pub fn from_environment() -> Self {
        let path = |name| {
            std::env::var_os(name)
                .filter(|value| !value.is_empty())
                .map(PathBuf::from)
        };
        let home = path("HOME");
        let below = |name: &str| home.as_ref().map(|home| home.join(".ssh").join(name));
        Self {
            method: Method::Ssh2,
            config: below("config"),
            known_hosts: below("known_hosts").unwrap_or_else(|| PathBuf::from("known_hosts")),
            connect_timeout: Duration::from_secs(10),
            command_timeout: Duration::from_secs(120),
            identity: None,
            agent: path("SSH_AUTH_SOCK"),
            home,
        }
    }
}

/// Whom a connection has reached.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Peer {
    /// The name or address after ssh_config.
    pub host: String,
    /// The port.
    pub port: u16,
    /// The user on the host.
    pub user: String,
    /// The address that answered; none behind a jump host, or when only the system's client knows.
    pub address: Option<IpAddr>,
}

impl fmt::Display for Peer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let target = Target {
            user: Some(self.user.clone()),
            host: self.host.clone(),
            port: (self.port != 22).then_some(self.port),
        };
        target.fmt(f)
    }
}

/// What a command left behind.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Output {
    /// Its exit code; 128 when a signal ended it, which `stderr` then names in its last line.
    pub code: i32,
    /// Its standard output, at most 16 MiB.
    pub stdout: Vec<u8>,
    /// The end of its standard error, at most 64 KiB.
    pub stderr: Vec<u8>,
}

/// A host that was reached, whose key is pinned, and that let us in. Clones share it; it closes with the last clone and channel.
///
/// At most eight channels are open at once; who asks for more waits. A channel that is not read holds up no other.
#[derive(Clone, Debug)]
pub struct Connection(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    peer: Peer,
    remarks: Vec<String>,
    permits: Arc<Semaphore>,
    command_timeout: Duration,
    way: Way,
}

#[derive(Debug)]
enum Way {
    Native(Arc<Handle>),
    System(Arc<System>),
}

impl Connection {
    /// Reaches a host.
    ///
    /// Every step is bounded by [`Options::connect_timeout`]. Needs a tokio runtime with I/O and time, which must live as long as connections
    /// through jump hosts and by the system's client do.
    ///
    /// # Errors
    /// Each [`SshError`] says what to do; [`SshError::is_unreachable`] tells a host that is away from one that refuses.
    pub async fn open(target: &Target, options: &Options) -> Result<Self, SshError> {
        match options.method {
            Method::Ssh2 => Self::open_native(target, options, None, JUMPS_MAX).await,
            Method::System => Self::open_system(target, options, Vec::new()).await,
        }
    }

    /// By libssh2, or by the system's client when known_hosts has lines that only that one understands. `before`: the hosts on the way.
    async fn open_native(
        target: &Target,
        options: &Options,
        before: Option<Vec<Target>>,
        depth: usize,
    ) -> Result<Self, SshError> {
        let mut route = Route::new(target, options)?;
        route.jumps = before.unwrap_or(route.jumps);
        let known = Known::read(&route.known_hosts, &route.host, route.port)?;
        if let Some(remark) = only_system(&known, &route) {
            return Self::open_system(target, options, vec![remark]).await;
        }
        let bound = options.connect_timeout;
        let stream = reach(&route, options, depth).await?;
        let address = stream.address;
        let link = match session::establish(stream, &route, known.clone(), bound).await {
            Ok(link) => link,
            Err(Failure::NoAlgorithm(_)) if known.algorithms().is_some() => {
                // It has no key of the types that are pinned: what it has now is another key.
                let stream = reach(&route, options, depth).await?;
                let key = session::show(stream, &route, None, bound)
                    .await
                    .map_err(|failure| failure.into_error(&route))?;
                return Err(known.judge(&key).err().unwrap_or(SshError::Closed {
                    host: route.name(),
                    cause: "it showed another key a moment ago; try again".to_owned(),
                }));
            }
            Err(failure) => return Err(failure.into_error(&route)),
        };
        Ok(Self::new(
            &route,
            address,
            Vec::new(),
            options,
            Way::Native(Arc::new(Handle(link))),
        ))
    }

    /// Runs `true`, so that what is wrong shows now.
    async fn open_system(
        target: &Target,
        options: &Options,
        remarks: Vec<String>,
    ) -> Result<Self, SshError> {
        let system = Arc::new(System::new(target, options).await?);
        let route = system.route().clone();
        let connection = Self::new(&route, None, remarks, options, Way::System(system));
        // The same bound as the built-in client has: connection, then keys and user.
        let bound = options.connect_timeout * 3;
        let first = async {
            let channel = connection.exec(&["true"]).await?;
            connection.finish(channel, "true", Vec::new(), bound).await
        };
        match first.await {
            Ok(_) => Ok(connection),
            Err(SshError::UnknownHostKey {
                host,
                kind,
                fingerprint,
                known_hosts,
            }) => {
                // ssh does not print what the host shows: look ourselves.
                let shown = host_keys(target, options)
                    .await
                    .ok()
                    .and_then(|keys| keys.into_iter().next());
                let (kind, fingerprint) =
                    shown.map_or((kind, fingerprint), |key| (key.kind, key.fingerprint));
                Err(SshError::UnknownHostKey {
                    host,
                    kind,
                    fingerprint,
                    known_hosts,
                })
            }
            Err(error) => Err(error),
        }
    }

    fn new(
        route: &Route,
        address: Option<IpAddr>,
        remarks: Vec<String>,
        options: &Options,
        way: Way,
    ) -> Self {
        Self(Arc::new(Inner {
            peer: Peer {
                host: route.host.clone(),
                port: route.port,
                user: route.user.clone(),
                address,
            },
            remarks,
            permits: Arc::new(Semaphore::new(CHANNELS_MAX)),
            command_timeout: options.command_timeout,
            way,
        }))
    }

    /// Starts a command; its standard input and output are the channel.
    ///
    /// Words of `[A-Za-z0-9_./=:,@+-]` and a leading `~/` are let through, so that no shell finds anything to interpret.
    ///
    /// # Errors
    /// [`SshError::BadCommand`] for other words, [`SshError::Busy`] when no channel becomes free in time.
    pub async fn exec(&self, command: &[&str]) -> Result<Channel, SshError> {
        let line = target::command_line(command)?;
        match &self.0.way {
            Way::Native(handle) => {
                let pipe = self.ask(handle, Purpose::Exec(line)).await?;
                Ok(Channel::native(pipe, Arc::clone(handle)))
            }
            Way::System(system) => {
                let permit = self.permit().await?;
                Ok(Channel::system(system.start(&line, permit)?))
            }
        }
    }

    /// Runs a command to its end.
    ///
    /// # Errors
    /// [`SshError::Timeout`] after [`Options::command_timeout`], [`SshError::Remote`] when it writes more than 16 MiB; an exit code is none.
    pub async fn run(&self, command: &[&str], stdin: &[u8]) -> Result<Output, SshError> {
        let channel = self.exec(command).await?;
        let line = command.join(" ");
        self.finish(channel, &line, stdin.to_vec(), self.bound())
            .await
    }

    /// Whom this reached.
    #[must_use]
    pub fn peer(&self) -> &Peer {
        &self.0.peer
    }

    /// What the user should know about how the host was reached, a line each.
    #[must_use]
    pub fn remarks(&self) -> &[String] {
        &self.0.remarks
    }

    fn bound(&self) -> Duration {
        self.0.command_timeout
    }

    fn late(&self, doing: &str) -> SshError {
        SshError::Timeout {
            host: self.peer().to_string(),
            doing: doing.to_owned(),
            seconds: self.bound().as_secs(),
        }
    }

    fn failed(&self, command: &[&str], output: &Output) -> SshError {
        SshError::Remote {
            host: self.peer().to_string(),
            command: command.join(" "),
            cause: format!(
                "exit code {}: {}",
                output.code,
                system::last_lines(&output.stderr)
            ),
        }
    }

    async fn permit(&self) -> Result<OwnedSemaphorePermit, SshError> {
        let busy = || SshError::Busy {
            host: self.peer().to_string(),
            seconds: self.bound().as_secs(),
        };
        match timeout(self.bound(), Arc::clone(&self.0.permits).acquire_owned()).await {
            Ok(permit) => permit.map_err(|_| busy()),
            Err(_) => Err(busy()),
        }
    }

    /// A channel of the session. A host that has room for fewer than we thought is asked for fewer from then on.
    async fn ask(&self, handle: &Handle, purpose: Purpose) -> Result<Arc<Pipe>, SshError> {
        loop {
            let (reply, answer) = oneshot::channel();
            let request = Request {
                purpose: purpose.clone(),
                permit: self.permit().await?,
                reply,
            };
            handle.0.ask(request);
            match timeout(self.bound(), answer).await {
                Ok(Ok(Ok(pipe))) => return Ok(pipe),
                Ok(Ok(Err(Refusal::Full(permit)))) => permit.forget(),
                Ok(Ok(Err(Refusal::Failed(error)))) => return Err(error),
                Ok(Err(_)) => {
                    return Err(SshError::Closed {
                        host: self.peer().to_string(),
                        cause: "its thread ended".to_owned(),
                    });
                }
                Err(_) => return Err(self.late("opening a channel")),
            }
        }
    }

    /// Feeds a command its input, gathers its output and waits for its end.
    async fn finish(
        &self,
        mut channel: Channel,
        command: &str,
        stdin: Vec<u8>,
        bound: Duration,
    ) -> Result<Output, SshError> {
        let whole = async {
            let (mut from, mut to) = tokio::io::split(&mut channel);
            let mut stdout = Vec::new();
            let feed = async {
                // A command that ends early does not read its input; its exit code tells more than a broken pipe.
                let _ended_early = to.write_all(&stdin).await;
                let _ended_early = to.shutdown().await;
            };
            let gather = async {
                let limit = u64::try_from(OUTPUT_MAX + 1).unwrap_or(u64::MAX);
                drop((&mut from).take(limit).read_to_end(&mut stdout).await);
            };
            tokio::join!(feed, gather);
            if stdout.len() > OUTPUT_MAX {
                return Err(SshError::Remote {
                    host: self.peer().to_string(),
                    command: command.to_owned(),
                    cause: "it wrote more than 16 MiB".to_owned(),
                });
            }
            channel.end().await.map(|end| (stdout, end))
        };
        let (stdout, end) = timeout(bound, whole)
            .await
            .map_err(|_| SshError::Timeout {
                host: self.peer().to_string(),
                doing: format!("running `{command}`"),
                seconds: bound.as_secs(),
            })??;
        let mut stderr = end.stderr;
        if let Some(signal) = end.signal {
            stderr.extend(format!("\nended by signal {signal}\n").into_bytes());
        }
        Ok(Output {
            code: end.code.unwrap_or(128),
            stdout,
            stderr,
        })
    }
}

/// The keys that a host shows, one of each type, best first; none of them is trusted yet. Nothing is sent but the handshake.
///
/// # Errors
/// As [`Connection::open`], without what concerns known keys and users of the host itself; hosts on the way must be known.
pub async fn host_keys(target: &Target, options: &Options) -> Result<Vec<HostKey>, SshError> {
    let route = match options.method {
        Method::Ssh2 => Route::new(target, options)?,
        Method::System => System::new(target, options).await?.route().clone(),
    };
    let mut keys = Vec::new();
    let mut none = None;
    for algorithms in known_hosts::algorithm_groups() {
        let stream = reach(&route, options, JUMPS_MAX).await?;
        match session::show(stream, &route, Some(algorithms), options.connect_timeout).await {
            Ok(key) => keys.push(key),
            Err(Failure::NoAlgorithm(cause)) => none = Some(Failure::NoAlgorithm(cause)),
            Err(failure @ Failure::Other(_)) => return Err(failure.into_error(&route)),
        }
    }
    match none {
        Some(failure) if keys.is_empty() => Err(failure.into_error(&route)),
        Some(_) | None => Ok(keys),
    }
}

/// A byte stream to the host's sshd, through the hosts on the way.
fn reach<'a>(
    route: &'a Route,
    options: &'a Options,
    depth: usize,
) -> Pin<Box<dyn Future<Output = Result<session::Stream, SshError>> + Send + 'a>> {
    Box::pin(async move {
        let Some((jump, before)) = route.jumps.split_last() else {
            return session::dial(route, options.connect_timeout).await;
        };
        let refused = |cause: String| SshError::Refused {
            host: jump.to_string(),
            what: format!("a connection on to {}", route.name()),
            cause,
        };
        let Some(depth) = depth.checked_sub(1) else {
            return Err(refused(format!(
                "more than {JUMPS_MAX} hosts on the way; does ProxyJump lead round in a circle?"
            )));
        };
        let before = (!before.is_empty()).then(|| before.to_vec());
        let connection = Connection::open_native(jump, options, before, depth).await?;
        let Way::Native(handle) = &connection.0.way else {
            return Err(refused("its known hosts need the system's client: say `client: system` in the host's entry".to_owned()));
        };
        let pipe = connection
            .ask(handle, Purpose::Forward(route.host.clone(), route.port))
            .await?;
        let channel = Channel::native(pipe, Arc::clone(handle));
        session::through(connection, channel).map_err(|error| refused(error.to_string()))
    })
}

/// Why only the system's client can tell whether to trust the host, as a line for the user.
fn only_system(known: &Known, route: &Route) -> Option<String> {
    if let Some(foreign) = &known.foreign {
        return Some(format!(
            "host `{}`: {}:{} has {}, which only the system's ssh understands: using that",
            route.name(),
            foreign.file.display(),
            foreign.line,
            foreign.what
        ));
    }
    // Keys are pinned, but of types that libssh2 cannot verify.
    let none = known
        .algorithms()
        .is_some_and(|algorithms| algorithms.is_empty());
    none.then(|| format!("host `{}`: its pinned keys are of types that only the system's ssh understands: using that", route.name()))
}
