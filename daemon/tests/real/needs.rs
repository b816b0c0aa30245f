//! What federates need besides their program: secrets, processors, scheduling, a user.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, Permissions};
use std::io;
use std::net::{Ipv4Addr, TcpListener};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};

use ictus_deploy::gives::Gives;
use ictus_deploy::placement::{Realtime, RealtimePolicy, SecretSource};
use ictusd::api::secret::{SecretValue, SecretValues, StartCall};
use ictusd::api::{ErrorCode, Event, Outcome, StartRequest, State};
use ictusd::client::ClientError;
use rustix::process::{Resource, Rlimit};

use crate::world::{BOUND, OWN_SOCKETS, Process, Started, World, fakes, federation, next, outcome};

const NAME: &str = "fake";
const CANARY: &str = "canary-3f1c";

/// `a` with a secret, `b` without.
fn request() -> StartRequest {
    let mut request = federation(&[("a", ""), ("b", "")]);
    let secrets = &mut request.federates[0].needs.secrets;
    secrets.insert("TOKEN".to_owned(), SecretSource::Environment);
    request
}

fn values(value: &str) -> SecretValues {
    let value = SecretValue::new(value.as_bytes().to_vec());
    let of_a = BTreeMap::from([("TOKEN".to_owned(), value)]);
    SecretValues(BTreeMap::from([("a".to_owned(), of_a)]))
}

fn call(value: &str) -> StartCall {
    StartCall {
        request: request(),
        secrets: values(value),
    }
}

async fn start(world: &World, call: &StartCall) -> Started {
    let mut stream = world.client.start_with(NAME, call).await.unwrap();
    let mut processes = BTreeMap::new();
    loop {
        match next(&mut stream).await.event {
            Event::Started { member, pid, .. } => {
                processes.insert(member, Process::of(pid));
            }
            Event::Healthy => return Started { processes, stream },
            Event::Ended { outcome } => panic!("not healthy: {outcome:?}"),
            _ => {}
        }
    }
}

async fn refused(world: &World, call: &StartCall) -> (ErrorCode, String) {
    match world.client.start_with(NAME, call).await {
        Err(ClientError::Refused(refusal)) => (refusal.code, refusal.message),
        other => panic!("{other:?}"),
    }
}

fn of_process(started: &Started, member: &str, file: &str) -> String {
    let pid = started.processes[member].pid;
    let text = fs::read(format!("/proc/{pid}/{file}")).unwrap();
    String::from_utf8_lossy(&text).replace('\0', "\n")
}

/// Where a federate of a run finds its secret.
fn secret_file(started: &Started) -> PathBuf {
    let environ = of_process(started, "a", "environ");
    let file = environ
        .lines()
        .find_map(|line| line.strip_prefix("TOKEN_FILE="));
    PathBuf::from(file.unwrap_or_else(|| panic!("{environ}")))
}

/// Files below a directory that hold a text; what goes while it is looked at holds nothing.
fn holding(directory: &Path, text: &str) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in there(fs::read_dir(directory)).into_iter().flatten() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(holding(&path, text));
        } else if path.is_file() {
            let bytes = there(fs::read(&path)).unwrap_or_default();
            if bytes.windows(text.len()).any(|it| it == text.as_bytes()) {
                found.push(path);
            }
        }
    }
    found
}

fn there<T>(read: io::Result<T>) -> Option<T> {
    match read {
        Err(error) if error.kind() == io::ErrorKind::NotFound => None,
        read => Some(read.unwrap()),
    }
}

