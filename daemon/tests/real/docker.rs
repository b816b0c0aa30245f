//! Members in containers of this machine's engine; skipped where there is none, but not in CI.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::net::Ipv4Addr;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};
use std::thread;

use ictus_deploy::image::elf::Machine;
use ictus_deploy::{Engine, Needs};
use ictusd::api::part::{CommitRequest, HostRef, LeaseRequest, Part, PrepareRequest};
use ictusd::api::secret::SecretValues;
use ictusd::api::{Event, Failure, FailureKind, Outcome, StartRequest, State};
use ictusd::identity::random_id;

use crate::world::{BOUND, OWN_SOCKETS, Process, Program, World, fakes, federation, next, outcome};

const SOCKET: &str = "/var/run/docker.sock";

/// The fakes as a static program, as everything is that runs in an image of ours.
fn static_fakes() -> &'static Path {
    static BUILT: OnceLock<PathBuf> = OnceLock::new();
    BUILT.get_or_init(|| {
        if Machine::of(fakes()).unwrap().interpreter.is_none() {
            return fakes().to_path_buf();
        }
        // Together with `ictus`, as `make test` has done by then.
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
        let built = Command::new(root.join(".ci/static")).output().unwrap();
        assert!(built.status.success(), "{built:?}");
        let ictus = String::from_utf8(built.stdout).unwrap();
        root.join(ictus.trim_end()).with_file_name("ictusd-fakes")
    })
}

fn docker(args: &[&str]) -> String {
    let output = Command::new("docker").args(args).output().unwrap();
    assert!(output.status.success(), "docker {args:?}: {output:?}");
    String::from_utf8(output.stdout).unwrap().trim().to_owned()
}

/// A federation's name that nobody else in this engine has; everything with it is removed at the end.
struct Rig {
    name: String,
}

impl Rig {
    /// Absent where there is no engine, which a line tells; not where everything must be tested.
    fn new() -> Option<Self> {
        let there = Command::new("docker").arg("info").output();
        if there.is_ok_and(|output| output.status.success()) {
            let name = format!("t{}", &random_id().unwrap()[..12]);
            return Some(Self { name });
        }
        assert_ne!(
            std::env::var("CI").as_deref(),
            Ok("true"),
            "no Docker engine"
        );
        eprintln!("skipped: no Docker engine");
        None
    }

    fn list(&self, what: &[&str], fields: &str) -> Vec<String> {
        let filter = format!("label=ictus.federation={}", self.name);
        let found = docker(&[what, &["--filter", &filter, "--format", fields]].concat());
        let mut found: Vec<_> = found.lines().map(str::to_owned).collect();
        found.sort();
        found
    }

    /// Members that have a container, running or not.
    fn containers(&self) -> Vec<String> {
        self.list(&["ps", "--all"], "{{.Label \"ictus.member\"}}")
    }

    fn ids(&self) -> Vec<String> {
        self.list(&["ps", "--all", "--no-trunc"], "{{.ID}}")
    }

    fn container(&self, member: &str) -> String {
        let all = self.list(&["ps", "--all"], "{{.Label \"ictus.member\"}} {{.Names}}");
        let found = all
            .iter()
            .find_map(|line| line.strip_prefix(&format!("{member} ")));
        found.unwrap().to_owned()
    }

    fn images(&self) -> Vec<String> {
        self.list(&["images"], "{{.ID}}")
    }

    async fn world(&self) -> World {
        self.world_with(None).await
    }

    async fn world_with(&self, engine: Option<PathBuf>) -> World {
        let executable = static_fakes().to_path_buf();
        World::of(Program { executable, engine }).await
    }

    /// Fake federates, all on this host, in containers.
    fn request(&self, members: &[(&str, &str)]) -> StartRequest {
        let mut request = federation(members);
        for run in &mut request.federates {
            run.executable = static_fakes().to_path_buf();
        }
        let (address, way) = (Ipv4Addr::LOCALHOST, ictus_deploy::placement::Way::Local);
        request.part = Some(Part {
            host: "here".to_owned(),
            hosts: BTreeMap::from([("here".to_owned(), HostRef { way, address })]),
            rti: true,
            federates: request.federates.iter().map(|run| run.id).collect(),
            address,
            engine: Engine::Docker,
            ports: None,
            security: ictus_deploy::placement::Security::TrustedNetwork,
            programs: BTreeMap::new(),
        });
        request
    }

