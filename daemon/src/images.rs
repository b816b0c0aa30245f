//! Images of the engine of whoever deploys: found, built, loaded, and cut down to what a host does not have.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use futures_util::{StreamExt, stream};
use hyper::body::Bytes;
use ictus_deploy::compose::image::LABEL;
use ictus_deploy::image::Archive;
use ictus_deploy::image::elf::Architecture;
use serde::{Deserialize, Serialize};
use tar::{Builder, EntryType, Header};
use tempfile::NamedTempFile;
use tokio::sync::mpsc;

use crate::docker::{Engine, EngineError, Image, archive_of, digits};

/// The longest file of an archive that is read whole: a description, not a layer.
const DESCRIPTION_BYTES_MAX: u64 = 16 << 20;
/// Pieces of a folder that wait for the engine.
const PIECES_MAX: usize = 8;
/// Bytes of a piece.
const PIECE_BYTES: usize = 256 << 10;

/// The engine of this machine.
#[derive(Clone, Debug)]
pub struct Local(Engine);

/// An image that was found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Found {
    /// Its id there.
    pub id: String,
    /// What it is for, as Rust names it; Docker's name when Rust has none.
    pub arch: String,
    /// Its size.
    pub bytes: u64,
    /// The ids of its layers, the lowest first.
    pub layers: Vec<String>,
}

/// Why an image cannot be had from this machine's engine.
#[derive(Debug, thiserror::Error)]
pub enum ImagesError {
    /// The engine is not there, or does not do it.
    #[error("{what}")]
    Engine {
        /// What it says, with the fix.
        what: String,
    },
    /// A file cannot be read or written.
    #[error("cannot use {path}", path = path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// The folder of an image has a file that leaves parts of it out, which is not heeded.
    #[error(
        "not everything in {} is for its image: its {name} is not heeded; build it yourself and write `image:`",
        folder.display()
    )]
    Ignoring {
        /// The folder.
        folder: PathBuf,
        /// The file.
        name: String,
    },
    /// The engine's archive is not what it should be.
    #[error("the engine's archive of image {image} is not understood: {what}")]
    Archive {
        /// The image.
        image: String,
        /// What is wrong with it.
        what: String,
    },
}

impl From<EngineError> for ImagesError {
    fn from(error: EngineError) -> Self {
        Self::Engine {
            what: error.to_string(),
        }
    }
}

impl Local {
    /// Connects.
    ///
    /// # Errors
    /// When there is no engine that can be used, with what to do about it.
    pub async fn connect() -> Result<Self, ImagesError> {
        Ok(Self(Engine::connect().await?))
    }

    /// Looks for an image, by name or id.
    ///
    /// # Errors
    /// When the engine does not tell.
    pub async fn find(&self, image: &str) -> Result<Option<Found>, ImagesError> {
        Ok(self.0.inspect_image(image).await?.map(found))
    }

    /// Loads an image under its name, unless that very one has the name already; gives whether it was loaded. The image
    /// that had the name before goes when nothing uses it.
    ///
    /// # Errors
    /// When the engine does not take it.
    pub async fn load(&self, archive: Archive) -> Result<bool, ImagesError> {
        let before = self.find(&archive.reference()).await?.map(|image| image.id);
        if before.as_deref() == Some(archive.id()) {
            return Ok(false);
        }
        let now = self.0.load(archive).await?;
        if let Some(before) = before.filter(|before| *before != now) {
            self.0.remove_unused_image(&before).await?;
        }
        Ok(true)
    }

    /// Removes the images of a federation's compose file that nothing uses; gives how many.
    ///
    /// # Errors
    /// When the engine does not tell which there are, or refuses one for another reason than that it is used.
    pub async fn remove_of_compose(&self, federation: &str) -> Result<usize, ImagesError> {
        Ok(self.0.remove_images((LABEL, federation)).await?)
    }

