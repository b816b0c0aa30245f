//! The API's routes; see [`crate::api`].

use std::convert::Infallible;
use std::io;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

use axum::Router;
use axum::body::{Body, Bytes};
use axum::extract::connect_info::{Connected, IntoMakeServiceWithConnectInfo};
use axum::extract::{DefaultBodyLimit, Path, Query, Request, State};
use axum::http::StatusCode;
use axum::http::header::CONTENT_TYPE;
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{IntoResponse, Json, Response};
use axum::routing::{get, post};
use axum::serve::IncomingStream;
use hyper::body::Frame;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use tokio::net::{UnixListener, UnixStream};
use tokio::sync::{broadcast, mpsc, watch};

use crate::accounts;
use crate::api::secret::StartCall;
use crate::api::{
    ApiError, ErrorCode, Event, FederationMeasures, FederationView, Happening, Info, LogLine,
    Removed, VERSION,
};
use crate::federation::Command;
use crate::host::Host;
use crate::logs::Follower;
use crate::paths::Paths;
use crate::store::Leave;

mod parts;
mod reach;
mod recorded;
pub(crate) mod viewer;

/// Lines of a stream that wait for a slow client.
const LINES_MAX: usize = 1024;
/// The largest request: a plan of thousands of federates.
const REQUEST_BYTES_MAX: usize = 64 << 20;
/// How often growing log files are looked at.
const FOLLOW_PERIOD: Duration = Duration::from_millis(100);
/// How long to wait before another connection is tried when the system is out of descriptors.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// The host's events.
type Told = broadcast::Receiver<Happening>;

/// The routes over a host.
pub(crate) fn router(host: Host) -> Router {
    let federation = get(federation)
        .post(start)
        .put(parts::prepare)
        .delete(remove);
    Router::new()
        .route("/v1/info", get(info))
        .route("/v1/federations", get(federations))
        .route("/v1/federations/{name}", federation)
        .route("/v1/federations/{name}/stop", post(stop))
        .route("/v1/federations/{name}/logs", get(logs))
        .route("/v1/federations/{name}/measures", get(measures))
        .route("/v1/events", get(events))
        .route("/v1/end", post(end))
        .route("/v1/give-way", post(give_way))
        .route("/metrics", get(metrics))
        .merge(parts::router())
        .merge(reach::router())
        .merge(parts::readable())
        .merge(recorded::readable())
        .merge(recorded::private())
        .fallback(async || bad_request("no such call; is the daemon of another version?"))
        .layer(from_fn_with_state(host.clone(), touch))
        .layer(DefaultBodyLimit::max(REQUEST_BYTES_MAX))
        .with_state(host)
}

/// Accepts connections of this user only; of the host's daemon, of whoever may open the socket.
#[derive(Debug)]
pub(crate) struct OwnListener {
    listener: UnixListener,
    of_host: bool,
}

impl OwnListener {
    pub(crate) fn new(listener: UnixListener, paths: &Paths) -> Self {
        let of_host = paths.of_host();
        Self { listener, of_host }
    }
}

impl axum::serve::Listener for OwnListener {
    type Io = UnixStream;
    type Addr = Caller;

    async fn accept(&mut self) -> (Self::Io, Self::Addr) {
        loop {
            match self.listener.accept().await {
                Ok((stream, _)) => match stream.peer_cred().map(|peer| Caller(peer.uid())) {
                    Ok(caller) if self.of_host || caller.is_us() => return (stream, caller),
                    Ok(Caller(uid)) => tracing::warn!(uid, "another user was refused"),
                    Err(error) => tracing::warn!(%error, "a nameless peer was refused"),
                },
                Err(error) => {
                    tracing::warn!(%error, "cannot accept");
                    tokio::time::sleep(ACCEPT_PAUSE).await;
                }
            }
        }
    }

    fn local_addr(&self) -> io::Result<Self::Addr> {
        Ok(Caller(rustix::process::geteuid().as_raw()))
    }
}

/// The user at the other end, as the kernel tells.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Caller(u32);

impl Caller {
    fn is_us(self) -> bool {
        self.0 == rustix::process::geteuid().as_raw()
    }

    /// Who somebody is: what another user than the daemon's says of itself comes after what is known.
    fn named(self, says: String) -> String {
        if self.is_us() {
            return says;
        }
        format!("{} ({says})", accounts::name(self.0))
    }
}

