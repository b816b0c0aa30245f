//! The read-only TCP listeners for Prometheus: one for each `metrics.listen` of the federations that are there.

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};
use std::convert::Infallible;
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use http_body_util::Full;
use hyper::body::{Bytes, Incoming};
use hyper::header::{ALLOW, CONTENT_TYPE, HeaderValue};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper::{Method, Request, Response, StatusCode};
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio::task::AbortHandle;
use tokio::time::{sleep, timeout};

use crate::collector::Collector;
use crate::host::Host;

/// Connections at a time on one address; further ones wait.
const CONNECTIONS_MAX: usize = 16;
/// How long a connection may take to say what it wants.
const REQUEST_MAX: Duration = Duration::from_secs(2);
/// How long one connection may last: its one request, and a slow reader of the answer.
const CONNECTION_MAX: Duration = Duration::from_secs(10);
/// How long to wait before another connection is tried when the system is out of descriptors.
pub(crate) const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// The addresses that are listened on, and for whom.
#[derive(Debug, Default)]
pub(crate) struct Listeners(BTreeMap<SocketAddr, Listener>);

#[derive(Debug)]
struct Listener {
    /// Where it really is: another port when any was asked for.
    address: SocketAddr,
    federations: BTreeSet<String>,
    task: AbortHandle,
}

impl Drop for Listener {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl Listeners {
    /// Listens on the address that a federation wants, instead of what it wanted before; gives where that is.
    ///
    /// # Errors
    /// When the system does not let us; what was before is kept.
    pub(crate) fn claim(
        &mut self,
        host: &Host,
        federation: &str,
        wanted: SocketAddr,
    ) -> io::Result<SocketAddr> {
        if let Entry::Vacant(place) = self.0.entry(wanted) {
            let listener = std::net::TcpListener::bind(wanted)?;
            listener.set_nonblocking(true)?;
            let listener = TcpListener::from_std(listener)?;
            let address = listener.local_addr()?;
            let pages = Pages::Host(host.clone());
            let task = tokio::spawn(serve(listener, pages)).abort_handle();
            let federations = BTreeSet::new();
            let listener = Listener {
                address,
                federations,
                task,
            };
            place.insert(listener);
        }
        for (address, listener) in &mut self.0 {
            if *address == wanted {
                listener.federations.insert(federation.to_owned());
            } else {
                listener.federations.remove(federation);
            }
        }
        self.close_unwanted();
        let listener = self.0.get(&wanted);
        Ok(listener.map_or(wanted, |listener| listener.address))
    }

    /// Closes what only this federation wanted.
    pub(crate) fn release(&mut self, federation: &str) {
        for listener in self.0.values_mut() {
            listener.federations.remove(federation);
        }
        self.close_unwanted();
    }

    fn close_unwanted(&mut self) {
        self.0.retain(|_, it| !it.federations.is_empty());
    }
}

/// Whose page is shown.
#[derive(Clone, Debug)]
pub(crate) enum Pages {
    /// That of all federations of this host.
    Host(Host),
    /// That of one, which no daemon knows.
    Collector(Collector),
}

impl Pages {
    async fn metrics(&self) -> String {
        match self {
            Self::Host(host) => host.metrics().await,
            Self::Collector(collector) => collector.page(),
        }
    }
}

/// Answers whoever connects.
pub(crate) async fn serve(listener: TcpListener, pages: Pages) {
    let slots = Arc::new(Semaphore::new(CONNECTIONS_MAX));
    loop {
        // Never closed.
        let Ok(slot) = slots.clone().acquire_owned().await else {
            return;
        };
        match listener.accept().await {
            Ok((stream, _)) => {
                let pages = pages.clone();
                tokio::spawn(async move {
                    timeout(CONNECTION_MAX, converse(stream, pages)).await.ok();
                    drop(slot);
                });
            }
            Err(error) => {
                tracing::warn!(%error, "cannot accept a scrape");
                sleep(ACCEPT_PAUSE).await;
            }
        }
    }
}

/// Answers one request.
async fn converse(stream: TcpStream, pages: Pages) {
    let service = service_fn(move |request| {
        let pages = pages.clone();
        async move { Ok::<_, Infallible>(answer(&request, &pages).await) }
    });
    let mut server = http1::Builder::new();
    server
        .timer(TokioTimer::new())
        .header_read_timeout(REQUEST_MAX)
        .keep_alive(false);
    let connection = server.serve_connection(TokioIo::new(stream), service);
    if let Err(error) = connection.await {
        tracing::debug!(%error, "a scrape broke off");
    }
}

async fn answer(request: &Request<Incoming>, pages: &Pages) -> Response<Full<Bytes>> {
    let reading = [Method::GET, Method::HEAD].contains(request.method());
    let (status, kind, text) = match request.uri().path() {
        "/metrics" | "/healthz" if !reading => (
            StatusCode::METHOD_NOT_ALLOWED,
            PLAIN,
            "read only\n".to_owned(),
        ),
        "/metrics" => (
            StatusCode::OK,
            ictus_metrics::CONTENT_TYPE,
            pages.metrics().await,
        ),
        "/healthz" => (StatusCode::OK, PLAIN, "ok\n".to_owned()),
        _ => (
            StatusCode::NOT_FOUND,
            PLAIN,
            "there is /metrics and /healthz\n".to_owned(),
        ),
    };
    let mut response = Response::new(Full::from(text));
    *response.status_mut() = status;
    let headers = response.headers_mut();
    headers.insert(CONTENT_TYPE, HeaderValue::from_static(kind));
    if status == StatusCode::METHOD_NOT_ALLOWED {
        headers.insert(ALLOW, HeaderValue::from_static("GET, HEAD"));
    }
    response
}

const PLAIN: &str = "text/plain; charset=utf-8";