    /// Starts it and gives the failure it must end with; then nothing may be left.
    async fn fails(&self, request: &StartRequest) -> Failure {
        let world = self.world().await;
        let mut stream = world.client.start(&self.name, request).await.unwrap();
        let outcome = outcome(&mut stream).await;
        let Outcome::Failed { failure, .. } = outcome else {
            panic!("{outcome:?}");
        };
        assert_eq!(self.containers(), [""; 0]);
        // A stop that comes while it is undone is answered when that is over.
        let stopped = async {
            let mut stream = world.client.stop(&self.name, false).await.unwrap();
            while stream.next().await.unwrap().is_some() {}
        };
        tokio::time::timeout(BOUND, stopped).await.unwrap();
        // Waits for the undoing, unless it is over.
        world.client.remove(&self.name, true).await.ok();
        let run_files = fs::read_dir(&world.paths.run).unwrap();
        assert_eq!(run_files.count(), OWN_SOCKETS);
        failure
    }
}

impl Drop for Rig {
    fn drop(&mut self) {
        // What a daemon that just ended had asked to be removed may still be going.
        let docker = |args: &[&str]| Command::new("docker").args(args).output();
        let filter = format!("label=ictus.federation={}", self.name);
        for (list, remove) in [
            (&["ps", "--all", "--quiet"][..], "rm"),
            (&["images", "--quiet"], "rmi"),
        ] {
            let found = docker(&[list, &["--filter", &filter]].concat());
            let found = found.map(|found| String::from_utf8_lossy(&found.stdout).into_owned());
            for id in found.unwrap_or_default().lines() {
                docker(&[remove, "--force", id]).ok();
            }
        }
    }
}

#[tokio::test]
async fn members_in_containers_start_and_stop_and_leave_nothing() {
    let Some(rig) = Rig::new() else { return };
    let world = rig.world().await;
    let request = rig.request(&[("a", ""), ("b", "")]);
    let mut started = world.start_healthy(&rig.name, &request).await;
    assert_eq!(rig.containers(), ["a", "b", "rti"]);
    // The pids that are told are this host's.
    let status =
        fs::read_to_string(format!("/proc/{}/status", started.processes["a"].pid)).unwrap();
    let inside = status.lines().find_map(|line| line.strip_prefix("NSpid:"));
    assert_eq!(
        inside.unwrap().split_ascii_whitespace().count(),
        2,
        "{status}"
    );
    let view = world.client.federation(&rig.name).await.unwrap();
    assert_eq!(view.federates[0].pid, Some(started.processes["a"].pid));
    let inspected = docker(&["inspect", &rig.container("a")]);
    let inspected: serde_json::Value = serde_json::from_str(&inspected).unwrap();
    let host = &inspected[0]["HostConfig"];
    assert_eq!(
        (host["NetworkMode"].as_str(), host["Privileged"].as_bool()),
        (Some("host"), Some(false))
    );
    assert_eq!(host["ReadonlyRootfs"], true);
    let mut stop = world.client.stop(&rig.name, false).await.unwrap();
    let stopped = Outcome::Stopped { missed: Vec::new() };
    assert_eq!(outcome(&mut stop).await, stopped);
    assert_eq!(outcome(&mut started.stream).await, stopped);
    assert_eq!(rig.containers(), [""; 0]);
    let log = fs::read_to_string(world.directory(&rig.name).join("logs/a.log")).unwrap();
    assert!(log.contains("hello from a"), "{log}");
    let record = fs::read_to_string(world.directory(&rig.name).join("exit/a.json")).unwrap();
    assert!(record.contains("\"ending\": \"exited\""), "{record}");
    assert_ne!(rig.images(), [""; 0]);
    world.client.remove(&rig.name, true).await.unwrap();
    assert_eq!(rig.images(), [""; 0]);
    assert!(!world.directory(&rig.name).exists());
    let left = fs::read_dir(&world.paths.run).unwrap();
    assert_eq!(left.count(), OWN_SOCKETS);
}

#[tokio::test]
async fn a_daemon_that_is_killed_changes_nothing_and_the_next_one_adopts_containers() {
    let Some(rig) = Rig::new() else { return };
    let mut world = rig.world().await;
    let started = world
        .start_healthy(&rig.name, &rig.request(&[("a", ""), ("b", "")]))
        .await;
    let before = rig.ids();
    world.replace_daemon().await;
    for process in started.processes.values() {
        process.assert_lives();
    }
    assert_eq!(rig.ids(), before);
    let view = world.client.federation(&rig.name).await.unwrap();
    assert_eq!(view.state, State::Running);
    assert!(
        view.federates.iter().all(|it| it.state == "running"),
        "{view:?}"
    );
    let mut stop = world.client.stop(&rig.name, false).await.unwrap();
    assert_eq!(
        outcome(&mut stop).await,
        Outcome::Stopped { missed: Vec::new() }
    );
    assert_eq!(rig.containers(), [""; 0]);
}

