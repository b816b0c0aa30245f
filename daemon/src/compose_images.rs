//! Images for this machine's engine, without a daemon: what a compose file needs is loaded, and removed by its label.

use ictus_deploy::compose::image::LABEL;
use ictus_deploy::image::Archive;

use crate::docker::{Engine, EngineError};

/// Why the engine does not have an image. Its message names what was tried and the fix.
#[derive(Debug, thiserror::Error)]
#[error(transparent)]
pub struct ImagesError(#[from] EngineError);

/// The engine of this machine, as far as images go.
#[derive(Clone, Debug)]
pub struct LocalImages {
    engine: Engine,
}

impl LocalImages {
    /// Connects to the engine: `DOCKER_HOST` if it names a Unix socket, or the usual place.
    ///
    /// # Errors
    /// When there is none that can be used.
    pub async fn connect() -> Result<Self, ImagesError> {
        let engine = Engine::connect().await?;
        Ok(Self { engine })
    }

    /// Loads an image under its name, unless that very one has the name already; gives whether it was loaded. The image
    /// that had the name before goes when nothing uses it.
    ///
    /// # Errors
    /// When the engine does not take it.
    pub async fn load(&self, archive: Archive) -> Result<bool, ImagesError> {
        let before = self.engine.inspect_image(&archive.reference()).await?;
        let before = before.map(|image| image.id);
        if before.as_deref() == Some(archive.id()) {
            return Ok(false);
        }
        let now = self.engine.load(archive).await?;
        if let Some(before) = before.filter(|before| *before != now) {
            self.engine.remove_unused_image(&before).await?;
        }
        Ok(true)
    }

    /// Removes the images of a federation's compose file that nothing uses; gives how many.
    ///
    /// # Errors
    /// When the engine does not tell which there are, or refuses one for another reason than that it is used.
    pub async fn remove(&self, federation: &str) -> Result<usize, ImagesError> {
        Ok(self.engine.remove_images((LABEL, federation)).await?)
    }
}
