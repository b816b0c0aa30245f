//! The host's Docker engine: images are loaded and containers made, started, looked at and removed; nothing else.
//!
//! Every call is bounded. What is not ours is never touched: a container is ours by a label *and* an instance id that is
//! in a record.

use std::collections::{BTreeMap, HashMap};
use std::io;
use std::path::{Path, PathBuf};
use std::pin::pin;
use std::time::Duration;

use bollard::Docker;
use bollard::errors::Error;
use bollard::models::ContainerInspectResponse;
use bollard::query_parameters::{
    CreateContainerOptions, ImportImageOptions, ListContainersOptions, ListImagesOptions,
    LogsOptions, RemoveContainerOptions, RemoveImageOptions,
};
use futures_util::{StreamExt, TryStreamExt, stream};
use ictus_deploy::image::elf::Architecture;
use ictus_deploy::image::{Archive, ImageError};
use tokio::net::UnixStream;
use tokio::sync::mpsc;
use tokio::task::spawn_blocking;
use tokio::time::timeout;

use crate::api::part::DockerFacts;

mod error;
mod images;
mod spec;
#[cfg(test)]
mod tests;

pub(crate) use error::EngineError;
use error::{is_conflict, is_not_found};
pub(crate) use images::{archive_of, digits, sent_name};
pub(crate) use spec::{Binding, ContainerSpec, label};

/// Where engines listen unless `DOCKER_HOST` says otherwise.
const SOCKET: &str = "/var/run/docker.sock";
/// The oldest API that is spoken: Docker 20.10.
const API_MIN: (u32, u32) = (1, 41);
/// How long the engine may take for anything but loading an image.
const ANSWER_MAX: Duration = Duration::from_secs(60);
/// How long it may take to load an image.
const LOAD_MAX: Duration = Duration::from_secs(600);
/// What is sent of an image at a time.
const CHUNK_BYTES: usize = 256 * 1024;
/// Chunks that wait to be sent.
const CHUNKS_MAX: usize = 8;
/// What is kept of a container's log.
const TAIL_BYTES_MAX: usize = 4096;

/// The engine of this host.
#[derive(Clone, Debug)]
pub(crate) struct Engine {
    docker: Docker,
    facts: DockerFacts,
}

/// A container as it is.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Container {
    /// Its id.
    pub(crate) id: String,
    /// Its name.
    pub(crate) name: String,
    /// Whether it runs.
    pub(crate) running: bool,
    /// Its first process as this host sees it, while it runs.
    pub(crate) pid: Option<u32>,
    /// When it was started, in the engine's words; empty before.
    pub(crate) started_at: String,
    /// How its first process ended, once it has.
    pub(crate) exit_code: Option<i64>,
    /// Whether the kernel killed something in it because its memory was used up.
    pub(crate) oom_killed: bool,
    /// What the engine said when it could not be started.
    pub(crate) error: String,
    /// Its labels.
    pub(crate) labels: BTreeMap<String, String>,
}

/// An image as it is.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Image {
    /// Its id.
    pub(crate) id: String,
    /// What it is built for, in Docker's words.
    pub(crate) architecture: String,
    /// What it executes.
    pub(crate) entrypoint: Vec<String>,
    /// Arguments to that, or what it executes when it has no entrypoint.
    pub(crate) cmd: Vec<String>,
    /// `NAME=VALUE`.
    pub(crate) env: Vec<String>,
    /// Who runs it; empty: root.
    pub(crate) user: String,
    /// Its working directory; empty: `/`.
    pub(crate) workdir: String,
    /// The ids of its layers, the lowest first.
    pub(crate) layers: Vec<String>,
    /// Its names.
    pub(crate) tags: Vec<String>,
    /// Its size.
    pub(crate) bytes: u64,
}

impl Engine {
    /// Connects to the engine of this host: `DOCKER_HOST` if it names a Unix socket, or the usual place.
    ///
    /// # Errors
    /// When there is none that can be used, with what to do about it.
    pub(crate) async fn connect() -> Result<Self, EngineError> {
        Self::connect_to(&socket(std::env::var("DOCKER_HOST").ok())?).await
    }

