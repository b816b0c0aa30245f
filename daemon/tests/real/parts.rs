//! One federation over two daemons: what one host's daemon does with its part.

use std::collections::BTreeMap;
use std::net::{Ipv4Addr, SocketAddrV4, TcpListener};
use std::os::unix::fs::PermissionsExt as _;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::time::Duration;

use ictus_deploy::Engine;
use ictus_deploy::placement::{PortRange, Security, Way};
use ictus_stream::Papers;
use ictusd::api::part::{CommitRequest, HostRef, LeaseRequest, Part, PrepareRequest};
use ictusd::api::reach::{ListenRequest, ProbeRequest};
use ictusd::api::secret::SecretValues;
use ictusd::api::{ErrorCode, Event, ExitReason, Outcome, StartRequest, State};
use ictusd::client::ClientError;

use crate::world::{BOUND, Process, World, fakes, federation, next, outcome};

const HOME: Ipv4Addr = Ipv4Addr::LOCALHOST;
const NAME: &str = "fake";

/// `a` beside the RTI, `b` on another host.
fn part(request: &StartRequest, host: &str, digest: &str) -> StartRequest {
    let reference = || HostRef {
        way: Way::Local,
        address: HOME,
    };
    let (federates, name) = if host == "one" {
        (vec![0], "a")
    } else {
        (vec![1], "b")
    };
    let part = Part {
        host: host.to_owned(),
        hosts: BTreeMap::from(["one", "two"].map(|name| (name.to_owned(), reference()))),
        rti: host == "one",
        federates,
        address: HOME,
        engine: Engine::Process,
        ports: None,
        programs: BTreeMap::from([(name.to_owned(), digest.to_owned())]),
        security: Security::TrustedNetwork,
    };
    StartRequest {
        part: Some(part),
        ..request.clone()
    }
}

fn prepare(request: StartRequest, previous: Option<&str>) -> PrepareRequest {
    PrepareRequest {
        previous: previous.map(str::to_owned),
        id: "run-1".to_owned(),
        digest: "of all".to_owned(),
        facets: BTreeMap::new(),
        generation: None,
        request,
        secrets: SecretValues::default(),
        papers: BTreeMap::new(),
    }
}

fn commit(fence: u64, rti: Option<u16>) -> CommitRequest {
    CommitRequest {
        fence,
        id: "run-1".to_owned(),
        rti: rti.map(|port| SocketAddrV4::new(HOME, port)),
    }
}

async fn lease(world: &World) -> u64 {
    let request = LeaseRequest {
        who: "a test".to_owned(),
        ttl_ms: 60_000,
    };
    world.client.lease(NAME, &request).await.unwrap().fence
}

fn refusal(error: ClientError) -> (ErrorCode, String) {
    let ClientError::Refused(refusal) = error else {
        panic!("{error}");
    };
    (refusal.code, refusal.message)
}

fn digest() -> String {
    ictusd::blobs::digest(std::fs::File::open(fakes()).unwrap()).unwrap()
}

/// Sends the program and prepares both parts.
async fn prepared(one: &World, two: &World) -> (u64, u64) {
    let digest = digest();
    let (first, second) = (lease(one).await, lease(two).await);
    let request = federation(&[("a", ""), ("b", "")]);
    for (world, host, fence) in [(one, "one", first), (two, "two", second)] {
        let digests = [digest.clone()];
        let missing = world.client.missing_blobs(&digests).await.unwrap();
        if !missing.is_empty() {
            let sent = Arc::new(AtomicU64::new(0));
            let sent = world
                .client
                .send_blob((NAME, fence), &digest, fakes(), sent)
                .await;
            assert!(sent.unwrap() > 0);
        }
        assert!(
            world
                .client
                .missing_blobs(&digests)
                .await
                .unwrap()
                .is_empty()
        );
        let request = prepare(part(&request, host, &digest), None);
        let prepared = world.client.prepare((NAME, fence), &request).await.unwrap();
        assert_eq!(prepared.id, "run-1");
        let view = world.client.federation(NAME).await.unwrap();
        assert_eq!(
            (view.state, view.digest.as_str()),
            (State::Prepared, "of all")
        );
    }
    (first, second)
}

