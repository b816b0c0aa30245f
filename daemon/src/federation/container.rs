//! A member's supervisor as the first process of a container: made, found again, told apart from others, removed.
//!
//! The host's own executable is mounted into the container, and the run's directories stand at their own paths, so that
//! supervisors and what they say are the same in a container as outside.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use ictus_deploy::Needs;
use ictus_deploy::image::elf::Machine;
use ictus_deploy::image::{Archive, ImageConfig, PROGRAM};
use ictus_stream::Papers;
use tokio::net::UnixStream;
use tokio::time::{Instant, sleep, timeout};

use super::launch::Run;
use crate::agent::{MemberId, RTI};
use crate::docker::{Binding, Container, ContainerSpec, Engine, EngineError, label};
use crate::files;
use crate::host::unnamed;
use crate::identity::ProcessIdentity;
use crate::secrets;
use crate::store::{Record, Supervised};
use crate::supervisor::spec::Spec;

/// Where the supervisor stands in a container.
const SUPERVISOR: &str = "/.ictus/ictus";
/// Between two looks at whether a supervisor listens.
const LOOK_EVERY: Duration = Duration::from_millis(20);
/// Between two looks at whether its container still runs.
const INSPECT_EVERY: Duration = Duration::from_millis(200);
/// How long the engine may take to notice that memory was used up.
const NOTICE_MAX: Duration = Duration::from_secs(1);

mod limits;

use limits::Limit;

/// A member's container, made or not.
#[derive(Clone, Debug)]
pub(crate) struct Contained {
    /// Its name; in the record before it is made.
    name: String,
    labels: BTreeMap<String, String>,
    instance: String,
    source: Source,
    needs: Needs,
    /// Files that the member reads.
    files: Vec<PathBuf>,
    /// The directory of its secrets, if it has any.
    secrets: Option<PathBuf>,
    /// Directories that the member writes.
    directories: Vec<PathBuf>,
    /// The directory of its socket, which is its alone.
    socket_directory: PathBuf,
}

/// What becomes of a federation's images when its containers are removed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Images {
    /// The next run needs them.
    Keep,
    /// Those that nothing uses go, too.
    Remove,
}

/// Where a container's image comes from.
#[derive(Clone, Debug)]
enum Source {
    /// It is made of this program.
    Program(PathBuf),
    /// It is made of this executable: the RTI.
    Own,
    /// It has a name.
    Image(String),
}

/// A container that was made or found, and is ours.
#[derive(Clone, Debug)]
pub(crate) struct Handle {
    engine: Engine,
    id: String,
    limited: bool,
}

/// Why a container's supervisor cannot be talked to.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ContainerError {
    /// The engine refused.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// The image cannot be made, or says nothing that could be executed.
    #[error("{0}")]
    Image(String),
    /// A file or directory of the run cannot be prepared.
    #[error("cannot prepare {path}: {source}", path = path.display())]
    Io { path: PathBuf, source: io::Error },
    /// The executable was replaced while the daemon runs.
    #[error(
        "this daemon's executable was replaced, and cannot be mounted into a container: start ictusd again"
    )]
    Replaced,
    /// The container ended, or its supervisor did not listen in time.
    #[error("its supervisor does not listen: {0}")]
    Silent(String),
}

impl Contained {
    /// A member's container, if it is to have one.
    pub(super) fn of(run: &Run<'_>, member: MemberId, supervised: &Supervised) -> Option<Self> {
        let name = supervised.container.clone()?;
        let federate = match member {
            MemberId::Rti => None,
            MemberId::Federate(index) => run.request.federates.get(usize::from(index)),
        };
        let source = match federate {
            None => Source::Own,
            Some(federate) => match &federate.needs.image {
                Some(image) => Source::Image(image.clone()),
                None => Source::Program(run.executable(federate)),
            },
        };
        let member_name = federate.map_or(RTI, |federate| &federate.name);
        let labels = [
            (label::FEDERATION, run.record.view.name.as_str()),
            (label::MEMBER, member_name),
            (label::INSTANCE, &supervised.instance),
            (label::GENERATION, &run.record.view.id),
        ];
        let exits = run
            .directory
            .exit_record(member_name)
            .parent()
            .map(Path::to_path_buf);
        let mut directories = vec![run.directory.logs(), run.directory.work()];
        directories.extend([run.directory.trace(), run.directory.timing()]);
        directories.extend(exits);
        let mut files = vec![run.directory.plan(), run.directory.spec(member_name)];
        if let Some(papers) = run.papers(member_name) {
            files.extend(Papers::FILES.map(|file| papers.join(file)));
        }
        let mut needs = federate
            .map(|federate| federate.needs.clone())
            .unwrap_or_default();
        // By number: the image need not know who that is.
        let unnamed = || unnamed(run.paths).map(|account| account.numbers());
        needs.user = needs.user.or_else(unnamed);
        Some(Self {
            name,
            labels: labels
                .map(|(name, value)| (name.to_owned(), value.to_owned()))
                .into(),
            instance: supervised.instance.clone(),
            source,
            needs,
            secrets: federate
                .filter(|federate| !federate.needs.secrets.is_empty())
                .and_then(|federate| {
                    let kept = run.record.secrets.as_ref()?;
                    Some(secrets::directory(kept, &federate.name))
                }),
            files,
            directories,
            socket_directory: supervised
                .socket
                .parent()
                .unwrap_or(Path::new(""))
                .to_path_buf(),
        })
    }

