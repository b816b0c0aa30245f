//! Images that Ictus did not make: looked at, sent, pulled, built, removed again.
//!
//! What was sent has a name of ours for each federation that uses it, and goes with the last of them.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use bollard::body_try_stream;
use bollard::errors::Error;
use bollard::query_parameters::{
    BuildImageOptions, CreateImageOptions, ImportImageOptions, ListImagesOptions,
    RemoveImageOptions, TagImageOptions,
};
use futures_util::{Stream, StreamExt, TryStreamExt};
use hyper::body::Bytes;
use tokio::fs::File;
use tokio::io::AsyncWriteExt;
use tokio::time::timeout;

use super::error::{is_conflict, is_not_found};
use super::{ANSWER_MAX, Engine, EngineError, Image, LOAD_MAX, answer, told};

/// The repository of images that were sent.
const SENT: &str = "ictus-sent";
/// Digits of the id in such an image's tag.
const TAG_DIGITS: usize = 16;
/// How long an image's build may take.
const BUILD_MAX: Duration = Duration::from_secs(3600);
/// How long pulling may take: who prepares waits no longer.
const PULL_MAX: Duration = Duration::from_secs(110);
/// Bytes of a build's words that are kept for its error.
const WORDS_BYTES_MAX: usize = 2000;

/// The digits of an id `sha256:...` of an image or a layer.
pub(crate) fn digits(id: &str) -> Option<&str> {
    let digits = id.strip_prefix("sha256:")?;
    let hexadecimal = |byte: u8| byte.is_ascii_digit() || (b'a'..=b'f').contains(&byte);
    (digits.len() == 64 && digits.bytes().all(hexadecimal)).then_some(digits)
}

/// The name of an image that was sent for a federation; absent when `id` is no `sha256:...`.
pub(crate) fn sent_name(federation: &str, id: &str) -> Option<String> {
    let digits = digits(id)?;
    Some(format!("{SENT}:{federation}-{}", &digits[..TAG_DIGITS]))
}

impl Engine {
    /// The image that a federate of a federation is to run in: the one that was sent for it, or the one of this name or id.
    ///
    /// # Errors
    /// When the engine does not tell.
    pub(crate) async fn resolve(
        &self,
        federation: &str,
        image: &str,
    ) -> Result<Option<(String, Image)>, EngineError> {
        if let Some(name) = sent_name(federation, image)
            && let Some(found) = self.inspect_image(&name).await?
        {
            return Ok(Some((name, found)));
        }
        let found = self.inspect_image(image).await?;
        Ok(found.map(|found| (image.to_owned(), found)))
    }

    /// Sees that an image is there for a federation: one that was sent for another gets a name for this one, too; one that
    /// is not there is pulled.
    ///
    /// # Errors
    /// When it cannot be had.
    pub(crate) async fn keep(
        &self,
        doing: &str,
        (federation, image): (&str, &str),
    ) -> Result<(), EngineError> {
        if self.resolve(federation, image).await?.is_none() {
            let missing = |why: String| EngineError::ImageNowhere {
                doing: doing.to_owned(),
                image: image.to_owned(),
                why,
            };
            if image.starts_with("sha256:") {
                return Err(missing("it was removed since it was looked for".to_owned()));
            }
            self.pull(image)
                .await
                .map_err(|error| missing(error.to_string()))?;
        }
        let ours = format!("{SENT}:");
        let found = self.inspect_image(image).await?;
        let sent = found.is_some_and(|found| found.tags.iter().any(|tag| tag.starts_with(&ours)));
        match sent_name(federation, image) {
            Some(name) if sent => self.tag(image, &name).await,
            Some(_) | None => Ok(()),
        }
    }

    async fn tag(&self, image: &str, name: &str) -> Result<(), EngineError> {
        let (repository, tag) = name.split_once(':').unwrap_or((name, "latest"));
        let options = TagImageOptions {
            repo: Some(repository.to_owned()),
            tag: Some(tag.to_owned()),
        };
        let tagged = self.docker.tag_image(image, Some(options));
        answer(format!("name image {image} {name}"), tagged).await
    }

