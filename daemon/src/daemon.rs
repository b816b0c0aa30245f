//! The daemon's life: lock, socket, adoption, service, end.

use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::MetadataExt;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rustix::fs::{FlockOperation, Mode, flock};
use tokio::net::UnixListener;
use tokio::signal::unix::{SignalKind, signal};

use crate::files;
use crate::host::Host;
use crate::installation::{ConfigError, Shared};
use crate::paths::{Owner, Paths, PathsError};
use crate::server::{OwnListener, callers, router, viewer};

/// What a daemon prints on standard output once it, or another one, serves.
pub const READY: &str = "ready";
/// The variable that says after how many milliseconds without anything owned the daemon ends.
pub const IDLE_VARIABLE: &str = "ICTUS_DAEMON_IDLE_MS";

/// How long a daemon that owns nothing stays.
const IDLE_DEFAULT: Duration = Duration::from_secs(60);
/// How long another daemon that holds the lock may take to serve or to end.
const LOCK_MAX: Duration = Duration::from_secs(5);
const LOCK_PERIOD: Duration = Duration::from_millis(20);
/// How long open connections may hold the end.
const GOODBYE_MAX: Duration = Duration::from_secs(1);

/// Why a daemon could not serve.
#[derive(Debug, thiserror::Error)]
pub enum DaemonError {
    /// It has no place.
    #[error(transparent)]
    Paths(#[from] PathsError),
    /// What the owner of the host has decided cannot be gone by.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// Another one holds the lock but does not answer. Wait, or end it.
    #[error("another daemon holds {lock} and does not answer", lock = lock.display())]
    Locked {
        /// The lock file.
        lock: PathBuf,
    },
    /// The system refused what a daemon needs.
    #[error("cannot {what}")]
    System {
        /// What was tried.
        what: &'static str,
        /// Why it failed.
        source: io::Error,
    },
}

/// How the daemon ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Served {
    /// It served and ended: nothing was owned any more, or a signal came. Federations that live go on.
    Done,
    /// Another one serves already.
    ByAnother,
}

/// Serves until nothing has been owned for the idle time, or SIGTERM or SIGINT comes.
///
/// # Errors
/// See [`DaemonError`].
pub fn run(paths: &Paths) -> Result<Served, DaemonError> {
    // Fails only for a group leader, which a shell makes of us; a Ctrl-C there is meant for us.
    rustix::process::setsid().ok();
    let mut paths = paths.clone();
    if paths.of_host() {
        paths.owner = Owner::Host(Some(Shared::read()?));
        // Others may enter its directories; what they may read is opened to them by name.
        rustix::process::umask(Mode::from_raw_mode(0o077));
    }
    let paths = &paths;
    paths.create()?;
    let Some(lock) = Lock::acquire(paths)? else {
        announce()?;
        return Ok(Served::ByAnother);
    };
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build();
    let served = runtime
        .map_err(system("start the runtime"))?
        .block_on(serve(paths));
    for socket in [paths.socket(), paths.viewer_socket()] {
        files::remove(&socket).map_err(system("remove the socket"))?;
    }
    lock.release();
    if served.is_ok() {
        clean(paths);
    }
    served.map(|()| Served::Done)
}

/// Writes the daemon's own log to standard error, from `info` up or as `ICTUS_LOG` says.
pub fn log_to_stderr() {
    let filter = tracing_subscriber::EnvFilter::try_from_env("ICTUS_LOG")
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("info"));
    let subscriber = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_ansi(false);
    // Fails when there is a subscriber already, which then is the one to use.
    subscriber.with_writer(io::stderr).try_init().ok();
}

async fn serve(paths: &Paths) -> Result<(), DaemonError> {
    let listener = bind(paths, &paths.socket())?;
    let viewers = bind(paths, &paths.viewer_socket())?;
    let mut terminate = signal(SignalKind::terminate()).map_err(system("watch signals"))?;
    let mut interrupt = signal(SignalKind::interrupt()).map_err(system("watch signals"))?;
    let host = Host::new(paths.clone());
    host.adopt_all().await;
    announce()?;
    tracing::info!(socket = %paths.socket().display(), "serving");
    let (end, ended) = tokio::sync::oneshot::channel::<()>();
    let listen = |listener| OwnListener::new(listener, paths);
    let server = axum::serve(listen(listener), callers(router(host.clone())))
        .with_graceful_shutdown(async move { ended.await.unwrap_or(()) });
    let server = tokio::spawn(server.into_future());
    // Who only looks is not waited for at the end.
    let viewers = axum::serve(listen(viewers), callers(viewer::router(host.clone())));
    let viewers = tokio::spawn(viewers.into_future());
    tokio::select! {
        () = idle(&host, idle_after()), if !paths.of_host() => tracing::info!("nothing owned"),
        () = host.ended() => tracing::info!("asked to end"),
        _ = terminate.recv() => tracing::info!("SIGTERM"),
        _ = interrupt.recv() => tracing::info!("SIGINT"),
    }
    end.send(()).ok();
    viewers.abort();
    tokio::time::timeout(GOODBYE_MAX, server).await.ok();
    Ok(())
}