    /// Writes the spec, makes the container and starts it; nothing is left of it when that fails.
    pub(super) async fn launch(&self, spec: &Spec, path: &Path) -> Result<Handle, ContainerError> {
        let engine = Engine::connect().await?;
        let executable = own_executable()?;
        let mut spec = spec.clone();
        let image = match &self.source {
            Source::Own => provide(&engine, &executable, &self.labels).await?,
            Source::Program(program) => {
                spec.program = PROGRAM.into();
                provide(&engine, program, &self.labels).await?
            }
            Source::Image(image) => self.take_over(&engine, image, &mut spec).await?,
        };
        let text = serde_json::to_vec_pretty(&spec).map_err(|error| failed(path, error.into()))?;
        fs::write(path, text).map_err(|error| failed(path, error))?;
        self.open_directories()?;
        let container = self.container_spec(image, &executable, path);
        let id = engine
            .run(&container)
            .await
            .inspect_err(|_| self.remove_socket())?;
        Ok(Handle {
            engine,
            id,
            limited: self.needs.memory.is_some(),
        })
    }

    /// Finds the container of an earlier daemon.
    pub(super) async fn find(&self) -> Result<Found, EngineError> {
        let engine = Engine::connect().await?;
        Ok(match engine.inspect(&self.name).await? {
            None => Found::Nothing,
            Some(found) if !is_of(&found, &self.instance) => Found::Foreign,
            Some(found) => Found::Own(Handle {
                engine,
                id: found.id,
                limited: self.needs.memory.is_some(),
            }),
        })
    }

    /// Whether a user of its own runs it.
    pub(super) fn has_user(&self) -> bool {
        self.needs.user.is_some()
    }

    /// Removes the directory of the socket, and what a killed supervisor left in it.
    pub(super) fn remove_socket(&self) {
        remove_directory(&self.socket_directory);
    }

    /// What an image executes comes before the arguments that a federate gets; its environment before the manifest's. Gives
    /// the name by which a container is made from it.
    async fn take_over(
        &self,
        engine: &Engine,
        image: &str,
        spec: &mut Spec,
    ) -> Result<String, ContainerError> {
        let doing = || format!("create container `{}`", self.name);
        let federation = &self.labels[label::FEDERATION];
        let found = engine.resolve(federation, image).await?;
        let (name, found) = found.ok_or_else(|| EngineError::ImageMissing {
            doing: doing(),
            image: image.to_owned(),
        })?;
        let command = if found.entrypoint.is_empty() {
            found.cmd
        } else {
            found.entrypoint
        };
        let mut command = command.into_iter();
        let program = command.next().ok_or_else(|| {
            ContainerError::Image(format!("image {image} has neither ENTRYPOINT nor CMD: give it one that executes the federate"))
        })?;
        spec.program = program.into();
        spec.args = command.chain(spec.args.drain(..)).collect();
        for variable in found.env {
            if let Some((name, value)) = variable.split_once('=') {
                spec.env
                    .entry(name.to_owned())
                    .or_insert_with(|| value.to_owned());
            }
        }
        if !found.workdir.is_empty() {
            spec.cwd = found.workdir.into();
        }
        Ok(name)
    }

    fn container_spec(&self, image: String, executable: &Path, spec: &Path) -> ContainerSpec {
        let own = || {
            format!(
                "{}:{}",
                rustix::process::geteuid().as_raw(),
                rustix::process::getegid().as_raw()
            )
        };
        let mut mounts = vec![Binding {
            host: executable.to_path_buf(),
            inside: SUPERVISOR.into(),
            read_only: true,
        }];
        mounts.extend(self.files.iter().map(|path| Binding::same(path, true)));
        mounts.extend(self.secrets.iter().map(|path| Binding {
            host: path.clone(),
            inside: secrets::INSIDE.into(),
            read_only: true,
        }));
        let directories = self.directories.iter().chain([&self.socket_directory]);
        mounts.extend(directories.map(|path| Binding::same(path, false)));
        let mut container = ContainerSpec {
            name: self.name.clone(),
            image,
            labels: self.labels.clone(),
            entrypoint: vec![
                SUPERVISOR.to_owned(),
                "supervise".to_owned(),
                spec.to_string_lossy().into_owned(),
            ],
            user: self.needs.user.clone().unwrap_or_else(own),
            workdir: "/".into(),
            mounts,
            // What somebody else's image writes where, we do not know.
            read_only_root: !matches!(self.source, Source::Image(_)),
            ..ContainerSpec::default()
        };
        container.needs(&self.needs);
        container
    }