#[tokio::test]
async fn two_parts_become_one_federation_and_end_together() {
    let (one, two) = (World::new().await, World::new().await);
    let (first, second) = prepared(&one, &two).await;
    let mut at_one = one.client.commit(NAME, &commit(first, None)).await.unwrap();
    let port = loop {
        if let Event::Listening { port } = next(&mut at_one).await.event {
            break port;
        }
    };
    let mut at_two = two
        .client
        .commit(NAME, &commit(second, Some(port)))
        .await
        .unwrap();
    for stream in [&mut at_one, &mut at_two] {
        while next(stream).await.event != Event::Healthy {}
    }
    let view = two.client.federation(NAME).await.unwrap();
    let names: Vec<_> = view.federates.iter().map(|it| it.name.as_str()).collect();
    assert_eq!(names, ["b"], "a part shows its own");
    assert_eq!(view.state, State::Running);
    // Stopped where the RTI is, it ends everywhere.
    one.client.stop_part((NAME, first), false).await.unwrap();
    assert_eq!(
        outcome(&mut at_one).await,
        Outcome::Stopped { missed: Vec::new() }
    );
    assert_eq!(outcome(&mut at_two).await, Outcome::Completed);
    for (world, fence) in [(&one, first), (&two, second)] {
        world.client.remove_part((NAME, fence), true).await.unwrap();
        world.client.release(NAME, fence).await.unwrap();
        assert!(!world.paths.federations().exists(), "records are left");
        assert!(!world.paths.blobs().exists(), "programs are left");
        assert!(!world.paths.leases().exists(), "leases are left");
    }
}

#[tokio::test]
async fn keys_are_in_files_of_their_members_and_nowhere_else() {
    const CANARY: &str = "canary-of-a-key";
    let world = World::new().await;
    let fence = lease(&world).await;
    let mut request = part(&federation(&[("a", ""), ("b", "")]), "one", &digest());
    if let Some(part) = &mut request.part {
        part.security = Security::Mtls;
        part.programs.clear();
    }
    let mut prepare = prepare(request, None);
    let papers = Papers {
        authority: "an authority".to_owned(),
        certificate: "a certificate".to_owned(),
        key: CANARY.to_owned(),
    };
    prepare.papers.insert("rti".to_owned(), papers.clone());
    let error = world.client.prepare((NAME, fence), &prepare).await;
    let refused = |what: &str| (ErrorCode::BadRequest, what.to_owned());
    let missing = refused("there is no certificate for `a`");
    assert_eq!(refusal(error.unwrap_err()), missing);
    prepare.papers.insert("a".to_owned(), papers.clone());
    prepare.papers.insert("b".to_owned(), papers);
    let error = world.client.prepare((NAME, fence), &prepare).await;
    let odd = refused("a certificate for `b` is of no use here");
    assert_eq!(refusal(error.unwrap_err()), odd);
    prepare.papers.remove("b");
    world.client.prepare((NAME, fence), &prepare).await.unwrap();
    let mut found = Vec::new();
    let mut directories = vec![world.paths.federations()];
    while let Some(directory) = directories.pop() {
        for entry in std::fs::read_dir(directory).unwrap() {
            let (path, kind) = entry
                .map(|it| (it.path(), it.file_type().unwrap()))
                .unwrap();
            if kind.is_dir() {
                directories.push(path);
            } else if std::fs::read_to_string(&path).unwrap().contains(CANARY) {
                assert_eq!(path.metadata().unwrap().permissions().mode() & 0o777, 0o600);
                found.push(
                    path.strip_prefix(world.paths.federations())
                        .unwrap()
                        .to_owned(),
                );
            }
        }
    }
    found.sort();
    let expected = ["a", "rti"].map(|member| format!("{NAME}/tls/{member}/key.pem"));
    let expected = expected.map(std::path::PathBuf::from);
    assert_eq!(found, expected);
    world
        .client
        .remove_part((NAME, fence), false)
        .await
        .unwrap();
    let left = world.paths.federations().join(NAME).join("tls");
    assert!(!left.exists(), "keys are left");
    world.client.remove_part((NAME, fence), true).await.unwrap();
    world.client.release(NAME, fence).await.unwrap();
}

#[tokio::test]
async fn a_killed_daemon_adopts_its_part() {
    let (one, mut two) = (World::new().await, World::new().await);
    let (first, second) = prepared(&one, &two).await;
    // What is prepared survives, too, and runs no sooner than it is committed.
    two.replace_daemon().await;
    assert_eq!(
        two.client.federation(NAME).await.unwrap().state,
        State::Prepared
    );
    let mut at_one = one.client.commit(NAME, &commit(first, None)).await.unwrap();
    let port = loop {
        if let Event::Listening { port } = next(&mut at_one).await.event {
            break port;
        }
    };
    let mut at_two = two
        .client
        .commit(NAME, &commit(second, Some(port)))
        .await
        .unwrap();
    for stream in [&mut at_one, &mut at_two] {
        while next(stream).await.event != Event::Healthy {}
    }
    two.replace_daemon().await;
    let view = two.client.federation(NAME).await.unwrap();
    assert_eq!(
        (view.state, view.federates[0].state.as_str()),
        (State::Running, "running")
    );
    let b = Process::of(view.federates[0].pid.unwrap());
    b.kill();
    b.assert_ends();
    let Outcome::Failed { failure, .. } = outcome(&mut at_one).await else {
        panic!("the RTI's host must notice");
    };
    // Here it is only known that it was lost; its own host knows why, and comes first.
    assert_eq!((failure.member.as_deref(), failure.rank), (Some("b"), 1));
    let mut events = two.client.events(Some(NAME), true).await.unwrap();
    let Outcome::Failed { failure, .. } = outcome(&mut events).await else {
        panic!("its own host must notice");
    };
    assert_eq!((failure.member.as_deref(), failure.rank), (Some("b"), 0));
    let view = two.client.federation(NAME).await.unwrap();
    assert_eq!(view.federates[0].exit, Some(ExitReason::Killed));
}