    /// Connects to the engine behind a socket.
    ///
    /// # Errors
    /// See [`Self::connect`].
    pub(crate) async fn connect_to(socket: &Path) -> Result<Self, EngineError> {
        let doing = || "ask the Docker engine for its version".to_owned();
        // The client's own errors do not tell these apart.
        match timeout(ANSWER_MAX, UnixStream::connect(socket)).await {
            Ok(Ok(_)) => {}
            Ok(Err(error)) => return Err(unreachable(socket, &error)),
            Err(_) => return Err(EngineError::Silent { doing: doing() }),
        }
        let path = socket.to_string_lossy();
        let docker =
            Docker::connect_with_unix(&path, LOAD_MAX.as_secs(), bollard::API_DEFAULT_VERSION)
                .map_err(|error| EngineError::of(doing(), error))?;
        let docker = answer(doing(), docker.negotiate_version()).await?;
        let version = answer(doing(), docker.version()).await?;
        let api = version.api_version.unwrap_or_default();
        let version = version.version.unwrap_or_default();
        if !is_new_enough(&api) {
            return Err(EngineError::TooOld { version, api });
        }
        let info = answer("ask the Docker engine what it is".to_owned(), docker.info()).await?;
        let facts = DockerFacts {
            version,
            api: docker.client_version().to_string(),
            storage_driver: info.driver.unwrap_or_default(),
            cgroup_version: info
                .cgroup_version
                .map(|it| it.to_string())
                .unwrap_or_default(),
        };
        Ok(Self { docker, facts })
    }

    /// What it is.
    pub(crate) fn facts(&self) -> &DockerFacts {
        &self.facts
    }

    /// Looks at an image, by id or reference; absent when it is not there.
    ///
    /// # Errors
    /// When the engine does not tell.
    pub(crate) async fn inspect_image(
        &self,
        reference: &str,
    ) -> Result<Option<Image>, EngineError> {
        let doing = format!("look at image {reference}");
        let found = answer_or_absent(doing, self.docker.inspect_image(reference)).await?;
        Ok(found.map(|found| {
            let config = found.config.unwrap_or_default();
            Image {
                id: found.id.unwrap_or_default(),
                architecture: found.architecture.unwrap_or_default(),
                entrypoint: config.entrypoint.unwrap_or_default(),
                cmd: config.cmd.unwrap_or_default(),
                env: config.env.unwrap_or_default(),
                user: config.user.unwrap_or_default(),
                workdir: config.working_dir.unwrap_or_default(),
                layers: found.root_fs.and_then(|it| it.layers).unwrap_or_default(),
                tags: found.repo_tags.unwrap_or_default(),
                bytes: found.size.and_then(|it| it.try_into().ok()).unwrap_or(0),
            }
        }))
    }

    /// Whether an image is there.
    ///
    /// # Errors
    /// When the engine does not tell.
    pub(crate) async fn has_image(&self, reference: &str) -> Result<bool, EngineError> {
        Ok(self.inspect_image(reference).await?.is_some())
    }

    /// Makes sure that a program's image is there; gives the name by which containers are made from it. Nothing is sent when
    /// it is there already.
    ///
    /// # Errors
    /// When the archive cannot be made, or the engine does not take it.
    pub(crate) async fn provide(&self, archive: Archive) -> Result<String, EngineError> {
        let reference = archive.reference();
        if !self.has_image(&reference).await? {
            self.load(archive).await?;
        }
        Ok(reference)
    }

    /// Loads an image; gives its id in this engine.
    ///
    /// # Errors
    /// See [`Self::provide`].
    pub(crate) async fn load(&self, archive: Archive) -> Result<String, EngineError> {
        let reference = archive.reference();
        let doing = || format!("load image {reference}");
        let (sender, chunks) = mpsc::channel(CHUNKS_MAX);
        let writing = spawn_blocking(move || archive.write_to(Chunks::new(sender)));
        let chunks = stream::unfold(chunks, |mut chunks| async {
            let chunk = chunks.recv().await?;
            Some((Ok::<_, io::Error>(chunk), chunks))
        });
        let options = ImportImageOptions {
            quiet: true,
            platform: None,
        };
        let said = self
            .docker
            .import_image_stream(options, chunks.map_ok(Into::into), None);
        let loaded = timeout(LOAD_MAX, said.try_for_each(|_| async { Ok(()) })).await;
        // That the archive could not be written comes before what the engine says about half of it; that the engine
        // did not take it, before what the archive says about its closed pipe.
        let written = timeout(ANSWER_MAX, writing).await;
        let own = |error: &ImageError| !matches!(error, ImageError::Unwritable { .. });
        match written {
            Ok(Ok(Err(source))) if own(&source) => {
                return Err(EngineError::Image {
                    doing: doing(),
                    source: Box::new(source),
                });
            }
            Ok(_) | Err(_) => {}
        }
        match loaded {
            Ok(Ok(())) => {}
            Ok(Err(error)) => return Err(EngineError::of(doing(), error)),
            Err(_) => return Err(EngineError::Silent { doing: doing() }),
        }
        let image = self.inspect_image(&reference).await?;
        image
            .map(|image| image.id)
            .ok_or_else(|| EngineError::NotFound {
                doing: doing(),
                why: "it is not there after it was loaded".to_owned(),
            })
    }

