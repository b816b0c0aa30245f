//! A client of the daemon: what the command line uses.

use std::ffi::OsStr;
use std::fmt;
use std::fs::OpenOptions;
use std::io;
use std::marker::PhantomData;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::process::Stdio;
use std::sync::Arc;
use std::time::Duration;

use http_body_util::{BodyExt, Full, Limited};
use hyper::body::{Body, Bytes, Incoming};
use hyper::client::conn::http1;
use hyper::{Method, Response, StatusCode};
use hyper_util::rt::TokioIo;
use serde::de::DeserializeOwned;
use tokio::io::{AsyncBufReadExt, AsyncRead, AsyncWrite, BufReader};
use tokio::net::UnixStream;
use tokio::task::JoinHandle;
use tokio::time::timeout;

use crate::accounts;
use crate::api::secret::{SecretValues, StartCall};
use crate::api::{
    ApiError, ErrorCode, FederationMeasures, FederationView, Happening, Info, LogLine, Removed,
    StartRequest,
};
use crate::daemon::READY;
use crate::installation::{GROUP, PROGRAM};
use crate::paths::{Paths, PathsError};
use crate::process;

/// How long a daemon may take to serve after it was started.
const START_MAX: Duration = Duration::from_secs(15);
/// How long a daemon may take to say who it is: one that was just started looks at what it adopts first.
const PROBE_MAX: Duration = Duration::from_secs(6);
/// How long a daemon may take to begin an answer, a removal apart.
const ANSWER_MAX: Duration = Duration::from_secs(10);
/// How long a daemon that owns nothing may take to end.
const END_MAX: Duration = Duration::from_secs(5);
/// The largest answer that is not a stream.
const ANSWER_BYTES_MAX: usize = 64 << 20;
/// The longest line of a stream.
const LINE_BYTES_MAX: usize = 1 << 20;

/// A way to a daemon; each request has a connection of its own.
#[derive(Clone, Debug)]
pub struct Client {
    way: Way,
}

#[derive(Clone, Debug)]
enum Way {
    Socket(PathBuf),
    Dial(Arc<dyn Dial>),
}

/// Makes connections to the daemon of another host; its errors name the host.
pub trait Dial: fmt::Debug + Send + Sync {
    /// One connection, over which the daemon already answers.
    fn dial(&self) -> Dialled<'_>;
}

/// A connection that is on its way.
pub type Dialled<'a> = Pin<Box<dyn Future<Output = io::Result<Box<dyn Duplex>>> + Send + 'a>>;

/// Bytes in both directions.
pub trait Duplex: AsyncRead + AsyncWrite + Send + Unpin {}

impl<T: AsyncRead + AsyncWrite + Send + Unpin> Duplex for T {}