/// Listens; we hold the lock, so a socket that is there is a dead daemon's.
fn bind(paths: &Paths, path: &Path) -> Result<UnixListener, DaemonError> {
    files::remove(path).map_err(system("remove a stale socket"))?;
    let listener = UnixListener::bind(path).map_err(system("bind the socket"))?;
    let admitted = paths.admit_group(path, 0o660);
    admitted.map_err(system("let the group come to the socket"))?;
    Ok(listener)
}

fn idle_after() -> Duration {
    let given = std::env::var(IDLE_VARIABLE)
        .ok()
        .and_then(|text| text.parse().ok());
    given.map_or(IDLE_DEFAULT, Duration::from_millis)
}

/// Waits until nothing was asked for or owned for a while.
async fn idle(host: &Host, idle_after: Duration) {
    loop {
        let until = host.last_active() + idle_after;
        tokio::time::sleep_until(until).await;
        if host.last_active() + idle_after <= tokio::time::Instant::now() {
            return;
        }
    }
}

fn announce() -> Result<(), DaemonError> {
    let mut out = io::stdout().lock();
    match writeln!(out, "{READY}").and_then(|()| out.flush()) {
        // Who started us does not wait any more.
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => {
            Err(system("report readiness")(error))
        }
        Ok(()) | Err(_) => Ok(()),
    }
}

/// Removes directories that hold nothing, and with the state directory's last record the daemon's log.
fn clean(paths: &Paths) {
    if !paths.federations().exists() {
        files::remove(&paths.daemon_log()).ok();
        // With the last record its MACs are gone.
        files::remove(&paths.secrets_key()).ok();
    }
    for directory in [&paths.run, &paths.state] {
        // Fails when something is in it.
        std::fs::remove_dir(directory).ok();
    }
}

fn system(what: &'static str) -> impl Fn(io::Error) -> DaemonError {
    move |source| DaemonError::System { what, source }
}

/// The lock that makes one daemon at a time: its file is removed at the end.
#[derive(Debug)]
struct Lock {
    file: File,
    path: PathBuf,
}

impl Lock {
    /// Takes the lock; absent when another daemon holds it and serves.
    fn acquire(paths: &Paths) -> Result<Option<Self>, DaemonError> {
        let path = paths.lock();
        let tries = LOCK_MAX.as_millis() / LOCK_PERIOD.as_millis();
        for _ in 0..tries {
            // One that ends removes an empty directory.
            paths.create()?;
            let mut options = OpenOptions::new();
            let file = options
                .read(true)
                .write(true)
                .create(true)
                .truncate(false)
                .open(&path);
            let file = file.map_err(system("open the lock"))?;
            match flock(&file, FlockOperation::NonBlockingLockExclusive) {
                Ok(()) if is_at(&file, &path) => {
                    let socket = paths.socket();
                    file.set_len(0).map_err(system("write the lock"))?;
                    (&file)
                        .write_all(socket.as_os_str().as_bytes())
                        .map_err(system("write the lock"))?;
                    return Ok(Some(Self { file, path }));
                }
                // Removed by who held it; there may be another by now.
                Ok(()) => continue,
                Err(rustix::io::Errno::WOULDBLOCK) => {}
                Err(error) => return Err(system("lock")(error.into())),
            }
            let serves = |socket: PathBuf| UnixStream::connect(socket).is_ok();
            if paths.socket_in_lock().is_some_and(serves) {
                return Ok(None);
            }
            std::thread::sleep(LOCK_PERIOD);
        }
        Err(DaemonError::Locked { lock: path })
    }

    fn release(self) {
        std::fs::remove_file(&self.path).ok();
        drop(self.file);
    }
}

fn is_at(file: &File, path: &Path) -> bool {
    let inode = |found: io::Result<std::fs::Metadata>| found.ok().map(|found| found.ino());
    inode(file.metadata()).is_some() && inode(file.metadata()) == inode(std::fs::metadata(path))
}
