//! The connection to one supervisor: starts it or finds it again, and passes words and signals.

use std::io;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader, Lines};
use tokio::net::UnixStream;
use tokio::net::unix::{OwnedReadHalf, OwnedWriteHalf};
use tokio::sync::mpsc;
use tokio::time::timeout;

use super::container::{Contained, ContainerError, Found, Handle, host_pid, see};
use super::launch;
use crate::agent::{MemberEvent, MemberId};
use crate::host::with_sources;
use crate::identity::ProcessIdentity;
use crate::supervisor::READY;
use crate::supervisor::exit::{Ending, ExitRecord};
use crate::supervisor::protocol::{Reply, Request, StopSignal};
use crate::supervisor::spec::{PROTOCOL, Spec};
use crate::{process, stamp};

/// How long a supervisor may take to listen, to answer, and to end after its release.
const ANSWER_MAX: Duration = Duration::from_secs(10);
/// What the kernel sends when memory is used up, among others.
const SIGKILL: i32 = 9;
/// What is kept of a supervisor's own complaint.
const COMPLAINT_BYTES_MAX: u64 = 4096;

/// One member's link.
#[derive(Debug)]
pub(crate) struct Link {
    pub(crate) member: MemberId,
    /// The container whose first process the supervisor is, if it is in one.
    pub(crate) contained: Option<Contained>,
    /// The same, once it is made or found.
    pub(crate) handle: Option<Handle>,
    /// The supervisor, once it is known.
    pub(crate) supervisor: Option<ProcessIdentity>,
    /// The member's pid as it was told, and as this host knows it.
    pub(crate) child: Option<(u32, u32)>,
    pub(crate) instance: String,
    pub(crate) socket: PathBuf,
    pub(crate) spec: PathBuf,
    pub(crate) exit_record: PathBuf,
    pub(crate) hear: mpsc::Sender<Heard>,
    pub(crate) signals: mpsc::Receiver<StopSignal>,
}

/// Where the supervisor comes from.
#[derive(Debug)]
pub(crate) enum Origin {
    /// It is to be started.
    Launch(Box<Spec>),
    /// It cannot be started, for this reason.
    Refused(String),
    /// It was started by another daemon.
    Adopt(Option<ProcessIdentity>),
}

/// What a link says to the driver.
#[derive(Debug)]
pub(crate) enum Heard {
    /// The supervisor answered and is ours.
    Identified {
        member: MemberId,
        supervisor: ProcessIdentity,
    },
    /// Everything that happened before was said.
    CaughtUp { member: MemberId },
    /// It said something.
    Event {
        member: MemberId,
        at_ns: i64,
        event: MemberEvent,
    },
}

/// Why there is no link.
enum Failed {
    /// Nothing runs, and the reason is known.
    NotSupervised(String),
    /// Something answers that is not ours.
    Foreign(String),
    /// There is nobody.
    Nobody,
}

struct Connection {
    lines: Lines<BufReader<OwnedReadHalf>>,
    writer: OwnedWriteHalf,
    supervisor: ProcessIdentity,
}

impl Link {
    /// Follows the supervisor to its end.
    pub(crate) async fn run(mut self, origin: Origin) {
        let connected = match origin {
            Origin::Launch(spec) => self.launch(&spec).await,
            Origin::Refused(why) => Err(Failed::NotSupervised(why)),
            Origin::Adopt(recorded) => self.adopt(recorded).await,
        };
        match connected {
            Ok(connection) => {
                let supervisor = connection.supervisor;
                self.supervisor = Some(supervisor);
                let identified = Heard::Identified {
                    member: self.member,
                    supervisor,
                };
                self.hear.send(identified).await.ok();
                self.follow(connection).await;
            }
            Err(Failed::NotSupervised(why)) => {
                self.clean().await;
                self.say(MemberEvent::NotSupervised { why }).await;
            }
            Err(Failed::Foreign(why)) => self.say(MemberEvent::Foreign { why }).await,
            Err(Failed::Nobody) => self.say_from_record().await,
        }
        self.caught_up().await;
    }