impl Connected<IncomingStream<'_, OwnListener>> for Caller {
    fn connect_info(stream: IncomingStream<'_, OwnListener>) -> Self {
        *stream.remote_addr()
    }
}

/// Routes that know who calls.
pub(crate) fn callers(router: Router) -> IntoMakeServiceWithConnectInfo<Router, Caller> {
    router.into_make_service_with_connect_info()
}

async fn touch(State(host): State<Host>, request: Request, next: Next) -> Response {
    host.touch();
    next.run(request).await
}

async fn info(State(host): State<Host>) -> Json<Info> {
    Json(Info {
        api: VERSION.to_owned(),
        version: env!("CARGO_PKG_VERSION").to_owned(),
        pid: std::process::id(),
        state_dir: host.paths().state.clone(),
    })
}

async fn federations(State(host): State<Host>) -> Json<Vec<FederationView>> {
    Json(host.views())
}

async fn federation(
    State(host): State<Host>,
    Path(name): Path<String>,
) -> Result<Json<FederationView>, ApiError> {
    host.view(&name).map(Json)
}

async fn measures(
    State(host): State<Host>,
    Path(name): Path<String>,
) -> Result<Json<FederationMeasures>, ApiError> {
    host.measures(&name).await.map(Json)
}

async fn metrics(State(host): State<Host>) -> Response {
    let page = host.metrics().await;
    ([(CONTENT_TYPE, ictus_metrics::CONTENT_TYPE)], page).into_response()
}

async fn start(
    State(host): State<Host>,
    Path(name): Path<String>,
    body: Bytes,
) -> Result<Response, ApiError> {
    let call: StartCall = parse(&body)?;
    let told = host.subscribe();
    let handle = host.start(&name, call)?;
    let (lines, body) = JsonLines::new(Some(StarterGuard(handle.commands)));
    tokio::spawn(pass_until_end(told, name, lines));
    Ok(stream(body))
}

#[derive(Deserialize)]
struct StopQuery {
    #[serde(default)]
    kill: bool,
    fence: Option<u64>,
}

async fn stop(
    State(host): State<Host>,
    Path(name): Path<String>,
    Query(query): Query<StopQuery>,
) -> Result<Response, ApiError> {
    host.check_fence(&name, query.fence)?;
    let told = host.subscribe();
    let (lines, body) = JsonLines::new(None);
    let handle = host.handle(&name);
    let view = match &handle {
        Some(handle) => handle.view.borrow().clone(),
        None => host.view(&name)?,
    };
    if let Some(outcome) = view.outcome {
        // It has ended already (what it made may still be removed): its end is all there is to tell.
        let event = Event::Ended { outcome };
        let at_ns = view.since_ns;
        let federation = name;
        lines
            .send(&Happening {
                at_ns,
                federation,
                event,
            })
            .await;
        if let Some(mut handle) = handle {
            // The stream ends when nothing is left to be removed.
            tokio::spawn(async move {
                while handle.view.changed().await.is_ok() {}
                drop(lines);
            });
        }
        return Ok(stream(body));
    }
    let Some(handle) = handle else {
        return Ok(stream(body));
    };
    let command = if query.kill {
        Command::Kill
    } else {
        Command::Stop
    };
    handle.commands.send(command).await.ok();
    tokio::spawn(pass_until_gone(told, name, lines, handle.view));
    Ok(stream(body))
}

#[derive(Deserialize)]
struct RemoveQuery {
    #[serde(default)]
    purge: bool,
    /// With `purge`: the generations before stay.
    #[serde(default)]
    keep_history: bool,
    fence: Option<u64>,
}

async fn remove(
    State(host): State<Host>,
    Path(name): Path<String>,
    Query(query): Query<RemoveQuery>,
) -> Result<Json<Removed>, ApiError> {
    // In a task: a client that goes away does not leave half a removal.
    let leave = match (query.purge, query.keep_history) {
        (false, _) => Leave::Logs,
        (true, true) => Leave::History,
        (true, false) => Leave::Nothing,
    };
    let removal = tokio::spawn(async move { host.remove(&name, (leave, query.fence)).await });
    removal
        .await
        .unwrap_or_else(|error| {
            let (code, message) = (ErrorCode::Failed, error.to_string());
            Err(ApiError {
                code,
                message,
                known: Vec::new(),
            })
        })
        .map(Json)
}

#[derive(Deserialize)]
struct LogsQuery {
    #[serde(default)]
    follow: bool,
    /// Names joined by commas; empty: everybody.
    #[serde(default)]
    federate: String,
    /// Only the last so many lines of what is there.
    tail: Option<usize>,
}

