use std::fs;
use std::os::unix::net::UnixListener;
use std::process::{Command, Stdio};
use std::time::Duration;

use ictusd::api::{ErrorCode, Event, FailureKind, Outcome, State};
use ictusd::client::{Client, is_already_running};
use ictusd::paths::Owner;

use crate::world::{BOUND, Process, World, fakes, federation, next, outcome, spawn_daemon};

fn member(view: &ictusd::api::FederationView, name: &str) -> String {
    view.federates
        .iter()
        .find(|it| it.name == name)
        .unwrap()
        .state
        .clone()
}

#[tokio::test]
async fn a_start_tells_every_stage_and_a_stop_ends_at_the_stop_tag() {
    let world = World::new().await;
    let mut stream = world
        .client
        .start("pair", &federation(&[("a", ""), ("b", "")]))
        .await
        .unwrap();
    let mut stages = Vec::new();
    loop {
        let (event, last) = match next(&mut stream).await.event {
            Event::Started { member, .. } => (format!("started {member}"), false),
            Event::Listening { .. } => ("listening".to_owned(), false),
            Event::Joined { joined, of, .. } => (format!("joined {joined}/{of}"), false),
            Event::StartTag { .. } => ("start tag".to_owned(), false),
            Event::Running { running, of, .. } => (format!("running {running}/{of}"), false),
            Event::Healthy => ("healthy".to_owned(), true),
            other => panic!("{other:?}"),
        };
        stages.push(event);
        if last {
            break;
        }
    }
    assert_eq!(stages[..2], ["started rti", "listening"]);
    for stage in ["joined 2/2", "start tag", "running 2/2"] {
        assert!(stages.iter().any(|it| it == stage), "{stages:?}");
    }
    let place = |stage: &str| stages.iter().position(|it| it == stage);
    assert!(place("started a") < place("joined 2/2"), "{stages:?}");
    assert!(place("started b") < place("joined 2/2"), "{stages:?}");
    let view = world.client.federation("pair").await.unwrap();
    assert_eq!(
        (view.state, member(&view, "a")),
        (State::Running, "running".to_owned())
    );
    let mut stop = world.client.stop("pair", false).await.unwrap();
    assert_eq!(
        outcome(&mut stop).await,
        Outcome::Stopped { missed: Vec::new() }
    );
    assert_eq!(
        outcome(&mut stream).await,
        Outcome::Stopped { missed: Vec::new() }
    );
    let view = world.client.federation("pair").await.unwrap();
    assert_eq!(
        (view.state, member(&view, "b")),
        (State::Ended, "ended".to_owned())
    );
}

#[tokio::test]
async fn a_federate_that_exits_at_once_undoes_the_start() {
    let world = World::new().await;
    let request = federation(&[("a", ""), ("b", "crash"), ("c", "")]);
    let mut stream = world.client.start("trio", &request).await.unwrap();
    let mut processes = Vec::new();
    let outcome = loop {
        match next(&mut stream).await.event {
            Event::Started { pid, .. } => processes.push(pid),
            Event::Ended { outcome } => break outcome,
            _ => {}
        }
    };
    let Outcome::Failed {
        failure,
        was_healthy: false,
    } = outcome
    else {
        panic!("{outcome:?}")
    };
    assert_eq!(
        (failure.member.as_deref(), failure.what.as_str()),
        (Some("b"), "exit code 3")
    );
    assert_eq!(failure.lines, ["no good", "really"]);
    assert!(failure.log.unwrap().is_file());
    let left = fs::read_dir(world.directory("trio")).unwrap();
    let mut left: Vec<_> = left.map(|it| it.unwrap().file_name()).collect();
    left.sort();
    assert_eq!(left, ["events.ndjson", "exit", "logs", "record.json"]);
    for pid in processes {
        assert!(
            !fs::exists(format!("/proc/{pid}")).unwrap(),
            "{pid} lives on"
        );
    }
    assert!(stream.next().await.unwrap().is_none());
}