#[tokio::test]
async fn only_the_holder_of_the_lease_changes_a_part() {
    let world = World::new().await;
    let fence = lease(&world).await;
    let request = LeaseRequest {
        who: "another".to_owned(),
        ttl_ms: 1_000,
    };
    let error = world.client.lease(NAME, &request).await.unwrap_err();
    let (code, message) = refusal(error);
    assert_eq!(code, ErrorCode::Held);
    assert!(message.contains("a test"), "{message}");
    let held = world.client.start(NAME, &federation(&[("a", "")])).await;
    assert_eq!(refusal(held.unwrap_err()).0, ErrorCode::Held);
    let mut plain = part(&federation(&[("a", ""), ("b", "")]), "one", "");
    plain.part.as_mut().unwrap().programs.clear();
    let plain = prepare(plain, None);
    let old = world.client.prepare((NAME, fence - 1), &plain).await;
    assert_eq!(refusal(old.unwrap_err()).0, ErrorCode::Held);
    world.client.prepare((NAME, fence), &plain).await.unwrap();
    let broken = world.client.break_lease(NAME, "me").await.unwrap();
    assert_eq!(broken.unwrap().who, "a test");
    // Who held it changes nothing any more.
    let late = world.client.commit(NAME, &commit(fence, None)).await;
    assert_eq!(refusal(late.unwrap_err()).0, ErrorCode::Held);
    let newer = lease(&world).await;
    assert!(newer > fence);
    let late = world.client.remove_part((NAME, fence), true).await;
    assert_eq!(refusal(late.unwrap_err()).0, ErrorCode::Held);
    world.client.remove_part((NAME, newer), true).await.unwrap();
}

#[tokio::test]
async fn what_nobody_commits_is_removed_when_its_lease_has_ended() {
    let world = World::new().await;
    let mut request = part(&federation(&[("a", ""), ("b", "")]), "one", "");
    request.part.as_mut().unwrap().programs.clear();
    let prepare = prepare(request, None);
    let short = LeaseRequest {
        who: "a test".to_owned(),
        ttl_ms: 300,
    };
    let fence = world.client.lease(NAME, &short).await.unwrap().fence;
    world.client.prepare((NAME, fence), &prepare).await.unwrap();
    // Who takes the lease in time finds it, and keeps it for as long as that one lasts.
    let fence = until(async || world.client.lease(NAME, &short).await.ok())
        .await
        .fence;
    let there = world.client.federation(NAME).await.unwrap();
    assert_eq!(there.state, State::Prepared);
    until(async || {
        let left = world.client.federations().await.unwrap();
        left.is_empty().then_some(())
    })
    .await;
    let late = world.client.commit(NAME, &commit(fence, None)).await;
    refusal(late.unwrap_err());
    world.client.remove(NAME, true).await.ok();
}