#[tokio::test]
async fn what_ended_while_no_daemon_was_there_is_told_from_its_record() {
    let Some(rig) = Rig::new() else { return };
    let mut world = rig.world().await;
    let started = world
        .start_healthy(&rig.name, &rig.request(&[("a", ""), ("b", "")]))
        .await;
    world.kill_daemon();
    // The others end by themselves.
    started.processes["a"].kill();
    for process in started.processes.values() {
        process.assert_ends();
    }
    world.replace_daemon_after_end().await;
    let mut events = world.client.stop(&rig.name, false).await;
    if let Ok(events) = &mut events {
        outcome(events).await;
    }
    let view = world.client.federation(&rig.name).await.unwrap();
    assert_eq!(
        view.federates[0].ending.as_deref(),
        Some("killed by SIGKILL")
    );
    assert_eq!(rig.containers(), [""; 0]);
}

#[tokio::test]
async fn a_container_with_our_label_that_is_in_no_record_is_left_alone() {
    let Some(rig) = Rig::new() else { return };
    let mut world = rig.world().await;
    world
        .start_healthy(&rig.name, &rig.request(&[("a", "")]))
        .await;
    let image = docker(&["inspect", "--format", "{{.Image}}", &rig.container("a")]);
    let label = format!("ictus.federation={}", rig.name);
    let copied = docker(&[
        "create",
        "--label",
        &label,
        "--label",
        "ictus.member=a",
        &image,
    ]);
    world.replace_daemon().await;
    world.client.remove(&rig.name, true).await.unwrap();
    assert_eq!(rig.ids(), [copied]);
}

#[tokio::test]
async fn a_container_in_a_members_place_is_foreign_and_left_alone() {
    let Some(rig) = Rig::new() else { return };
    let mut world = rig.world().await;
    world
        .start_healthy(&rig.name, &rig.request(&[("a", ""), ("b", "")]))
        .await;
    let name = rig.container("a");
    let image = docker(&["inspect", "--format", "{{.Image}}", &name]);
    world.kill_daemon();
    docker(&["rm", "--force", &name]);
    let copied = docker(&[
        "create",
        "--name",
        &name,
        "--label",
        "ictus.instance=another",
        &image,
    ]);
    world.replace_daemon_after_end().await;
    let view = world.client.federation(&rig.name).await.unwrap();
    assert_eq!(view.federates[0].state, "foreign");
    world.client.remove(&rig.name, true).await.unwrap();
    assert_eq!(docker(&["inspect", "--format", "{{.Id}}", &name]), copied);
    docker(&["rm", "--force", &copied]);
    assert_eq!(rig.containers(), [""; 0]);
}

#[tokio::test]
async fn a_federate_that_fails_in_its_container_is_told_with_its_first_words() {
    let Some(rig) = Rig::new() else { return };
    let failure = rig.fails(&rig.request(&[("a", ""), ("b", "crash")])).await;
    assert_eq!(failure.member.as_deref(), Some("b"));
    assert_eq!(
        (failure.kind, failure.lines),
        (
            FailureKind::Process,
            vec!["no good".to_owned(), "really".to_owned()]
        )
    );
    assert!(failure.what.contains("exit code 3"), "{}", failure.what);
    assert_eq!(rig.images(), [""; 0]);
}

#[tokio::test]
async fn a_container_that_is_killed_from_outside_is_told_and_removed() {
    let Some(rig) = Rig::new() else { return };
    let world = rig.world().await;
    let mut started = world
        .start_healthy(&rig.name, &rig.request(&[("a", ""), ("b", "")]))
        .await;
    docker(&["kill", &rig.container("a")]);
    let Outcome::Failed { failure, .. } = outcome(&mut started.stream).await else {
        panic!("it stopped in order");
    };
    assert_eq!(failure.member.as_deref(), Some("a"));
    assert!(
        failure
            .what
            .contains("vanished together with its supervisor"),
        "{}",
        failure.what
    );
    assert_eq!(rig.containers(), [""; 0]);
}

