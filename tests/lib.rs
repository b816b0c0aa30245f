//! What the end-to-end tests share: the `ictus` binary in a state directory of its own, and test hosts.

#![expect(
    clippy::unwrap_used,
    clippy::missing_panics_doc,
    clippy::panic,
    reason = "a test stops at the first surprise"
)]

pub mod rig;

use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use tempfile::TempDir;

/// Everything must be over after this many seconds; `timeout` of coreutils sees to it.
const BOUND_S: u32 = 240;

/// The root of the work tree.
#[must_use]
pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .parent()
        .unwrap()
        .to_owned()
}

/// The static binary that `.ci/static` builds, which also runs on other hosts of this processor; static programs are beside
/// it. In `target/TRIPLE/release`, beside the test's `target/debug/deps`.
#[must_use]
pub fn ictus() -> PathBuf {
    let test = std::env::current_exe().unwrap();
    let target = test.ancestors().nth(3).unwrap();
    let triple = format!("{}-unknown-linux-gnu", std::env::consts::ARCH);
    let binary = target.join(triple).join("release/ictus");
    assert!(
        binary.exists(),
        "{} is missing: `.ci/static` first, as make test does",
        binary.display()
    );
    binary
}

/// A daemon, a state directory and nothing else; all of it goes with the value.
#[derive(Debug)]
pub struct Sandbox {
    state: TempDir,
}

impl Default for Sandbox {
    fn default() -> Self {
        Self::new()
    }
}

impl Sandbox {
    /// An empty one.
    #[must_use]
    pub fn new() -> Self {
        Self {
            state: tempfile::Builder::new().prefix("ictus-").tempdir().unwrap(),
        }
    }

    /// The state directory.
    #[must_use]
    pub fn state(&self) -> &Path {
        self.state.path()
    }

    /// `ictus ARGS`, bounded in time.
    #[must_use]
    pub fn command(&self, args: &[&str]) -> Command {
        let mut command = Command::new("timeout");
        command
            .args(["--kill-after=5", &BOUND_S.to_string()])
            .arg(ictus())
            .args(args)
            .current_dir(root())
            .env("ICTUS_STATE_DIR", self.state())
            .env("ICTUS_DAEMON_IDLE_MS", "1000")
            .env_remove("XDG_RUNTIME_DIR")
            .stdin(Stdio::null());
        command
    }

    /// Runs it and returns what it said, whatever that was.
    #[must_use]
    pub fn run(&self, args: &[&str]) -> Output {
        self.command(args).output().unwrap()
    }

    /// Runs it, expects success, and returns standard output.
    pub fn ok(&self, args: &[&str]) -> String {
        let output = self.run(args);
        assert!(output.status.success(), "ictus {args:?}: {}", said(&output));
        String::from_utf8(output.stdout).unwrap()
    }

    /// Runs it and expects this exit code; returns standard error.
    pub fn fails(&self, args: &[&str], code: i32) -> String {
        let output = self.run(args);
        assert_eq!(
            output.status.code(),
            Some(code),
            "ictus {args:?}: {}",
            said(&output)
        );
        String::from_utf8(output.stderr).unwrap()
    }

    /// Runs it with `-o json`, whatever its exit code, and returns the JSON.
    pub fn json(&self, args: &[&str]) -> Value {
        let output = self.run(&[args, &["-o", "json"]].concat());
        serde_json::from_slice(&output.stdout)
            .unwrap_or_else(|error| panic!("ictus {args:?}: {error}: {}", said(&output)))
    }

    /// One federation of `ictus ps`.
    pub fn view(&self, federation: &str) -> Value {
        let views = self.json(&["ps"]);
        let found = views
            .as_array()
            .unwrap()
            .iter()
            .find(|view| view["name"] == federation);
        found
            .unwrap_or_else(|| panic!("no {federation} in {views}"))
            .clone()
    }

    /// Returns when the federation has ended, and how it looks then.
    pub fn ended(&self, federation: &str) -> Value {
        // The log is followed to the federation's end.
        self.ok(&["logs", "--follow", federation]);
        let view = self.view(federation);
        assert_eq!(view["state"], "ended", "{view}");
        view
    }

    /// The process id of a member (`rti`, or a federate) of a running federation.
    #[must_use]
    pub fn pid(&self, federation: &str, member: &str) -> i32 {
        let view = self.view(federation);
        let federates = view["federates"].as_array().unwrap().iter();
        let mut members = std::iter::once(&view["rti"]).chain(federates);
        let found = members.find(|m| m["name"] == member).unwrap();
        i32::try_from(found["pid"].as_i64().unwrap()).unwrap()
    }

    /// Writes a manifest into the sandbox.
    #[must_use]
    pub fn manifest(&self, name: &str, text: &str) -> String {
        let path = self.state().join(name);
        std::fs::write(&path, text).unwrap();
        path.to_str().unwrap().to_owned()
    }

    /// The processes that know this sandbox's state directory: daemon, supervisors, RTI, federates.
    #[must_use]
    pub fn processes(&self) -> Vec<String> {
        let needle = self.state().to_str().unwrap().as_bytes().to_owned();
        let mut found = Vec::new();
        for entry in std::fs::read_dir("/proc").unwrap().flatten() {
            let name = entry.file_name().into_string().unwrap_or_default();
            if name.parse::<u32>().is_err() {
                continue;
            }
            let read = |file: &str| std::fs::read(entry.path().join(file)).unwrap_or_default();
            let cmdline = read("cmdline");
            let knows = |bytes: &[u8]| bytes.windows(needle.len()).any(|w| w == needle);
            if knows(&cmdline) || knows(&read("environ")) {
                found.push(format!("{name} {}", String::from_utf8_lossy(&cmdline)));
            }
        }
        found
    }
}

impl Drop for Sandbox {
    fn drop(&mut self) {
        // Whatever a failed test left behind.
        let views = self.run(&["ps", "-o", "json"]);
        let views: Value = serde_json::from_slice(&views.stdout).unwrap_or_default();
        for view in views.as_array().into_iter().flatten() {
            if let Some(name) = view["name"].as_str() {
                drop(self.run(&["down", name, "--purge"]));
            }
        }
    }
}

/// Sends SIGKILL.
pub fn kill(pid: i32) {
    let pid = rustix::process::Pid::from_raw(pid).unwrap();
    rustix::process::kill_process(pid, rustix::process::Signal::KILL).unwrap();
}

/// Both streams of an ended command.
#[must_use]
pub fn said(output: &Output) -> String {
    format!(
        "{}\n{}\n{}",
        output.status,
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    )
}