    /// Builds the image of a folder's Dockerfile, and gives it a name.
    ///
    /// # Errors
    /// When it cannot be built.
    pub async fn build(
        &self,
        name: &str,
        (folder, dockerfile): (&Path, &str),
    ) -> Result<Found, ImagesError> {
        wholly(folder, dockerfile)?;
        let (sender, pieces) = mpsc::channel(PIECES_MAX);
        let context = folder.to_path_buf();
        let archiving = tokio::task::spawn_blocking(move || {
            let mut out = Pieces {
                sender: &sender,
                piece: Vec::new(),
            };
            let archived = archive_of(&context, &mut out).and_then(|()| out.flush());
            if let Err(error) = &archived {
                let told = io::Error::new(error.kind(), error.to_string());
                sender.blocking_send(Err(told)).ok();
            }
            archived
        });
        let pieces = stream::unfold(pieces, |mut pieces| async {
            Some((pieces.recv().await?, pieces))
        });
        let built = self.0.build((name, dockerfile), pieces.boxed()).await;
        // That the folder cannot be read comes before what the engine says about half of it.
        if let Ok(Err(source)) = archiving.await
            && source.kind() != io::ErrorKind::BrokenPipe
        {
            let path = folder.to_path_buf();
            return Err(ImagesError::Io { path, source });
        }
        built?;
        let there = self.find(name).await?;
        there.ok_or_else(|| ImagesError::Engine {
            what: format!("image {name} is not there after it was built"),
        })
    }

    /// Takes an image out of the engine.
    ///
    /// # Errors
    /// When the engine does not give it, or gives what is not understood.
    pub async fn save(&self, image: &str) -> Result<Saved, ImagesError> {
        let temporary = NamedTempFile::new().map_err(|source| ImagesError::Io {
            path: std::env::temp_dir(),
            source,
        })?;
        self.0.save(image, temporary.path()).await?;
        let image = image.to_owned();
        let read = tokio::task::spawn_blocking(move || Saved::read(image, temporary));
        read.await.map_err(|error| ImagesError::Engine {
            what: error.to_string(),
        })?
    }
}

/// Refuses a folder of which parts are to be left out.
fn wholly(folder: &Path, dockerfile: &str) -> Result<(), ImagesError> {
    let names = [
        ".dockerignore".to_owned(),
        format!("{dockerfile}.dockerignore"),
    ];
    let found = names.into_iter().find(|name| folder.join(name).exists());
    found.map_or(Ok(()), |name| {
        let folder = folder.to_path_buf();
        Err(ImagesError::Ignoring { folder, name })
    })
}

fn found(image: Image) -> Found {
    let arch = Architecture::from_docker(&image.architecture);
    Found {
        id: image.id,
        arch: arch.map_or(image.architecture, |arch| arch.rust_name().to_owned()),
        bytes: image.bytes,
        layers: image.layers,
    }
}

/// An image in a file, from which archives with some of its layers are made.
#[derive(Debug)]
pub struct Saved {
    file: NamedTempFile,
    config: Vec<u8>,
    config_name: String,
    /// Ids of layers, the lowest first.
    layers: Vec<String>,
    /// Where each layer is in the file: its first byte and its length.
    places: BTreeMap<String, (u64, u64)>,
}

/// The description of an archive, as far as it matters.
#[derive(Debug, Deserialize, Serialize)]
#[serde(rename_all = "PascalCase")]
struct Description {
    config: String,
    repo_tags: Option<Vec<String>>,
    layers: Vec<String>,
}

/// The configuration of an image, as far as it matters.
#[derive(Debug, Deserialize)]
struct Config {
    rootfs: RootFs,
}

#[derive(Debug, Deserialize)]
struct RootFs {
    #[serde(default)]
    diff_ids: Vec<String>,
}

impl Saved {
    fn read(image: String, file: NamedTempFile) -> Result<Self, ImagesError> {
        let strange = |what: &str| ImagesError::Archive {
            image: image.clone(),
            what: what.to_owned(),
        };
        let unreadable = |source| ImagesError::Io {
            path: file.path().to_path_buf(),
            source,
        };
        let opened = || File::open(file.path());
        let contents = Contents::of(opened().map_err(unreadable)?).map_err(unreadable)?;
        let place = |name: &str| contents.place(name);
        let whole = |name: &str| -> Result<Vec<u8>, ImagesError> {
            let (at, length) = place(name).ok_or_else(|| strange("a file of it is missing"))?;
            if length > DESCRIPTION_BYTES_MAX {
                return Err(strange("its description is too long"));
            }
            let mut bytes = Vec::new();
            let mut opened = opened().map_err(unreadable)?;
            opened.seek(SeekFrom::Start(at)).map_err(unreadable)?;
            let read = opened.take(length).read_to_end(&mut bytes);
            read.map_err(unreadable).map(|_| bytes)
        };
        let described = whole("manifest.json")?;
        let described: Vec<Description> =
            serde_json::from_slice(&described).map_err(|error| strange(&error.to_string()))?;
        let [described] = described.as_slice() else {
            return Err(strange("it does not hold one image"));
        };
        let config = whole(&described.config)?;
        let parsed: Config =
            serde_json::from_slice(&config).map_err(|error| strange(&error.to_string()))?;
        let layers = parsed.rootfs.diff_ids;
        if layers.len() != described.layers.len() || layers.iter().any(|it| digits(it).is_none()) {
            return Err(strange("its layers are not those of its configuration"));
        }
        let found = layers.iter().zip(&described.layers).map(|(layer, path)| {
            let place = place(path).ok_or_else(|| strange("a layer of it is missing"))?;
            Ok((layer.clone(), place))
        });
        let places = found.collect::<Result<_, ImagesError>>()?;
        let name = Path::new(&described.config).file_name();
        let name = name.and_then(|name| name.to_str()).unwrap_or("config");
        Ok(Self {
            config_name: format!("{}.json", name.trim_end_matches(".json")),
            file,
            config,
            layers,
            places,
        })
    }