#[tokio::test]
async fn who_does_not_join_is_named_and_the_start_undone() {
    let world = World::new().await;
    let mut request = federation(&[("a", ""), ("b", "hang")]);
    request.settings.join_timeout = Duration::from_secs(5);
    let mut stream = world.client.start("pair", &request).await.unwrap();
    let Outcome::Failed { failure, .. } = outcome(&mut stream).await else {
        panic!()
    };
    assert_eq!(failure.kind, FailureKind::Timeout);
    assert_eq!(failure.what, "not joined in time: b");
}

#[tokio::test]
async fn a_starter_that_goes_away_before_healthy_undoes_the_start() {
    let world = World::new().await;
    let mut events = world.client.events(None, true).await.unwrap();
    let request = federation(&[("a", ""), ("b", "hang")]);
    let mut stream = world.client.start("pair", &request).await.unwrap();
    while !matches!(next(&mut stream).await.event, Event::Joined { .. }) {}
    drop(stream);
    assert_eq!(outcome(&mut events).await, Outcome::Aborted);
}

#[tokio::test]
async fn sigkill_of_a_federate_stops_the_rest_and_names_it() {
    let world = World::new().await;
    let mut pair = world
        .start_healthy("pair", &federation(&[("a", ""), ("b", "")]))
        .await;
    pair.processes["b"].kill();
    let Outcome::Failed {
        failure,
        was_healthy: true,
    } = outcome(&mut pair.stream).await
    else {
        panic!()
    };
    assert_eq!(
        (failure.member.as_deref(), failure.what.as_str()),
        (Some("b"), "killed by SIGKILL")
    );
    let view = world.client.federation("pair").await.unwrap();
    assert_eq!(view.federates[0].ending.as_deref(), Some("exit code 11"));
}

#[tokio::test]
async fn sigkill_of_the_rti_ends_every_federate() {
    let world = World::new().await;
    let mut pair = world
        .start_healthy("pair", &federation(&[("a", ""), ("b", "deaf")]))
        .await;
    pair.processes["rti"].kill();
    let Outcome::Failed { failure, .. } = outcome(&mut pair.stream).await else {
        panic!()
    };
    assert_eq!(failure.member.as_deref(), Some("rti"));
    let view = world.client.federation("pair").await.unwrap();
    assert_eq!(view.federates[0].ending.as_deref(), Some("exit code 10"));
}

#[tokio::test]
async fn sigkill_of_the_daemon_changes_nothing_and_the_next_one_adopts() {
    let mut world = World::new().await;
    let pair = world
        .start_healthy("pair", &federation(&[("a", ""), ("b", "")]))
        .await;
    let before = world.client.federation("pair").await.unwrap();
    world.replace_daemon().await;
    for process in pair.processes.values() {
        process.assert_lives();
    }
    let mut stop = world.client.stop("pair", false).await.unwrap();
    assert_eq!(
        outcome(&mut stop).await,
        Outcome::Stopped { missed: Vec::new() }
    );
    let view = world.client.federation("pair").await.unwrap();
    assert_eq!((view.id, view.start_ns), (before.id, before.start_ns));
    let mut events = world.client.events(Some("pair"), false).await.unwrap();
    let mut healthy = 0;
    while let Some(happening) = events.next().await.unwrap() {
        healthy += usize::from(happening.event == Event::Healthy);
    }
    assert_eq!(healthy, 1, "what was told before is not told again");
}

#[tokio::test]
async fn what_ended_without_a_daemon_is_told_by_the_next_one() {
    let mut world = World::new().await;
    let pair = world
        .start_healthy("pair", &federation(&[("a", ""), ("b", "")]))
        .await;
    world.kill_daemon();
    pair.processes["a"].kill();
    for process in pair.processes.values() {
        process.assert_ends();
    }
    world.replace_daemon_after_end().await;
    let mut stop = world.client.stop("pair", false).await.unwrap();
    let Outcome::Failed { failure, .. } = outcome(&mut stop).await else {
        panic!()
    };
    assert_eq!(
        (failure.member.as_deref(), failure.what.as_str()),
        (Some("a"), "killed by SIGKILL")
    );
}