#[tokio::test]
async fn a_secret_is_a_file_in_memory_and_nowhere_else() {
    let world = World::new().await;
    let mut started = start(&world, &call(CANARY)).await;
    let file = secret_file(&started);
    assert_eq!(fs::read_to_string(&file).unwrap(), CANARY);
    assert_eq!(file.metadata().unwrap().mode() & 0o777, 0o400);
    assert!(!of_process(&started, "b", "environ").contains("TOKEN_FILE"));
    for member in ["a", "b", "rti"] {
        for file in ["environ", "cmdline"] {
            assert!(!of_process(&started, member, file).contains(CANARY));
        }
    }
    let limits = of_process(&started, "a", "limits");
    let core = limits
        .lines()
        .find(|line| line.starts_with("Max core"))
        .unwrap();
    let words: Vec<_> = core.split_ascii_whitespace().collect();
    // 0 would not keep a pipe from getting it.
    assert_eq!(words[4..6], ["1", "1"], "{core}");
    assert_eq!(holding(&world.paths.state, CANARY), Vec::<PathBuf>::new());
    // The same once more is nothing to do; another value is.
    let (code, _) = refused(&world, &call(CANARY)).await;
    assert_eq!(code, ErrorCode::AlreadyRunning);
    let (code, message) = refused(&world, &call("other")).await;
    assert_eq!(code, ErrorCode::Conflict);
    assert!(
        message.contains("another value of secret `TOKEN` of federate `a`"),
        "{message}"
    );
    let changed = world.client.changed_secrets(NAME, &values("other")).await;
    let names = BTreeSet::from(["TOKEN".to_owned()]);
    assert_eq!(changed.unwrap(), BTreeMap::from([("a".to_owned(), names)]));
    let same = world.client.changed_secrets(NAME, &values(CANARY)).await;
    assert!(same.unwrap().is_empty());
    world.client.stop(NAME, false).await.unwrap();
    outcome(&mut started.stream).await;
    world.client.remove(NAME, true).await.unwrap();
    assert!(!file.exists());
    assert!(!file.ancestors().nth(3).unwrap().exists(), "the last one");
    assert!(!world.paths.secrets_key().exists());
}