    async fn pull(&self, image: &str) -> Result<(), EngineError> {
        let doing = || format!("pull image {image}");
        // Without a tag, all that there are would be pulled.
        let last = image.rsplit('/').next().unwrap_or(image);
        let exact = last.contains([':', '@']);
        let from = if exact {
            image.to_owned()
        } else {
            format!("{image}:latest")
        };
        let options = CreateImageOptions {
            from_image: Some(from),
            ..CreateImageOptions::default()
        };
        let said = self.docker.create_image(Some(options), None, None);
        let pulled = timeout(PULL_MAX, said.try_for_each(|_| async { Ok(()) })).await;
        told(doing(), pulled)
    }

    /// The layers of a chain that are not there: all after the longest beginning that an image of this engine has.
    ///
    /// # Errors
    /// When the engine does not tell.
    pub(crate) async fn missing_layers(
        &self,
        layers: &[String],
    ) -> Result<Vec<String>, EngineError> {
        let options = ListImagesOptions {
            all: true,
            ..ListImagesOptions::default()
        };
        let images = self.docker.list_images(Some(options));
        let mut have = 0;
        for image in answer("list images".to_owned(), images).await? {
            let Some(found) = self.inspect_image(&image.id).await? else {
                continue;
            };
            let same = found.layers.iter().zip(layers);
            have = have.max(same.take_while(|(one, other)| one == other).count());
        }
        Ok(layers[have..].to_vec())
    }

    /// Loads an archive that comes piece by piece, compressed or not; the image has this name then.
    ///
    /// # Errors
    /// When the engine does not take it. What an archive leaves out must be there.
    pub(crate) async fn load_stream(
        &self,
        name: &str,
        pieces: impl Stream<Item = io::Result<Bytes>> + Send + 'static,
    ) -> Result<(), EngineError> {
        let doing = || format!("load image {name}");
        let options = ImportImageOptions {
            quiet: true,
            platform: None,
        };
        let said = self.docker.import_image_stream(options, pieces, None);
        let loaded = timeout(LOAD_MAX, said.try_for_each(|_| async { Ok(()) })).await;
        told(doing(), loaded)?;
        match self.inspect_image(name).await? {
            Some(_) => Ok(()),
            None => Err(EngineError::NotFound {
                doing: doing(),
                why: "it is not there after it was loaded".to_owned(),
            }),
        }
    }

    /// Removes the names of images that were sent, but those that are needed, which is asked at the last moment; an image
    /// goes with its last name.
    ///
    /// # Errors
    /// When the engine does not tell which there are, or refuses one for another reason than that it is used.
    pub(crate) async fn remove_sent(
        &self,
        needed: impl Fn(&str) -> bool,
    ) -> Result<(), EngineError> {
        let filter = ("reference".to_owned(), vec![SENT.to_owned()]);
        let options = ListImagesOptions {
            filters: Some([filter].into()),
            ..ListImagesOptions::default()
        };
        let images = self.docker.list_images(Some(options));
        let images = answer("list images".to_owned(), images).await?;
        let names = images.into_iter().flat_map(|image| image.repo_tags);
        for name in names {
            if federation_of(&name).is_none() || needed(&name) {
                continue;
            }
            let options = RemoveImageOptions {
                force: false,
                noprune: false,
                platforms: None,
            };
            let gone = self.docker.remove_image(&name, Some(options), None);
            match timeout(ANSWER_MAX, gone).await {
                Ok(Err(error)) if is_not_found(&error) || is_conflict(&error) => {}
                gone => told(format!("remove image {name}"), gone).map(drop)?,
            }
        }
        Ok(())
    }

