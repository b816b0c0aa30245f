//! Programs: built by cargo, then asked what they consist of.

use std::ffi::{OsStr, OsString};
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc;
use std::thread;
use std::time::{Duration, Instant};

use ictus_coord::describe::{InstanceDescriptions, InstanceRequest, ProgramDescription};
use ictus_coord::plan::FORMAT;
use serde::de::DeserializeOwned;

use crate::check::{CheckOptions, Progress};
use crate::problem::printable;

/// The most that a program may print when it describes itself, in bytes.
const DESCRIBE_LIMIT: usize = 8 << 20;
/// The most that is kept of a standard error stream, in bytes.
const STDERR_LIMIT: usize = 64 << 10;
/// Lines shown of a compiler's error.
const ERROR_LINES: usize = 16;
/// How often a child that closed its output is asked whether it has ended.
const POLL: Duration = Duration::from_millis(5);

/// Why a program has no executable.
#[derive(Debug, thiserror::Error)]
pub(crate) enum BuildError {
    /// The folder or its `Cargo.toml` is missing.
    #[error("{path} is not the folder of a cargo package", path = path.display())]
    NoPackage { path: PathBuf },
    /// The executable is missing, or not a file.
    #[error("{path} is not an executable file", path = path.display())]
    NoBinary { path: PathBuf },
    /// Cargo could not be started.
    #[error("cannot run cargo: {0}")]
    NoCargo(std::io::Error),
    /// Cargo does not say for what it builds.
    #[error("`cargo -vV` does not say the host's target triple: {0}")]
    NoTriple(String),
    /// Cargo failed; the first error it gave.
    #[error("{0}")]
    Failed(String),
    /// The package has no binary of the wanted name.
    #[error("package `{package}` has no binary{wanted}")]
    NoTarget { package: String, wanted: String },
    /// The package has several binaries and none was named.
    #[error("package `{package}` has several binaries: {names}")]
    ManyTargets { package: String, names: String },
}

/// Why a program could not describe itself.
#[derive(Debug, thiserror::Error)]
pub(crate) enum DescribeError {
    /// The program could not be started.
    #[error("it cannot be started: {0}")]
    NoStart(std::io::Error),
    /// It did not end in time.
    #[error("it did not end within {} s", .0.as_secs_f64())]
    TimedOut(Duration),
    /// It ended with a failure.
    #[error("it ended with {status}{}", quoted(.stderr))]
    Failed { status: ExitStatus, stderr: String },
    /// It printed more than the limit.
    #[error("it printed more than {DESCRIBE_LIMIT} bytes")]
    TooLong,
    /// It printed something else.
    #[error("it printed no description ({what}); the output begins with `{start}`")]
    Garbage { what: String, start: String },
    /// It speaks another version of the format.
    #[error("it speaks version `{0}`, and this is `{FORMAT}`")]
    Version(String),
    /// It answered another number of questions than were asked.
    #[error("it described {found} instances of {asked}")]
    Count { asked: usize, found: usize },
    /// The file with the questions could not be written.
    #[error("cannot write {path}: {source}", path = path.display())]
    Request {
        path: PathBuf,
        source: std::io::Error,
    },
}

/// What of a package is wanted.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PackageBuild<'a> {
    /// The manifest's name of the program.
    pub(crate) program: &'a str,
    /// The package's folder.
    pub(crate) dir: &'a Path,
    /// The binary, when named.
    pub(crate) bin: Option<&'a str>,
    /// Whether the executable is to run on any host of this architecture, and in an empty container: static.
    pub(crate) portable: bool,
}

