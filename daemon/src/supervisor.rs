//! The supervisor: one small process per federate (and one for the RTI) that outlives the daemon.
//!
//! It owns the pipes, so that a daemon that dies neither breaks a federate's standard output nor loses its
//! exit status. It is single-threaded, waits in `poll`, and never blocks on a client. Lives and deaths:
//!
//! - the federate ends: its orphans are killed, the exit record is written, subscribers are told;
//! - the supervisor is killed: the kernel kills the federate (`PR_SET_PDEATHSIG`), no exit record is written, and the
//!   daemon reports it as vanished; grandchildren of the federate are then left to `init`;
//! - the daemon dies: nothing changes;
//! - SIGTERM or SIGINT at the supervisor is passed on to the federate.

use std::fs::Permissions;
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use nix::sys::socket::sockopt::PeerCredentials;
use rustix::event::{PollFd, PollFlags, Timespec, poll};

use crate::identity::ProcessIdentity;
use crate::{files, stamp};

mod control;
pub mod exit;
mod history;
pub mod limits;
pub(crate) mod lines;
pub(crate) mod log;
pub(crate) mod process;
pub mod protocol;
pub mod shim;
pub mod spec;

use control::{Client, Closed};
use exit::{Ending, ExitRecord};
use history::History;
use lines::Lines;
use log::{Log, Stream};
use process::Process;
use protocol::{Reply, Request, StopSignal};
use spec::{PROTOCOL, Spec, SpecError};

/// What a supervisor prints on standard output once it listens; errors go to standard error.
pub const READY: &str = "ready";

/// The longest status line; longer ones are no status.
const STATUS_BYTES_MAX: usize = 64 * 1024;
/// Connections at a time; further ones are closed at once.
const CLIENTS_MAX: usize = 32;
/// How long pipes that something still holds open are read after the process has ended.
const DRAIN_MAX: Duration = Duration::from_secs(1);

/// Why a supervisor could not do its work.
#[derive(Debug, thiserror::Error)]
pub enum SuperviseError {
    /// There is no spec.
    #[error(transparent)]
    Spec(#[from] SpecError),
    /// The system refused what a supervisor needs; fatal.
    #[error("cannot {what}")]
    System {
        /// What was tried.
        what: &'static str,
        /// Why it failed.
        source: io::Error,
    },
}

/// Runs the process of a spec to its end.
///
/// # Errors
/// See [`SuperviseError`]. That the process could not be started, or failed, is no error: the exit record says so.
pub fn run(spec: &Path) -> Result<(), SuperviseError> {
    let system = |what| move |source| SuperviseError::System { what, source };
    let owner = std::fs::metadata(spec).map(|file| file.uid());
    let spec = Spec::read(spec)?;
    let owner = owner.map_err(system("look at the spec"))?;
    let mut supervisor = Supervisor::listen(spec, owner).map_err(system("listen"))?;
    announce().map_err(system("report readiness"))?;
    let socket = supervisor.spec.socket.clone();
    supervisor.start();
    let ended = supervisor.run().map_err(system("supervise"));
    files::remove(&socket).map_err(system("remove the socket"))?;
    ended
}

fn announce() -> io::Result<()> {
    use std::io::Write;
    let mut out = io::stdout().lock();
    writeln!(out, "{READY}")?;
    out.flush()
}

struct Supervisor {
    spec: Spec,
    /// Who wrote the spec: in a container the supervisor may run as somebody else.
    owner: u32,
    own: ProcessIdentity,
    listener: UnixListener,
    /// SIGTERM and SIGINT arrive here as bytes.
    signals: UnixStream,
    /// So does that a child has ended, which may be an orphan that became ours.
    children: UnixStream,
    log: Log,
    statuses: Lines,
    process: Option<Process>,
    started_ns: i64,
    history: History,
    clients: Vec<Client>,
    phase: Phase,
}

enum Phase {
    /// The process lives.
    Running,
    /// It has ended; its pipes may still hold something.
    Draining {
        ending: Ending,
        ended_ns: i64,
        until: Instant,
    },
    /// The record is written; somebody may want to read it.
    Lingering { until: Instant },
}

/// What `poll` watches.
#[derive(Clone, Copy)]
enum Watched {
    Listener,
    Signals,
    Children,
    End,
    Pipe(Pipe),
    Client(usize),
}

/// A pipe of the process.
#[derive(Clone, Copy)]
enum Pipe {
    Out,
    Err,
    Status,
}

impl Supervisor {
    fn listen(spec: Spec, owner: u32) -> io::Result<Self> {
        // Fails only for a group leader, which a shell makes of us; then the session is its own already.
        match rustix::process::setsid() {
            Ok(_) | Err(_) => {}
        }
        rustix::process::set_child_subreaper(Some(rustix::process::getpid()))?;
        let log = Log::open(&spec.log, spec.log_size_max, spec.log_files_max)?;
        let listener = UnixListener::bind(&spec.socket)?;
        if owner != rustix::process::geteuid().as_raw() {
            // The directory is private to both.
            std::fs::set_permissions(&spec.socket, Permissions::from_mode(0o666))?;
        }
        listener.set_nonblocking(true)?;
        let (signals, writer) = UnixStream::pair()?;
        signals.set_nonblocking(true)?;
        for signal in [signal_hook::consts::SIGTERM, signal_hook::consts::SIGINT] {
            signal_hook::low_level::pipe::register(signal, writer.try_clone()?)?;
        }
        let (children, writer) = UnixStream::pair()?;
        children.set_nonblocking(true)?;
        signal_hook::low_level::pipe::register(signal_hook::consts::SIGCHLD, writer)?;
        Ok(Self {
            own: ProcessIdentity::own()?,
            listener,
            signals,
            children,
            log,
            statuses: Lines::new(STATUS_BYTES_MAX),
            process: None,
            started_ns: stamp::now_ns(),
            history: History::default(),
            clients: Vec::new(),
            phase: Phase::Running,
            owner,
            spec,
        })
    }