    /// Writes an image as an archive.
    ///
    /// # Errors
    /// When the engine does not give it, or the disk does not take it.
    pub(crate) async fn save(&self, image: &str, path: &Path) -> Result<(), EngineError> {
        let doing = || format!("save image {image}");
        let failed = |source: io::Error| EngineError::Refused {
            doing: doing(),
            why: format!("{}: {source}", path.display()),
            fix: "",
        };
        let mut file = File::create(path).await.map_err(failed)?;
        let mut pieces = Box::pin(self.docker.export_image(image));
        // The engine gathers the whole image before it says anything.
        let mut patience = LOAD_MAX;
        loop {
            match told(doing(), timeout(patience, pieces.try_next()).await)? {
                Some(piece) => file.write_all(&piece).await.map_err(failed)?,
                None => return file.flush().await.map_err(failed),
            }
            patience = ANSWER_MAX;
        }
    }

    /// Builds an image from the archive of a folder, without BuildKit, and gives it a name.
    ///
    /// # Errors
    /// When it cannot be built, with the build's last words.
    pub(crate) async fn build(
        &self,
        (name, dockerfile): (&str, &str),
        context: impl Stream<Item = io::Result<Bytes>> + Send + 'static,
    ) -> Result<(), EngineError> {
        let doing = || format!("build image {name}");
        let options = BuildImageOptions {
            dockerfile: dockerfile.to_owned(),
            t: Some(name.to_owned()),
            rm: true,
            forcerm: true,
            ..BuildImageOptions::default()
        };
        let said = self
            .docker
            .build_image(options, None, Some(body_try_stream(context)));
        let mut said = Box::pin(said);
        let mut words = String::new();
        let building = async {
            while let Some(info) = said.next().await {
                words.push_str(&info?.stream.unwrap_or_default());
                let cut = words.len().saturating_sub(WORDS_BYTES_MAX);
                let cut = (cut..=words.len()).find(|at| words.is_char_boundary(*at));
                words.drain(..cut.unwrap_or(0));
            }
            Ok::<(), Error>(())
        };
        let built = timeout(BUILD_MAX, building).await;
        told(doing(), built).map_err(|error| EngineError::Build {
            what: error.to_string(),
            words: words
                .trim()
                .lines()
                .map(|line| format!("\n  | {line}"))
                .collect(),
        })
    }
}

/// The federation for which an image was sent.
fn federation_of(name: &str) -> Option<&str> {
    let tag = name.strip_prefix(SENT)?.strip_prefix(':')?;
    let (federation, digits) = tag.rsplit_once('-')?;
    (digits.len() == TAG_DIGITS).then_some(federation)
}

/// A folder as an archive, in the order of names.
///
/// # Errors
/// When something in it cannot be read.
pub(crate) fn archive_of(folder: &Path, to: impl io::Write) -> io::Result<()> {
    let mut archive = tar::Builder::new(to);
    archive.follow_symlinks(false);
    let mut folders = vec![PathBuf::new()];
    while let Some(within) = folders.pop() {
        let mut entries = BTreeMap::new();
        for entry in std::fs::read_dir(folder.join(&within))? {
            let entry = entry?;
            entries.insert(entry.file_name(), entry.file_type()?);
        }
        for (name, kind) in entries {
            let inside = within.join(name);
            if kind.is_dir() {
                archive.append_dir(&inside, folder.join(&inside))?;
                folders.push(inside);
            } else if kind.is_file() || kind.is_symlink() {
                archive.append_path_with_name(folder.join(&inside), &inside)?;
            }
        }
    }
    archive.finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_sent_is_named_for_its_federation() {
        let id = format!("sha256:{}", "0a".repeat(32));
        let name = sent_name("one-two", &id).unwrap();
        assert_eq!(name, "ictus-sent:one-two-0a0a0a0a0a0a0a0a");
        assert_eq!(federation_of(&name), Some("one-two"));
        for strange in [
            "ictus-sent:x",
            "other:one-0a0a0a0a0a0a0a0a",
            "<none>:<none>",
        ] {
            assert_eq!(federation_of(strange), None, "{strange}");
        }
        for no_id in ["viewer:1", "sha256:", "sha256:../../../etc"] {
            assert_eq!(sent_name("f", no_id), None, "{no_id}");
        }
    }
}
