//! The multi-call binary's stand-in for tests: daemon and supervisor are the real ones, RTI and federates speak
//! a line protocol of their own and misbehave on demand.
#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    clippy::print_stderr,
    clippy::exit,
    clippy::zombie_processes,
    clippy::too_many_lines,
    reason = "a test program"
)]

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::process::{Command, ExitCode};
use std::sync::mpsc::{Sender, channel};
use std::thread;

use ictus_coord::measure::Measures;
use ictus_coord::report::{
    self as status_lines, ClockSource, ClockStatus, FederateStatus, RtiStatus, exit,
};
use ictus_core::Duration;
use ictusd::daemon;
use ictusd::paths::Paths;
use ictusd::supervisor;
use serde::Serialize;

fn main() -> ExitCode {
    let mut args = std::env::args_os().skip(1);
    let command = args.next().unwrap_or_default();
    match command.to_str().unwrap_or_default() {
        supervisor::shim::COMMAND => supervisor::shim::exec(args),
        "supervise" => report(supervisor::run(Path::new(&args.next().unwrap_or_default()))),
        "daemon" => report(
            Paths::from_env()
                .map_err(Into::into)
                .and_then(|paths| daemon::run(&paths).map(|_| ())),
        ),
        "rti" => rti(&options()),
        _ => federate(&options()),
    }
}

fn report<E: std::fmt::Display>(result: Result<(), E>) -> ExitCode {
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}

/// `-x VALUE` pairs.
fn options() -> BTreeMap<String, String> {
    let args: Vec<String> = std::env::args()
        .skip_while(|arg| !arg.starts_with('-'))
        .collect();
    args.chunks(2)
        .filter_map(|pair| Some((pair[0].clone(), pair.get(1)?.clone())))
        .collect()
}

struct Status(File);

impl Status {
    fn open(options: &BTreeMap<String, String>) -> Self {
        let path = format!("/proc/self/fd/{}", options["--status-fd"]);
        Self(OpenOptions::new().write(true).open(path).unwrap())
    }

    fn say(&mut self, status: &impl Serialize) {
        let mut line = serde_json::to_vec(status).unwrap();
        line.push(b'\n');
        self.0.write_all(&line).unwrap();
    }
}

/// What the RTI waits for.
enum Heard {
    Hello(u16, TcpStream),
    Bye(u16),
    Gone(u16),
    Terminate,
}

fn rti(options: &BTreeMap<String, String>) -> ExitCode {
    let mut status = Status::open(options);
    let listener = match TcpListener::bind(format!("127.0.0.1:{}", options["-p"])) {
        Ok(listener) => listener,
        Err(error) => {
            eprintln!("cannot listen on port {}: {error}", options["-p"]);
            return ExitCode::FAILURE;
        }
    };
    status.say(&RtiStatus::Listening {
        port: listener.local_addr().unwrap().port(),
    });
    let (sender, heard) = channel();
    let of: usize = options["-n"].parse().unwrap();
    let accepted = sender.clone();
    thread::spawn(move || {
        for stream in listener.incoming() {
            let sender = accepted.clone();
            thread::spawn(move || hear(stream.unwrap(), &sender));
        }
    });
    thread::spawn(move || {
        wait_for_terminate();
        sender.send(Heard::Terminate).unwrap();
    });
    let mut federates = BTreeMap::new();
    let mut code = exit::OK;
    let mut joined = 0;
    for heard in heard {
        match heard {
            Heard::Hello(federate, stream) => {
                federates.insert(federate, stream);
                joined += 1;
                status.say(&RtiStatus::Joined { federate });
                if joined == of {
                    status.say(&RtiStatus::Start {
                        start_ns: ictusd::stamp::now_ns(),
                    });
                    tell(&mut federates, "start");
                }
            }
            Heard::Bye(federate) => {
                federates.remove(&federate);
                status.say(&RtiStatus::Resigned { federate });
            }
            Heard::Gone(federate) => {
                if federates.remove(&federate).is_some() {
                    let reason = "the connection was closed".to_owned();
                    status.say(&RtiStatus::Failed { federate, reason });
                    code = exit::FAILED;
                    tell(&mut federates, "peer");
                }
            }
            Heard::Terminate => {
                status.say(&RtiStatus::StopRequested { federate: None });
                status.say(&RtiStatus::Stop {
                    elapsed_ns: 0,
                    microstep: 1,
                });
                tell(&mut federates, "stop");
            }
        }
        if joined == of && federates.is_empty() {
            break;
        }
    }
    status.say(&RtiStatus::Ended { code });
    ExitCode::from(code)
}

fn hear(stream: TcpStream, sender: &Sender<Heard>) {
    let mut id = 0;
    for line in BufReader::new(stream.try_clone().unwrap()).lines() {
        let Ok(line) = line else { break };
        if let Some(hello) = line.strip_prefix("hello ") {
            id = hello.parse().unwrap();
            sender
                .send(Heard::Hello(id, stream.try_clone().unwrap()))
                .unwrap();
        } else {
            sender.send(Heard::Bye(id)).unwrap();
        }
    }
    sender.send(Heard::Gone(id)).ok();
}

fn tell(federates: &mut BTreeMap<u16, TcpStream>, word: &str) {
    for stream in federates.values_mut() {
        writeln!(stream, "{word}").ok();
    }
}