    /// Removes the images with a label that nothing uses; gives how many.
    ///
    /// # Errors
    /// When the engine does not tell which there are, or refuses one for another reason than that it is used.
    pub(crate) async fn remove_images(&self, label: (&str, &str)) -> Result<usize, EngineError> {
        let options = ListImagesOptions {
            filters: Some(filter(&[label])),
            ..ListImagesOptions::default()
        };
        let images = answer(
            "list images".to_owned(),
            self.docker.list_images(Some(options)),
        )
        .await?;
        let mut removed = 0;
        for image in images {
            // Several names are no reason to keep it; a container is, also with force while it runs.
            let names = image.repo_tags.iter();
            for name in names.filter(|name| !name.starts_with('<')) {
                if !self.remove_image_name(name).await? {
                    break;
                }
            }
            removed += usize::from(self.remove_unused_image(&image.id).await?);
        }
        Ok(removed)
    }

    /// Removes an image by its id unless a name or a container uses it; gives whether it is gone.
    ///
    /// # Errors
    /// See [`Self::remove_images`].
    pub(crate) async fn remove_unused_image(&self, id: &str) -> Result<bool, EngineError> {
        let named = self.inspect_image(id).await?;
        if named.is_some_and(|image| image.tags.is_empty()) {
            self.remove_image_name(id).await?;
        }
        Ok(!self.has_image(id).await?)
    }

    /// Removes one name of an image, and the image with its last one; false when it is used.
    async fn remove_image_name(&self, name: &str) -> Result<bool, EngineError> {
        let options = RemoveImageOptions {
            force: false,
            noprune: false,
            platforms: None,
        };
        let gone = self.docker.remove_image(name, Some(options), None);
        match timeout(ANSWER_MAX, gone).await {
            Ok(Err(error)) if is_not_found(&error) => Ok(true),
            Ok(Err(error)) if is_conflict(&error) => Ok(false),
            gone => told(format!("remove image {name}"), gone).map(|_| true),
        }
    }

    /// Makes a container and starts it; gives its id.
    ///
    /// # Errors
    /// The first thing that went wrong; no container is left then.
    pub(crate) async fn run(&self, spec: &ContainerSpec) -> Result<String, EngineError> {
        let id = self.create(spec).await?;
        if let Err(error) = self.start(&id, &spec.name).await {
            self.remove_or_warn(&id).await;
            return Err(error);
        }
        Ok(id)
    }

    /// Makes a container; gives its id.
    ///
    /// # Errors
    /// When the image is not there or for another processor, the name is taken, or the engine refuses. No container is left
    /// then.
    pub(crate) async fn create(&self, spec: &ContainerSpec) -> Result<String, EngineError> {
        let doing = || format!("create container `{}`", spec.name);
        self.check_image(spec).await?;
        let options = || CreateContainerOptions {
            name: Some(spec.name.clone()),
            platform: String::new(),
        };
        let create = || {
            timeout(
                ANSWER_MAX,
                self.docker.create_container(Some(options()), spec.body()),
            )
        };
        let mut created = create().await;
        if matches!(&created, Ok(Err(error)) if is_conflict(error)) {
            // An interrupted call of ours may have made it after all; nobody else knows the instance id.
            if !self.remove_own(spec).await? {
                return Err(EngineError::NameTaken {
                    doing: doing(),
                    name: spec.name.clone(),
                });
            }
            created = create().await;
        }
        match told(doing(), created) {
            Ok(created) => Ok(created.id),
            Err(error) => {
                if let Err(error) = self.remove_own(spec).await {
                    tracing::warn!(%error, container = spec.name, "perhaps a container was left");
                }
                Err(error)
            }
        }
    }

