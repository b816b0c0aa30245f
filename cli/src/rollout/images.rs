//! Images of federates: what this machine's engine has of them, and what of that goes to a host.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use ictus_deploy::rollout::ImageFile;
use ictus_deploy::{Checked, FederateRun};
use ictusd::client::{Client, ClientError};
use ictusd::images::{Found, ImagesError, Local, Saved};
use tokio::sync::Mutex;

use crate::error::CliError;

/// What is known of images here, and those that were taken out of the engine; clones share them.
#[derive(Clone, Debug, Default)]
pub(crate) struct Images {
    /// By federate.
    pub(super) files: BTreeMap<String, ImageFile>,
    engine: Option<Local>,
    /// By id.
    saved: Arc<Mutex<BTreeMap<String, Arc<Saved>>>>,
}

/// Why an image was not sent.
#[derive(Debug)]
pub(crate) enum SendError {
    /// This machine's engine does not give it.
    Here(String),
    /// The host does not take it.
    There(ClientError),
}

impl From<ClientError> for SendError {
    fn from(error: ClientError) -> Self {
        Self::There(error)
    }
}

impl Images {
    /// Looks for every federate's image in this machine's engine, and builds those that are to be built. One that is not
    /// here may be on its host.
    pub(crate) async fn find(checked: &Checked) -> Result<Self, CliError> {
        let runs = checked.federates.iter();
        let runs: Vec<&FederateRun> = runs.filter(|run| run.needs.has_image()).collect();
        let mut images = Self::default();
        if runs.is_empty() {
            return Ok(images);
        }
        let engine = Local::connect().await;
        for run in runs {
            let name = match (&run.needs.image, &run.needs.build) {
                (Some(image), _) => image.clone(),
                (None, _) => format!("ictus-build:{}-{}", checked.plan.federation, run.name),
            };
            let found: Option<Found> = match (&engine, &run.needs.build) {
                (Err(error), Some(_)) => {
                    let message = format!("federate `{}` cannot be built: {error}", run.name);
                    return Err(CliError::failed(message));
                }
                (Err(_), None) => None,
                (Ok(engine), Some(build)) => {
                    let from = (build.context.as_path(), build.dockerfile.as_str());
                    let built = engine.build(&name, from).await;
                    let failed = |error| {
                        let message = format!("federate `{}` cannot be built: {error}", run.name);
                        CliError::failed(message)
                    };
                    Some(built.map_err(failed)?)
                }
                (Ok(engine), None) => engine.find(&name).await.map_err(CliError::failed)?,
            };
            let file = ImageFile {
                name,
                id: found.as_ref().map(|found| found.id.clone()),
                arch: found.as_ref().map(|found| found.arch.clone()),
                bytes: found.map_or(0, |found| found.bytes),
            };
            images.files.insert(run.name.clone(), file);
        }
        images.engine = engine.ok();
        Ok(images)
    }

    /// What a host is asked to run a federate in.
    pub(super) fn of(&self, federate: &str) -> Option<String> {
        let file = self.files.get(federate)?;
        Some(file.id.clone().unwrap_or_else(|| file.name.clone()))
    }

    /// Sends the layers of an image that a host does not have; all of them when it has others than it says. Gives the bytes
    /// that went over the wire, and how many layers they were of how many.
    pub(super) async fn send(
        &self,
        client: &Client,
        key: (&str, u64),
        id: &str,
    ) -> Result<(u64, usize, usize), SendError> {
        let image = self.saved(id).await?;
        let layers = image.layers().to_vec();
        let all: BTreeSet<String> = layers.iter().cloned().collect();
        let missing = client.missing_layers(&layers).await?;
        let missing: BTreeSet<String> = missing.into_iter().collect();
        let sent = Arc::new(AtomicU64::new(0));
        let some = (Arc::clone(&image), missing.clone());
        match client.send_image(key, id, some, Arc::clone(&sent)).await {
            Ok(bytes) => Ok((bytes, missing.len(), all.len())),
            Err(error) if error.refusal().is_some() && missing.len() < all.len() => {
                let whole = (image, all.clone());
                client.send_image(key, id, whole, Arc::clone(&sent)).await?;
                Ok((sent.load(Ordering::Relaxed), all.len(), all.len()))
            }
            Err(error) => Err(error.into()),
        }
    }

    /// The image as a file; taken out of the engine once.
    async fn saved(&self, id: &str) -> Result<Arc<Saved>, SendError> {
        let mut saved = self.saved.lock().await;
        if let Some(image) = saved.get(id) {
            return Ok(Arc::clone(image));
        }
        let gone = || SendError::Here("this machine has no Docker engine any more".to_owned());
        let engine = self.engine.as_ref().ok_or_else(gone)?;
        let failed = |error: ImagesError| SendError::Here(error.to_string());
        let image = Arc::new(engine.save(id).await.map_err(failed)?);
        saved.insert(id.to_owned(), Arc::clone(&image));
        Ok(image)
    }
}
