//! A process of a run: bounded in time, and killed when nobody waits for it any more.

use std::fs::{self, File};
use std::io::{self, BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::{self, Receiver};
use std::thread;
use std::time::{Duration, Instant};
use thiserror::Error;

/// How often a process is asked whether it has ended.
const POLL: Duration = Duration::from_millis(5);
/// Lines of a log that an error quotes.
const QUOTED: usize = 8;

/// Why a process did not do what it should.
#[derive(Debug, Error)]
pub(crate) enum PartError {
    /// It could not be started, or its log not be written.
    #[error("{name} cannot be started: {source}")]
    Start {
        /// Its name.
        name: String,
        source: io::Error,
    },
    /// It ended in failure.
    #[error("{name} ended with {status}{said}")]
    Failed {
        /// Its name.
        name: String,
        status: ExitStatus,
        /// The end of its log.
        said: String,
    },
    /// It did not say its line, or did not end, in time.
    #[error("{name} was not done within {} s{said}", limit.as_secs())]
    Late {
        /// Its name.
        name: String,
        limit: Duration,
        /// The end of its log.
        said: String,
    },
}

/// A running process.
#[derive(Debug)]
pub(crate) struct Part {
    name: String,
    child: Child,
    lines: Receiver<String>,
    log: PathBuf,
}

impl Part {
    /// Starts a process with its standard error in `directory`; its standard input stays open as long as this lives.
    ///
    /// # Errors
    ///
    /// When it cannot be started.
    pub(crate) fn start(
        name: &str,
        command: &mut Command,
        directory: &Path,
    ) -> Result<Self, PartError> {
        let log = directory.join(format!("{name}.log"));
        let cannot = |source| PartError::Start {
            name: name.to_owned(),
            source,
        };
        let file = File::create(&log).map_err(cannot)?;
        command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(file);
        let mut child = command.spawn().map_err(cannot)?;
        let (sender, lines) = mpsc::channel();
        if let Some(stdout) = child.stdout.take() {
            thread::spawn(move || {
                let lines = BufReader::new(stdout).lines().map_while(Result::ok);
                lines.for_each(|line| drop(sender.send(line)));
            });
        }
        Ok(Self {
            name: name.to_owned(),
            child,
            lines,
            log,
        })
    }

    /// The next line of its standard output for which `take` has an answer.
    ///
    /// # Errors
    ///
    /// When there is none within `limit`, or its output ends.
    pub(crate) fn line<T>(
        &mut self,
        limit: Duration,
        mut take: impl FnMut(&str) -> Option<T>,
    ) -> Result<T, PartError> {
        let end = Instant::now() + limit;
        loop {
            let left = end.saturating_duration_since(Instant::now());
            match self.lines.recv_timeout(left) {
                Ok(line) => {
                    if let Some(answer) = take(&line) {
                        return Ok(answer);
                    }
                }
                Err(_) => return Err(self.late(limit)),
            }
        }
    }

    /// Ends its standard input.
    #[cfg(feature = "mqtt")]
    pub(crate) fn close_stdin(&mut self) {
        self.child.stdin = None;
    }

    /// Waits for its end.
    ///
    /// # Errors
    ///
    /// When it fails, or does not end within `limit`.
    pub(crate) fn end(&mut self, limit: Duration) -> Result<(), PartError> {
        let end = Instant::now() + limit;
        while Instant::now() < end {
            match self.child.try_wait() {
                Ok(None) => thread::sleep(POLL),
                Ok(Some(status)) if status.success() => return Ok(()),
                Ok(Some(status)) => {
                    return Err(PartError::Failed {
                        name: self.name.clone(),
                        status,
                        said: self.said(),
                    });
                }
                Err(source) => {
                    let name = self.name.clone();
                    return Err(PartError::Start { name, source });
                }
            }
        }
        Err(self.late(limit))
    }

    fn late(&self, limit: Duration) -> PartError {
        PartError::Late {
            name: self.name.clone(),
            limit,
            said: self.said(),
        }
    }

    fn said(&self) -> String {
        let text = fs::read_to_string(&self.log).unwrap_or_default();
        let lines: Vec<&str> = text.lines().collect();
        let last = &lines[lines.len().saturating_sub(QUOTED)..];
        last.iter().map(|line| format!("\n  | {line}")).collect()
    }
}

impl Drop for Part {
    fn drop(&mut self) {
        // One that has ended cannot be killed, and is waited for all the same.
        drop(self.child.kill());
        drop(self.child.wait());
    }
}
