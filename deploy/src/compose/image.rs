//! The images of a compose file, and their names.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use crate::image::{Archive, ImageConfig, ImageError};

/// The repository of images that are made here. No registry answers at `localhost`, so that nobody else's image can come
/// in their place.
pub const REPOSITORY: &str = "localhost/ictus";
/// The label of images that are made for a federation's compose file.
pub const LABEL: &str = "ictus.compose";
/// The longest tag that engines take.
const TAG_MAX: usize = 128;

/// An image that must be loaded before a compose file can be run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LocalImage {
    /// Its name in the file: of the federation and the program, not of the program's bytes.
    pub reference: String,
    /// What it is made of.
    pub source: ImageSource,
    /// The federation.
    pub federation: String,
}

/// What an image is made of.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ImageSource {
    /// The static `ictus`, which is RTI and collector.
    Ictus,
    /// This program.
    Program(PathBuf),
}

impl LocalImage {
    /// The image's archive; `ictus` is the static `ictus`.
    ///
    /// # Errors
    /// See [`Archive::of`].
    pub fn archive(&self, ictus: &Path) -> Result<Archive, ImageError> {
        let program = match &self.source {
            ImageSource::Ictus => ictus,
            ImageSource::Program(path) => path,
        };
        let labels = BTreeMap::from([(LABEL.to_owned(), self.federation.clone())]);
        Ok(Archive::of(program, &ImageConfig { labels })?.named(&self.reference))
    }
}

/// Images as they are needed, each once.
#[derive(Debug, Default)]
pub(super) struct Images(Vec<LocalImage>);

impl Images {
    /// Notes an image; gives its name. No name of a federation, program or federate has a dot.
    pub(super) fn need(&mut self, federation: &str, what: &str, source: ImageSource) -> String {
        let reference = reference(federation, what);
        if !self.0.iter().any(|image| image.reference == reference) {
            self.0.push(LocalImage {
                reference: reference.clone(),
                source,
                federation: federation.to_owned(),
            });
        }
        reference
    }

    pub(super) fn into_needed(self) -> Vec<LocalImage> {
        self.0
    }
}

/// The name of an image of a federation.
pub(super) fn reference(federation: &str, what: &str) -> String {
    let mut tag = format!("{federation}.{what}");
    if tag.len() > TAG_MAX {
        tag = crate::image::hex(&Sha256::digest(&tag));
    }
    format!("{REPOSITORY}:{tag}")
}
