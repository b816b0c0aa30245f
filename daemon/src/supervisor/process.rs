//! The supervised process: its start, its pipes, its signals, its end.

use std::ffi::OsStr;
use std::fs;
use std::io::{self, Read};
use std::os::fd::{AsRawFd, OwnedFd};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};

use rustix::io::FdFlags;
use rustix::pipe::{PipeFlags, fcntl_setpipe_size, pipe_with};
use rustix::process::{Pid, PidfdFlags, Signal, WaitOptions, pidfd_open, pidfd_send_signal};

use super::exit::Ending;
use super::protocol::StopSignal;
use super::shim;
use super::spec::Spec;

/// What the status pipe holds, if the system gives so much: measures are dropped when it is full.
const STATUS_PIPE_BYTES: usize = 1 << 20;

/// A process and the ends of its pipes that are ours.
#[derive(Debug)]
pub(crate) struct Process {
    child: Child,
    /// Readable when the process has ended.
    pub(crate) pidfd: OwnedFd,
    pub(crate) out: Option<OwnedFd>,
    pub(crate) err: Option<OwnedFd>,
    pub(crate) status: Option<OwnedFd>,
}

impl Process {
    /// Starts the process and waits until its program is executed.
    ///
    /// # Errors
    /// The reason in words when it is not.
    pub(crate) fn start(spec: &Spec) -> Result<Self, String> {
        let said = |what: &'static str| move |error: io::Error| format!("{what}: {error}");
        let limits = serde_json::to_string(&spec.limits).map_err(|error| error.to_string())?;
        let prepared = command(spec, &limits).map_err(said("cannot prepare its pipes"));
        let (mut command, status) = prepared?;
        let (report, report_ours) = pipe_with(PipeFlags::CLOEXEC)
            .map_err(|error| format!("cannot make a pipe: {error}"))?;
        command.stdin(Stdio::from(report_ours));
        let mut child = command.spawn().map_err(said("cannot start a process"))?;
        let (status, status_theirs) = status.unzip();
        // Our copies of their ends: the pipes end when the process does.
        drop(status_theirs);
        drop(command);
        let mut why = String::new();
        fs::File::from(report)
            .read_to_string(&mut why)
            .map_err(said("cannot learn whether it was executed"))?;
        if !why.is_empty() {
            child.wait().map_err(said("cannot wait for it"))?;
            return Err(format!("{}: {why}", spec.program.display()));
        }
        let pid = i32::try_from(child.id()).ok().and_then(Pid::from_raw);
        let pidfd = pid
            .ok_or(io::ErrorKind::InvalidData.into())
            .and_then(|pid| Ok(pidfd_open(pid, PidfdFlags::empty())?))
            .map_err(said("cannot open its pidfd"))?;
        let out = child.stdout.take().map(OwnedFd::from);
        let err = child.stderr.take().map(OwnedFd::from);
        Ok(Self {
            child,
            pidfd,
            out,
            err,
            status,
        })
    }

    /// The process id.
    pub(crate) fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Sends a signal; that the process has just ended is no error.
    pub(crate) fn signal(&self, signal: StopSignal) -> io::Result<()> {
        let signal = match signal {
            StopSignal::Term => Signal::TERM,
            StopSignal::Kill => Signal::KILL,
        };
        match pidfd_send_signal(&self.pidfd, signal) {
            Ok(()) | Err(rustix::io::Errno::SRCH) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }

    /// Takes the exit status after `pidfd` became readable.
    pub(crate) fn wait(&mut self) -> Ending {
        self.child.wait().map_or(Ending::Unknown, Ending::of)
    }
}

/// A pipe for statuses: our end and theirs.
type StatusPipe = Option<(OwnedFd, OwnedFd)>;

fn command(spec: &Spec, limits: &str) -> io::Result<(Command, StatusPipe)> {
    let mut command = Command::new(own_executable());
    command
        .arg0("ictus")
        .args([
            OsStr::new(shim::COMMAND),
            OsStr::new(&std::process::id().to_string()),
            OsStr::new(limits),
        ])
        .arg(&spec.program)
        .args(&spec.args)
        .env_clear()
        .envs(&spec.env)
        .current_dir(&spec.cwd)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    if !spec.status {
        return Ok((command, None));
    }
    let (ours, theirs) = pipe_with(PipeFlags::CLOEXEC)?;
    if let Some(account) = &spec.limits.account {
        account.own(&theirs)?;
    }
    // Without it a federate with many peers drops more of its measures.
    fcntl_setpipe_size(&ours, STATUS_PIPE_BYTES).ok();
    // Inherited by the one process that this single-threaded program starts.
    rustix::io::fcntl_setfd(&theirs, FdFlags::empty())?;
    command
        .arg("--status-fd")
        .arg(theirs.as_raw_fd().to_string());
    Ok((command, Some((ours, theirs))))
}

/// The running executable, also after its file was replaced or removed.
pub(crate) fn own_executable() -> &'static Path {
    Path::new("/proc/self/exe")
}

/// Ends what a process that has been waited for left behind: its orphans are children of the supervisor, which is a
/// subreaper. Bounded: a child that forks faster than it is killed must not hold the supervisor for ever.
pub(crate) fn kill_orphans() {
    for _ in 0..100 {
        match rustix::process::wait(WaitOptions::NOHANG) {
            Err(_) => return,
            Ok(Some(_)) => {}
            Ok(None) => {
                for pid in own_children() {
                    // Our own unreaped child: its pid cannot be another's.
                    let Ok(pidfd) = pidfd_open(pid, PidfdFlags::empty()) else {
                        continue;
                    };
                    if pidfd_send_signal(&pidfd, Signal::KILL).is_ok() {
                        wait_readable(&pidfd);
                    }
                }
            }
        }
    }
}

/// Takes the exit statuses of children that have ended, but not of this one, which is waited for.
pub(crate) fn reap_orphans(but: Option<u32>) {
    let but = but.and_then(|pid| Pid::from_raw(i32::try_from(pid).ok()?));
    for pid in own_children().into_iter().filter(|pid| Some(*pid) != but) {
        // One that lives on is asked again when it ends.
        match rustix::process::waitpid(Some(pid), WaitOptions::NOHANG) {
            Ok(_) | Err(_) => {}
        }
    }
}

fn wait_readable(pidfd: &OwnedFd) {
    let mut fds = [rustix::event::PollFd::new(
        pidfd,
        rustix::event::PollFlags::IN,
    )];
    let bound = rustix::event::Timespec {
        tv_sec: 1,
        tv_nsec: 0,
    };
    match rustix::event::poll(&mut fds, Some(&bound)) {
        Ok(_) | Err(_) => {}
    }
}

fn own_children() -> Vec<Pid> {
    let own = std::process::id();
    let listed = fs::read_to_string(format!("/proc/{own}/task/{own}/children")).unwrap_or_default();
    let pids = listed
        .split_ascii_whitespace()
        .filter_map(|pid| pid.parse().ok());
    pids.filter_map(Pid::from_raw).collect()
}
