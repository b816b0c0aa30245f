//! Making a session: connect, agree on keys, check the host's, show ours. All of it on the thread that will own the session.

use std::net::{IpAddr, SocketAddr};
use std::os::fd::{AsFd as _, OwnedFd};
use std::os::unix::net::UnixStream;
use std::sync::Arc;
use std::thread;
use std::time::Duration;

use ssh2::{ErrorCode, MethodType, Session};
use tokio::net::{TcpStream, lookup_host};
use tokio::sync::oneshot;
use tokio::time::timeout;

use super::Connection;
use super::channel::Channel;
use super::error::SshError;
use super::identity::authenticate;
use super::known_hosts::{HostKey, Known, all_algorithms, known_name};
use super::route::Route;
use super::worker::{Link, Worker};

/// After how long without an answer the kernel asks a silent peer, how often, and when it gives up.
const KEEPALIVE_IDLE: Duration = Duration::from_secs(10);
const KEEPALIVE_PAUSE: Duration = Duration::from_secs(5);
const KEEPALIVE_COUNT: u32 = 4;
const USER_TIMEOUT_MS: u32 = 30_000;

/// libssh2's codes for "no common algorithm": LIBSSH2_ERROR_KEX_FAILURE, LIBSSH2_ERROR_METHOD_NONE.
const NO_ALGORITHM: &[i32] = &[-5, -17];

/// A byte stream to the host's sshd.
#[derive(Debug)]
pub(super) struct Stream {
    socket: OwnedFd,
    pub(super) address: Option<IpAddr>,
}

/// Connects by TCP, to the first address that answers.
pub(super) async fn dial(route: &Route, bound: Duration) -> Result<Stream, SshError> {
    let unreachable = |cause: String| SshError::Unreachable {
        host: route.name(),
        cause,
    };
    let late = |_| SshError::Timeout {
        host: route.name(),
        doing: "connecting".to_owned(),
        seconds: bound.as_secs(),
    };
    let found = timeout(bound, lookup_host((route.host.as_str(), route.port)))
        .await
        .map_err(late)?;
    let addresses: Vec<SocketAddr> = found
        .map_err(|error| unreachable(error.to_string()))?
        .collect();
    let mut last = unreachable("its name has no address".to_owned());
    for address in addresses {
        let stream = match timeout(bound, TcpStream::connect(address))
            .await
            .map_err(late)
        {
            Ok(Ok(stream)) => stream,
            Ok(Err(error)) => {
                last = unreachable(format!("{address}: {error}"));
                continue;
            }
            Err(error) => {
                last = error;
                continue;
            }
        };
        let prepared = keep_alive(&stream).and_then(|()| stream.into_std());
        let stream = prepared.map_err(|error| unreachable(error.to_string()))?;
        return Ok(Stream {
            socket: stream.into(),
            address: Some(address.ip()),
        });
    }
    Err(last)
}

/// A dead peer is noticed by the kernel: libssh2's own probe lies on its stack, and sent in part it would block the session for ever.
fn keep_alive(stream: &TcpStream) -> std::io::Result<()> {
    use rustix::net::sockopt;
    stream.set_nodelay(true)?;
    sockopt::set_socket_keepalive(stream, true)?;
    sockopt::set_tcp_keepidle(stream, KEEPALIVE_IDLE)?;
    sockopt::set_tcp_keepintvl(stream, KEEPALIVE_PAUSE)?;
    sockopt::set_tcp_keepcnt(stream, KEEPALIVE_COUNT)?;
    sockopt::set_tcp_user_timeout(stream, USER_TIMEOUT_MS)?;
    Ok(())
}

/// A stream through another host: a task pumps between its channel and a pair of sockets, one of which the session owns.
pub(super) fn through(jump: Connection, channel: Channel) -> std::io::Result<Stream> {
    let (ours, theirs) = UnixStream::pair()?;
    theirs.set_nonblocking(true)?;
    let theirs = tokio::net::UnixStream::from_std(theirs)?;
    // The task ends with either side; the connection to the host on the way stays as long as it does.
    drop(tokio::spawn(async move {
        let (mut from_us, mut to_us) = tokio::io::split(theirs);
        let (mut from_host, mut to_host) = tokio::io::split(channel);
        tokio::select! {
            _ = tokio::io::copy(&mut from_us, &mut to_host) => {}
            _ = tokio::io::copy(&mut from_host, &mut to_us) => {}
        }
        drop(jump);
    }));
    Ok(Stream {
        socket: ours.into(),
        address: None,
    })
}

/// Why there is no session.
#[derive(Debug)]
pub(super) enum Failure {
    /// No host key of the types that were asked for.
    NoAlgorithm(String),
    Other(SshError),
}

impl Failure {
    pub(super) fn into_error(self, route: &Route) -> SshError {
        match self {
            Self::NoAlgorithm(cause) => SshError::Refused {
                host: route.name(),
                what: "our algorithms".to_owned(),
                cause: format!(
                    "{cause}; the host's sshd is too old or too strict for the built-in client: try `client: system`"
                ),
            },
            Self::Other(error) => error,
        }
    }
}