#[tokio::test]
async fn the_first_answer_of_a_new_daemon_is_its_own() {
    let mut world = World::new().await;
    let pair = world
        .start_healthy("pair", &federation(&[("a", ""), ("b", "")]))
        .await;
    world.kill_daemon();
    let [a, b] = ["a", "b"].map(|name| {
        let pid = &world.record("pair")["members"][name]["supervisor"]["pid"];
        Process::of(u32::try_from(pid.as_u64().unwrap()).unwrap())
    });
    // A supervisor that does not answer holds neither the daemon nor what is known of the others.
    b.stop();
    a.kill();
    pair.processes["a"].assert_ends();
    world.replace_daemon_after_end().await;
    let view = world.client.federation("pair").await.unwrap();
    b.go_on();
    assert_eq!(member(&view, "a"), "ended");
    assert_ne!(member(&view, "b"), "running");
    assert!(view.rti_port.is_some() && view.start_ns.is_some());
    world.client.remove("pair", true).await.unwrap();
    for process in pair.processes.values() {
        process.assert_ends();
    }
}

#[tokio::test]
async fn a_record_that_does_not_match_is_foreign_and_its_process_never_signalled() {
    let mut world = World::new().await;
    let pair = world
        .start_healthy("pair", &federation(&[("a", ""), ("b", "")]))
        .await;
    world.kill_daemon();
    let mut record = world.record("pair");
    let start_time = &mut record["members"]["a"]["supervisor"]["start_time"];
    *start_time = (start_time.as_u64().unwrap() + 1).into();
    let text = serde_json::to_vec(&record).unwrap();
    fs::write(world.directory("pair").join("record.json"), text).unwrap();
    world.replace_daemon_after_end().await;
    let mut kill = world.client.stop("pair", true).await.unwrap();
    let Outcome::Failed { failure, .. } = outcome(&mut kill).await else {
        panic!()
    };
    assert_eq!(
        (failure.kind, failure.member.as_deref()),
        (FailureKind::Foreign, Some("a"))
    );
    pair.processes["b"].assert_ends();
    // The fake federate ends by itself when it loses the RTI; nobody has killed it.
    pair.processes["a"].assert_ends();
    let log = fs::read_to_string(world.directory("pair").join("exit/a.json")).unwrap();
    assert!(log.contains("\"ending\": \"exited\""), "{log}");
}

#[tokio::test]
async fn a_deaf_federate_is_killed_and_said_to_have_missed_the_stop_tag() {
    let world = World::new().await;
    let mut request = federation(&[("a", ""), ("b", "deaf")]);
    for forced in [false, true] {
        if forced {
            request.settings.stop_grace = BOUND;
        }
        let _pair = world.start_healthy("pair", &request).await;
        let mut stop = world.client.stop("pair", false).await.unwrap();
        if forced {
            let ended_a =
                |event: &Event| matches!(event, Event::Exited { member, .. } if member == "a");
            while !ended_a(&next(&mut stop).await.event) {}
            stop = world.client.stop("pair", true).await.unwrap();
        }
        let Outcome::Failed {
            failure,
            was_healthy: true,
        } = outcome(&mut stop).await
        else {
            panic!()
        };
        assert_eq!(
            (failure.kind, failure.what.as_str()),
            (
                FailureKind::Timeout,
                "did not reach the stop tag in time: b"
            )
        );
    }
}

