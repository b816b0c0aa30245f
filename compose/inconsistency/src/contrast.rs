//! The contrast: the same source, nodes and planner as plain programs over an MQTT broker. No tags: whatever comes is handled.

use crate::classes::{Random, busy, say};
use crate::harness::{Place, RunError, Setup};
use crate::order::{Orders, Step, Tally};
use crate::part::{Part, PartError};
use clap::{Args, ValueEnum};
use rumqttc::{Client, Connection, Event, MqttOptions, NetworkOptions, Packet, QoS};
use std::io::{self, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::process::{Command, Stdio};
use std::sync::mpsc::{self, Receiver};
use std::thread;
use std::time::{Duration, Instant};
use thiserror::Error;

const BROKER: &str = "mosquitto";
/// Debian puts it where only root looks.
const PATHS: [&str; 2] = ["mosquitto", "/usr/sbin/mosquitto"];
/// Requests that a client holds before it blocks.
const REQUESTS: usize = 1 << 16;
/// How long a program or the broker may take to start.
const START: Duration = Duration::from_secs(20);
/// From the source's end until the planner is told to stop although messages are missing.
const DRAIN: Duration = Duration::from_secs(5);
/// The last part of a wait is spun.
const SPIN: Duration = Duration::from_micros(200);

/// A program of the contrast: its role, and what it needs to know.
#[derive(Debug, Args)]
pub(crate) struct Program {
    role: Role,
    /// The broker's port on this host
    #[arg(long)]
    port: u16,
    #[arg(long)]
    qos: u8,
    #[arg(long)]
    sequences: u32,
    /// In nanoseconds
    #[arg(long)]
    period: u64,
    /// In nanoseconds
    #[arg(long)]
    pause: u64,
    /// In nanoseconds
    #[arg(long)]
    work: u64,
}

/// Who a program is.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum Role {
    Source,
    Vehicle,
    Localizer,
    Planner,
}

impl Role {
    const fn name(self) -> &'static str {
        match self {
            Self::Source => "source",
            Self::Vehicle => "vehicle",
            Self::Localizer => "localizer",
            Self::Planner => "planner",
        }
    }
}

/// Why a program ended early.
#[derive(Debug, Error)]
pub(crate) enum ContrastError {
    /// The broker refused, or is gone.
    #[error("the broker: {0}")]
    Client(#[from] rumqttc::ClientError),
    /// Nobody reads standard output.
    #[error("standard output: {0}")]
    Output(#[from] io::Error),
}

/// Whether there is a broker to run.
///
/// # Errors
///
/// When there is none, with what to do.
pub(crate) fn available() -> Result<(), String> {
    if broker().is_some() {
        return Ok(());
    }
    Err(format!("there is no {BROKER}: `apt-get install {BROKER}`"))
}

fn broker() -> Option<&'static str> {
    PATHS.into_iter().find(|path| {
        let mut command = Command::new(path);
        command.arg("-h").stdin(Stdio::null());
        command.stdout(Stdio::null()).stderr(Stdio::null());
        command.status().is_ok()
    })
}

/// Runs a broker and the four programs; gives what the planner counted.
///
/// # Errors
///
/// When a process cannot be started, fails, or is not done in time.
pub(crate) fn run(place: &Place<'_>, setup: &Setup, qos: u8) -> Result<Tally, RunError> {
    let (_broker, port) = start_broker(place)?;
    let start = |role: Role| -> Result<Part, PartError> {
        let mut command = Command::new(place.program);
        command.args(["mqtt", role.name()]);
        for (option, value) in [
            ("--port", u128::from(port)),
            ("--qos", u128::from(qos)),
            ("--sequences", u128::from(setup.sequences)),
            ("--period", setup.period.as_nanos()),
            ("--pause", setup.pause.as_nanos()),
            ("--work", setup.work.as_nanos()),
        ] {
            command.args([option, &value.to_string()]);
        }
        let mut part = Part::start(role.name(), &mut command, place.directory)?;
        part.line(START, |line| (line == READY).then_some(()))?;
        Ok(part)
    };
    let mut planner = start(Role::Planner)?;
    let _nodes = [start(Role::Vehicle)?, start(Role::Localizer)?];
    let mut source = start(Role::Source)?;
    source.end(setup.limit())?;
    let read = |line: &str| serde_json::from_str(line).ok();
    let tally = match planner.line(DRAIN, read) {
        Ok(tally) => tally,
        Err(_) => {
            planner.close_stdin();
            planner.line(START, read)?
        }
    };
    planner.end(START)?;
    Ok(tally)
}

fn start_broker(place: &Place<'_>) -> Result<(Part, u16), RunError> {
    let free = TcpListener::bind("127.0.0.1:0").and_then(|listener| listener.local_addr());
    let cannot = |source| PartError::Start {
        name: BROKER.to_owned(),
        source,
    };
    let port = free.map_err(cannot)?.port();
    let config = format!(
        "listener {port} 127.0.0.1\nallow_anonymous true\npersistence false\nset_tcp_nodelay true\n\
         max_queued_messages 0\nlog_dest stderr\n"
    );
    let config = place.write("mosquitto.conf", &config)?;
    let mut command = Command::new(broker().unwrap_or(BROKER));
    command.arg("-c").arg(config);
    let broker = Part::start(BROKER, &mut command, place.directory)?;
    let end = Instant::now() + START;
    loop {
        match TcpStream::connect(("127.0.0.1", port)) {
            Ok(_) => return Ok((broker, port)),
            Err(source) if Instant::now() > end => return Err(cannot(source).into()),
            Err(_) => thread::sleep(Duration::from_millis(5)),
        }
    }
}

/// What a program says when it is connected and subscribed.
const READY: &str = "ready";

/// What a program hears.
enum Heard {
    Ready,
    Message(u32, Step),
    /// Standard input is closed, or the broker is gone.
    End,
}

impl Program {
    /// Plays the role.
    ///
    /// # Errors
    ///
    /// When the broker is gone before the end.
    pub(crate) fn run(&self) -> Result<(), ContrastError> {
        let mut options = MqttOptions::new(self.role.name(), "127.0.0.1", self.port);
        options.set_keep_alive(Duration::from_secs(60));
        options.set_inflight(u16::MAX);
        let (client, mut connection) = Client::new(options, REQUESTS);
        let mut network = NetworkOptions::new();
        network.set_tcp_nodelay(true);
        connection.eventloop.set_network_options(network);
        let topics: &[&str] = match self.role {
            Role::Source => &[],
            Role::Vehicle => &["source/report"],
            Role::Localizer => &["source/kinematic"],
            Role::Planner => &["vehicle/report", "localizer/kinematic"],
        };
        for topic in topics {
            client.subscribe(*topic, self.level())?;
        }
        let heard = listen(connection, topics.len());
        loop {
            match heard.recv() {
                Ok(Heard::Ready) => break,
                Ok(Heard::Message(..)) => {}
                Ok(Heard::End) | Err(_) => return Ok(()),
            }
        }
        writeln!(io::stdout(), "{READY}")?;
        match self.role {
            Role::Source => self.send(&client, &heard),
            Role::Vehicle => self.relay(&client, &heard, ("vehicle/report", 1)),
            Role::Localizer => self.relay(&client, &heard, ("localizer/kinematic", 2)),
            Role::Planner => {
                self.count(&heard);
                Ok(())
            }
        }
    }

