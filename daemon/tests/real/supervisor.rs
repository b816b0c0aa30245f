use std::collections::BTreeMap;
use std::fs;
use std::io::{BufRead, BufReader, Lines, Write};
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};

use ictusd::supervisor::READY;
use ictusd::supervisor::exit::{Ending, ExitRecord};
use ictusd::supervisor::limits::Limits;
use ictusd::supervisor::protocol::{Reply, Request, StopSignal};
use ictusd::supervisor::spec::{PROTOCOL, Spec};
use tempfile::TempDir;

use crate::world::{BOUND, Process, fakes};

struct Supervised {
    directory: TempDir,
    child: Child,
    lines: Lines<BufReader<UnixStream>>,
    writer: UnixStream,
}

impl Supervised {
    fn run(manner: &str) -> Self {
        Self::run_with(|spec| {
            spec.env = BTreeMap::from([("FAKE".to_owned(), manner.to_owned())]);
        })
    }

    fn run_with(change: impl FnOnce(&mut Spec)) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let at = |name: &str| directory.path().join(name);
        let mut spec = Spec {
            limits: Limits::default(),
            protocol: PROTOCOL,
            instance: "the instance".to_owned(),
            name: "a".to_owned(),
            program: fakes().to_path_buf(),
            args: vec![
                "federate".to_owned(),
                "--federate".to_owned(),
                "a".to_owned(),
            ],
            env: BTreeMap::new(),
            cwd: PathBuf::from("/"),
            status: true,
            log: at("a.log"),
            log_size_max: 50_000,
            log_files_max: 3,
            socket: at("a.sock"),
            exit_record: at("a.json"),
            linger_ms: 60_000,
        };
        change(&mut spec);
        fs::write(at("spec.json"), serde_json::to_vec(&spec).unwrap()).unwrap();
        let mut child = Command::new(fakes())
            .arg("supervise")
            .arg(at("spec.json"))
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut ready = String::new();
        BufReader::new(child.stdout.take().unwrap())
            .read_line(&mut ready)
            .unwrap();
        assert_eq!(ready.trim_end(), READY);
        let stream = UnixStream::connect(&spec.socket).unwrap();
        stream.set_read_timeout(Some(BOUND)).unwrap();
        let writer = stream.try_clone().unwrap();
        Self {
            directory,
            child,
            lines: BufReader::new(stream).lines(),
            writer,
        }
    }

    fn ask(&mut self, request: Request) {
        let mut line = serde_json::to_vec(&request).unwrap();
        line.push(b'\n');
        self.writer.write_all(&line).unwrap();
    }

    fn next(&mut self) -> Reply {
        serde_json::from_str(&self.lines.next().unwrap().unwrap()).unwrap()
    }

    fn started(&mut self) -> Process {
        self.ask(Request::Subscribe);
        match self.next() {
            Reply::Started { pid, .. } => Process::of(pid),
            other => panic!("{other:?}"),
        }
    }

    fn ended(&mut self) -> ExitRecord {
        self.ask(Request::Subscribe);
        loop {
            if let Reply::Ended { record } = self.next() {
                return *record;
            }
        }
    }

    fn log(&self) -> String {
        fs::read_to_string(self.directory.path().join("a.log")).unwrap()
    }
}

impl Drop for Supervised {
    fn drop(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }
}

#[test]
fn the_exit_is_recorded_with_the_first_words_and_told() {
    let mut it = Supervised::run("crash");
    let record = it.ended();
    assert_eq!(record.ending, Ending::Exited { code: 3 });
    assert_eq!(record.first_lines, ["no good", "really"]);
    let path = it.directory.path().join("a.json");
    assert_eq!(ExitRecord::read(&path, "the instance"), Some(record));
    assert_eq!(ExitRecord::read(&path, "another instance"), None);
    it.ask(Request::Release);
    assert!(it.child.wait().unwrap().success());
    assert!(!it.directory.path().join("a.sock").exists());
}

