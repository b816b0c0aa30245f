//! Runs a plan: the RTI and one process a federate, or one process for all.

use ictus_stream::{Authority, Member};
use serde_json::{Value, json};
use std::ffi::OsStr;
use std::fs;
use std::io::{self, BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStderr, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

/// Where the programs are.
#[derive(Debug)]
pub(crate) struct Bench {
    /// The `ictus` binary, which has the RTI.
    pub(crate) ictus: PathBuf,
    /// This program.
    pub(crate) program: PathBuf,
    /// A directory of this run's own.
    pub(crate) directory: PathBuf,
}

/// A federation to measure.
#[derive(Debug)]
pub(crate) struct Case {
    /// Its name.
    pub(crate) name: &'static str,
    /// Name, class and parameters of each federate.
    pub(crate) federates: Vec<(&'static str, &'static str, Value)>,
    /// From `federate.port` to `federate.port`, by federate index, with `after` in nanoseconds.
    pub(crate) connections: Vec<(Port, Port, Option<i64>)>,
    /// Ahead of physical time.
    pub(crate) fast: bool,
    /// Decentralized coordination, and every federate's STP offset.
    pub(crate) stp_offset: Option<Duration>,
    /// Under mutual TLS, as between hosts.
    pub(crate) tls: bool,
}

type Port = (u16, &'static str, u32);

/// What a run said.
#[derive(Debug, Default)]
pub(crate) struct Results {
    /// The JSON lines of all federates.
    pub(crate) lines: Vec<Value>,
    /// The RTI's peak resident memory in KiB.
    pub(crate) rti_peak_kib: u64,
}

impl Results {
    /// The first number under `key`.
    #[must_use]
    pub(crate) fn number(&self, key: &str) -> Option<f64> {
        self.lines.iter().find_map(|line| line[key].as_f64())
    }

    /// The largest number under `key`.
    #[must_use]
    pub(crate) fn largest(&self, key: &str) -> Option<f64> {
        self.lines
            .iter()
            .filter_map(|line| line[key].as_f64())
            .max_by(f64::total_cmp)
    }
}

impl Case {
    fn plan(&self) -> Value {
        let federates: Vec<Value> = self
            .federates
            .iter()
            .map(|(name, class, parameters)| {
                let mut federate = json!({
                    "name": name, "class": class, "program": "bench", "parameters": parameters
                });
                if let Some(offset) = self.stp_offset {
                    let nanos = u64::try_from(offset.as_nanos()).unwrap_or(u64::MAX);
                    federate["stp_offset_ns"] = json!(nanos);
                }
                federate
            })
            .collect();
        let coordination = match self.stp_offset {
            Some(_) => "decentralized",
            None => "centralized",
        };
        let mut next_port = vec![0_u16; federates.len()];
        let end = |(federate, port, channel): Port| json!({"federate": federate, "port": port, "channel": channel});
        let connections: Vec<Value> = self
            .connections
            .iter()
            .map(|(from, to, after)| {
                let port_id = &mut next_port[usize::from(to.0)];
                *port_id += 1;
                let mut connection = json!({
                    "from": end(*from), "to": end(*to),
                    "serializer": "native", "port_id": *port_id - 1
                });
                if let Some(after) = after {
                    connection["after_ns"] = json!(after);
                }
                connection
            })
            .collect();
        json!({
            "ictus": "v1", "federation": self.name, "coordination": coordination,
            "fast": self.fast, "max_lead_ns": 20_000_000, "extensions": true,
            "federates": federates, "connections": connections
        })
    }
}

impl Bench {
    fn write_plan(&self, case: &Case) -> io::Result<PathBuf> {
        let path = self.directory.join(format!("{}.json", case.name));
        fs::write(&path, case.plan().to_string())?;
        Ok(path)
    }

    /// Runs all federates in one process.
    ///
    /// # Errors
    ///
    /// When a process cannot be started or fails.
    pub(crate) fn alone(&self, case: &Case) -> io::Result<Results> {
        let plan = self.write_plan(case)?;
        let child = self.federate(&plan).spawn()?;
        Ok(Results {
            lines: finish(child)?,
            rti_peak_kib: 0,
        })
    }

    /// Runs each federate in a process of its own, and the RTI.
    ///
    /// # Errors
    ///
    /// When a process cannot be started or fails.
    pub(crate) fn federated(&self, case: &Case) -> io::Result<Results> {
        let plan = self.write_plan(case)?;
        let tls = if case.tls {
            Some(self.certify(case)?)
        } else {
            None
        };
        let papers = |member: &str| {
            let directory = tls.as_ref().map(|tls| tls.join(member));
            directory.map_or_else(Vec::new, |it| vec!["--tls".into(), it.into_os_string()])
        };
        let rti = Rti::start_with(&self.ictus, case.federates.len(), &papers("rti"))?;
        let memory = rti.watch_memory();
        let children: io::Result<Vec<Child>> = case
            .federates
            .iter()
            .map(|(name, _, _)| {
                let address = format!("127.0.0.1:{}", rti.port);
                let mut command = self.federate(&plan);
                command
                    .args(["--federate", name, "--rti", &address, "-i", FEDERATION])
                    .args(papers(name))
                    .spawn()
            })
            .collect();
        let mut lines = Vec::new();
        for child in children? {
            lines.extend(finish(child)?);
        }
        let rti_peak_kib = memory.stop();
        rti.finish()?;
        Ok(Results {
            lines,
            rti_peak_kib,
        })
    }

    /// Gives every member a certificate of this run, in a directory of its name.
    fn certify(&self, case: &Case) -> io::Result<PathBuf> {
        let directory = self.directory.join("tls");
        let authority = Authority::new(FEDERATION).map_err(io::Error::other)?;
        let names = case.federates.iter().map(|(name, _, _)| *name);
        let federates = names.zip((0..).map(Member::Federate));
        for (name, member) in federates.chain([("rti", Member::Rti)]) {
            let papers = authority.certify(member).map_err(io::Error::other)?;
            papers.write(&directory.join(name))?;
        }
        Ok(directory)
    }

    /// A program of a plan, to be told which federate it is.
    pub(crate) fn federate(&self, plan: &Path) -> Command {
        let mut command = Command::new(&self.program);
        command
            .arg("--plan")
            .arg(plan)
            .stdin(Stdio::null())
            .stdout(Stdio::piped());
        command
    }
}

/// Reads a federate's results to the end.
pub(crate) fn finish(mut child: Child) -> io::Result<Vec<Value>> {
    let mut text = String::new();
    if let Some(mut stdout) = child.stdout.take() {
        stdout.read_to_string(&mut text)?;
    }
    let status = child.wait()?;
    if !status.success() {
        return Err(io::Error::other(format!("a federate ended with {status}")));
    }
    Ok(text
        .lines()
        .filter_map(|line| serde_json::from_str(line).ok())
        .collect())
}

/// The federation id of every run.
pub(crate) const FEDERATION: &str = "bench";

/// An RTI process.
#[derive(Debug)]
pub(crate) struct Rti {
    child: Child,
    said: BufReader<ChildStderr>,
    /// Its TCP port.
    pub(crate) port: u16,
}

impl Rti {
    /// Starts an RTI for `federates` and waits until it listens.
    ///
    /// # Errors
    ///
    /// When it cannot be started or does not listen.
    pub(crate) fn start(ictus: &Path, federates: usize) -> io::Result<Self> {
        Self::start_with::<&str>(ictus, federates, &[])
    }

    /// As [`Rti::start`], with more arguments.
    ///
    /// # Errors
    ///
    /// As [`Rti::start`].
    pub(crate) fn start_with<A: AsRef<OsStr>>(
        ictus: &Path,
        federates: usize,
        arguments: &[A],
    ) -> io::Result<Self> {
        let mut child = Command::new(ictus)
            .args([
                "rti",
                "-i",
                FEDERATION,
                "-n",
                &federates.to_string(),
                "-p",
                "0",
            ])
            .args(["--status-fd", "1"])
            .args(arguments)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()?;
        let (Some(stdout), Some(stderr)) = (child.stdout.take(), child.stderr.take()) else {
            return Err(io::Error::other("no output"));
        };
        let mut lines = BufReader::new(stdout);
        let mut line = String::new();
        while lines.read_line(&mut line)? > 0 {
            let status: Value = serde_json::from_str(&line).unwrap_or_default();
            if let Some(port) = status["port"].as_u64() {
                // The rest of its status is read so that its pipe never fills.
                thread::spawn(move || io::copy(&mut lines, &mut io::sink()));
                return Ok(Self {
                    child,
                    said: BufReader::new(stderr),
                    port: u16::try_from(port).unwrap_or(0),
                });
            }
            line.clear();
        }
        child.kill()?;
        Err(io::Error::other("the RTI did not say its port"))
    }

    /// Follows its peak memory until told to stop.
    #[must_use]
    pub(crate) fn watch_memory(&self) -> Memory {
        let path = format!("/proc/{}/status", self.child.id());
        let (peak, stop) = (Arc::new(Mutex::new(0)), Arc::new(AtomicBool::new(false)));
        let (seen, stopped) = (Arc::clone(&peak), Arc::clone(&stop));
        let thread = thread::spawn(move || {
            while !stopped.load(Ordering::Relaxed) {
                let status = fs::read_to_string(&path).unwrap_or_default();
                let line = status.lines().find(|line| line.starts_with("VmHWM:"));
                let kib = line.and_then(|l| l.split_whitespace().nth(1)?.parse::<u64>().ok());
                if let Some(kib) = kib {
                    *seen.lock().unwrap_or_else(PoisonError::into_inner) = kib;
                }
                thread::sleep(Duration::from_millis(20));
            }
        });
        Memory { peak, stop, thread }
    }

    /// Waits for its end.
    ///
    /// # Errors
    ///
    /// When it failed.
    pub(crate) fn finish(mut self) -> io::Result<()> {
        let status = self.child.wait()?;
        if status.success() {
            Ok(())
        } else {
            let mut words = String::new();
            self.said.read_to_string(&mut words)?;
            Err(io::Error::other(format!(
                "the RTI ended with {status}:\n{words}"
            )))
        }
    }
}

/// Follows a process's peak memory.
#[derive(Debug)]
pub(crate) struct Memory {
    peak: Arc<Mutex<u64>>,
    stop: Arc<AtomicBool>,
    thread: thread::JoinHandle<()>,
}

impl Memory {
    /// The peak in KiB.
    #[must_use]
    pub(crate) fn stop(self) -> u64 {
        self.stop.store(true, Ordering::Relaxed);
        // A watcher that panicked has seen nothing: the peak stays what it was.
        drop(self.thread.join());
        *self.peak.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