    async fn launch(&mut self, spec: &Spec) -> Result<Connection, Failed> {
        if let Some(contained) = &self.contained {
            let launched = contained.launch(spec, &self.spec).await;
            self.handle = Some(launched.map_err(|error| not_supervised(&error))?);
            // Made a moment ago, it is ours and is removed, whatever answers in it.
            return self.connect(None).await.map_err(|failed| match failed {
                Failed::Foreign(why) => Failed::NotSupervised(why),
                other @ (Failed::NotSupervised(_) | Failed::Nobody) => other,
            });
        }
        let failed = |what: &str, error: &dyn std::fmt::Display| {
            Failed::NotSupervised(format!("{what}: {error}"))
        };
        let text = serde_json::to_vec_pretty(spec).map_err(|e| failed("cannot write", &e))?;
        std::fs::write(&self.spec, text).map_err(|e| failed("cannot write its spec", &e))?;
        let mut child = supervise(&self.spec)
            .spawn()
            .map_err(|error| failed("cannot start a supervisor", &error))?;
        let (out, err) = (child.stdout.take(), child.stderr.take());
        // Reaps the supervisor whenever it ends.
        tokio::spawn(async move { child.wait().await });
        let ready = timeout(ANSWER_MAX, first_line(out)).await;
        if !matches!(&ready, Ok(Ok(line)) if line.trim_end() == READY) {
            let mut complaint = String::new();
            if let Some(err) = err {
                let mut err = err.take(COMPLAINT_BYTES_MAX);
                timeout(ANSWER_MAX, err.read_to_string(&mut complaint))
                    .await
                    .ok();
            }
            return Err(failed("its supervisor does not listen", &complaint.trim()));
        }
        self.connect(None).await.map_err(|error| match error {
            Failed::Nobody => failed("its supervisor", &"vanished at once"),
            other @ (Failed::NotSupervised(_) | Failed::Foreign(_)) => other,
        })
    }

    async fn adopt(&mut self, recorded: Option<ProcessIdentity>) -> Result<Connection, Failed> {
        if let Some(contained) = &self.contained {
            match contained.find().await {
                Ok(Found::Own(handle)) => self.handle = Some(handle),
                Ok(Found::Nothing) => return Err(Failed::Nobody),
                Ok(Found::Foreign) => {
                    return Err(Failed::Foreign(
                        "its container has another instance id".to_owned(),
                    ));
                }
                // What listens is still known by its process, if something does.
                Err(error) => tracing::warn!(%error, "a container is adopted without its engine"),
            }
            // A supervisor that does not answer is gone; its exit record tells.
            return self.connect(recorded).await.map_err(|failed| match failed {
                Failed::NotSupervised(_) => Failed::Nobody,
                other @ (Failed::Foreign(_) | Failed::Nobody) => other,
            });
        }
        let connection = self.connect(recorded).await;
        if matches!(connection, Err(Failed::Nobody)) {
            // Killed: it could not remove its socket. The name is random, so it is ours.
            std::fs::remove_file(&self.socket).ok();
        }
        connection
    }