#[test]
fn a_program_that_is_not_there_is_named() {
    let mut it = Supervised::run_with(|spec| spec.program = PathBuf::from("/no/such/program"));
    match it.ended().ending {
        Ending::NotStarted { why } => {
            assert_eq!(
                why,
                "/no/such/program: No such file or directory (os error 2)"
            );
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn it_says_who_it_is() {
    let mut it = Supervised::run("hang");
    it.ask(Request::Identify);
    let Reply::Identity {
        instance,
        supervisor,
        ..
    } = it.next()
    else {
        panic!()
    };
    assert_eq!(
        (instance.as_str(), supervisor.pid),
        ("the instance", it.child.id())
    );
    assert!(supervisor.lives());
}

#[test]
fn signals_go_through_the_socket() {
    let mut it = Supervised::run("hang");
    it.ask(Request::Signal {
        signal: StopSignal::Term,
    });
    assert_eq!(it.next(), Reply::Done);
    assert_eq!(it.ended().ending, Ending::Killed { signal: 15 });
}

#[test]
fn strange_requests_are_refused_and_harm_nobody() {
    let mut it = Supervised::run("hang");
    it.writer
        .write_all(b"\xff\xfe{}\n{\"op\":\"dance\"}\n")
        .unwrap();
    assert!(matches!(it.next(), Reply::Refused { .. }));
    assert!(matches!(it.next(), Reply::Refused { .. }));
    it.started().assert_lives();
}

#[test]
fn logs_stay_within_their_bounds_whatever_is_written() {
    let mut it = Supervised::run("spam");
    let record = it.ended();
    assert_eq!(
        (record.ending, record.log_lines_lost),
        (Ending::Exited { code: 0 }, 0)
    );
    let sizes: Vec<_> = fs::read_dir(it.directory.path())
        .unwrap()
        .map(|entry| entry.unwrap())
        .filter(|entry| entry.file_name().to_string_lossy().starts_with("a.log"))
        .map(|entry| entry.metadata().unwrap().len())
        .collect();
    assert_eq!(sizes.len(), 3);
    assert!(sizes.iter().all(|size| *size <= 50_000), "{sizes:?}");
}

#[test]
fn nothing_but_the_spec_reaches_the_program() {
    let mut it = Supervised::run("env");
    it.ended();
    let log = it.log();
    let texts: Vec<_> = log
        .lines()
        .map(|line| line.splitn(3, ' ').nth(2).unwrap())
        .collect();
    assert_eq!(texts, ["hello from a", "FAKE=env", "stdin had 0 lines"]);
}

#[test]
fn a_federate_dies_with_its_supervisor() {
    let mut it = Supervised::run("hang");
    let federate = it.started();
    federate.assert_lives();
    it.child.kill().unwrap();
    federate.assert_ends();
    assert!(!it.directory.path().join("a.json").exists());
}

#[test]
fn orphans_are_killed() {
    let mut it = Supervised::run("orphan");
    assert_eq!(it.ended().ending, Ending::Exited { code: 0 });
    let log = it.log();
    let orphan = log
        .lines()
        .find_map(|line| line.split_once("out orphan "))
        .unwrap()
        .1;
    assert!(!PathBuf::from(format!("/proc/{orphan}")).exists());
}

/// In a container nobody else would, and they would count against its limit of processes.
#[test]
fn orphans_that_end_are_reaped_while_the_process_runs() {
    let mut it = Supervised::run("zombie");
    let began = std::time::Instant::now();
    loop {
        // Answered after what the supervisor does about a child that has ended.
        it.ask(Request::Status);
        assert!(matches!(it.next(), Reply::Status { pid: Some(_), .. }));
        let log = it.log();
        let mut lines = log.lines();
        let orphan = lines.find_map(|line| line.split_once("out orphan "));
        if orphan.is_some_and(|(_, pid)| !PathBuf::from(format!("/proc/{pid}")).exists()) {
            return;
        }
        assert!(began.elapsed() < BOUND, "{log}");
    }
}