    /// Writes an archive under this name that leaves out all layers but these.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn write_to(
        &self,
        name: &str,
        layers: &BTreeSet<String>,
        out: impl Write,
    ) -> io::Result<()> {
        let mut archive = Builder::new(out);
        append(
            &mut archive,
            &self.config_name,
            (self.config.len() as u64, self.config.as_slice()),
        )?;
        let mut file = File::open(self.file.path())?;
        for (layer, (at, length)) in &self.places {
            if layers.contains(layer) {
                file.seek(SeekFrom::Start(*at))?;
                let content = Read::by_ref(&mut file).take(*length);
                append(&mut archive, &path_of(layer), (*length, content))?;
            }
        }
        let described = [Description {
            config: self.config_name.clone(),
            repo_tags: Some(vec![name.to_owned()]),
            layers: self.layers.iter().map(|layer| path_of(layer)).collect(),
        }];
        let described = serde_json::to_vec(&described)?;
        let content = (described.len() as u64, described.as_slice());
        append(&mut archive, "manifest.json", content)?;
        archive.into_inner()?.flush()
    }

    /// The ids of its layers, the lowest first.
    #[must_use]
    pub fn layers(&self) -> &[String] {
        &self.layers
    }
}

/// Where the files of an archive are in it, by path.
#[derive(Debug, Default)]
struct Contents {
    places: BTreeMap<String, (u64, u64)>,
    links: BTreeMap<String, String>,
}

impl Contents {
    fn of(archive: File) -> io::Result<Self> {
        let mut contents = Self::default();
        for entry in tar::Archive::new(archive).entries()? {
            let entry = entry?;
            let path = plain(&entry.path()?);
            match entry.link_name()? {
                Some(to) if entry.header().entry_type() == EntryType::Symlink => {
                    let beside = Path::new(&path).parent().unwrap_or(Path::new(""));
                    let to = plain(&beside.join(to));
                    contents.links.insert(path, to);
                }
                Some(to) => {
                    contents.links.insert(path, plain(&to));
                }
                None => {
                    let place = (entry.raw_file_position(), entry.size());
                    contents.places.insert(path, place);
                }
            }
        }
        Ok(contents)
    }

    /// First byte and length of a file, or of what a link names.
    fn place(&self, path: &str) -> Option<(u64, u64)> {
        let path = plain(Path::new(path));
        let target = self.links.get(&path).unwrap_or(&path);
        self.places.get(target).copied()
    }
}

fn append<W: Write>(
    archive: &mut Builder<W>,
    path: &str,
    (length, content): (u64, impl Read),
) -> io::Result<()> {
    let mut header = Header::new_ustar();
    header.set_path(path)?;
    header.set_entry_type(EntryType::Regular);
    header.set_mode(0o644);
    header.set_size(length);
    header.set_cksum();
    archive.append(&header, content)
}

/// Where a layer stands in an archive of ours.
fn path_of(layer: &str) -> String {
    format!("{}/layer.tar", digits(layer).unwrap_or("none"))
}

/// A path without `.` and `..`, as text.
fn plain(path: &Path) -> String {
    let mut parts: Vec<String> = Vec::new();
    for part in path.components() {
        match part {
            std::path::Component::ParentDir => {
                parts.pop();
            }
            std::path::Component::Normal(name) => parts.push(name.to_string_lossy().into_owned()),
            std::path::Component::CurDir
            | std::path::Component::RootDir
            | std::path::Component::Prefix(_) => {}
        }
    }
    parts.join("/")
}

/// Bytes on their way to the engine.
struct Pieces<'a> {
    sender: &'a mpsc::Sender<io::Result<Bytes>>,
    piece: Vec<u8>,
}