    fn start(&mut self) {
        match Process::start(&self.spec) {
            Ok(process) => {
                self.started_ns = stamp::now_ns();
                let reply = Reply::Started {
                    pid: process.pid(),
                    at_ns: self.started_ns,
                };
                self.process = Some(process);
                self.history.started = Some(reply.clone());
                self.publish(&reply);
            }
            Err(why) => {
                self.log.remark(&why);
                self.drain(Ending::NotStarted { why }, Duration::ZERO);
            }
        }
    }

    /// The process has ended, now; its pipes are read for at most so long.
    fn drain(&mut self, ending: Ending, at_most: Duration) {
        let (ended_ns, until) = (stamp::now_ns(), Instant::now() + at_most);
        self.phase = Phase::Draining {
            ending,
            ended_ns,
            until,
        };
    }

    fn run(&mut self) -> io::Result<()> {
        loop {
            self.step();
            let timeout = match &self.phase {
                Phase::Running => None,
                Phase::Draining { until, .. } | Phase::Lingering { until } => {
                    Some(until.saturating_duration_since(Instant::now()))
                }
            };
            if matches!(self.phase, Phase::Lingering { .. }) && timeout == Some(Duration::ZERO) {
                return Ok(());
            }
            for watched in self.wait(timeout)? {
                self.handle(watched);
            }
        }
    }

    /// Moves from phase to phase when it is time.
    fn step(&mut self) {
        let Phase::Draining {
            ending,
            ended_ns,
            until,
        } = &self.phase
        else {
            return;
        };
        let drained = self.process.as_ref().is_none_or(|process| {
            process.out.is_none() && process.err.is_none() && process.status.is_none()
        });
        if drained || *until <= Instant::now() {
            let (ending, ended_ns) = (ending.clone(), *ended_ns);
            self.finish(ending, ended_ns);
        }
    }