#[tokio::test]
async fn without_its_secrets_a_run_waits_and_is_not_started() {
    let mut world = World::new().await;
    let mut only = call(CANARY);
    only.secrets = SecretValues::default();
    let free = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let address = free.local_addr().unwrap();
    drop(free);
    only.request.settings.metrics_listen = Some(address);
    let (_, message) = refused(&world, &only).await;
    assert!(
        message.contains("the value of secret `TOKEN` of federate `a` did not come"),
        "{message}"
    );
    // Nor does it listen for a run that is not there.
    let closed = async {
        while TcpListener::bind(address).is_err() {
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(BOUND, closed).await.unwrap();
    only.request = request();
    let started = start(&world, &call(CANARY)).await;
    let file = secret_file(&started);
    // As when the host loses its power: processes and memory are gone, the record is there.
    world.kill_daemon();
    let members = world.record(NAME)["members"].as_object().cloned().unwrap();
    for member in members.values() {
        let pid = member["supervisor"]["pid"].as_u64().unwrap();
        let supervisor = Process::of(u32::try_from(pid).unwrap());
        supervisor.kill();
        supervisor.assert_ends();
    }
    fs::remove_dir_all(file.ancestors().nth(3).unwrap()).unwrap();
    world.replace_daemon_after_end().await;
    let view = world.client.federation(NAME).await.unwrap();
    assert_eq!((view.state, view.outcome), (State::WaitingForSecrets, None));
    let left = fs::read_dir(&world.paths.run).unwrap();
    assert_eq!(left.count(), OWN_SOCKETS);
    world.replace_daemon().await;
    let view = world.client.federation(NAME).await.unwrap();
    assert_eq!(view.state, State::WaitingForSecrets);
    let (_, message) = refused(&world, &only).await;
    assert!(message.contains("did not come"), "{message}");
    let again = start(&world, &call(CANARY)).await;
    assert_eq!(fs::read_to_string(secret_file(&again)).unwrap(), CANARY);
    world.client.remove(NAME, true).await.unwrap();
    assert!(!file.exists());
}

/// What `chrt` and `taskset` would print: policy and priority of the kernel, processors, user.
#[tokio::test]
async fn a_federate_runs_where_and_as_what_it_is_told() {
    let world = World::new().await;
    let gives: Gives = world.client.host().await.unwrap().gives;
    // Root of a container may perhaps not raise limits.
    let unlimited = Rlimit {
        current: None,
        maximum: None,
    };
    let raised = rustix::process::setrlimit(Resource::Memlock, unlimited).is_ok();
    let mut request = federation(&[("a", ""), ("b", "")]);
    let cpu = *gives.cpus.last().unwrap();
    let needs = &mut request.federates[0].needs;
    needs.cpus = vec![cpu];
    match &gives.realtime {
        Ok(_) => {
            needs.realtime = Some(Realtime {
                policy: RealtimePolicy::RoundRobin,
                priority: 7,
                lock_memory: raised,
            });
        }
        Err(denied) => skipped(&format!("realtime scheduling: {}", denied.why)),
    }
    if gives.uid == 0 {
        // The program has to be reached by that user, too.
        let public = world.paths.state.parent().unwrap();
        fs::set_permissions(public, Permissions::from_mode(0o755)).unwrap();
        let program = public.join("fakes");
        fs::copy(fakes(), &program).unwrap();
        request.federates[0].executable = program;
        request.federates[0].needs.user = Some("60007:60008".to_owned());
        request.federates[1].needs.user = Some("0:60008".to_owned());
    } else {
        skipped("another user: this is not root");
    }
    let mut started = world.start_healthy(NAME, &request).await;
    let status = of_process(&started, "a", "status");
    let line = |name: &str| {
        let line = status.lines().find_map(|line| line.strip_prefix(name));
        line.unwrap().trim().to_owned()
    };
    assert_eq!(line("Cpus_allowed_list:"), cpu.to_string());
    if gives.uid == 0 {
        assert_eq!(line("Uid:"), "60007\t60007\t60007\t60007");
        assert_eq!(line("Gid:"), "60008\t60008\t60008\t60008");
        assert_eq!(line("Groups:"), "");
        let status = of_process(&started, "b", "status");
        let group = status.lines().find(|line| line.starts_with("Gid:"));
        assert_eq!(group, Some("Gid:\t60008\t60008\t60008\t60008"));
    }
    if !raised {
        skipped("memory that is locked: the limit cannot be raised");
    }
    if gives.realtime.is_ok() {
        let stat = of_process(&started, "a", "stat");
        let fields: Vec<_> = stat
            .rsplit_once(')')
            .unwrap()
            .1
            .split_ascii_whitespace()
            .collect();
        // Fields 40 and 41 of stat(5): rt_priority and policy (SCHED_RR is 2).
        assert_eq!((fields[37], fields[38]), ("7", "2"), "{stat}");
        if gives.uid == 0 && raised {
            let limits = of_process(&started, "a", "limits");
            let mut lines = limits.lines();
            let locked = lines.find(|line| line.starts_with("Max locked memory"));
            let words: Vec<_> = locked.unwrap().split_ascii_whitespace().collect();
            assert_eq!(words[3..5], ["unlimited"; 2], "{limits}");
        }
    }
    // Another user's process is stopped like any other.
    world.client.stop(NAME, false).await.unwrap();
    let ended = outcome(&mut started.stream).await;
    assert_eq!(ended, Outcome::Stopped { missed: Vec::new() });
}

#[expect(clippy::print_stderr, reason = "a test's report")]
fn skipped(what: &str) {
    eprintln!("skipped: {what}");
}

#[tokio::test]
async fn what_this_host_cannot_give_is_refused_before_anything_runs() {
    let world = World::new().await;
    let mut request = federation(&[("a", ""), ("b", "")]);
    request.federates[1].needs.cpus = vec![0, 1_000_000];
    let error = world.client.start(NAME, &request).await.unwrap_err();
    let text = error.to_string();
    let words = "this host cannot give federate `b` processor 1000000: it has 0";
    assert!(text.starts_with(words), "{text}");
    assert!(!world.directory(NAME).exists());
}
