//! A home for one test: nothing of the user's environment gets in, nothing that ran gets out.

use std::fmt;
use std::fs;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStderr, Command, Output, Stdio};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::process::{Pid, PidfdFlags, Signal, kill_process, pidfd_open};
use tempfile::TempDir;

/// How long a command may take to end.
const BOUND: Duration = Duration::from_secs(60);

pub(crate) struct Environment {
    directory: TempDir,
}

/// What a command said.
pub(crate) struct Said {
    pub(crate) code: i32,
    pub(crate) out: String,
    pub(crate) err: String,
}

/// A command that goes on while the test looks.
pub(crate) struct Going {
    pub(crate) child: Child,
    err: BufReader<ChildStderr>,
}

impl Environment {
    pub(crate) fn new() -> Self {
        Self {
            directory: tempfile::tempdir().unwrap(),
        }
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    pub(crate) fn state(&self) -> PathBuf {
        self.path("s")
    }

    pub(crate) fn write(&self, name: &str, text: &str) {
        let fixture = ictus().with_file_name("examples").join("fixture");
        let text = text.replace("FIXTURE_PROGRAM", fixture.to_str().unwrap());
        fs::write(self.path(name), text).unwrap();
    }

    pub(crate) fn command(&self, args: &[&str]) -> Command {
        let mut command = Command::new(ictus());
        command
            .args(args)
            .env_clear()
            .env("PATH", std::env::var_os("PATH").unwrap())
            .env("HOME", self.directory.path())
            .env("ICTUS_STATE_DIR", self.state())
            .env("ICTUS_DAEMON_IDLE_MS", "10000")
            .current_dir(self.directory.path())
            .stdin(Stdio::null());
        command
    }

    /// Runs a command to its end.
    pub(crate) fn run(&self, args: &[&str]) -> Said {
        self.said(&self.command(args).output().unwrap())
    }

    pub(crate) fn start(&self, args: &[&str]) -> Going {
        let mut command = self.command(args);
        let mut child = command
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let err = BufReader::new(child.stderr.take().unwrap());
        Going { child, err }
    }

    fn said(&self, output: &Output) -> Said {
        let text = |bytes: &[u8]| {
            let text = String::from_utf8(bytes.to_vec()).unwrap();
            assert!(!text.contains('\x1b'), "colours without a terminal: {text}");
            text.replace(self.directory.path().to_str().unwrap(), "HOME")
        };
        let code = output.status.code().unwrap();
        Said {
            code,
            out: text(&output.stdout),
            err: text(&output.stderr),
        }
    }
}

impl Drop for Environment {
    fn drop(&mut self) {
        for name in ictusd::store::names(&self.state().join("federations")) {
            self.command(&["down", &name, "--purge"]).output().ok();
        }
    }
}

impl Said {
    #[track_caller]
    pub(crate) fn ok(self) -> Self {
        assert_eq!(self.code, 0, "{self}");
        self
    }
}

impl fmt::Display for Said {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { code, out, err } = self;
        write!(
            f,
            "exit code {code}\n-- standard output\n{out}-- standard error\n{err}"
        )
    }
}

impl Going {
    /// Reads standard error until a line holds this text.
    pub(crate) fn wait_for(&mut self, text: &str) {
        let mut line = String::new();
        while !line.contains(text) {
            line.clear();
            let read = self.err.read_line(&mut line).unwrap();
            assert!(read > 0, "standard error ended before {text:?}");
        }
    }

    pub(crate) fn interrupt(&self) {
        let pid = i32::try_from(self.child.id())
            .ok()
            .and_then(Pid::from_raw)
            .unwrap();
        kill_process(pid, Signal::INT).unwrap();
    }

    /// The exit code, and the rest of standard error.
    pub(crate) fn end(mut self) -> (i32, String) {
        let pid = i32::try_from(self.child.id())
            .ok()
            .and_then(Pid::from_raw)
            .unwrap();
        let pidfd = pidfd_open(pid, PidfdFlags::empty()).unwrap();
        let mut fds = [PollFd::new(&pidfd, PollFlags::IN)];
        let ended = poll(&mut fds, Some(&Timespec::try_from(BOUND).unwrap())).unwrap() == 1;
        if !ended {
            self.child.kill().unwrap();
        }
        let mut rest = String::new();
        std::io::Read::read_to_string(&mut self.err, &mut rest).unwrap();
        assert!(ended, "it goes on: {rest}");
        (self.child.wait().unwrap().code().unwrap(), rest)
    }
}

fn ictus() -> &'static Path {
    Path::new(env!("CARGO_BIN_EXE_ictus"))
}