    fn wait(&self, timeout: Option<Duration>) -> io::Result<Vec<Watched>> {
        let mut fds = vec![
            (
                Watched::Listener,
                PollFd::new(&self.listener, PollFlags::IN),
            ),
            (Watched::Signals, PollFd::new(&self.signals, PollFlags::IN)),
            (
                Watched::Children,
                PollFd::new(&self.children, PollFlags::IN),
            ),
        ];
        if let Some(process) = &self.process {
            if matches!(self.phase, Phase::Running) {
                fds.push((Watched::End, PollFd::new(&process.pidfd, PollFlags::IN)));
            }
            let pipes = [
                (Watched::Pipe(Pipe::Out), &process.out),
                (Watched::Pipe(Pipe::Err), &process.err),
                (Watched::Pipe(Pipe::Status), &process.status),
            ];
            for (watched, pipe) in pipes {
                fds.extend(
                    pipe.as_ref()
                        .map(|fd| (watched, PollFd::new(fd, PollFlags::IN))),
                );
            }
        }
        for (index, client) in self.clients.iter().enumerate() {
            let wanted = if client.has_unsent() {
                PollFlags::OUT
            } else {
                PollFlags::empty()
            };
            let fd = PollFd::new(&client.stream, PollFlags::IN | wanted);
            fds.push((Watched::Client(index), fd));
        }
        let (names, mut fds): (Vec<_>, Vec<_>) = fds.into_iter().unzip();
        let timeout = timeout.and_then(|timeout| Timespec::try_from(timeout).ok());
        match poll(&mut fds, timeout.as_ref()) {
            Ok(_) => {}
            Err(rustix::io::Errno::INTR) => return Ok(Vec::new()),
            Err(error) => return Err(error.into()),
        }
        let ready = names
            .into_iter()
            .zip(&fds)
            .filter(|(_, fd)| !fd.revents().is_empty());
        // Clients last and from the end, so that removing one does not move another that is still to come;
        // the pipes before the end, so that what a process wrote stands before it.
        let mut ready: Vec<_> = ready.map(|(name, _)| name).collect();
        ready.sort_by_key(|watched| match watched {
            Watched::Pipe(_) => (0, 0),
            Watched::End | Watched::Signals | Watched::Children => (1, 0),
            Watched::Client(index) => (2, usize::MAX - index),
            Watched::Listener => (3, 0),
        });
        Ok(ready)
    }

    fn handle(&mut self, watched: Watched) {
        match watched {
            Watched::Listener => self.accept(),
            Watched::Signals => self.pass_signal_on(),
            Watched::Children => self.reap_orphans(),
            Watched::Pipe(pipe) => self.read_pipe(pipe),
            Watched::End => self.reap(),
            Watched::Client(index) => {
                if self.serve(index).is_err() {
                    self.clients.swap_remove(index);
                }
            }
        }
    }

    fn accept(&mut self) {
        let Ok((stream, _)) = self.listener.accept() else {
            return;
        };
        // Not rustix's: from a container's inside the daemon's pid is 0, which its type does not hold.
        let ours = nix::sys::socket::getsockopt(&stream, PeerCredentials).is_ok_and(|peer| {
            [self.owner, rustix::process::geteuid().as_raw()].contains(&peer.uid())
        });
        if ours && self.clients.len() < CLIENTS_MAX {
            self.clients.extend(Client::new(stream));
        }
    }

    fn pass_signal_on(&mut self) {
        let mut bytes = [0; 64];
        if rustix::io::read(&self.signals, &mut bytes).is_ok()
            && let (Phase::Running, Some(process)) = (&self.phase, &self.process)
            && let Err(error) = process.signal(StopSignal::Term)
        {
            self.log
                .remark(&format!("cannot pass a signal on: {error}"));
        }
    }

    /// Orphans that have ended would count as processes of their container until the federate ends.
    fn reap_orphans(&mut self) {
        let mut bytes = [0; 64];
        if rustix::io::read(&self.children, &mut bytes).is_ok() {
            process::reap_orphans(self.process.as_ref().map(Process::pid));
        }
    }

    fn reap(&mut self) {
        let Some(process) = &mut self.process else {
            return;
        };
        let ending = process.wait();
        self.drain(ending, DRAIN_MAX);
        process::kill_orphans();
    }

