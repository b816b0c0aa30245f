//! The routes that try whether hosts can connect; see [`crate::api::reach`].

use axum::Router;
use axum::body::Bytes;
use axum::response::Json;
use axum::routing::post;

use crate::api::reach::{ListenRequest, Listening, ProbeRequest, Reached};
use crate::api::{ApiError, ErrorCode};
use crate::host::Host;
use crate::reach::{self, ReachError};

use super::parse;

/// The routes.
pub(super) fn router() -> Router<Host> {
    Router::new()
        .route("/v1/reach/listen", post(listen))
        .route("/v1/reach/probe", post(probe))
}

async fn listen(body: Bytes) -> Result<Json<Listening>, ApiError> {
    let request: ListenRequest = parse(&body)?;
    reach::listen(request).await.map(Json).map_err(refused)
}

async fn probe(body: Bytes) -> Result<Json<Reached>, ApiError> {
    let request: ProbeRequest = parse(&body)?;
    reach::probe(&request).await.map(Json).map_err(refused)
}

fn refused(error: ReachError) -> ApiError {
    let code = match error {
        ReachError::Word => ErrorCode::BadRequest,
        ReachError::Listen { .. } => ErrorCode::Failed,
    };
    ApiError {
        code,
        message: error.to_string(),
        known: Vec::new(),
    }
}
