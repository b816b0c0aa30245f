//! What was there when a host was looked at, and is not when it prepares: it is sent then.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;

use ictusd::api::part::{PrepareRequest, sent_name};
use ictusd::client::ClientError;

use super::{Call, Effect, Outcome, failed};
use crate::rollout::images::{Images, SendError};

/// What may have to be sent.
#[derive(Clone, Debug, Default)]
pub(super) struct Stock {
    /// Programs by digest.
    pub(super) files: BTreeMap<String, PathBuf>,
    pub(super) images: Images,
}

impl Call {
    /// Sends what a host lacks of an image.
    pub(super) async fn send_image(&self, image: &str) -> Result<(Outcome, Effect), ClientError> {
        let key = (self.federation.as_str(), self.fence);
        match self.stock.images.send(&self.client, key, image).await {
            Ok(sent) => Ok((Outcome::Done, Effect::SentLayers(sent))),
            Err(error) => refused(error),
        }
    }

    /// Has the host prepare its part.
    pub(super) async fn prepare(&self) -> Result<(Outcome, Effect), ClientError> {
        let Some(request) = &self.request else {
            return Ok((failed("there is nothing to prepare"), Effect::Nothing));
        };
        let sent = match self.send_again(request).await {
            Ok(sent) => sent,
            Err(error) => return refused(error),
        };
        let key = (self.federation.as_str(), self.fence);
        self.client.prepare(key, request).await?;
        let effect = match sent {
            0 => Effect::Nothing,
            sent => Effect::Sent(sent),
        };
        Ok((Outcome::Done, effect))
    }

    /// Sends programs and images that somebody else's change has removed since, now that the lease keeps them; gives the
    /// bytes that went over the wire.
    async fn send_again(&self, request: &PrepareRequest) -> Result<u64, SendError> {
        let (client, key) = (&self.client, (self.federation.as_str(), self.fence));
        let Some(part) = &request.request.part else {
            return Ok(0);
        };
        let mut sent = 0;
        let programs: Vec<String> = part.programs.values().cloned().collect();
        for digest in client.missing_blobs(&programs).await? {
            if let Some(file) = self.stock.files.get(&digest) {
                let counter = Arc::new(AtomicU64::new(0));
                sent += client.send_blob(key, &digest, file, counter).await?;
            }
        }
        let runs = request.request.federates.iter();
        let runs = runs.filter(|run| part.federates.contains(&run.id));
        let images = runs.filter_map(|run| run.needs.image.clone());
        // Only what has an id is here.
        let images: BTreeSet<String> = images
            .filter(|image| sent_name(key.0, image).is_some())
            .collect();
        let images: Vec<String> = images.into_iter().collect();
        if images.is_empty() {
            return Ok(sent);
        }
        let there = client.images(key.0, &images).await?;
        for image in images.iter().filter(|image| !there.contains_key(*image)) {
            sent += self.stock.images.send(client, key, image).await?.0;
        }
        Ok(sent)
    }
}

/// What went wrong as a call's.
fn refused(error: SendError) -> Result<(Outcome, Effect), ClientError> {
    match error {
        SendError::Here(what) => Ok((failed(&what), Effect::Nothing)),
        SendError::There(error) => Err(error),
    }
}
