//! The routes of what runs have left; see [`crate::api::recorded`].

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};

use axum::Router;
use axum::body::{Body, Bytes};
use axum::extract::{Path, Query, State};
use axum::http::header::{CONTENT_LENGTH, CONTENT_TYPE};
use axum::response::{IntoResponse, Json, Response};
use axum::routing::get;
use rustix::fs::{Mode, OFlags};
use serde::Deserialize;

use super::{JsonLines, Sender};
use crate::api::recorded::{FileKind, Generation, GenerationView, Recorded};
use crate::api::{ApiError, ErrorCode};
use crate::host::Host;

/// Bytes that are read at a time.
const PIECE_BYTES: usize = 64 << 10;

/// The routes that whoever may look may ask.
pub(super) fn readable() -> Router<Host> {
    Router::new()
        .route("/v1/names", get(names))
        .route("/v1/federations/{name}/recorded", get(recorded))
        .route("/v1/federations/{name}/recorded/{kind}/{member}", get(file))
}

/// What a generation was run from has the environment of federates in it, and how one ended their words.
pub(super) fn private() -> Router<Host> {
    Router::new()
        .route("/v1/federations/{name}/history", get(history))
        .route("/v1/federations/{name}/history/{run}", get(generation))
}

async fn names(State(host): State<Host>) -> Json<Vec<String>> {
    Json(host.names())
}

async fn recorded(
    State(host): State<Host>,
    Path(name): Path<String>,
) -> Result<Json<Recorded>, ApiError> {
    host.recorded(&name).map(Json)
}

async fn history(
    State(host): State<Host>,
    Path(name): Path<String>,
) -> Result<Json<Vec<GenerationView>>, ApiError> {
    host.generations(&name).map(Json)
}

async fn generation(
    State(host): State<Host>,
    Path((name, run)): Path<(String, String)>,
) -> Result<Json<Generation>, ApiError> {
    host.generation(&name, &run).map(Json)
}

#[derive(Deserialize)]
struct FileQuery {
    #[serde(default)]
    from: u64,
}

/// What the file holds now; a member may still write.
async fn file(
    State(host): State<Host>,
    Path((name, kind, member)): Path<(String, FileKind, String)>,
    Query(query): Query<FileQuery>,
) -> Result<Response, ApiError> {
    let path = host.recorded_file(&name, kind, &member)?;
    let opened = tokio::task::spawn_blocking(move || open(&path, query.from)).await;
    let (file, length) = opened
        .unwrap_or_else(|error| Err(io::Error::other(error)))
        .map_err(|error| ApiError {
            code: if error.kind() == io::ErrorKind::NotFound {
                ErrorCode::Unknown
            } else {
                ErrorCode::Failed
            },
            message: format!(
                "federate `{member}` of `{name}` has no {} file here: {error}",
                kind.name()
            ),
            known: Vec::new(),
        })?;
    let (pieces, body) = JsonLines::new(None);
    tokio::task::spawn_blocking(move || send(file.take(length), &pieces));
    let head = [
        (CONTENT_TYPE, "text/plain".to_owned()),
        (CONTENT_LENGTH, length.to_string()),
    ];
    Ok((head, Body::new(body)).into_response())
}

fn open(path: &std::path::Path, from: u64) -> io::Result<(File, u64)> {
    // Federates write there: what they put in its place (a link, a pipe) is not followed and not waited for.
    let flags = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
    let mut file = File::from(rustix::fs::open(path, flags, Mode::empty())?);
    let metadata = file.metadata()?;
    if !metadata.is_file() {
        return Err(io::Error::other("it is no file"));
    }
    let length = metadata.len();
    file.seek(SeekFrom::Start(from))?;
    Ok((file, length.saturating_sub(from)))
}

/// Ends early when it cannot be read: whoever asked sees that bytes are missing.
fn send(mut from: impl Read, pieces: &Sender) {
    let mut buffer = vec![0; PIECE_BYTES];
    while let Ok(count @ 1..) = from.read(&mut buffer) {
        let piece = Bytes::copy_from_slice(&buffer[..count]);
        if pieces.0.blocking_send(piece).is_err() {
            return;
        }
    }
}