/// Builds a package's binary; gives the executable.
///
/// Without `portable` there is no `--target`: the executable is for this machine, and shares what is compiled with
/// builds by hand.
pub(crate) fn build(
    wanted: PackageBuild<'_>,
    options: &CheckOptions,
    progress: &mut dyn FnMut(Progress),
) -> Result<PathBuf, BuildError> {
    let no_package = || BuildError::NoPackage {
        path: wanted.dir.to_path_buf(),
    };
    let dir = wanted.dir.canonicalize().map_err(|_| no_package())?;
    let cargo_manifest = dir.join("Cargo.toml");
    if !cargo_manifest.is_file() {
        return Err(no_package());
    }
    progress(Progress::Building {
        program: wanted.program.to_owned(),
    });
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut command = for_itself(&cargo);
    command
        .arg("build")
        .arg("--message-format=json")
        .arg("--manifest-path")
        .arg(&cargo_manifest);
    match wanted.bin {
        Some(bin) => command.arg("--bin").arg(bin),
        None => command.arg("--bins"),
    };
    if options.release {
        command.arg("--release");
    }
    if wanted.portable {
        // `--target` also for this machine's own triple: without it the flag would hold for procedural macros too,
        // and those cannot be static.
        let triple = host_triple(&cargo, &dir)?;
        let (name, flags) = static_flags(&triple, &|name| std::env::var_os(name));
        command.arg("--target").arg(&triple).env(name, flags);
        // It travels: what only a debugger reads stays here.
        command
            .env("CARGO_PROFILE_RELEASE_STRIP", "symbols")
            .env("CARGO_PROFILE_RELEASE_DEBUG", "none");
    }
    if let Some(target_dir) = &options.target_dir {
        command.arg("--target-dir").arg(target_dir);
    }
    command
        .current_dir(&dir)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    let mut child = command.spawn().map_err(BuildError::NoCargo)?;
    let stderr = child
        .stderr
        .take()
        .map(|stderr| read_in_thread(stderr, STDERR_LIMIT));
    let mut outcome = Outcome {
        manifest: cargo_manifest,
        ..Outcome::default()
    };
    if let Some(stdout) = child.stdout.take() {
        for line in std::io::BufRead::lines(std::io::BufReader::new(stdout)) {
            let Ok(line) = line else { break };
            outcome.message(&line, wanted.program, progress);
        }
    }
    let status = child.wait().map_err(BuildError::NoCargo)?;
    let stderr = stderr
        .and_then(|stderr| stderr.recv().ok())
        .unwrap_or_default();
    if !status.success() {
        return Err(BuildError::Failed(
            outcome.first_error(&String::from_utf8_lossy(&stderr.bytes)),
        ));
    }
    outcome.executable(wanted)
}

/// cargo, as if nobody had been run by another one.
fn for_itself(cargo: &OsStr) -> Command {
    let mut command = Command::new(cargo);
    for (name, _) in std::env::vars_os() {
        if is_of_another_package(&name) {
            command.env_remove(name);
        }
    }
    command
}

/// What cargo tells a program that it runs of that one's package. Build scripts (ring's) that ask cargo to watch these would
/// be run again, and all that depends on them compiled again, whenever another program asks for the same build.
fn is_of_another_package(name: &OsStr) -> bool {
    let name = name.as_encoded_bytes();
    name.starts_with(b"CARGO_PKG_") || name.starts_with(b"CARGO_MANIFEST_")
}

/// The triple for which cargo builds when it is not told, with the toolchain of a folder.
fn host_triple(cargo: &OsStr, dir: &Path) -> Result<String, BuildError> {
    let mut command = Command::new(cargo);
    let command = command.arg("-vV").current_dir(dir).stdin(Stdio::null());
    let output = command.output().map_err(BuildError::NoCargo)?;
    let text = String::from_utf8_lossy(&output.stdout);
    let triple = text.lines().find_map(|line| line.strip_prefix("host: "));
    let word = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_' || c == '.';
    match triple.map(str::trim) {
        Some(triple) if !triple.is_empty() && triple.chars().all(word) => Ok(triple.to_owned()),
        Some(_) | None => {
            let stderr = String::from_utf8_lossy(&output.stderr);
            let line = stderr.lines().chain(text.lines()).next();
            Err(BuildError::NoTriple(
                line.unwrap_or("it said nothing").to_owned(),
            ))
        }
    }
}