    async fn check_image(&self, spec: &ContainerSpec) -> Result<(), EngineError> {
        let doing = || format!("create container `{}`", spec.name);
        let image = || spec.image.clone();
        let found = self.inspect_image(&spec.image).await?;
        let found = found.ok_or_else(|| EngineError::ImageMissing {
            doing: doing(),
            image: image(),
        })?;
        // Without emulation it would only say "exec format error".
        match (
            Architecture::from_docker(&found.architecture),
            Architecture::own(),
        ) {
            (Some(of_image), Some(host)) if of_image != host => {
                Err(EngineError::ImageArchitecture {
                    doing: doing(),
                    image: image(),
                    found: found.architecture,
                    host: host.to_string(),
                })
            }
            _ => Ok(()),
        }
    }

    /// Removes the container of this name if it is of this very instance; false when it is another's.
    async fn remove_own(&self, spec: &ContainerSpec) -> Result<bool, EngineError> {
        let Some(found) = self.inspect(&spec.name).await? else {
            return Ok(true);
        };
        let own = spec.labels.get(label::INSTANCE);
        if own.is_none() || found.labels.get(label::INSTANCE) != own {
            return Ok(false);
        }
        self.remove(&found.id).await?;
        Ok(true)
    }

    /// Starts a container.
    ///
    /// # Errors
    /// When the engine cannot.
    pub(crate) async fn start(&self, id: &str, name: &str) -> Result<(), EngineError> {
        answer(
            format!("start container `{name}`"),
            self.docker.start_container(id, None),
        )
        .await
    }

    /// Looks at a container, by id or name; absent when it is not there.
    ///
    /// # Errors
    /// When the engine does not tell.
    pub(crate) async fn inspect(&self, id: &str) -> Result<Option<Container>, EngineError> {
        let doing = format!("look at container `{id}`");
        let found = answer_or_absent(doing, self.docker.inspect_container(id, None)).await?;
        Ok(found.map(container))
    }

    /// The end of what a container's first process wrote; empty when the engine does not tell.
    pub(crate) async fn log_tail(&self, id: &str) -> String {
        let options = LogsOptions {
            stdout: true,
            stderr: true,
            tail: "20".to_owned(),
            ..LogsOptions::default()
        };
        let mut lines = pin!(self.docker.logs(id, Some(options)));
        let mut tail = Vec::new();
        let read = async {
            while let Some(Ok(line)) = lines.next().await {
                tail.extend_from_slice(&line.into_bytes());
                tail.drain(..tail.len().saturating_sub(TAIL_BYTES_MAX));
            }
        };
        // What came until then is shown.
        timeout(ANSWER_MAX, read).await.ok();
        String::from_utf8_lossy(&tail).trim().to_owned()
    }

    /// Removes a container, running or not; that it is not there is no error.
    ///
    /// # Errors
    /// When the engine cannot.
    pub(crate) async fn remove(&self, id: &str) -> Result<(), EngineError> {
        let options = RemoveContainerOptions {
            v: true,
            force: true,
            link: false,
        };
        match timeout(ANSWER_MAX, self.docker.remove_container(id, Some(options))).await {
            Ok(Err(error)) if is_not_found(&error) || is_conflict(&error) => Ok(()),
            removed => told(format!("remove container `{id}`"), removed),
        }
    }

    pub(crate) async fn remove_or_warn(&self, id: &str) {
        if let Err(error) = self.remove(id).await {
            tracing::warn!(%error, "a container was left");
        }
    }

    /// Containers with all these labels, running or not, sorted by name.
    ///
    /// # Errors
    /// When the engine does not tell.
    pub(crate) async fn list(
        &self,
        labels: &[(&str, &str)],
    ) -> Result<Vec<Container>, EngineError> {
        let options = ListContainersOptions {
            all: true,
            filters: Some(filter(labels)),
            ..ListContainersOptions::default()
        };
        let found = answer(
            "list containers".to_owned(),
            self.docker.list_containers(Some(options)),
        )
        .await?;
        let mut containers = Vec::new();
        for id in found.into_iter().filter_map(|found| found.id) {
            // One that is gone meanwhile is not listed.
            containers.extend(self.inspect(&id).await?);
        }
        containers.sort_by(|one, other| one.name.cmp(&other.name));
        Ok(containers)
    }
}