/// Why a request failed.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// There is no place for a daemon.
    #[error(transparent)]
    Paths(#[from] PathsError),
    /// The daemon could not be started.
    #[error("the daemon does not start: {why}")]
    NotStarted {
        /// The last lines of its log.
        why: String,
        /// Its log.
        log: PathBuf,
    },
    /// The host's daemon is not for this user. Become a member of its group.
    #[error(
        "user {user} may not use the ictusd of this host: have root run `usermod -aG {GROUP} {user}` there, and log in again"
    )]
    NotMember {
        /// Who asked.
        user: String,
    },
    /// The host's daemon does not run, and this user may not start it.
    #[error(
        "the ictusd of this host does not run, and only root may start it: `sudo systemctl start ictusd`, or where there is \
         no systemd `sudo {PROGRAM} dial-stdio </dev/null`"
    )]
    NotServing,
    /// The daemon is not there, or went away.
    #[error("no connection to the daemon at {socket}", socket = socket.display())]
    Unreachable {
        /// Its socket.
        socket: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// The daemon of another host cannot be reached (any more).
    #[error("{0}")]
    Far(io::Error),
    /// The daemon does not answer; it may be stopped or overloaded.
    #[error("the daemon{} does not answer{}", named(*.pid), way_out(*.pid))]
    Silent {
        /// Its process id, if the system tells.
        pid: Option<u32>,
    },
    /// The connection broke.
    #[error("the connection to the daemon broke")]
    Broken(#[source] hyper::Error),
    /// The daemon said no.
    #[error("{}", .0.message)]
    Refused(ApiError),
    /// The daemon said something that this version does not understand.
    #[error("the daemon's answer is not understood; is it of another version?")]
    NotUnderstood(#[source] serde_json::Error),
    /// What came could not be written down here.
    #[error("cannot write what was sent")]
    Unwritable(#[source] io::Error),
    /// The daemon's answer is larger than any it should give.
    #[error("the daemon's answer is too large")]
    TooLarge,
}

impl ClientError {
    /// Why the daemon said no; absent when it did not.
    #[must_use]
    pub fn refusal(&self) -> Option<&ApiError> {
        match self {
            Self::Refused(error) => Some(error),
            Self::Paths(_)
            | Self::NotStarted { .. }
            | Self::NotMember { .. }
            | Self::NotServing
            | Self::Unreachable { .. }
            | Self::Far(_)
            | Self::Silent { .. }
            | Self::Broken(_)
            | Self::NotUnderstood(_)
            | Self::Unwritable(_)
            | Self::TooLarge => None,
        }
    }
}

impl Client {
    /// Finds the daemon that serves; absent when there is none.
    pub async fn find(paths: &Paths) -> Option<Self> {
        Self::probe(paths).await.unwrap_or_default()
    }

    /// The same, but one that is there and does not answer is an error.
    async fn probe(paths: &Paths) -> Result<Option<Self>, ClientError> {
        // A session with another XDG_RUNTIME_DIR may have started it: the lock tells where it listens.
        let in_lock = paths.socket_in_lock();
        let own = Some(paths.socket()).filter(|own| in_lock.as_ref() != Some(own));
        for socket in in_lock.into_iter().chain(own) {
            let client = Self {
                way: Way::Socket(socket.clone()),
            };
            match timeout(PROBE_MAX, client.info()).await {
                Ok(Ok(_)) => return Ok(Some(client)),
                Ok(Err(silent @ ClientError::Silent { .. })) => return Err(silent),
                Ok(Err(_)) => {}
                Err(_) => {
                    let stream = UnixStream::connect(&socket).await.ok();
                    let pid = stream.as_ref().and_then(listener);
                    return Err(ClientError::Silent { pid });
                }
            }
        }
        Ok(None)
    }

    /// The daemon of another host.
    #[must_use]
    pub fn over(dial: Arc<dyn Dial>) -> Self {
        Self {
            way: Way::Dial(dial),
        }
    }

    /// Finds the daemon, or starts `EXECUTABLE daemon` and waits until it serves.
    ///
    /// # Errors
    /// When it does not serve in time, with its own words, or is there and does not answer.
    pub async fn find_or_start(paths: &Paths, executable: &Path) -> Result<Self, ClientError> {
        if let Some(client) = Self::probe(paths).await? {
            return Ok(client);
        }
        let user = rustix::process::geteuid();
        if paths.of_host() && !user.is_root() {
            let refused = UnixStream::connect(paths.socket()).await.err();
            return Err(match refused.map(|error| error.kind()) {
                Some(io::ErrorKind::PermissionDenied) => ClientError::NotMember {
                    user: accounts::name(user.as_raw()),
                },
                Some(_) | None => ClientError::NotServing,
            });
        }
        paths.create()?;
        let log = paths.daemon_log();
        let failed = |why: String| ClientError::NotStarted {
            why,
            log: paths.daemon_log(),
        };
        let mut options = OpenOptions::new();
        let file = options.append(true).create(true).mode(0o600).open(&log);
        let file = file.map_err(|error| failed(error.to_string()))?;
        let length_before = file.metadata().map_or(0, |found| found.len());
        let mut command = tokio::process::Command::new(executable);
        command
            .arg("daemon")
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(file);
        let mut child = command.spawn().map_err(|error| failed(error.to_string()))?;
        let out = child
            .stdout
            .take()
            .ok_or_else(|| failed("no standard output".to_owned()))?;
        let mut line = String::new();
        let mut out = BufReader::new(out);
        let read = timeout(START_MAX, out.read_line(&mut line)).await;
        if !matches!(read, Ok(Ok(_))) || line.trim_end() != READY {
            let log = std::fs::read(&log).unwrap_or_default();
            let new = log
                .get(usize::try_from(length_before).unwrap_or(0)..)
                .unwrap_or_default();
            return Err(failed(String::from_utf8_lossy(new).trim().to_owned()));
        }
        let found = Self::probe(paths).await?;
        found.ok_or_else(|| failed("it serves, but does not answer".to_owned()))
    }

    /// Asks who answers.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn info(&self) -> Result<Info, ClientError> {
        self.answer(Method::GET, "/v1/info", Bytes::new()).await
    }

    /// Every federation that lives or has ended and was not taken down.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn federations(&self) -> Result<Vec<FederationView>, ClientError> {
        self.answer(Method::GET, "/v1/federations", Bytes::new())
            .await
    }

    /// One federation.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn federation(&self, name: &str) -> Result<FederationView, ClientError> {
        self.answer(Method::GET, &path(name, "", &[]), Bytes::new())
            .await
    }

    /// Starts a federation. Dropping the stream before `healthy` undoes it.
    ///
    /// # Errors
    /// See [`ClientError`]; a federation of that name that runs is [`ErrorCode::AlreadyRunning`] or
    /// [`ErrorCode::Conflict`].
    pub async fn start(
        &self,
        name: &str,
        request: &StartRequest,
    ) -> Result<Stream<Happening>, ClientError> {
        let call = StartCall {
            request: request.clone(),
            secrets: SecretValues::default(),
        };
        self.start_with(name, &call).await
    }

    /// The same with the values of its secrets.
    ///
    /// # Errors
    /// As for [`Client::start`]; a value that is missing, or another one than that of the run that is there.
    pub async fn start_with(
        &self,
        name: &str,
        call: &StartCall,
    ) -> Result<Stream<Happening>, ClientError> {
        let body = serde_json::to_vec(call).map_err(ClientError::NotUnderstood)?;
        self.stream(Method::POST, &path(name, "", &[]), body.into())
            .await
    }

    /// Stops a federation in order, or kills it; the stream ends with its end.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn stop(&self, name: &str, kill: bool) -> Result<Stream<Happening>, ClientError> {
        let kill = kill.to_string();
        let path = path(name, "/stop", &[("kill", &kill)]);
        self.stream(Method::POST, &path, Bytes::new()).await
    }

    /// Stops a federation if it runs and removes what it left.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn remove(&self, name: &str, purge: bool) -> Result<Removed, ClientError> {
        let purge = purge.to_string();
        self.answer(
            Method::DELETE,
            &path(name, "", &[("purge", &purge)]),
            Bytes::new(),
        )
        .await
    }

    /// The logs of some federates, or of everybody when none is given.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn logs(
        &self,
        name: &str,
        members: &[String],
        follow: bool,
        tail: Option<usize>,
    ) -> Result<Stream<LogLine>, ClientError> {
        let (members, follow) = (members.join(","), follow.to_string());
        let mut query = vec![("federate", members.as_str()), ("follow", &follow)];
        let tail = tail.map(|tail| tail.to_string());
        query.extend(tail.as_deref().map(|tail| ("tail", tail)));
        self.stream(Method::GET, &path(name, "/logs", &query), Bytes::new())
            .await
    }

    /// Events kept, and with `follow` those that come.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn events(
        &self,
        name: Option<&str>,
        follow: bool,
    ) -> Result<Stream<Happening>, ClientError> {
        let follow = follow.to_string();
        let mut query = vec![("follow", follow.as_str())];
        query.extend(name.map(|name| ("federation", name)));
        let path = format!("/v1/events?{}", encode(&query));
        self.stream(Method::GET, &path, Bytes::new()).await
    }

    /// What was measured in a federation that lives, or has ended and was not taken down.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn measures(&self, name: &str) -> Result<FederationMeasures, ClientError> {
        let path = path(name, "/measures", &[]);
        self.answer(Method::GET, &path, Bytes::new()).await
    }

    /// All federations' metrics, as Prometheus reads them.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn metrics(&self) -> Result<String, ClientError> {
        let (response, _connection) = self.send(Method::GET, "/metrics", Bytes::new()).await?;
        let bytes = whole(response).await?;
        Ok(String::from_utf8_lossy(&bytes).into_owned())
    }

    /// Ends the daemon if it owns nothing, and waits until it has ended; tells whether it owned nothing.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn end(&self) -> Result<bool, ClientError> {
        let pid = self.info().await?.pid;
        // Of another host's daemon only the answer can be waited for.
        let local = matches!(self.way, Way::Socket(_));
        let pidfd = local.then(|| process::open(pid)).flatten();
        let idle = self.answer(Method::POST, "/v1/end", Bytes::new()).await?;
        if let (true, Some(pidfd)) = (idle, pidfd) {
            process::wait_for_end(pidfd, END_MAX).await;
        }
        Ok(idle)
    }

    /// Has the daemon end, whatever it owns: another one takes over.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn give_way(&self) -> Result<(), ClientError> {
        let pid = self.info().await?.pid;
        let local = matches!(self.way, Way::Socket(_));
        let pidfd = local.then(|| process::open(pid)).flatten();
        let _: bool = self
            .answer(Method::POST, "/v1/give-way", Bytes::new())
            .await?;
        if let Some(pidfd) = pidfd {
            process::wait_for_end(pidfd, END_MAX).await;
        }
        Ok(())
    }

    async fn answer<T: DeserializeOwned>(
        &self,
        method: Method,
        path: &str,
        body: Bytes,
    ) -> Result<T, ClientError> {
        let (response, _connection) = self.send(method, path, body).await?;
        let bytes = whole(response).await?;
        serde_json::from_slice(&bytes).map_err(ClientError::NotUnderstood)
    }

    async fn stream<T: DeserializeOwned>(
        &self,
        method: Method,
        path: &str,
        body: Bytes,
    ) -> Result<Stream<T>, ClientError> {
        let (response, connection) = self.send(method, path, body).await?;
        let (body, buffer) = (response.into_body(), Vec::new());
        Ok(Stream {
            body,
            buffer,
            _connection: connection,
            item: PhantomData,
        })
    }

    async fn send(
        &self,
        method: Method,
        path: &str,
        body: Bytes,
    ) -> Result<(Response<Incoming>, Connection), ClientError> {
        let limit = if method == Method::DELETE {
            // As long as the federation takes to stop, which has bounds of its own.
            None
        } else {
            Some(ANSWER_MAX)
        };
        self.exchange((method, path), Full::new(body), limit).await
    }

    /// Sends a request with any body; the answer begins within the limit.
    async fn exchange<B>(
        &self,
        (method, path): (Method, &str),
        body: B,
        limit: Option<Duration>,
    ) -> Result<(Response<Incoming>, Connection), ClientError>
    where
        B: Body + Send + 'static,
        B::Data: Send,
        B::Error: Into<Box<dyn std::error::Error + Send + Sync>>,
    {
        let (stream, pid) = self.connect().await?;
        let io = TokioIo::new(stream);
        let (mut sender, connection) = http1::handshake(io).await.map_err(ClientError::Broken)?;
        let connection = Connection(tokio::spawn(async move {
            // What breaks is seen where the answer is read.
            connection.await.ok();
        }));
        let request = hyper::Request::builder()
            .method(method)
            .uri(path)
            .header("host", "ictusd")
            .body(body)
            .map_err(|error| self.unreachable(io::Error::other(error)))?;
        let answer = sender.send_request(request);
        let response = match limit {
            Some(limit) => timeout(limit, answer)
                .await
                .map_err(|_| ClientError::Silent { pid })?,
            None => answer.await,
        };
        let response = response.map_err(ClientError::Broken)?;
        if response.status() == StatusCode::OK {
            return Ok((response, connection));
        }
        let bytes = whole(response).await?;
        let error: ApiError = serde_json::from_slice(&bytes).map_err(ClientError::NotUnderstood)?;
        Err(ClientError::Refused(error))
    }

    /// A connection, and who listens there if that is on this host.
    async fn connect(&self) -> Result<(Box<dyn Duplex>, Option<u32>), ClientError> {
        match &self.way {
            Way::Socket(socket) => {
                let stream = UnixStream::connect(socket).await;
                let stream = stream.map_err(|error| self.unreachable(error))?;
                let pid = listener(&stream);
                Ok((Box::new(stream), pid))
            }
            Way::Dial(dial) => {
                let stream = dial.dial().await;
                Ok((stream.map_err(|error| self.unreachable(error))?, None))
            }
        }
    }

    fn unreachable(&self, source: io::Error) -> ClientError {
        match &self.way {
            Way::Socket(socket) => ClientError::Unreachable {
                socket: socket.clone(),
                source,
            },
            Way::Dial(_) => ClientError::Far(source),
        }
    }
}