async fn logs(
    State(host): State<Host>,
    Path(name): Path<String>,
    Query(query): Query<LogsQuery>,
) -> Result<Response, ApiError> {
    let logs = host.known_directory(&name)?.logs();
    let members: Vec<_> = query
        .federate
        .split(',')
        .filter(|it| !it.is_empty())
        .map(str::to_owned)
        .collect();
    let known = crate::logs::members(&logs);
    if let Some(unknown) = members.iter().find(|member| !known.contains(member)) {
        let message = format!("federation `{name}` has no log of `{unknown}`");
        return Err(ApiError {
            code: ErrorCode::Unknown,
            message,
            known,
        });
    }
    let (lines, body) = JsonLines::new(None);
    tokio::spawn(follow_logs(
        host,
        name,
        Follower::new(&logs, members),
        query,
        lines,
    ));
    Ok(stream(body))
}

async fn follow_logs(
    host: Host,
    name: String,
    mut follower: Follower,
    query: LogsQuery,
    lines: Sender,
) {
    let mut tail = query.tail;
    loop {
        // Asked before reading, so that what is written until the end is read.
        let living = host.handle(&name).is_some();
        let sender = lines.clone();
        let keep = tail.take();
        let read = tokio::task::spawn_blocking(move || {
            read_logs(&mut follower, keep, &sender);
            follower
        });
        let Ok(back) = read.await else { return };
        follower = back;
        if !query.follow || !living {
            return;
        }
        tokio::select! {
            () = lines.0.closed() => return,
            () = tokio::time::sleep(FOLLOW_PERIOD) => {}
        }
    }
}

fn read_logs(follower: &mut Follower, tail: Option<usize>, lines: &Sender) {
    let Some(tail) = tail else {
        follower.read(|line| lines.blocking_send(&line));
        return;
    };
    let mut last: std::collections::VecDeque<LogLine> = std::collections::VecDeque::new();
    follower.read(|line| {
        last.push_back(line);
        if last.len() > tail {
            last.pop_front();
        }
    });
    for line in last {
        lines.blocking_send(&line);
    }
}

#[derive(Deserialize)]
struct EventsQuery {
    #[serde(default)]
    follow: bool,
    federation: Option<String>,
}

async fn events(
    State(host): State<Host>,
    Query(query): Query<EventsQuery>,
) -> Result<Response, ApiError> {
    tell_events(&host, query, std::convert::identity)
}

/// Tells events, each as whoever asks may see it.
fn tell_events(
    host: &Host,
    query: EventsQuery,
    seen: fn(Happening) -> Happening,
) -> Result<Response, ApiError> {
    let told = host.subscribe();
    let mut kept = Vec::new();
    let names = match &query.federation {
        Some(name) => vec![name.clone()],
        None => host.names(),
    };
    for name in names {
        kept.extend(host.known_directory(&name)?.events_kept());
    }
    kept.sort_by_key(|happening| happening.at_ns);
    let (lines, body) = JsonLines::new(None);
    tokio::spawn(async move {
        for happening in kept {
            lines.send(&seen(happening)).await;
        }
        if query.follow {
            pass(told, (query.federation, seen), lines).await;
        }
    });
    Ok(stream(body))
}

async fn end(State(host): State<Host>) -> Json<bool> {
    Json(host.end_if_idle())
}

async fn give_way(State(host): State<Host>) -> Json<bool> {
    host.end();
    Json(true)
}

/// Passes a federation's events on until its end, or until nobody listens.
async fn pass_until_end(mut told: Told, name: String, lines: Sender) {
    pass_to_end(&mut told, &name, &lines).await;
}

/// The same, and until what it leaves is removed. One that has ended before anybody listened tells its end then.
async fn pass_until_gone(
    mut told: Told,
    name: String,
    lines: Sender,
    mut view: watch::Receiver<FederationView>,
) {
    let mut late = view.clone();
    tokio::select! {
        () = pass_to_end(&mut told, &name, &lines) => {}
        () = gone(&mut late) => {
            let (outcome, at_ns) = {
                let view = late.borrow();
                (view.outcome.clone(), view.since_ns)
            };
            if let Some(outcome) = outcome {
                let event = Event::Ended { outcome };
                let federation = name;
                lines.send(&Happening { at_ns, federation, event }).await;
            }
        }
    }
    gone(&mut view).await;
}