/// The variable that makes rustc link statically for a triple, with its value. Cargo takes its flags from the first
/// place that has any, so ours join those that are there.
fn static_flags(triple: &str, env: &dyn Fn(&str) -> Option<OsString>) -> (String, OsString) {
    const OURS: [&str; 2] = ["-C", "target-feature=+crt-static"];
    let encoded = "CARGO_ENCODED_RUSTFLAGS";
    let own = format!(
        "CARGO_TARGET_{}_RUSTFLAGS",
        triple.to_uppercase().replace(['-', '.'], "_")
    );
    let (name, separator, have) = if let Some(have) = env(encoded) {
        (encoded.to_owned(), "\u{1f}", have)
    } else if let Some(have) = env("RUSTFLAGS") {
        ("RUSTFLAGS".to_owned(), " ", have)
    } else {
        let have = env(&own).unwrap_or_default();
        (own, " ", have)
    };
    let mut flags = have;
    for flag in OURS {
        if !flags.is_empty() {
            flags.push(separator);
        }
        flags.push(flag);
    }
    (name, flags)
}

/// What cargo's messages said.
#[derive(Debug, Default)]
struct Outcome {
    manifest: PathBuf,
    executables: Vec<(String, PathBuf)>,
    error: Option<String>,
}

impl Outcome {
    fn message(&mut self, line: &str, program: &str, progress: &mut dyn FnMut(Progress)) {
        let Ok(message) = serde_json::from_str::<serde_json::Value>(line) else {
            return;
        };
        let text = |pointer: &str| message.pointer(pointer).and_then(serde_json::Value::as_str);
        match text("/reason") {
            Some("compiler-message") => {
                let wrong = text("/message/level").is_some_and(|level| level.starts_with("error"));
                if wrong && self.error.is_none() {
                    self.error = text("/message/rendered").map(str::to_owned);
                }
            }
            Some("compiler-artifact") => {
                let package = text("/target/name").unwrap_or_default().to_owned();
                let ours =
                    text("/manifest_path").is_some_and(|path| Path::new(path) == self.manifest);
                if let (true, Some(executable)) = (ours, text("/executable")) {
                    self.executables
                        .push((package.clone(), PathBuf::from(executable)));
                }
                if text("/target/kind/0") != Some("custom-build") {
                    let program = program.to_owned();
                    progress(Progress::Compiled { program, package });
                }
            }
            _ => {}
        }
    }

    /// The compiler's first error, else cargo's own, cut to a readable length.
    fn first_error(&self, stderr: &str) -> String {
        let text = self.error.clone().unwrap_or_else(|| {
            let from = stderr.lines().skip_while(|line| !line.starts_with("error"));
            from.collect::<Vec<_>>().join("\n")
        });
        let lines: Vec<&str> = text.trim_end().lines().collect();
        let mut shown = lines[..lines.len().min(ERROR_LINES)].join("\n");
        if lines.len() > ERROR_LINES {
            shown.push_str("\n...");
        }
        if shown.is_empty() {
            "cargo failed without a message".to_owned()
        } else {
            shown
        }
    }

    fn executable(mut self, wanted: PackageBuild<'_>) -> Result<PathBuf, BuildError> {
        let package = wanted.dir.display().to_string();
        match (self.executables.len(), wanted.bin) {
            (1, _) => Ok(self.executables.remove(0).1),
            (0, bin) => {
                let wanted = bin.map_or(String::new(), |bin| format!(" `{bin}`"));
                Err(BuildError::NoTarget { package, wanted })
            }
            _ => {
                let names: Vec<String> = self
                    .executables
                    .into_iter()
                    .map(|(name, _)| format!("`{name}`"))
                    .collect();
                Err(BuildError::ManyTargets {
                    package,
                    names: names.join(", "),
                })
            }
        }
    }
}

/// Takes an executable as it is.
pub(crate) fn existing(path: &Path) -> Result<PathBuf, BuildError> {
    use std::os::unix::fs::PermissionsExt;
    let no_binary = || BuildError::NoBinary {
        path: path.to_path_buf(),
    };
    let path = path.canonicalize().map_err(|_| no_binary())?;
    let metadata = path.metadata().map_err(|_| no_binary())?;
    if metadata.is_file() && metadata.permissions().mode() & 0o111 != 0 {
        Ok(path)
    } else {
        Err(no_binary())
    }
}