/// Whether a refusal says that the federation runs from the very same plan.
#[must_use]
pub fn is_already_running(error: &ClientError) -> bool {
    error
        .refusal()
        .is_some_and(|refusal| refusal.code == ErrorCode::AlreadyRunning)
}

mod parts;
mod reach;
mod recorded;

/// A stream of JSON values; dropping it closes the connection.
#[derive(Debug)]
pub struct Stream<T> {
    body: Incoming,
    buffer: Vec<u8>,
    _connection: Connection,
    item: PhantomData<T>,
}

/// The task that drives a connection: it ends with what uses it.
#[derive(Debug)]
struct Connection(JoinHandle<()>);

impl Drop for Connection {
    fn drop(&mut self) {
        self.0.abort();
    }
}

impl<T: DeserializeOwned> Stream<T> {
    /// The next value; absent at the end.
    ///
    /// # Errors
    /// When the connection breaks or the daemon says something strange.
    pub async fn next(&mut self) -> Result<Option<T>, ClientError> {
        loop {
            if let Some(end) = self.buffer.iter().position(|byte| *byte == b'\n') {
                let line: Vec<u8> = self.buffer.drain(..=end).collect();
                let value = serde_json::from_slice(&line).map_err(ClientError::NotUnderstood)?;
                return Ok(Some(value));
            }
            if self.buffer.len() > LINE_BYTES_MAX {
                return Err(ClientError::TooLarge);
            }
            let Some(frame) = self.body.frame().await else {
                return Ok(None);
            };
            let frame = frame.map_err(ClientError::Broken)?;
            if let Ok(data) = frame.into_data() {
                self.buffer.extend_from_slice(&data);
            }
        }
    }
}