    fn read_pipe(&mut self, pipe: Pipe) {
        let Some(process) = &mut self.process else {
            return;
        };
        let end = match pipe {
            Pipe::Out => &mut process.out,
            Pipe::Err => &mut process.err,
            Pipe::Status => &mut process.status,
        };
        let mut buffer = [0; 16 * 1024];
        let count = end.as_ref().map_or(0, |fd| read_some(fd, &mut buffer));
        if count == 0 {
            *end = None;
        }
        let bytes = &buffer[..count];
        match pipe {
            Pipe::Out => self.log.push(Stream::Out, bytes),
            Pipe::Err => self.log.push(Stream::Err, bytes),
            Pipe::Status => self.read_statuses(bytes),
        }
    }

    fn read_statuses(&mut self, bytes: &[u8]) {
        let mut found = Vec::new();
        self.statuses.push(bytes, |piece| {
            if piece.whole && !piece.continued {
                found.extend(serde_json::from_slice::<serde_json::Value>(piece.bytes));
            }
        });
        for line in found.into_iter().filter(serde_json::Value::is_object) {
            let reply = self.history.report(stamp::now_ns(), line);
            self.publish(&reply);
        }
    }

    fn publish(&mut self, reply: &Reply) {
        self.clients
            .retain_mut(|client| !client.subscribed || client.send(reply).is_ok());
    }

    /// The process has ended and its pipes are empty: writes the record and tells it.
    fn finish(&mut self, ending: Ending, ended_ns: i64) {
        self.log.finish();
        let record = ExitRecord {
            protocol: PROTOCOL,
            instance: self.spec.instance.clone(),
            name: self.spec.name.clone(),
            pid: self.process.as_ref().map(Process::pid),
            started_ns: self.started_ns,
            ended_ns,
            ending,
            last_status: self.history.last.clone(),
            reports: self.history.reports(),
            first_lines: self.log.first_lines().to_vec(),
            log_lines_lost: self.log.lost(),
        };
        if let Err(error) = record.write(&self.spec.exit_record) {
            self.log
                .remark(&format!("cannot write the exit record: {error}"));
        }
        let reply = Reply::Ended {
            record: Box::new(record),
        };
        self.history.ended = Some(reply.clone());
        self.publish(&reply);
        let linger = Duration::from_millis(self.spec.linger_ms.into());
        self.phase = Phase::Lingering {
            until: Instant::now() + linger,
        };
    }

    fn serve(&mut self, index: usize) -> Result<(), Closed> {
        self.clients[index].flush()?;
        for request in self.clients[index].read()? {
            self.answer(index, request)?;
        }
        Ok(())
    }

    fn answer(&mut self, index: usize, request: Request) -> Result<(), Closed> {
        let reply = match request {
            Request::Identify => Reply::Identity {
                protocol: PROTOCOL,
                instance: self.spec.instance.clone(),
                supervisor: self.own,
            },
            Request::Status => Reply::Status {
                pid: self.running().map(Process::pid),
                last: self.history.last.clone(),
            },
            Request::Subscribe => {
                self.clients[index].subscribed = true;
                for reply in self.history.all() {
                    self.clients[index].send(reply)?;
                }
                return Ok(());
            }
            Request::Signal { signal } => match self.running().map(|it| it.signal(signal)) {
                Some(Ok(())) => Reply::Done,
                Some(Err(error)) => Reply::Refused {
                    why: error.to_string(),
                },
                None => Reply::Refused {
                    why: "the process has ended".to_owned(),
                },
            },
            Request::Release => {
                if matches!(self.phase, Phase::Lingering { .. }) {
                    self.phase = Phase::Lingering {
                        until: Instant::now(),
                    };
                }
                Reply::Done
            }
        };
        self.clients[index].send(&reply)
    }

    fn running(&self) -> Option<&Process> {
        self.process
            .as_ref()
            .filter(|_| matches!(self.phase, Phase::Running))
    }
}

/// Reads once; an error counts as the end.
fn read_some(fd: &OwnedFd, buffer: &mut [u8]) -> usize {
    loop {
        match rustix::io::read(fd.as_fd(), &mut *buffer) {
            Ok(count) => return count,
            Err(rustix::io::Errno::INTR) => {}
            Err(_) => return 0,
        }
    }
}

/// The file in which a member's output stands.
#[must_use]
pub fn log_path(logs: &Path, member: &str) -> PathBuf {
    logs.join(format!("{member}.log"))
}