    /// Makes the socket's directory, and lets another user in. The parents stay private, so nobody else comes there.
    fn open_directories(&self) -> Result<(), ContainerError> {
        let socket = &self.socket_directory;
        files::remove(socket)
            .and_then(|()| fs::create_dir_all(socket))
            .map_err(|error| failed(socket, error))?;
        let (of_directories, of_files) = if self.has_user() {
            (0o777, 0o644)
        } else {
            (0o700, 0o600)
        };
        let directories = self
            .directories
            .iter()
            .chain([socket])
            .map(|path| (path, of_directories));
        for (path, mode) in directories.chain(self.files.iter().map(|path| (path, of_files))) {
            // A directory that members of several users share stays open.
            let mode = if path == socket || self.has_user() {
                mode
            } else {
                continue;
            };
            fs::set_permissions(path, fs::Permissions::from_mode(mode))
                .map_err(|error| failed(path, error))?;
        }
        Ok(())
    }
}

/// What has a container's name.
#[derive(Debug)]
#[expect(
    clippy::large_enum_variant,
    reason = "one at a time, and gone when it is looked at"
)]
pub(super) enum Found {
    /// No container.
    Nothing,
    /// The one with the record's instance id.
    Own(Handle),
    /// Another one.
    Foreign,
}

impl Handle {
    /// Connects to the supervisor; waits until it listens, but not longer than its container runs.
    pub(super) async fn connect(
        &self,
        socket: &Path,
        at_most: Duration,
    ) -> Result<UnixStream, ContainerError> {
        let until = Instant::now() + at_most;
        let mut inspected = Instant::now();
        loop {
            if let Ok(stream) = UnixStream::connect(socket).await {
                return Ok(stream);
            }
            if inspected.elapsed() >= INSPECT_EVERY {
                inspected = Instant::now();
                let found = self.engine.inspect(&self.id).await?;
                if found.as_ref().is_none_or(|found| !found.running) || Instant::now() >= until {
                    return Err(ContainerError::Silent(self.complaint(found).await));
                }
            }
            sleep(LOOK_EVERY).await;
        }
    }

    async fn complaint(&self, found: Option<Container>) -> String {
        let said = self.engine.log_tail(&self.id).await;
        let Some(found) = found else {
            return "its container was removed by somebody".to_owned();
        };
        let how = match (found.running, found.oom_killed, found.exit_code) {
            (true, ..) => "it was waited for in vain".to_owned(),
            (false, true, _) => "its container's memory limit (`memory:`) is too small".to_owned(),
            (false, false, Some(code)) => format!("its container ended with exit code {code}"),
            (false, false, None) => format!("its container never ran {}", found.error),
        };
        if said.is_empty() {
            how
        } else {
            format!("{how}: {said}")
        }
    }

    /// Whether this process is the container's first one.
    pub(super) async fn begins_with(&self, pid: u32) -> Result<bool, String> {
        let found = self
            .engine
            .inspect(&self.id)
            .await
            .map_err(|error| error.to_string())?;
        Ok(found.and_then(|found| found.pid) == Some(pid))
    }

    /// Whether the container's memory was used up. While its first process is there the kernel tells; afterwards the
    /// engine does, in a moment.
    pub(super) async fn out_of_memory(&self, first: Option<u32>) -> bool {
        if !self.limited {
            return false;
        }
        let killed = first.and_then(|pid| limits::count(pid, Limit::Memory));
        if let Some(killed) = killed {
            return killed > 0;
        }
        let noticed = async {
            loop {
                match self.engine.inspect(&self.id).await {
                    Ok(Some(found)) if found.oom_killed => return true,
                    Ok(Some(_)) => sleep(LOOK_EVERY).await,
                    Ok(None) | Err(_) => return false,
                }
            }
        };
        timeout(NOTICE_MAX, noticed).await.unwrap_or(false)
    }

    /// How often a process or thread was refused because there were too many.
    pub(super) fn processes_refused(&self, first: u32) -> u64 {
        limits::count(first, Limit::Processes).unwrap_or(0)
    }

    /// Removes the container, whatever runs in it.
    pub(super) async fn remove(&self) {
        self.engine.remove_or_warn(&self.id).await;
    }
}