async fn whole(response: Response<Incoming>) -> Result<Bytes, ClientError> {
    let body = Limited::new(response.into_body(), ANSWER_BYTES_MAX);
    match body.collect().await {
        Ok(collected) => Ok(collected.to_bytes()),
        Err(error) => match error.downcast::<hyper::Error>() {
            Ok(error) => Err(ClientError::Broken(*error)),
            Err(_) => Err(ClientError::TooLarge),
        },
    }
}

fn listener(stream: &UnixStream) -> Option<u32> {
    u32::try_from(stream.peer_cred().ok()?.pid()?).ok()
}

fn named(pid: Option<u32>) -> String {
    pid.map_or_else(String::new, |pid| format!(" (pid {pid})"))
}

fn way_out(pid: Option<u32>) -> String {
    pid.map_or_else(String::new, |pid| {
        format!(
            "; if it is stopped, `kill -CONT {pid}` lets it go on; `kill -KILL {pid}` ends it, \
             federations go on, and the next command starts another daemon"
        )
    })
}

fn path(name: &str, call: &str, query: &[(&str, &str)]) -> String {
    let name = escape(name);
    format!("/v1/federations/{name}{call}?{}", encode(query))
}

fn encode(query: &[(&str, &str)]) -> String {
    let pairs = query
        .iter()
        .map(|(key, value)| format!("{key}={}", escape(value)));
    pairs.collect::<Vec<_>>().join("&")
}

/// Percent-encodes what is not plainly allowed in a path or query.
fn escape(text: &str) -> String {
    let mut escaped = String::new();
    for byte in OsStr::new(text).as_encoded_bytes() {
        if byte.is_ascii_alphanumeric() || b"-_.,".contains(byte) {
            escaped.push(char::from(*byte));
        } else {
            escaped.push_str(&format!("%{byte:02X}"));
        }
    }
    escaped
}

#[cfg(test)]
mod tests {
    use super::escape;

    #[test]
    fn strange_names_stay_one_path_segment() {
        assert_eq!(escape("a/../b c"), "a%2F..%2Fb%20c");
    }
}