#[tokio::test]
async fn a_run_whose_record_is_damaged_is_adopted_from_what_else_is_there() {
    for text in ["", "{\"protocol\": 1, \"mem"] {
        let mut world = World::new().await;
        let pair = world
            .start_healthy("pair", &federation(&[("a", ""), ("b", "")]))
            .await;
        let before = world.client.federation("pair").await.unwrap();
        world.kill_daemon();
        fs::write(world.directory("pair").join("record.json"), text).unwrap();
        world.replace_daemon_after_end().await;
        let view = world.client.federation("pair").await.unwrap();
        assert_eq!(
            (view.state, view.id, view.start_ns),
            (State::Running, before.id, before.start_ns)
        );
        let removed = world.client.remove("pair", false).await.unwrap();
        let missed = Vec::new();
        assert_eq!(removed.outcome, Some(Outcome::Stopped { missed }));
        for process in pair.processes.values() {
            process.assert_ends();
        }
    }
}

#[tokio::test]
async fn a_run_of_a_newer_version_is_listed_and_neither_taken_down_nor_left_without_a_daemon() {
    let mut world = World::new().await;
    let pair = world
        .start_healthy("pair", &federation(&[("a", ""), ("b", "")]))
        .await;
    world.kill_daemon();
    let path = world.directory("pair").join("record.json");
    let record = fs::read(&path).unwrap();
    fs::write(&path, "{\"protocol\": 99}").unwrap();
    world.replace_daemon_after_end().await;
    let views = world.client.federations().await.unwrap();
    let Some(Outcome::Failed { failure, .. }) = &views[0].outcome else {
        panic!("{views:?}")
    };
    assert!(failure.what.contains("is of protocol 99"), "{failure:?}");
    assert_eq!(views[0].state, State::Running);
    for purge in [false, true] {
        let error = world.client.remove("pair", purge).await.unwrap_err();
        let said = error.to_string();
        assert!(said.contains(path.to_str().unwrap()), "{said}");
        assert!(said.contains("rti (supervisor "), "{said}");
    }
    let request = federation(&[("a", "")]);
    assert!(world.client.start("pair", &request).await.is_err());
    assert!(!world.client.end().await.unwrap(), "it is still needed");
    for process in pair.processes.values() {
        process.assert_lives();
    }
    world.kill_daemon();
    fs::write(&path, record).unwrap();
    world.replace_daemon_after_end().await;
    world.client.remove("pair", true).await.unwrap();
    pair.processes["a"].assert_ends();
}

#[tokio::test]
async fn a_run_whose_request_is_damaged_is_not_taken_down_while_it_runs() {
    let mut world = World::new().await;
    let pair = world
        .start_healthy("pair", &federation(&[("a", ""), ("b", "")]))
        .await;
    world.kill_daemon();
    let path = world.directory("pair").join("request.json");
    fs::write(&path, "").unwrap();
    world.replace_daemon_after_end().await;
    let error = world.client.remove("pair", false).await.unwrap_err();
    assert!(
        error.to_string().contains(path.to_str().unwrap()),
        "{error}"
    );
    pair.processes["a"].kill();
    for process in pair.processes.values() {
        process.assert_ends();
    }
}

#[tokio::test]
async fn a_run_whose_directory_was_removed_is_still_listed_and_stopped() {
    let world = World::new().await;
    let pair = world
        .start_healthy("pair", &federation(&[("a", ""), ("b", "")]))
        .await;
    fs::remove_dir_all(world.directory("pair")).unwrap();
    let views = world.client.federations().await.unwrap();
    assert_eq!((views.len(), views[0].state), (1, State::Running));
    let removed = world.client.remove("pair", false).await.unwrap();
    let missed = Vec::new();
    assert_eq!(removed.outcome, Some(Outcome::Stopped { missed }));
    for process in pair.processes.values() {
        process.assert_ends();
    }
}

#[tokio::test]
async fn a_program_that_ends_by_itself_is_completed() {
    let world = World::new().await;
    let request = federation(&[("a", "short"), ("b", "short")]);
    let mut stream = world.client.start("pair", &request).await.unwrap();
    while next(&mut stream).await.event != Event::Healthy {}
    assert_eq!(outcome(&mut stream).await, Outcome::Completed);
}

