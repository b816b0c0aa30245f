//! The routes of a host's part; see [`crate::api::part`].

use std::collections::BTreeMap;
use std::io::{self, Read};
use std::time::Duration;

use axum::Router;
use axum::body::{Body, Bytes};
use axum::extract::{ConnectInfo, DefaultBodyLimit, Path, Query, State};
use axum::response::{Json, Response};
use axum::routing::{get, post, put};
use futures_util::StreamExt;
use serde::Deserialize;
use tokio::sync::mpsc;
use tokio::time::timeout;

use crate::api::part::{
    CommitRequest, Foreign, HostFacts, ImageFacts, Lease, LeaseRequest, LeaseView, PrepareRequest,
    Prepared,
};
use crate::api::secret::{SecretValues, SecretsChanged};
use crate::api::{ApiError, ErrorCode};
use crate::docker::Engine;
use crate::facts;
use crate::federation::container::Images;
use crate::host::Host;

use super::{Caller, JsonLines, StarterGuard, bad_request, parse, pass_until_end, stream};

/// How long the engine may take to say what it is, before a host is told without it.
const ENGINE_MAX: Duration = Duration::from_secs(4);

/// Pieces of a blob that wait for the disk.
const PIECES_MAX: usize = 16;
/// How long giving images up may take.
const COLLECTING_MAX: Duration = Duration::from_secs(5);

/// The routes.
pub(super) fn router() -> Router<Host> {
    let lease = post(take).put(renew).delete(release);
    // A blob is written as it comes, and may be of any size.
    let blob = put(write_blob).layer(DefaultBodyLimit::disable());
    let image = put(load_image).layer(DefaultBodyLimit::disable());
    Router::new()
        .route("/v1/foreign", get(foreign))
        .route("/v1/leases/{name}", lease)
        .route("/v1/images", post(images))
        .route("/v1/images/layers", post(missing_layers))
        .route("/v1/images/{id}", image)
        .route("/v1/blobs", post(missing))
        .route("/v1/blobs/{digest}", blob)
        .route("/v1/federations/{name}/commit", post(commit))
        .route("/v1/federations/{name}/secrets", post(changed_secrets))
}

/// Those that whoever may look may ask.
pub(super) fn readable() -> Router<Host> {
    Router::new()
        .route("/v1/host", get(host_facts))
        .route("/v1/leases", get(leases))
}

#[derive(Deserialize)]
pub(super) struct FenceQuery {
    fence: u64,
}

#[derive(Deserialize)]
struct ReleaseQuery {
    fence: Option<u64>,
    /// Who breaks it.
    r#break: Option<String>,
}

#[derive(Deserialize)]
struct BlobQuery {
    fence: u64,
    federation: String,
}

async fn host_facts(State(host): State<Host>) -> Json<HostFacts> {
    // An engine that hangs concerns only those who need one.
    let docker = match timeout(ENGINE_MAX, Engine::connect()).await {
        Ok(connected) => connected
            .map(|engine| engine.facts().clone())
            .map_err(|error| error.to_string()),
        Err(_) => Err(format!(
            "the Docker engine does not answer within {} s",
            ENGINE_MAX.as_secs()
        )),
    };
    Json(facts::of_this_host(host.paths(), docker))
}

#[derive(Deserialize)]
struct ForeignQuery {
    federation: String,
}

async fn foreign(
    State(host): State<Host>,
    Query(query): Query<ForeignQuery>,
) -> Json<Vec<Foreign>> {
    Json(host.foreign(&query.federation).await)
}

async fn leases(State(host): State<Host>) -> Json<Vec<LeaseView>> {
    Json(host.lease_views())
}

async fn take(
    State(host): State<Host>,
    Path(name): Path<String>,
    ConnectInfo(caller): ConnectInfo<Caller>,
    body: Bytes,
) -> Result<Json<Lease>, ApiError> {
    let mut request: LeaseRequest = parse(&body)?;
    request.who = caller.named(request.who);
    host.take_lease(&name, &request).map(Json)
}

async fn renew(
    State(host): State<Host>,
    Path(name): Path<String>,
    Query(query): Query<FenceQuery>,
) -> Result<Json<Lease>, ApiError> {
    host.renew_lease(&name, query.fence).map(Json)
}

async fn release(
    State(host): State<Host>,
    Path(name): Path<String>,
    Query(query): Query<ReleaseQuery>,
    ConnectInfo(caller): ConnectInfo<Caller>,
) -> Result<Json<Option<LeaseView>>, ApiError> {
    match (query.fence, query.r#break) {
        (Some(fence), None) => {
            host.release_lease(&name, fence)?;
            host.collect_blobs();
            // An engine that does not answer keeps nobody waiting.
            timeout(COLLECTING_MAX, host.collect_images()).await.ok();
            Ok(Json(None))
        }
        (None, Some(by)) => {
            let by = caller.named(by);
            host.break_lease(&name, &by).map(Json)
        }
        (Some(_), Some(_)) | (None, None) => Err(bad_request("either `fence` or `break`")),
    }
}

