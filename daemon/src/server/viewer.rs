//! What whoever may only look may ask: reading calls, without what federates have written and what could hold a secret.

use axum::Router;
use axum::extract::{Path, Query, State};
use axum::http::StatusCode;
use axum::middleware::from_fn_with_state;
use axum::response::{Json, Response};
use axum::routing::get;

use super::{EventsQuery, parts, recorded};
use crate::api::recorded::GenerationView;
use crate::api::{ApiError, ErrorCode, Event, FederationView, Happening, Outcome};
use crate::host::Host;

/// The routes over a host.
pub(crate) fn router(host: Host) -> Router {
    Router::new()
        .route("/v1/info", get(super::info))
        .route("/v1/federations", get(federations))
        .route("/v1/federations/{name}", get(federation))
        .route("/v1/federations/{name}/measures", get(super::measures))
        .route("/v1/federations/{name}/history", get(history))
        .route("/v1/events", get(events))
        .route("/metrics", get(super::metrics))
        .merge(parts::readable())
        .merge(recorded::readable())
        .fallback(refused)
        .method_not_allowed_fallback(refused)
        .layer(from_fn_with_state(host.clone(), super::touch))
        .with_state(host)
}

async fn refused() -> (StatusCode, Json<ApiError>) {
    let error = ApiError {
        code: ErrorCode::Forbidden,
        message: "whoever has the role `viewer` may only look, and not at logs".to_owned(),
        known: Vec::new(),
    };
    (StatusCode::FORBIDDEN, Json(error))
}

async fn federations(State(host): State<Host>) -> Json<Vec<FederationView>> {
    Json(host.views().into_iter().map(view).collect())
}

async fn federation(
    State(host): State<Host>,
    Path(name): Path<String>,
) -> Result<Json<FederationView>, ApiError> {
    host.view(&name).map(view).map(Json)
}

async fn history(
    State(host): State<Host>,
    Path(name): Path<String>,
) -> Result<Json<Vec<GenerationView>>, ApiError> {
    let mut runs = host.generations(&name)?;
    for run in &mut runs {
        run.outcome = run.outcome.take().map(outcome);
    }
    Ok(Json(runs))
}

async fn events(
    State(host): State<Host>,
    Query(query): Query<EventsQuery>,
) -> Result<Response, ApiError> {
    super::tell_events(&host, query, happening)
}

/// Without the words of a federate that failed.
fn view(view: FederationView) -> FederationView {
    FederationView {
        outcome: view.outcome.map(outcome),
        ..view
    }
}

fn happening(mut happening: Happening) -> Happening {
    happening.event = match happening.event {
        Event::Ended { outcome: how } => Event::Ended {
            outcome: outcome(how),
        },
        Event::Exited { member, how, .. } => Event::Exited {
            member,
            how,
            reason: None,
        },
        event @ (Event::Started { .. }
        | Event::Listening { .. }
        | Event::Joined { .. }
        | Event::StartTag { .. }
        | Event::Running { .. }
        | Event::Healthy
        | Event::Rejected { .. }
        | Event::StopRequested { .. }
        | Event::StopTag { .. }
        | Event::Resigned { .. }
        | Event::Lost { .. }
        | Event::StpViolation { .. }
        | Event::FallingBehind { .. }
        | Event::CaughtUp { .. }
        | Event::ClockStep { .. }
        | Event::Signalled { .. }
        | Event::Foreign { .. }) => event,
    };
    happening
}

fn outcome(outcome: Outcome) -> Outcome {
    match outcome {
        Outcome::Failed {
            mut failure,
            was_healthy,
        } => {
            (failure.reason, failure.lines) = (None, Vec::new());
            Outcome::Failed {
                failure,
                was_healthy,
            }
        }
        other @ (Outcome::Completed | Outcome::Stopped { .. } | Outcome::Aborted) => other,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::api::{Failure, FailureKind};

    #[test]
    fn what_a_federate_has_said_of_its_end_is_not_shown() {
        let failed = Outcome::Failed {
            failure: Failure {
                kind: FailureKind::Process,
                member: Some("a".to_owned()),
                rank: 0,
                what: "exit code 1".to_owned(),
                reason: Some("canary".to_owned()),
                lines: vec!["canary".to_owned()],
                log: None,
                at_ns: 0,
            },
            was_healthy: true,
        };
        let exited = Event::Exited {
            member: "a".to_owned(),
            how: "exit code 1".to_owned(),
            reason: Some("canary".to_owned()),
        };
        for event in [Event::Ended { outcome: failed }, exited] {
            let told = happening(Happening {
                federation: "f".to_owned(),
                at_ns: 0,
                event,
            });
            let told = serde_json::to_string(&told).unwrap();
            assert!(told.contains("exit code 1"), "{told}");
            assert!(!told.contains("canary"), "{told}");
        }
    }
}