/// Makes sure that the images of a host's members are there, or says what is missing.
pub(crate) async fn prepare(run: &Run<'_>, members: &[MemberId]) -> Result<(), ContainerError> {
    let engine = Engine::connect().await?;
    let executable = own_executable()?;
    for member in members {
        let supervised = Supervised {
            container: Some(String::new()),
            ..Supervised::default()
        };
        let Some(contained) = Contained::of(run, *member, &supervised) else {
            continue;
        };
        match &contained.source {
            Source::Own => provide(&engine, &executable, &contained.labels)
                .await
                .map(drop)?,
            Source::Program(program) => provide(&engine, program, &contained.labels)
                .await
                .map(drop)?,
            Source::Image(image) => {
                let doing = format!("prepare {}", contained.labels[label::MEMBER]);
                let federation = &contained.labels[label::FEDERATION];
                engine.keep(&doing, (federation, image)).await?;
            }
        }
    }
    Ok(())
}

/// Removes containers of a run that are provably ours, and the images that nothing uses any more if they are to go.
pub(crate) async fn sweep(
    federation: &str,
    record: Option<&Record>,
    images: Images,
) -> Result<(), EngineError> {
    let engine = Engine::connect().await?;
    let members = record
        .into_iter()
        .flat_map(|record| record.members.values());
    for supervised in members {
        let (Some(name), Some(directory)) = (&supervised.container, supervised.socket.parent())
        else {
            continue;
        };
        let found = engine.inspect(name).await?;
        if let Some(found) = found.filter(|found| is_of(found, &supervised.instance)) {
            engine.remove(&found.id).await?;
        }
        if directory.ends_with(&supervised.instance) {
            remove_directory(directory);
        }
    }
    for left in engine.list(&[(label::FEDERATION, federation)]).await? {
        tracing::warn!(
            container = left.name,
            federation,
            "foreign: it has our label, but is in no record of ours; left alone"
        );
    }
    if images == Images::Remove {
        engine
            .remove_images((label::FEDERATION, federation))
            .await?;
    }
    Ok(())
}

fn remove_directory(path: &Path) {
    if let Err(error) = files::remove(path) {
        tracing::warn!(%error, directory = %path.display(), "not removed");
    }
}

fn is_of(found: &Container, instance: &str) -> bool {
    found
        .labels
        .get(label::INSTANCE)
        .is_some_and(|found| found == instance)
}

/// Makes a program's image, unless it is there. It has the federation's label, so that it is removed with it.
async fn provide(
    engine: &Engine,
    program: &Path,
    labels: &BTreeMap<String, String>,
) -> Result<String, ContainerError> {
    let label = labels.get_key_value(label::FEDERATION);
    let labels = label
        .map(|(name, value)| (name.clone(), value.clone()))
        .into_iter()
        .collect();
    let program = program.to_path_buf();
    let archive =
        tokio::task::spawn_blocking(move || Archive::of(&program, &ImageConfig { labels }));
    let archive = archive
        .await
        .map_err(|error| ContainerError::Image(error.to_string()))?;
    let archive =
        archive.map_err(|error| ContainerError::Image(crate::host::with_sources(&error)))?;
    Ok(engine.provide(archive).await?)
}

/// The file of the running executable, which must run in an image that holds nothing else.
fn own_executable() -> Result<PathBuf, ContainerError> {
    let link = Path::new("/proc/self/exe");
    let path = fs::read_link(link).map_err(|error| failed(link, error))?;
    if !path.exists() {
        return Err(ContainerError::Replaced);
    }
    let machine = Machine::of(&path).and_then(|machine| machine.check_alone(&path));
    machine.map_err(|error| ContainerError::Image(crate::host::with_sources(&error)))?;
    Ok(path)
}

/// The identity, as this host sees it, of a process that claims one inside its container.
pub(super) fn see(pid: u32, claimed: ProcessIdentity) -> Result<ProcessIdentity, String> {
    let seen = ProcessIdentity::seen(pid, claimed.pid_namespace)
        .map_err(|error| format!("cannot look at its supervisor, process {pid}: {error}"))?;
    if (seen.start_time, seen.pid_namespace) == (claimed.start_time, claimed.pid_namespace) {
        Ok(seen)
    } else {
        Err("its supervisor is another process than it says".to_owned())
    }
}

/// The pid by which this host knows a child of a container's first process.
pub(super) fn host_pid(first: u32, inside: u32) -> Option<u32> {
    let children = fs::read_to_string(format!("/proc/{first}/task/{first}/children")).ok()?;
    let mut children = children
        .split_ascii_whitespace()
        .filter_map(|pid| pid.parse().ok());
    children.find(|pid: &u32| {
        let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
        let known_as = status.lines().find_map(|line| line.strip_prefix("NSpid:"));
        known_as.and_then(|pids| pids.split_ascii_whitespace().last()?.parse().ok()) == Some(inside)
    })
}

fn failed(path: &Path, source: io::Error) -> ContainerError {
    ContainerError::Io {
        path: path.to_path_buf(),
        source,
    }
}