#[tokio::test]
async fn the_same_start_again_and_another_one_are_told_apart() {
    let world = World::new().await;
    let request = federation(&[("a", ""), ("b", "")]);
    let _pair = world.start_healthy("pair", &request).await;
    assert!(is_already_running(
        &world.client.start("pair", &request).await.unwrap_err()
    ));
    let other = world
        .client
        .start("pair", &federation(&[("a", "")]))
        .await
        .unwrap_err();
    assert_eq!(other.refusal().unwrap().code, ErrorCode::Conflict);
    let unknown = world.client.federation("pear").await.unwrap_err();
    let refusal = unknown.refusal().unwrap();
    assert_eq!(
        (refusal.code, refusal.known.as_slice()),
        (ErrorCode::Unknown, &["pair".to_owned()][..])
    );
}

#[tokio::test]
async fn a_bad_request_harms_nobody() {
    let world = World::new().await;
    let mut request = federation(&[("a", "")]);
    for name in ["..", "a/b", ""] {
        assert!(world.client.start(name, &request).await.is_err(), "{name}");
    }
    request.federates[0].name = "../../x".to_owned();
    request.plan.federates[0].name = "../../x".to_owned();
    let error = world.client.start("pair", &request).await.unwrap_err();
    assert_eq!(error.refusal().unwrap().code, ErrorCode::BadRequest);
    assert!(world.client.federations().await.unwrap().is_empty());
}

#[tokio::test]
async fn down_keeps_the_logs_and_purge_keeps_nothing() {
    let mut world = World::new().await;
    let _pair = world
        .start_healthy("pair", &federation(&[("a", ""), ("b", "")]))
        .await;
    let at = |name: &str| world.directory("pair").join(name);
    fs::write(at("timing").join("a.timing"), "0\t0").unwrap();
    let removed = world.client.remove("pair", false).await.unwrap();
    let kept: Vec<_> = removed.kept.iter().map(|it| it.path.clone()).collect();
    assert_eq!(kept, [at("logs"), at("timing")]);
    assert_eq!(removed.kept[1].bytes, 3, "and how large it is");
    assert!(!at("trace").exists(), "nothing was in it");
    assert!(world.client.federations().await.unwrap().is_empty());
    let mut logs = world
        .client
        .logs("pair", &["a".to_owned()], false, None)
        .await
        .unwrap();
    assert_eq!(logs.next().await.unwrap().unwrap().text, "hello from a");
    let removed = world.client.remove("pair", true).await.unwrap();
    assert!(removed.kept.is_empty());
    assert!(!world.paths.federations().exists());
    assert!(world.client.end().await.unwrap());
    assert!(world.daemon.wait().unwrap().success());
    assert!(!world.paths.state.exists(), "nothing is left");
    world.daemon = Command::new("/bin/true").spawn().unwrap();
}

#[tokio::test]
async fn logs_are_followed_to_the_end_of_the_run() {
    let world = World::new().await;
    let _pair = world
        .start_healthy("pair", &federation(&[("a", ""), ("b", "")]))
        .await;
    let mut logs = world.client.logs("pair", &[], true, None).await.unwrap();
    let first = logs.next().await.unwrap().unwrap();
    assert!(first.text.starts_with("hello from"), "{first:?}");
    let mut stop = world.client.stop("pair", false).await.unwrap();
    outcome(&mut stop).await;
    let rest = async { while logs.next().await.unwrap().is_some() {} };
    tokio::time::timeout(BOUND, rest).await.unwrap();
}