#[tokio::test]
async fn memory_that_is_used_up_is_named_as_the_cause() {
    let Some(rig) = Rig::new() else { return };
    let mut request = rig.request(&[("a", "fill"), ("b", "")]);
    request.federates[0].needs.memory = Some(48 << 20);
    let failure = rig.fails(&request).await;
    assert_eq!(failure.member.as_deref(), Some("a"));
    assert!(
        failure
            .what
            .contains("its memory limit (`memory:`) was used up"),
        "{}",
        failure.what
    );
}

#[tokio::test]
async fn too_many_processes_are_named_as_the_cause() {
    let Some(rig) = Rig::new() else { return };
    let mut request = rig.request(&[("a", "crowd"), ("b", "")]);
    request.federates[0].needs.pids = Some(20);
    let failure = rig.fails(&request).await;
    assert_eq!(failure.member.as_deref(), Some("a"));
    assert!(
        failure.lines[0].contains("its limit of processes (`pids:`) was reached"),
        "{failure:?}"
    );
}

#[tokio::test]
async fn an_image_that_is_not_there_is_named() {
    let Some(rig) = Rig::new() else { return };
    let mut request = rig.request(&[("a", ""), ("b", "")]);
    request.federates[1].needs.image = Some("127.0.0.1:1/no-such-image:1".to_owned());
    let failure = rig.fails(&request).await;
    assert_eq!(failure.member.as_deref(), Some("b"));
    assert!(
        failure
            .what
            .contains("image 127.0.0.1:1/no-such-image:1 is not on this host"),
        "{}",
        failure.what
    );
}

#[tokio::test]
async fn a_dynamic_program_is_refused_with_its_interpreter() {
    let Some(rig) = Rig::new() else { return };
    let mut request = rig.request(&[("a", "")]);
    request.federates[0].executable = "/bin/true".into();
    let failure = rig.fails(&request).await;
    assert!(
        failure.what.contains("/lib64/ld-linux") && failure.what.contains("crt-static"),
        "{}",
        failure.what
    );
}

#[tokio::test]
async fn another_user_runs_a_federate() {
    let Some(rig) = Rig::new() else { return };
    let mut request = rig.request(&[("a", "")]);
    request.federates[0].needs = Needs {
        user: Some("4711:4711".to_owned()),
        ..Needs::default()
    };
    let world = rig.world().await;
    let started = world.start_healthy(&rig.name, &request).await;
    let status =
        fs::read_to_string(format!("/proc/{}/status", started.processes["a"].pid)).unwrap();
    assert!(status.contains("Uid:\t4711\t4711\t4711\t4711"), "{status}");
    let mut stop = world.client.stop(&rig.name, false).await.unwrap();
    assert_eq!(
        outcome(&mut stop).await,
        Outcome::Stopped { missed: Vec::new() }
    );
    assert_eq!(rig.containers(), [""; 0]);
    world.client.remove(&rig.name, true).await.unwrap();
    assert!(!world.directory(&rig.name).exists());
}

#[tokio::test]
async fn images_are_made_before_anything_runs() {
    let Some(rig) = Rig::new() else { return };
    let world = rig.world().await;
    let name = rig.name.as_str();
    let asks = LeaseRequest {
        who: "a test".to_owned(),
        ttl_ms: 600_000,
    };
    let fence = world.client.lease(name, &asks).await.unwrap().fence;
    let mut prepare = PrepareRequest {
        previous: None,
        id: "run-1".to_owned(),
        digest: String::new(),
        facets: BTreeMap::new(),
        generation: None,
        request: rig.request(&[("a", ""), ("b", "")]),
        secrets: SecretValues::default(),
        papers: BTreeMap::new(),
    };
    prepare.request.federates[1].needs.image = Some("127.0.0.1:1/no-such-image:1".to_owned());
    let refused = world.client.prepare((name, fence), &prepare).await;
    let why = refused.unwrap_err().to_string();
    assert!(
        why.contains("host `here`")
            && why.contains("image 127.0.0.1:1/no-such-image:1 is not on this host"),
        "{why}"
    );
    prepare.request = rig.request(&[("a", ""), ("b", "")]);
    world.client.prepare((name, fence), &prepare).await.unwrap();
    let made = rig.images();
    assert_eq!((made.len(), rig.containers()), (1, Vec::new()));
    let commit = CommitRequest {
        fence,
        id: "run-1".to_owned(),
        rti: None,
    };
    let mut stream = world.client.commit(name, &commit).await.unwrap();
    while next(&mut stream).await.event != Event::Healthy {}
    assert_eq!(rig.containers(), ["a", "b", "rti"]);
    assert_eq!(rig.images(), made);
    world.client.remove_part((name, fence), true).await.unwrap();
    assert_eq!((rig.containers(), rig.images()), (Vec::new(), Vec::new()));
}