    const fn level(&self) -> QoS {
        match self.qos {
            0 => QoS::AtMostOnce,
            _ => QoS::AtLeastOnce,
        }
    }

    fn send(&self, client: &Client, heard: &Receiver<Heard>) -> Result<(), ContrastError> {
        let (period, pause) = (
            Duration::from_nanos(self.period),
            Duration::from_nanos(self.pause),
        );
        let mut due = Instant::now();
        for sequence in 0..self.sequences {
            due += pause;
            for step in Step::ALL {
                if step != Step::Drive {
                    due += period;
                }
                wait_until(due);
                let topic = if step.is_report() {
                    "source/report"
                } else {
                    "source/kinematic"
                };
                client.publish(topic, self.level(), false, encode(sequence, step))?;
            }
        }
        // Everything that was published leaves before this does.
        client.disconnect()?;
        while let Ok(heard) = heard.recv() {
            if matches!(heard, Heard::End) {
                break;
            }
        }
        Ok(())
    }

    fn relay(
        &self,
        client: &Client,
        heard: &Receiver<Heard>,
        (topic, seed): (&str, u64),
    ) -> Result<(), ContrastError> {
        let work = ictus::Duration::from_nanos(i64::try_from(self.work).unwrap_or(i64::MAX));
        let mut random = Random::new(seed);
        while let Ok(Heard::Message(sequence, step)) = heard.recv() {
            busy(random.up_to(work));
            client.publish(topic, self.level(), false, encode(sequence, step))?;
        }
        Ok(())
    }

    fn count(&self, heard: &Receiver<Heard>) {
        let mut orders = Orders::default();
        let mut complete = 0;
        while complete < self.sequences {
            let Ok(Heard::Message(sequence, step)) = heard.recv() else {
                break;
            };
            complete += u32::from(orders.note(sequence, step, false).is_some());
        }
        say(&orders);
    }
}

/// Reads the connection, and standard input's end, from threads of their own.
fn listen(mut connection: Connection, subscriptions: usize) -> Receiver<Heard> {
    let (sender, heard) = mpsc::channel();
    let ending = sender.clone();
    thread::spawn(move || {
        drop(io::stdin().read_to_end(&mut Vec::new()));
        drop(ending.send(Heard::End));
    });
    thread::spawn(move || {
        let mut open = 1 + subscriptions;
        for event in connection.iter() {
            let heard = match event {
                Ok(Event::Incoming(Packet::Publish(message))) => {
                    let Some((sequence, step)) = decode(&message.payload) else {
                        continue;
                    };
                    Heard::Message(sequence, step)
                }
                Ok(Event::Incoming(Packet::ConnAck(_) | Packet::SubAck(_))) => {
                    open = open.saturating_sub(1);
                    if open > 0 {
                        continue;
                    }
                    Heard::Ready
                }
                Ok(_) => continue,
                Err(_) => break,
            };
            if sender.send(heard).is_err() {
                return;
            }
        }
        drop(sender.send(Heard::End));
    });
    heard
}

fn encode(sequence: u32, step: Step) -> Vec<u8> {
    let mut bytes = sequence.to_le_bytes().to_vec();
    bytes.push(step.number());
    bytes
}

fn decode(bytes: &[u8]) -> Option<(u32, Step)> {
    let (sequence, step) = bytes.split_first_chunk::<4>()?;
    let step = Step::from_number(*step.first()?)?;
    Some((u32::from_le_bytes(*sequence), step))
}

fn wait_until(due: Instant) {
    let left = due.saturating_duration_since(Instant::now());
    if left > SPIN {
        thread::sleep(left.saturating_sub(SPIN));
    }
    while Instant::now() < due {
        std::hint::spin_loop();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_is_read_as_it_was_written() {
        for step in Step::ALL {
            assert_eq!(decode(&encode(70_000, step)), Some((70_000, step)));
        }
        for bad in [&[][..], &[1, 2, 3, 4], &[1, 2, 3, 4, 9]] {
            assert_eq!(decode(bad), None);
        }
    }
}