#[tokio::test]
async fn an_rti_port_in_use_is_the_headline() {
    let world = World::new().await;
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let mut request = federation(&[("a", "")]);
    request.settings.rti_port = Some(taken.local_addr().unwrap().port());
    let mut stream = world.client.start("one", &request).await.unwrap();
    let Outcome::Failed { failure, .. } = outcome(&mut stream).await else {
        panic!()
    };
    assert_eq!(failure.member.as_deref(), Some("rti"));
    assert!(failure.lines[0].contains("in use"), "{failure:?}");
}

#[tokio::test]
async fn a_stale_socket_is_replaced_and_two_daemons_never_serve() {
    let directory = tempfile::tempdir().unwrap();
    let state = directory.path().to_path_buf();
    let paths = ictusd::paths::Paths {
        run: state.join("run"),
        state,
        owner: Owner::User,
    };
    paths.create().unwrap();
    // Dropped without removing the file: what a killed daemon leaves.
    drop(UnixListener::bind(paths.socket()).unwrap());
    assert!(paths.socket().exists());
    let mut first = spawn_daemon(&paths, "60000");
    assert_eq!(
        Client::find(&paths)
            .await
            .unwrap()
            .info()
            .await
            .unwrap()
            .pid,
        first.id()
    );
    let mut second = spawn_daemon(&paths, "60000");
    assert!(second.wait().unwrap().success());
    assert_eq!(
        Client::find(&paths)
            .await
            .unwrap()
            .info()
            .await
            .unwrap()
            .pid,
        first.id()
    );
    first.kill().unwrap();
    first.wait().unwrap();
}

#[tokio::test]
async fn a_daemon_that_does_not_answer_is_named_in_bounded_time() {
    let world = World::new().await;
    let daemon = Process::of(world.daemon.id());
    daemon.stop();
    let found = Client::find_or_start(&world.paths, fakes());
    let found = tokio::time::timeout(Duration::from_secs(10), found).await;
    daemon.go_on();
    let said = found.expect("in time").unwrap_err().to_string();
    let expected = format!("the daemon (pid {}) does not answer", daemon.pid);
    assert!(said.starts_with(&expected), "{said}");
    assert!(
        said.contains(&format!("kill -CONT {}", daemon.pid)),
        "{said}"
    );
}

#[tokio::test]
async fn a_session_with_another_runtime_directory_finds_the_same_daemon_and_federates() {
    let mut world = World::new().await;
    let pair = world
        .start_healthy("pair", &federation(&[("a", ""), ("b", "")]))
        .await;
    let elsewhere = tempfile::tempdir().unwrap();
    let other = ictusd::paths::Paths {
        run: elsewhere.path().join("ictus"),
        ..world.paths.clone()
    };
    let client = Client::find(&other).await.unwrap();
    assert_eq!(client.info().await.unwrap().pid, world.daemon.id());
    world.kill_daemon();
    world.paths = other;
    world.replace_daemon_after_end().await;
    let mut stop = world.client.stop("pair", false).await.unwrap();
    assert_eq!(
        outcome(&mut stop).await,
        Outcome::Stopped { missed: Vec::new() }
    );
    pair.processes["a"].assert_ends();
}

#[tokio::test]
async fn a_daemon_that_owns_nothing_ends_and_leaves_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let state = directory.path().join("s");
    let paths = ictusd::paths::Paths {
        run: state.join("run"),
        state,
        owner: Owner::User,
    };
    let mut daemon = spawn_daemon(&paths, "100");
    Process::of(daemon.id()).assert_ends();
    assert!(daemon.wait().unwrap().success());
    assert!(!paths.state.exists());
}

#[test]
fn a_socket_path_that_is_too_long_is_said_before_anything_starts() {
    let directory = tempfile::tempdir().unwrap();
    let output = Command::new(fakes())
        .arg("daemon")
        .env_clear()
        .env("ICTUS_STATE_DIR", directory.path().join("x".repeat(100)))
        .stdin(Stdio::null())
        .output()
        .unwrap();
    assert!(!output.status.success());
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("too long for sockets"), "{said}");
}