    /// Connects and makes sure that who answers is the recorded supervisor.
    async fn connect(&self, recorded: Option<ProcessIdentity>) -> Result<Connection, Failed> {
        let stream = match &self.handle {
            Some(handle) => handle
                .connect(&self.socket, ANSWER_MAX)
                .await
                .map_err(|error| not_supervised(&error))?,
            None => UnixStream::connect(&self.socket)
                .await
                .map_err(|_| Failed::Nobody)?,
        };
        let peer = stream.peer_cred().ok();
        let peer = peer.map(|peer| {
            (
                peer.uid(),
                peer.pid().and_then(|pid| u32::try_from(pid).ok()),
            )
        });
        let (reader, mut writer) = stream.into_split();
        let mut lines = BufReader::new(reader).lines();
        send(&mut writer, Request::Identify)
            .await
            .map_err(|_| Failed::Nobody)?;
        let line = timeout(ANSWER_MAX, lines.next_line()).await;
        let Ok(Ok(Some(line))) = line else {
            return Err(Failed::Nobody);
        };
        let foreign = |why: &str| Err(Failed::Foreign(why.to_owned()));
        let Ok(Reply::Identity {
            protocol,
            instance,
            supervisor,
        }) = serde_json::from_str(&line)
        else {
            return foreign("it does not speak the supervisors' protocol");
        };
        if protocol > PROTOCOL {
            return foreign("its supervisor speaks a newer protocol");
        }
        if instance != self.instance {
            return foreign("its supervisor has another instance id");
        }
        let supervisor = if self.contained.is_some() {
            let pid = peer.and_then(|(_, pid)| pid);
            self.identify(pid, supervisor, recorded).await?
        } else {
            supervisor
        };
        if recorded.is_some_and(|recorded| recorded != supervisor)
            || (self.contained.is_none() && !supervisor.lives())
        {
            return foreign("its supervisor is another process than the record's");
        }
        let own = rustix::process::geteuid().as_raw();
        let named = self.contained.as_ref().is_some_and(Contained::has_user);
        if peer.map(|(_, pid)| pid) != Some(Some(supervisor.pid))
            || (!named && peer.map(|(uid, _)| uid) != Some(own))
        {
            return foreign("its supervisor is another process than it says");
        }
        // The status is asked for because its answer comes after everything that happened before.
        for request in [Request::Subscribe, Request::Status] {
            send(&mut writer, request)
                .await
                .map_err(|_| Failed::Nobody)?;
        }
        Ok(Connection {
            lines,
            writer,
            supervisor,
        })
    }

    /// In a container a supervisor knows itself by another pid than this host does.
    async fn identify(
        &self,
        pid: Option<u32>,
        claimed: ProcessIdentity,
        recorded: Option<ProcessIdentity>,
    ) -> Result<ProcessIdentity, Failed> {
        let foreign = |why: &str| Failed::Foreign(why.to_owned());
        let pid = pid.ok_or_else(|| foreign("its supervisor cannot be seen from here"))?;
        let seen = see(pid, claimed).map_err(|why| foreign(&why))?;
        match &self.handle {
            Some(handle) if !handle.begins_with(pid).await.map_err(|why| foreign(&why))? => Err(
                foreign("its supervisor is not the first process of its container"),
            ),
            // Without the engine only the record tells.
            None if recorded != Some(seen) => Err(foreign(
                "its supervisor is another process than the record's",
            )),
            Some(_) | None => Ok(seen),
        }
    }

    async fn follow(&mut self, mut connection: Connection) {
        let pidfd = process::open(connection.supervisor.pid);
        loop {
            tokio::select! {
                line = connection.lines.next_line() => {
                    let Ok(Some(line)) = line else { break };
                    if self.pass(&line).await {
                        send(&mut connection.writer, Request::Release).await.ok();
                        if let Some(pidfd) = pidfd {
                            process::wait_for_end(pidfd, ANSWER_MAX).await;
                        }
                        self.clean().await;
                        return self.say(MemberEvent::Closed).await;
                    }
                }
                Some(signal) = self.signals.recv() => {
                    send(&mut connection.writer, Request::Signal { signal }).await.ok();
                }
            }
        }
        std::fs::remove_file(&self.socket).ok();
        self.say_from_record().await;
    }

    /// Passes a reply on; true when nothing follows it.
    async fn pass(&mut self, line: &str) -> bool {
        let (at_ns, event, last) = match serde_json::from_str(line) {
            Ok(Reply::Started { pid, at_ns }) => {
                let pid = self.known_here(pid);
                (at_ns, MemberEvent::Started { pid }, false)
            }
            Ok(Reply::Reported { at_ns, line }) => (at_ns, MemberEvent::Reported { line }, false),
            Ok(Reply::Ended { record }) => {
                let record = self.complete(record).await;
                (record.ended_ns, MemberEvent::Ended { record }, true)
            }
            Ok(Reply::Refused { why }) => {
                tracing::debug!(member = ?self.member, why, "refused");
                return false;
            }
            Ok(Reply::Status { .. }) => {
                self.caught_up().await;
                return false;
            }
            Ok(Reply::Identity { .. } | Reply::Done) | Err(_) => {
                return false;
            }
        };
        self.hear
            .send(Heard::Event {
                member: self.member,
                at_ns,
                event,
            })
            .await
            .ok();
        last
    }