/// Asks again until there is an answer.
async fn until<T>(ask: impl AsyncFn() -> Option<T>) -> T {
    let asked = async {
        loop {
            if let Some(answer) = ask().await {
                return answer;
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    tokio::time::timeout(BOUND, asked).await.unwrap()
}

#[tokio::test]
async fn what_cannot_be_prepared_is_said_and_leaves_nothing() {
    let world = World::new().await;
    let fence = lease(&world).await;
    let request = part(&federation(&[("a", ""), ("b", "")]), "one", &"0".repeat(64));
    let missing = world
        .client
        .prepare((NAME, fence), &prepare(request.clone(), None))
        .await;
    let (_, message) = refusal(missing.unwrap_err());
    assert!(message.contains("was not sent"), "{message}");
    let with = |change: &dyn Fn(&mut StartRequest)| {
        let mut request = request.clone();
        request.part.as_mut().unwrap().programs.clear();
        change(&mut request);
        prepare(request, None)
    };
    // A port that somebody else has.
    let other = TcpListener::bind((HOME, 0)).unwrap();
    let port = other.local_addr().unwrap().port();
    let ports = PortRange {
        first: port,
        last: port,
    };
    let taken = with(&|it| it.part.as_mut().unwrap().ports = Some(ports));
    let (_, message) = refusal(
        world
            .client
            .prepare((NAME, fence), &taken)
            .await
            .unwrap_err(),
    );
    assert!(message.contains("0 are free and 1 are needed"), "{message}");
    let taken = with(&|it| it.settings.rti_port = Some(port));
    let (_, message) = refusal(
        world
            .client
            .prepare((NAME, fence), &taken)
            .await
            .unwrap_err(),
    );
    assert!(message.contains(&format!("port {port}")), "{message}");
    // A run that is not the one that was seen.
    let moved = PrepareRequest {
        previous: Some("another run".to_owned()),
        ..with(&|_| {})
    };
    let (code, message) = refusal(
        world
            .client
            .prepare((NAME, fence), &moved)
            .await
            .unwrap_err(),
    );
    assert_eq!(code, ErrorCode::Conflict);
    assert!(message.contains("has changed here"), "{message}");
    assert!(world.client.federations().await.unwrap().is_empty());
    assert!(!world.directory(NAME).exists());
    // What this host does not have.
    let pinned = with(&|it| it.federates[0].needs.cpus = vec![9_999]);
    let said = world.client.prepare((NAME, fence), &pinned).await;
    let (_, message) = refusal(said.unwrap_err());
    assert!(message.contains("9999"), "{message}");
}

#[tokio::test]
async fn a_port_taken_between_prepare_and_commit_is_named() {
    let world = World::new().await;
    let fence = lease(&world).await;
    let mut request = part(&federation(&[("a", ""), ("b", "")]), "one", "");
    request.part.as_mut().unwrap().programs.clear();
    let free = TcpListener::bind((HOME, 0)).unwrap();
    let port = free.local_addr().unwrap().port();
    drop(free);
    request.settings.rti_port = Some(port);
    let fine = prepare(request, None);
    let prepared = world.client.prepare((NAME, fence), &fine).await.unwrap();
    assert_eq!(prepared.rti_port, Some(port));
    let thief = TcpListener::bind((HOME, port)).unwrap();
    let committed = world.client.commit(NAME, &commit(fence, None)).await;
    let (_, message) = refusal(committed.unwrap_err());
    let me = std::process::id();
    for words in [
        format!("host `one`: port {port} of {HOME}, which the RTI is to have, is taken"),
        format!("(process {me}, "),
    ] {
        assert!(message.contains(&words), "{words} is missing in {message}");
    }
    drop(thief);
    // Nothing of it runs, and who deploys undoes it.
    let view = world.client.federation(NAME).await.unwrap();
    assert_eq!(view.state, State::Prepared);
    world.client.remove_part((NAME, fence), true).await.unwrap();
    assert!(world.client.federations().await.unwrap().is_empty());
}

#[tokio::test]
async fn who_commits_and_goes_away_undoes_the_part() {
    let (one, two) = (World::new().await, World::new().await);
    let (first, _) = prepared(&one, &two).await;
    let mut stream = one.client.commit(NAME, &commit(first, None)).await.unwrap();
    while !matches!(next(&mut stream).await.event, Event::Listening { .. }) {}
    let mut events = one.client.events(Some(NAME), true).await.unwrap();
    drop(stream);
    assert_eq!(outcome(&mut events).await, Outcome::Aborted);
}

#[tokio::test]
async fn bytes_of_another_digest_are_refused() {
    let world = World::new().await;
    let fence = lease(&world).await;
    let sent = Arc::new(AtomicU64::new(0));
    let wrong = "0".repeat(64);
    let error = world
        .client
        .send_blob((NAME, fence), &wrong, fakes(), sent)
        .await;
    let (code, message) = refusal(error.unwrap_err());
    assert_eq!(code, ErrorCode::BadRequest);
    assert!(message.contains(&wrong), "{message}");
    assert_eq!(
        world
            .client
            .missing_blobs(std::slice::from_ref(&wrong))
            .await
            .unwrap(),
        [wrong]
    );
}

#[tokio::test]
async fn one_host_listens_and_another_says_the_word() {
    let (one, two) = (World::new().await, World::new().await);
    let word = "open".to_owned();
    let listen = ListenRequest {
        address: HOME,
        ports: None,
        word: word.clone(),
        for_ms: 20_000,
    };
    let there = one.client.listen_for_a_while(&listen).await.unwrap();
    let probe = ProbeRequest {
        from: Ipv4Addr::new(127, 0, 0, 2),
        to: SocketAddrV4::new(HOME, there.port),
        word,
        limit_ms: 10_000,
    };
    let reached = two.client.try_to_reach(&probe).await.unwrap();
    assert_eq!((reached.tcp, reached.udp), (Ok(()), Ok(())));
    let wordless = ListenRequest {
        word: String::new(),
        ..listen
    };
    let (code, _) = refusal(one.client.listen_for_a_while(&wordless).await.unwrap_err());
    assert_eq!(code, ErrorCode::BadRequest);
}