impl Write for Pieces<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.piece.extend_from_slice(bytes);
        if self.piece.len() >= PIECE_BYTES {
            self.flush()?;
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        let piece = std::mem::take(&mut self.piece);
        if piece.is_empty() {
            return Ok(());
        }
        self.sender
            .blocking_send(Ok(piece.into()))
            .map_err(|_| io::ErrorKind::BrokenPipe.into())
    }
}

#[cfg(test)]
mod tests {
    use ictus_deploy::image::hex;
    use sha2::{Digest, Sha256};

    use super::*;

    fn id(bytes: &[u8]) -> String {
        format!("sha256:{}", hex(&Sha256::digest(bytes)))
    }

    /// An archive as an engine writes it: the second layer is the first one again, as a link.
    fn archive(layers: &[&[u8]]) -> NamedTempFile {
        let file = NamedTempFile::new().unwrap();
        let mut archive = Builder::new(file.reopen().unwrap());
        let mut paths = Vec::new();
        for (index, layer) in layers.iter().enumerate() {
            let path = format!("l{index}/layer.tar");
            let first = layers.iter().position(|other| other == layer).unwrap();
            if first == index {
                append(&mut archive, &path, (layer.len() as u64, *layer)).unwrap();
            } else {
                let mut header = Header::new_ustar();
                header.set_entry_type(EntryType::Symlink);
                header.set_size(0);
                let to = format!("../l{first}/layer.tar");
                archive.append_link(&mut header, &path, to).unwrap();
            }
            paths.push(path);
        }
        let ids: Vec<_> = layers.iter().map(|layer| id(layer)).collect();
        let config = serde_json::json!({ "rootfs": { "diff_ids": ids } }).to_string();
        append(
            &mut archive,
            "c.json",
            (config.len() as u64, config.as_bytes()),
        )
        .unwrap();
        let described = [Description {
            config: "c.json".to_owned(),
            repo_tags: None,
            layers: paths,
        }];
        let described = serde_json::to_vec(&described).unwrap();
        let content = (described.len() as u64, described.as_slice());
        append(&mut archive, "manifest.json", content).unwrap();
        archive.finish().unwrap();
        file
    }

    #[test]
    fn only_the_layers_that_are_asked_for_are_in_an_archive() {
        let (base, top) = (&b"base"[..], &b"top"[..]);
        let saved = Saved::read("i".to_owned(), archive(&[base, base, top])).unwrap();
        assert_eq!(saved.layers(), [id(base), id(base), id(top)]);
        let mut out = Vec::new();
        let only = BTreeSet::from([id(top)]);
        saved.write_to("name:1", &only, &mut out).unwrap();
        let mut archive = tar::Archive::new(out.as_slice());
        let mut files = BTreeMap::new();
        for entry in archive.entries().unwrap() {
            let mut entry = entry.unwrap();
            let path = entry.path().unwrap().to_string_lossy().into_owned();
            let mut content = Vec::new();
            entry.read_to_end(&mut content).unwrap();
            files.insert(path, content);
        }
        let names: Vec<_> = files.keys().cloned().collect();
        let layer = path_of(&id(top));
        let mut expected = vec![
            layer.clone(),
            "c.json".to_owned(),
            "manifest.json".to_owned(),
        ];
        expected.sort();
        assert_eq!(names, expected);
        assert_eq!(files[&layer], top);
        let described: Vec<Description> = serde_json::from_slice(&files["manifest.json"]).unwrap();
        assert_eq!(described[0].repo_tags, Some(vec!["name:1".to_owned()]));
        assert_eq!(
            described[0].layers,
            [path_of(&id(base)), path_of(&id(base)), layer]
        );
    }

    #[test]
    fn a_folder_of_which_parts_are_left_out_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        wholly(folder.path(), "Dockerfile").unwrap();
        for name in ["x.dockerignore", ".dockerignore"] {
            let path = folder.path().join(name);
            std::fs::write(&path, "secret.key\n").unwrap();
            let error = wholly(folder.path(), "x").unwrap_err().to_string();
            assert!(
                error.contains(&format!("its {name} is not heeded")),
                "{error}"
            );
            std::fs::remove_file(path).unwrap();
        }
    }

    #[test]
    fn an_archive_of_something_else_is_refused() {
        let file = NamedTempFile::new().unwrap();
        Builder::new(file.reopen().unwrap()).finish().unwrap();
        let error = Saved::read("i".to_owned(), file).unwrap_err();
        assert!(
            error.to_string().contains("image i is not understood"),
            "{error}"
        );
    }
}