fn wait_for_terminate() {
    let (mut reader, writer) = UnixStream::pair().unwrap();
    signal_hook::low_level::pipe::register(signal_hook::consts::SIGTERM, writer).unwrap();
    std::io::Read::read_exact(&mut reader, &mut [0]).unwrap();
}

/// What a federate does, from its variable `FAKE`: nothing given is good behaviour.
fn federate(options: &BTreeMap<String, String>) -> ExitCode {
    let manner = std::env::var("FAKE").unwrap_or_default();
    println!(
        "hello from {}",
        options.get("--federate").map_or("nobody", String::as_str)
    );
    match manner.as_str() {
        "crash" => {
            eprintln!("no good\nreally");
            ExitCode::from(3)
        }
        "hang" => loop {
            thread::park();
        },
        "spam" => {
            for _ in 0..20_000 {
                println!("0123456789 0123456789 0123456789 0123456789");
            }
            std::io::stderr().write_all(&vec![0xff; 200_000]).unwrap();
            ExitCode::SUCCESS
        }
        "env" => {
            for (name, value) in std::env::vars() {
                println!("{name}={value}");
            }
            let read = std::io::stdin().lines().count();
            println!("stdin had {read} lines");
            ExitCode::SUCCESS
        }
        "zombie" => {
            // The child's child outlives it and ends at once.
            let own = std::env::current_exe().unwrap();
            let child = Command::new(own)
                .arg("federate")
                .env("FAKE", "parent")
                .status();
            assert!(child.unwrap().success());
            loop {
                thread::park();
            }
        }
        "parent" => {
            let own = std::env::current_exe().unwrap();
            let child = Command::new(own)
                .arg("federate")
                .env("FAKE", "env")
                .spawn()
                .unwrap();
            println!("orphan {}", child.id());
            ExitCode::SUCCESS
        }
        "crowd" => loop {
            let one_more = thread::Builder::new().spawn(|| {
                loop {
                    thread::park();
                }
            });
            if let Err(error) = one_more {
                eprintln!("{error}");
                return ExitCode::from(3);
            }
        },
        "fill" => {
            let mut kept = Vec::new();
            loop {
                kept.push(vec![1_u8; 1 << 20]);
            }
        }
        "orphan" => {
            let own = std::env::current_exe().unwrap();
            let child = Command::new(own)
                .arg("federate")
                .env("FAKE", "hang")
                .spawn()
                .unwrap();
            println!("orphan {}", child.id());
            ExitCode::SUCCESS
        }
        _ => member(options, &manner),
    }
}

/// What a federate with one upstream peer says once a second, lines that are none among it.
fn say_measures(status: &mut Status, federate: &str) {
    let mut measures = Measures::new(&[0], &[0]);
    measures.arrived(0, 8);
    measures.slack(0, Duration::from_millis(3));
    measures.violation(0, Duration::from_millis(2));
    measures.sent(0, 16);
    measures.tag_completed();
    for line in status_lines::lines(federate, &measures) {
        status.0.write_all(&line).unwrap();
    }
    status.say(&FederateStatus::Clock {
        federate: federate.to_owned(),
        clock: ClockStatus {
            source: ClockSource::Builtin,
            bound_ns: Some(5_000),
            ..ClockStatus::default()
        },
    });
    status
        .0
        .write_all(b"{\"event\":\"upstream\"}\nnothing\n\xff\n")
        .unwrap();
    status.say(&FederateStatus::StpViolation {
        federate: federate.to_owned(),
        upstream: 0,
        lateness_ns: 2_000_000,
        count: 1,
    });
}

fn member(options: &BTreeMap<String, String>, manner: &str) -> ExitCode {
    let mut status = Status::open(options);
    let federate = options["--federate"].clone();
    if manner == "deaf" {
        thread::spawn(|| {
            loop {
                wait_for_terminate();
            }
        });
    }
    let plan: ictus_coord::plan::Plan =
        serde_json::from_reader(File::open(&options["--plan"]).unwrap()).unwrap();
    let id = plan
        .federates
        .iter()
        .position(|it| it.name == federate)
        .unwrap();
    let mut stream = TcpStream::connect(&options["--rti"]).unwrap();
    writeln!(stream, "hello {id}").unwrap();
    let mut code = exit::RTI_LOST;
    let mut reason = "the RTI was lost";
    for line in BufReader::new(stream.try_clone().unwrap()).lines() {
        let Ok(line) = line else { break };
        match line.as_str() {
            "start" => {
                status.say(&FederateStatus::Joined {
                    federate: federate.clone(),
                });
                status.say(&FederateStatus::Start {
                    federate: federate.clone(),
                    start_ns: ictusd::stamp::now_ns(),
                });
                status.say(&FederateStatus::Running {
                    federate: federate.clone(),
                });
                if manner == "measured" {
                    say_measures(&mut status, &federate);
                }
                if manner == "short" {
                    (code, reason) = (exit::OK, "nothing left to do");
                    break;
                }
            }
            "stop" if manner != "deaf" => {
                (code, reason) = (exit::OK, "stopped");
                break;
            }
            "peer" if manner != "deaf" => {
                (code, reason) = (exit::PEER_FAILED, "another federate failed");
                break;
            }
            _ => {}
        }
    }
    if code == exit::OK || code == exit::PEER_FAILED {
        writeln!(stream, "bye").ok();
    }
    let (elapsed_ns, microstep, reason) = (0, 1, reason.to_owned());
    status.say(&FederateStatus::Ended {
        federate,
        elapsed_ns,
        microstep,
        code,
        reason,
    });
    ExitCode::from(code)
}