async fn missing(State(host): State<Host>, body: Bytes) -> Result<Json<Vec<String>>, ApiError> {
    let digests: Vec<String> = parse(&body)?;
    host.missing_blobs(&digests).map(Json)
}

#[derive(Deserialize)]
struct ImagesQuery {
    federation: String,
}

async fn images(
    State(host): State<Host>,
    Query(query): Query<ImagesQuery>,
    body: Bytes,
) -> Result<Json<BTreeMap<String, ImageFacts>>, ApiError> {
    let wanted: Vec<String> = parse(&body)?;
    Ok(Json(host.images(&query.federation, &wanted).await))
}

async fn missing_layers(
    State(host): State<Host>,
    body: Bytes,
) -> Result<Json<Vec<String>>, ApiError> {
    let layers: Vec<String> = parse(&body)?;
    host.missing_layers(&layers).await.map(Json)
}

async fn load_image(
    State(host): State<Host>,
    Path(id): Path<String>,
    Query(query): Query<BlobQuery>,
    body: Body,
) -> Result<Json<()>, ApiError> {
    host.check_fence(&query.federation, Some(query.fence))?;
    let pieces = body
        .into_data_stream()
        .map(|piece| piece.map_err(io::Error::other));
    let loaded = host.load_image(&query.federation, &id, pieces).await;
    loaded.map(Json)
}

async fn write_blob(
    State(host): State<Host>,
    Path(digest): Path<String>,
    Query(query): Query<BlobQuery>,
    body: Body,
) -> Result<Json<()>, ApiError> {
    host.check_fence(&query.federation, Some(query.fence))?;
    let (pieces, arriving) = mpsc::channel(PIECES_MAX);
    let writing = tokio::task::spawn_blocking(move || {
        let bytes = flate2::read::GzDecoder::new(Pieces {
            arriving,
            current: Bytes::new(),
        });
        host.write_blob(&digest, bytes)
    });
    let mut body = body.into_data_stream();
    while let Some(piece) = body.next().await {
        let piece = piece.map_err(io::Error::other);
        // Closed when the disk does not take it, which is told below.
        if pieces.send(piece).await.is_err() {
            break;
        }
    }
    drop(pieces);
    let failed = |error: tokio::task::JoinError| ApiError {
        code: ErrorCode::Failed,
        message: error.to_string(),
        known: Vec::new(),
    };
    writing.await.map_err(failed)?.map(Json)
}

/// What arrives, as a reader.
struct Pieces {
    arriving: mpsc::Receiver<io::Result<Bytes>>,
    current: Bytes,
}

impl Read for Pieces {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        while self.current.is_empty() {
            match self.arriving.blocking_recv() {
                Some(piece) => self.current = piece?,
                None => return Ok(0),
            }
        }
        let count = buffer.len().min(self.current.len());
        buffer[..count].copy_from_slice(&self.current.split_to(count));
        Ok(count)
    }
}

pub(super) async fn prepare(
    State(host): State<Host>,
    Path(name): Path<String>,
    Query(query): Query<FenceQuery>,
    body: Bytes,
) -> Result<Json<Prepared>, ApiError> {
    let request: PrepareRequest = parse(&body)?;
    host.check_fence(&name, Some(query.fence))?;
    // What the engine could not remove when the last run ended is in its record, which makes way.
    host.remove_containers(&name, Images::Keep).await?;
    let prepared = host.prepare(&name, query.fence, &request)?;
    // Afterwards, because only then everything that it needs is known to be there.
    host.prepare_images(&name).await?;
    Ok(Json(prepared))
}

async fn changed_secrets(
    State(host): State<Host>,
    Path(name): Path<String>,
    body: Bytes,
) -> Result<Json<SecretsChanged>, ApiError> {
    let values: SecretValues = parse(&body)?;
    host.known_directory(&name)?;
    host.changed_secrets(&name, &values).map(Json)
}

async fn commit(
    State(host): State<Host>,
    Path(name): Path<String>,
    body: Bytes,
) -> Result<Response, ApiError> {
    let request: CommitRequest = parse(&body)?;
    let told = host.subscribe();
    let handle = host.commit(&name, &request)?;
    let (lines, body) = JsonLines::new(Some(StarterGuard(handle.commands)));
    tokio::spawn(pass_until_end(told, name, lines));
    Ok(stream(body))
}