/// The socket that `DOCKER_HOST` names.
fn socket(host: Option<String>) -> Result<PathBuf, EngineError> {
    match host.filter(|host| !host.is_empty()) {
        None => Ok(PathBuf::from(SOCKET)),
        Some(host) => match host.strip_prefix("unix://") {
            Some(path) if path.starts_with('/') => Ok(PathBuf::from(path)),
            _ => Err(EngineError::NotLocal { host }),
        },
    }
}

fn unreachable(socket: &Path, error: &io::Error) -> EngineError {
    let socket = socket.to_path_buf();
    if error.kind() == io::ErrorKind::NotFound {
        EngineError::Absent { socket }
    } else if error.kind() == io::ErrorKind::PermissionDenied {
        let uid = rustix::process::geteuid().as_raw();
        EngineError::Denied { socket, uid }
    } else {
        EngineError::Stopped { socket }
    }
}

/// Whether an API version is one that is spoken: `1.41` or a later one.
fn is_new_enough(api: &str) -> bool {
    let parsed = api
        .split_once('.')
        .and_then(|(major, minor)| Some((major.parse().ok()?, minor.parse().ok()?)));
    parsed.is_some_and(|version: (u32, u32)| version >= API_MIN)
}

async fn answer<T>(
    doing: String,
    asked: impl Future<Output = Result<T, Error>>,
) -> Result<T, EngineError> {
    told(doing, timeout(ANSWER_MAX, asked).await)
}

async fn answer_or_absent<T>(
    doing: String,
    asked: impl Future<Output = Result<T, Error>>,
) -> Result<Option<T>, EngineError> {
    match timeout(ANSWER_MAX, asked).await {
        Ok(Err(error)) if is_not_found(&error) => Ok(None),
        found => told(doing, found).map(Some),
    }
}

fn told<T, E>(doing: String, answer: Result<Result<T, Error>, E>) -> Result<T, EngineError> {
    match answer {
        Ok(Ok(value)) => Ok(value),
        Ok(Err(error)) => Err(EngineError::of(doing, error)),
        Err(_) => Err(EngineError::Silent { doing }),
    }
}

fn filter(labels: &[(&str, &str)]) -> HashMap<String, Vec<String>> {
    let labels = labels
        .iter()
        .map(|(name, value)| format!("{name}={value}"))
        .collect();
    HashMap::from([("label".to_owned(), labels)])
}

fn container(found: ContainerInspectResponse) -> Container {
    let state = found.state.unwrap_or_default();
    let running = state.running.unwrap_or(false);
    let pid = state
        .pid
        .and_then(|pid| u32::try_from(pid).ok())
        .filter(|pid| *pid != 0);
    // A container that never ran says 0 and the year 1.
    let started_at = state
        .started_at
        .filter(|at| !at.starts_with("0001-"))
        .unwrap_or_default();
    let ended = !running && !started_at.is_empty();
    let labels = found
        .config
        .and_then(|config| config.labels)
        .unwrap_or_default();
    Container {
        id: found.id.unwrap_or_default(),
        name: found
            .name
            .unwrap_or_default()
            .trim_start_matches('/')
            .to_owned(),
        running,
        pid: pid.filter(|_| running),
        exit_code: state.exit_code.filter(|_| ended),
        started_at,
        oom_killed: state.oom_killed.unwrap_or(false),
        error: state.error.unwrap_or_default(),
        labels: labels.into_iter().collect(),
    }
}

/// Bytes on their way from a thread that writes to a task that sends.
struct Chunks {
    sender: mpsc::Sender<Vec<u8>>,
    chunk: Vec<u8>,
}

impl Chunks {
    fn new(sender: mpsc::Sender<Vec<u8>>) -> Self {
        Self {
            sender,
            chunk: Vec::with_capacity(CHUNK_BYTES),
        }
    }
}

impl io::Write for Chunks {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.chunk.extend_from_slice(bytes);
        if self.chunk.len() >= CHUNK_BYTES {
            self.flush()?;
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        let chunk = std::mem::replace(&mut self.chunk, Vec::with_capacity(CHUNK_BYTES));
        if chunk.is_empty() {
            return Ok(());
        }
        // Ends when nobody reads any more: the request is over.
        self.sender
            .blocking_send(chunk)
            .map_err(|_| io::ErrorKind::BrokenPipe.into())
    }
}