/// Asks a program for its classes.
pub(crate) fn describe_classes(
    executable: &Path,
    timeout: Duration,
) -> Result<ProgramDescription, DescribeError> {
    let output = run_describe(executable, None, timeout)?;
    let description: ProgramDescription = read_answer(&output)?;
    if description.ictus == FORMAT {
        Ok(description)
    } else {
        Err(DescribeError::Version(description.ictus))
    }
}

/// Asks a program what instances with given parameters look like; the answers are in order.
pub(crate) fn describe_instances(
    executable: &Path,
    requests: &[InstanceRequest],
    timeout: Duration,
) -> Result<InstanceDescriptions, DescribeError> {
    let path = request_path();
    let failed = |source| DescribeError::Request {
        path: path.clone(),
        source,
    };
    let json = serde_json::to_vec(requests).map_err(|error| failed(error.into()))?;
    write_new(&path, &json).map_err(failed)?;
    let output = run_describe(executable, Some(&path), timeout);
    let removed = std::fs::remove_file(&path);
    let description: InstanceDescriptions = read_answer(&output?)?;
    removed.map_err(failed)?;
    if description.ictus != FORMAT {
        return Err(DescribeError::Version(description.ictus));
    }
    let (asked, found) = (requests.len(), description.instances.len());
    if asked == found {
        Ok(description)
    } else {
        Err(DescribeError::Count { asked, found })
    }
}

/// A file of our own in the system's folder for temporary files.
fn request_path() -> PathBuf {
    use std::sync::atomic::{AtomicU64, Ordering};
    static NEXT: AtomicU64 = AtomicU64::new(0);
    let (process, count) = (std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed));
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    let nanos = since.map_or(0, |since| since.subsec_nanos());
    std::env::temp_dir().join(format!("ictus-describe-{process}-{count}-{nanos}.json"))
}

/// Creates a file that only its owner can read; an existing one, or a link, is an error.
fn write_new(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    use std::io::Write;
    use std::os::unix::fs::OpenOptionsExt;
    let mut options = std::fs::OpenOptions::new();
    let mut file = options
        .write(true)
        .create_new(true)
        .mode(0o600)
        .open(path)?;
    file.write_all(bytes)
}

fn read_answer<T: DeserializeOwned>(output: &[u8]) -> Result<T, DescribeError> {
    serde_json::from_slice(output).map_err(|error| DescribeError::Garbage {
        what: error.to_string(),
        start: printable(&String::from_utf8_lossy(output))
            .chars()
            .take(60)
            .collect(),
    })
}

/// Runs `EXECUTABLE --describe [FILE]`, bounded in time and output, with nothing to read and PATH and HOME
/// alone in its environment.
fn run_describe(
    executable: &Path,
    requests: Option<&Path>,
    timeout: Duration,
) -> Result<Vec<u8>, DescribeError> {
    use std::os::unix::process::CommandExt;
    let mut command = Command::new(executable);
    command
        .arg("--describe")
        .args(requests)
        .env_clear()
        .process_group(0);
    for name in ["PATH", "HOME"] {
        if let Some(value) = std::env::var_os(name) {
            command.env(name, value);
        }
    }
    command
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    let mut child = command.spawn().map_err(DescribeError::NoStart)?;
    let end = Instant::now() + timeout;
    let stdout = child
        .stdout
        .take()
        .map(|stdout| read_in_thread(stdout, DESCRIBE_LIMIT));
    let stderr = child
        .stderr
        .take()
        .map(|stderr| read_in_thread(stderr, STDERR_LIMIT));
    let output = stdout.and_then(|stdout| stdout.recv_timeout(until(end)).ok());
    if output.as_ref().is_some_and(|output| output.cut) {
        kill(&mut child);
        return Err(DescribeError::TooLong);
    }
    let (Some(output), Some(status)) = (output, wait_until(&mut child, end)) else {
        kill(&mut child);
        return Err(DescribeError::TimedOut(timeout));
    };
    if status.success() {
        return Ok(output.bytes);
    }
    let stderr = stderr
        .and_then(|stderr| stderr.recv_timeout(until(end)).ok())
        .unwrap_or_default();
    let stderr = String::from_utf8_lossy(&stderr.bytes).into_owned();
    Err(DescribeError::Failed { status, stderr })
}

