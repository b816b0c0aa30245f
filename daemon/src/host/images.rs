//! Images of this host's engine that are asked for, taken, and given up again.

use std::collections::BTreeMap;
use std::io;

use futures_util::Stream;
use hyper::body::Bytes;
use ictus_deploy::image::elf::Architecture;

use crate::api::ApiError;
use crate::api::ErrorCode;
use crate::api::part::ImageFacts;
use crate::docker::{Engine, EngineError, sent_name};

use super::Host;

impl Host {
    /// Those of these images that are there, or were sent for the federation; none when there is no engine.
    pub(crate) async fn images(
        &self,
        federation: &str,
        wanted: &[String],
    ) -> BTreeMap<String, ImageFacts> {
        let mut there = BTreeMap::new();
        let Ok(engine) = Engine::connect().await else {
            return there;
        };
        for image in wanted {
            if let Ok(Some((_, found))) = engine.resolve(federation, image).await {
                let arch = Architecture::from_docker(&found.architecture);
                let facts = ImageFacts {
                    id: found.id,
                    arch: arch.map_or(found.architecture, |arch| arch.rust_name().to_owned()),
                };
                there.insert(image.clone(), facts);
            }
        }
        there
    }

    /// Those layers of an image that are not there.
    pub(crate) async fn missing_layers(&self, layers: &[String]) -> Result<Vec<String>, ApiError> {
        let engine = Engine::connect().await.map_err(|error| failed(&error))?;
        let missing = engine.missing_layers(layers).await;
        missing.map_err(|error| failed(&error))
    }

    /// Takes an image for a federation.
    pub(crate) async fn load_image(
        &self,
        federation: &str,
        id: &str,
        pieces: impl Stream<Item = io::Result<Bytes>> + Send + 'static,
    ) -> Result<(), ApiError> {
        let Some(name) = sent_name(federation, id) else {
            return Err(ApiError {
                code: ErrorCode::BadRequest,
                message: format!(
                    "`{}` is no image's id",
                    id.chars().take(80).collect::<String>()
                ),
                known: Vec::new(),
            });
        };
        let engine = Engine::connect().await.map_err(|error| failed(&error))?;
        let loaded = engine.load_stream(&name, pieces).await;
        loaded.map_err(|error| failed(&error))
    }

    /// Gives up images that were sent and that no run of this host needs; those of a change that is under way are needed.
    pub(crate) async fn collect_images(&self) {
        // Where there is no engine there is no image either.
        let Ok(engine) = Engine::connect().await else {
            return;
        };
        // A change may begin while others are removed.
        let needed = |name: &str| !self.lease_views().is_empty() || self.needs_image(name);
        if let Err(error) = engine.remove_sent(needed).await {
            tracing::warn!(%error, "images were not removed");
        }
    }

    /// Whether a run, or one that may be returned to, has an image that was sent under this name.
    fn needs_image(&self, sent: &str) -> bool {
        self.names().iter().any(|name| {
            let request = self.directory(name).read_request().ok();
            let runs = request.into_iter().flat_map(|request| request.federates);
            let images = self.history(name).images().into_iter();
            let mut images = images.chain(runs.filter_map(|run| run.needs.image));
            images.any(|image| sent_name(name, &image).is_some_and(|name| name == sent))
        })
    }
}

fn failed(error: &EngineError) -> ApiError {
    ApiError {
        code: ErrorCode::Failed,
        message: error.to_string(),
        known: Vec::new(),
    }
}
