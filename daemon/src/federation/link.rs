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

use super::launch;
use crate::agent::{MemberEvent, MemberId};
use crate::identity::ProcessIdentity;
use crate::supervisor::READY;
use crate::supervisor::exit::ExitRecord;
use crate::supervisor::protocol::{Reply, Request, StopSignal};
use crate::supervisor::spec::{PROTOCOL, Spec};
use crate::{process, stamp};

/// How long a supervisor may take to listen, to answer, and to end after its release.
const ANSWER_MAX: Duration = Duration::from_secs(10);
/// What is kept of a supervisor's own complaint.
const COMPLAINT_BYTES_MAX: u64 = 4096;

/// One member's link.
#[derive(Debug)]
pub(crate) struct Link {
    pub(crate) member: MemberId,
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
            Origin::Adopt(recorded) => self.adopt(recorded).await,
        };
        match connected {
            Ok(connection) => {
                let supervisor = connection.supervisor;
                let identified = Heard::Identified {
                    member: self.member,
                    supervisor,
                };
                self.hear.send(identified).await.ok();
                self.follow(connection).await;
            }
            Err(Failed::NotSupervised(why)) => self.say(MemberEvent::NotSupervised { why }).await,
            Err(Failed::Foreign(why)) => self.say(MemberEvent::Foreign { why }).await,
            Err(Failed::Nobody) => self.say_from_record().await,
        }
        self.caught_up().await;
    }

    async fn launch(&self, spec: &Spec) -> Result<Connection, Failed> {
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

    async fn adopt(&self, recorded: Option<ProcessIdentity>) -> Result<Connection, Failed> {
        let connection = self.connect(recorded).await;
        if matches!(connection, Err(Failed::Nobody)) {
            // Killed: it could not remove its socket. The name is random, so it is ours.
            std::fs::remove_file(&self.socket).ok();
        }
        connection
    }

    /// Connects and makes sure that who answers is the recorded supervisor.
    async fn connect(&self, recorded: Option<ProcessIdentity>) -> Result<Connection, Failed> {
        let stream = UnixStream::connect(&self.socket)
            .await
            .map_err(|_| Failed::Nobody)?;
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
        if recorded.is_some_and(|recorded| recorded != supervisor) || !supervisor.lives() {
            return foreign("its supervisor is another process than the record's");
        }
        let own = rustix::process::geteuid().as_raw();
        if peer != Some((own, Some(supervisor.pid))) {
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
    async fn pass(&self, line: &str) -> bool {
        let (at_ns, event, last) = match serde_json::from_str(line) {
            Ok(Reply::Started { pid, at_ns }) => (at_ns, MemberEvent::Started { pid }, false),
            Ok(Reply::Reported { at_ns, line }) => (at_ns, MemberEvent::Reported { line }, false),
            Ok(Reply::Ended { record }) => (record.ended_ns, MemberEvent::Ended { record }, true),
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
        if let Some(record) = ExitRecord::read(&self.exit_record, &self.instance) {
            let (at_ns, record) = (record.ended_ns, Box::new(record));
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