/// What a stream gave, up to a limit.
#[derive(Debug, Default)]
struct Stream {
    bytes: Vec<u8>,
    cut: bool,
}

/// Reads a stream to its end in a thread of its own; what is beyond the limit is thrown away, but for a
/// stream whose excess matters the first answer comes at the limit.
fn read_in_thread<R: Read + Send + 'static>(mut from: R, limit: usize) -> mpsc::Receiver<Stream> {
    let (sender, receiver) = mpsc::channel();
    thread::spawn(move || {
        let mut stream = Stream::default();
        let bound = u64::try_from(limit).unwrap_or(u64::MAX).saturating_add(1);
        let read = from.by_ref().take(bound).read_to_end(&mut stream.bytes);
        stream.cut = read.is_ok_and(|read| read > limit);
        stream.bytes.truncate(limit);
        // The other side may have given up waiting.
        drop(sender.send(stream));
        drop(std::io::copy(&mut from, &mut std::io::sink()));
    });
    receiver
}

fn until(end: Instant) -> Duration {
    end.saturating_duration_since(Instant::now())
}

fn wait_until(child: &mut Child, end: Instant) -> Option<ExitStatus> {
    loop {
        if let Ok(Some(status)) = child.try_wait() {
            return Some(status);
        }
        if until(end).is_zero() {
            return None;
        }
        thread::sleep(POLL);
    }
}

/// Ends a child and what it started. It leads its process group and has not been waited for, so its id is
/// still its own.
fn kill(child: &mut Child) {
    let group = rustix::process::Pid::from_child(child);
    // It may have ended in between; waiting collects it either way.
    let _ = rustix::process::kill_process_group(group, rustix::process::Signal::KILL);
    drop(child.wait());
}

/// The last lines of a standard error stream, for a message.
fn quoted(stderr: &str) -> String {
    let lines: Vec<&str> = stderr
        .lines()
        .filter(|line| !line.trim().is_empty())
        .collect();
    let shown = &lines[lines.len().saturating_sub(4)..];
    if shown.is_empty() {
        String::new()
    } else {
        format!(":\n{}", shown.join("\n"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What the environment has, then what cargo is given.
    #[test]
    fn what_cargo_says_of_another_package_is_left_out_and_nothing_else() {
        for (name, out) in [
            ("CARGO_PKG_NAME", true),
            ("CARGO_MANIFEST_DIR", true),
            ("CARGO_HOME", false),
            ("CARGO_TARGET_DIR", false),
            ("CARGO_PROFILE_RELEASE_STRIP", false),
            ("RUSTFLAGS", false),
        ] {
            assert_eq!(is_of_another_package(OsStr::new(name)), out, "{name}");
        }
    }

    #[test]
    fn flags_of_the_user_are_kept() {
        let own = "CARGO_TARGET_X86_64_UNKNOWN_LINUX_GNU_RUSTFLAGS";
        let ours = "-C target-feature=+crt-static";
        type Row<'a> = (&'a [(&'a str, &'a str)], &'a str, String);
        let table: &[Row<'_>] = &[
            (&[], own, ours.to_owned()),
            (&[(own, "-g")], own, format!("-g {ours}")),
            (
                &[("RUSTFLAGS", "-C opt-level=1"), (own, "-g")],
                "RUSTFLAGS",
                format!("-C opt-level=1 {ours}"),
            ),
            (
                &[
                    ("RUSTFLAGS", "-g"),
                    ("CARGO_ENCODED_RUSTFLAGS", "-C\u{1f}opt-level=1"),
                ],
                "CARGO_ENCODED_RUSTFLAGS",
                "-C\u{1f}opt-level=1\u{1f}-C\u{1f}target-feature=+crt-static".to_owned(),
            ),
        ];
        for (have, name, flags) in table {
            let env = |wanted: &str| {
                let found = have.iter().find(|(name, _)| *name == wanted);
                found.map(|(_, value)| OsString::from(value))
            };
            let given = static_flags("x86_64-unknown-linux-gnu", &env);
            assert_eq!(
                given,
                ((*name).to_owned(), OsString::from(flags)),
                "{have:?}"
            );
        }
    }
}