    /// The supervisor is gone: its exit record tells, if it wrote one.
    async fn say_from_record(&self) {
        let record = match ExitRecord::read(&self.exit_record, &self.instance) {
            Some(record) => Some(self.complete(Box::new(record)).await),
            None => self.without_record().await,
        };
        self.clean().await;
        if let Some(record) = record {
            let at_ns = record.ended_ns;
            let event = MemberEvent::Ended { record };
            self.hear
                .send(Heard::Event {
                    member: self.member,
                    at_ns,
                    event,
                })
                .await
                .ok();
        }
        self.say(MemberEvent::Closed).await;
    }

    /// The pid by which this host knows the member.
    fn known_here(&mut self, pid: u32) -> u32 {
        let first = self.supervisor.filter(|_| self.contained.is_some());
        let here = first
            .and_then(|first| host_pid(first.pid, pid))
            .unwrap_or(pid);
        self.child = Some((pid, here));
        here
    }

    /// Adds to a record what only the container's owner knows.
    async fn complete(&self, mut record: Box<ExitRecord>) -> Box<ExitRecord> {
        if let Some((_, here)) = self.child.filter(|(inside, _)| record.pid == Some(*inside)) {
            record.pid = Some(here);
        }
        let Some(handle) = &self.handle else {
            return record;
        };
        let first = self.supervisor.map(|supervisor| supervisor.pid);
        let killed = record.ending == Ending::Killed { signal: SIGKILL };
        if killed && handle.out_of_memory(first).await {
            record.ending = Ending::OutOfMemory;
        }
        let refused = first.map_or(0, |first| handle.processes_refused(first));
        if refused > 0 {
            let remark = format!("its limit of processes (`pids:`) was reached {refused} times");
            record.first_lines.insert(0, remark);
        }
        record
    }

    /// The supervisor could not write a record: that its memory was used up is known all the same.
    async fn without_record(&self) -> Option<Box<ExitRecord>> {
        let handle = self.handle.as_ref()?;
        handle.out_of_memory(None).await.then(|| {
            Box::new(ExitRecord {
                protocol: PROTOCOL,
                instance: self.instance.clone(),
                name: String::new(),
                pid: self.child.map(|(_, here)| here),
                started_ns: 0,
                ended_ns: stamp::now_ns(),
                ending: Ending::OutOfMemory,
                last_status: None,
                reports: Vec::new(),
                first_lines: Vec::new(),
                log_lines_lost: 0,
            })
        })
    }

    /// Removes the container, and its socket's directory.
    async fn clean(&self) {
        if let Some(handle) = &self.handle {
            handle.remove().await;
        }
        if let Some(contained) = &self.contained {
            contained.remove_socket();
        }
    }

    async fn caught_up(&self) {
        let member = self.member;
        self.hear.send(Heard::CaughtUp { member }).await.ok();
    }

    async fn say(&self, event: MemberEvent) {
        let heard = Heard::Event {
            member: self.member,
            at_ns: stamp::now_ns(),
            event,
        };
        self.hear.send(heard).await.ok();
    }
}

fn not_supervised(error: &ContainerError) -> Failed {
    Failed::NotSupervised(with_sources(error))
}

fn supervise(spec: &Path) -> tokio::process::Command {
    let mut command = std::process::Command::new(launch::executable());
    command.arg0("ictus").arg("supervise").arg(spec);
    command
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    tokio::process::Command::from(command)
}

async fn first_line(out: Option<tokio::process::ChildStdout>) -> io::Result<String> {
    let mut line = String::new();
    if let Some(out) = out {
        BufReader::new(out.take(COMPLAINT_BYTES_MAX))
            .read_line(&mut line)
            .await?;
    }
    Ok(line)
}

async fn send(writer: &mut OwnedWriteHalf, request: Request) -> io::Result<()> {
    let mut line = serde_json::to_vec(&request)?;
    line.push(b'\n');
    writer.write_all(&line).await
}