/// Waits until nobody drives a federation any more.
async fn gone(view: &mut watch::Receiver<FederationView>) {
    while view.changed().await.is_ok() {}
}

async fn pass_to_end(told: &mut Told, name: &str, lines: &Sender) {
    while let Some(happening) = next(told, lines).await {
        if happening.federation == name {
            lines.send(&happening).await;
            if matches!(happening.event, Event::Ended { .. }) {
                return;
            }
        }
    }
}

/// Passes events on, of one federation or of all, until nobody listens.
async fn pass(
    mut told: Told,
    (federation, seen): (Option<String>, fn(Happening) -> Happening),
    lines: Sender,
) {
    while let Some(happening) = next(&mut told, &lines).await {
        if federation
            .as_ref()
            .is_none_or(|name| *name == happening.federation)
        {
            lines.send(&seen(happening)).await;
        }
    }
}

/// The next event; absent when nobody listens any more, or the listener was so slow that events were lost.
async fn next(told: &mut Told, lines: &Sender) -> Option<Happening> {
    tokio::select! {
        () = lines.0.closed() => None,
        happening = told.recv() => happening.ok(),
    }
}

fn stream(body: JsonLines) -> Response {
    ([(CONTENT_TYPE, "application/x-ndjson")], Body::new(body)).into_response()
}

/// A response body that grows a line at a time.
struct JsonLines {
    lines: mpsc::Receiver<Bytes>,
    /// Dropped with the body, that is when the client goes away.
    _guard: Option<StarterGuard>,
}

/// The writing end of [`JsonLines`].
#[derive(Clone)]
struct Sender(mpsc::Sender<Bytes>);

/// Tells the federation that who started it is gone.
struct StarterGuard(mpsc::Sender<Command>);

impl Drop for StarterGuard {
    fn drop(&mut self) {
        self.0.try_send(Command::StarterGone).ok();
    }
}

impl JsonLines {
    fn new(guard: Option<StarterGuard>) -> (Sender, Self) {
        let (sender, lines) = mpsc::channel(LINES_MAX);
        (
            Sender(sender),
            Self {
                lines,
                _guard: guard,
            },
        )
    }
}

impl Sender {
    /// Waits for room; a client that is gone takes everything.
    async fn send(&self, value: &impl Serialize) {
        if let Some(line) = line(value) {
            self.0.send(line).await.ok();
        }
    }

    fn blocking_send(&self, value: &impl Serialize) {
        if let Some(line) = line(value) {
            self.0.blocking_send(line).ok();
        }
    }
}

fn line(value: &impl Serialize) -> Option<Bytes> {
    let mut line = serde_json::to_vec(value).ok()?;
    line.push(b'\n');
    Some(Bytes::from(line))
}

impl hyper::body::Body for JsonLines {
    type Data = Bytes;
    type Error = Infallible;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Infallible>>> {
        self.lines
            .poll_recv(context)
            .map(|line| line.map(|line| Ok(Frame::data(line))))
    }
}

fn parse<T: DeserializeOwned>(body: &Bytes) -> Result<T, ApiError> {
    serde_json::from_slice(body).map_err(|error| bad_request(&error.to_string()))
}

fn bad_request(message: &str) -> ApiError {
    ApiError {
        code: ErrorCode::BadRequest,
        message: message.to_owned(),
        known: Vec::new(),
    }
}

impl IntoResponse for ApiError {
    fn into_response(self) -> Response {
        let status = match self.code {
            ErrorCode::BadRequest => StatusCode::BAD_REQUEST,
            ErrorCode::Unknown => StatusCode::NOT_FOUND,
            ErrorCode::Forbidden => StatusCode::FORBIDDEN,
            ErrorCode::AlreadyRunning | ErrorCode::Conflict | ErrorCode::Held => {
                StatusCode::CONFLICT
            }
            ErrorCode::Failed => StatusCode::INTERNAL_SERVER_ERROR,
        };
        (status, Json(self)).into_response()
    }
}

#[cfg(test)]
mod tests {
    use super::Caller;

    /// What the kernel tells comes before what somebody says of itself.
    #[test]
    fn another_user_is_named_by_the_system() {
        let own = rustix::process::geteuid().as_raw();
        let says = || "ann@laptop".to_owned();
        assert_eq!(Caller(own).named(says()), "ann@laptop");
        let stranger = own.wrapping_add(987_654);
        let named = Caller(stranger).named(says());
        assert_eq!(named, format!("{stranger} (ann@laptop)"));
    }
}