/// Agrees on keys with the host. `algorithms` restricts the host key's types. Blocks, each call up to `bound`.
fn handshake(
    stream: Stream,
    route: &Route,
    algorithms: Option<&str>,
    bound: Duration,
) -> Result<Session, Failure> {
    let closed = |error: ssh2::Error| {
        Failure::Other(SshError::Closed {
            host: route.name(),
            cause: error.message().to_owned(),
        })
    };
    let mut session = Session::new().map_err(closed)?;
    session.set_timeout(u32::try_from(bound.as_millis()).unwrap_or(u32::MAX));
    if let Some(algorithms) = algorithms {
        session
            .method_pref(MethodType::HostKey, algorithms)
            .map_err(|error| Failure::NoAlgorithm(error.message().to_owned()))?;
    }
    session.set_tcp_stream(stream.socket);
    match session.handshake() {
        Ok(()) => Ok(session),
        Err(error) => Err(match error.code() {
            ErrorCode::Session(code) if NO_ALGORITHM.contains(&code) => {
                Failure::NoAlgorithm(error.message().to_owned())
            }
            ErrorCode::Session(-9) => Failure::Other(late(route, "agreeing on keys", bound)),
            ErrorCode::Session(_) | ErrorCode::SFTP(_) => Failure::Other(SshError::Closed {
                host: route.name(),
                cause: format!(
                    "{} (does an sshd listen on port {}?)",
                    error.message(),
                    route.port
                ),
            }),
        }),
    }
}

fn late(route: &Route, doing: &str, bound: Duration) -> SshError {
    SshError::Timeout {
        host: route.name(),
        doing: doing.to_owned(),
        seconds: bound.as_secs(),
    }
}

fn shown_key(session: &Session, route: &Route) -> Result<HostKey, SshError> {
    let key = session
        .host_key()
        .and_then(|(blob, _)| HostKey::new(&known_name(&route.host, route.port), blob));
    key.ok_or_else(|| SshError::Closed {
        host: route.name(),
        cause: "it showed no key that can be read".to_owned(),
    })
}

/// The key that the host shows when asked for one of these types.
pub(super) async fn show(
    stream: Stream,
    route: &Route,
    algorithms: Option<String>,
    bound: Duration,
) -> Result<HostKey, Failure> {
    let owned = route.clone();
    let key = on_thread(route, bound, move |reply| {
        let shown = handshake(stream, &owned, algorithms.as_deref(), bound)
            .and_then(|session| shown_key(&session, &owned).map_err(Failure::Other));
        drop(reply.send(shown));
    });
    key.await
}

/// Makes the session and the thread that serves it.
pub(super) async fn establish(
    stream: Stream,
    route: &Route,
    known: Known,
    bound: Duration,
) -> Result<Arc<Link>, Failure> {
    let local = |error: std::io::Error| Failure::Other(local_error(&error));
    let link = Arc::new(Link::new(&route.name()).map_err(local)?);
    let watched = stream.socket.as_fd().try_clone_to_owned().map_err(local)?;
    let (owned, theirs) = (route.clone(), Arc::clone(&link));
    let made = on_thread(route, bound, move |reply| {
        let session = handshake(
            stream,
            &owned,
            Some(&known.algorithms().unwrap_or_else(all_algorithms)),
            bound,
        )
        .and_then(|session| {
            let trusted = shown_key(&session, &owned).and_then(|key| known.judge(&key));
            trusted
                .and_then(|()| authenticate(&session, &owned))
                .map_err(Failure::Other)?;
            Ok(session)
        });
        match session {
            Ok(session) => {
                // When nobody waits any more, nobody will ever ask this session.
                if reply.send(Ok(())).is_ok() {
                    Worker::new(session, watched, theirs).run();
                }
            }
            Err(failure) => drop(reply.send(Err(failure))),
        }
    });
    made.await?;
    Ok(link)
}

type Reply<T> = oneshot::Sender<Result<T, Failure>>;

/// Runs what blocks on a thread of its own, and waits for its reply at most a few bounds long.
async fn on_thread<T: Send + 'static>(
    route: &Route,
    bound: Duration,
    work: impl FnOnce(Reply<T>) + Send + 'static,
) -> Result<T, Failure> {
    let (reply, answer) = oneshot::channel();
    let name = format!("ssh {}", route.host.chars().take(11).collect::<String>());
    let started = thread::Builder::new().name(name).spawn(move || work(reply));
    started.map_err(|error| Failure::Other(local_error(&error)))?;
    // Handshake and keys: each call of libssh2 is bounded; together they get two bounds.
    let whole = bound * 2;
    match timeout(whole, answer).await {
        Ok(Ok(result)) => result,
        Ok(Err(_)) => Err(Failure::Other(SshError::Closed {
            host: route.name(),
            cause: "its thread ended early".to_owned(),
        })),
        Err(_) => Err(Failure::Other(late(
            route,
            "agreeing on keys and users",
            whole,
        ))),
    }
}

fn local_error(error: &std::io::Error) -> SshError {
    SshError::Local {
        what: "no resources for another session".to_owned(),
        cause: error.to_string(),
    }
}