/// A socket before the engine's, which can be closed as a stopped engine's is.
struct Proxy {
    path: PathBuf,
    open: Arc<AtomicBool>,
}

impl Proxy {
    fn new(directory: &Path) -> Self {
        let path = directory.join("docker.sock");
        let listener = UnixListener::bind(&path).unwrap();
        let open = Arc::new(AtomicBool::new(true));
        let shared = Arc::clone(&open);
        thread::spawn(move || {
            for client in listener.incoming().map_while(Result::ok) {
                if !shared.load(Ordering::SeqCst) {
                    continue;
                }
                let engine = UnixStream::connect(SOCKET).unwrap();
                let (from, to) = (client.try_clone().unwrap(), engine.try_clone().unwrap());
                thread::spawn(move || pass(from, to));
                thread::spawn(move || pass(engine, client));
            }
        });
        Self { path, open }
    }
}

fn pass(mut from: UnixStream, mut to: UnixStream) {
    // Either side may close first.
    io::copy(&mut from, &mut to).ok();
    to.shutdown(std::net::Shutdown::Write).ok();
}

#[tokio::test]
async fn an_engine_that_stops_answering_is_named_and_what_is_left_is_removed_later() {
    let Some(rig) = Rig::new() else { return };
    let directory = tempfile::tempdir().unwrap();
    let proxy = Proxy::new(directory.path());
    let world = rig.world_with(Some(proxy.path.clone())).await;
    world
        .start_healthy(&rig.name, &rig.request(&[("a", "")]))
        .await;
    proxy.open.store(false, Ordering::SeqCst);
    // Supervisors need no engine.
    let mut stop = world.client.stop(&rig.name, false).await.unwrap();
    assert_eq!(
        outcome(&mut stop).await,
        Outcome::Stopped { missed: Vec::new() }
    );
    assert_eq!(rig.containers(), ["a", "rti"]);
    let why = world
        .client
        .remove(&rig.name, true)
        .await
        .unwrap_err()
        .to_string();
    assert!(
        why.contains("leaves containers") && why.contains("systemctl start docker"),
        "{why}"
    );
    proxy.open.store(true, Ordering::SeqCst);
    world.client.remove(&rig.name, true).await.unwrap();
    assert_eq!((rig.containers(), rig.images()), (Vec::new(), Vec::new()));
}

#[tokio::test]
async fn an_engine_that_is_not_there_is_named_with_the_fix() {
    let Some(rig) = Rig::new() else { return };
    let directory = tempfile::tempdir().unwrap();
    let world = rig.world_with(Some(directory.path().join("no.sock"))).await;
    let facts = world.client.host().await.unwrap();
    assert!(
        facts
            .docker
            .unwrap_err()
            .contains("apt-get install docker.io")
    );
    let mut stream = world
        .client
        .start(&rig.name, &rig.request(&[("a", "")]))
        .await
        .unwrap();
    loop {
        if let Event::Ended {
            outcome: Outcome::Failed { failure, .. },
        } = next(&mut stream).await.event
        {
            assert!(
                failure.what.contains("no Docker engine"),
                "{}",
                failure.what
            );
            break;
        }
    }
    let world = rig.world().await;
    let facts = world.client.host().await.unwrap().docker.unwrap();
    assert!(
        !facts.version.is_empty() && !facts.storage_driver.is_empty(),
        "{facts:?}"
    );
}

#[tokio::test]
async fn an_orphan_in_a_container_ends_with_its_federate() {
    let Some(rig) = Rig::new() else { return };
    let world = rig.world().await;
    let started = world
        .start_healthy(&rig.name, &rig.request(&[("a", ""), ("b", "")]))
        .await;
    let first = docker(&["inspect", "--format", "{{.State.Pid}}", &rig.container("a")]);
    let supervisor = Process::of(first.parse().unwrap());
    world.client.stop(&rig.name, true).await.unwrap();
    assert!(supervisor.ended(BOUND));
    for process in started.processes.values() {
        process.assert_ends();
    }
}
