//! What is planned, refused, and shown.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use ictus_deploy::gives::{Denied, Gives};
use ictus_deploy::placement::{Realtime, RealtimePolicy};
use ictus_deploy::rollout::{
    Blob, Desired, DesiredHost, Held, MemberState, NewerRecord, Observed, Operation, Plan, Reached,
    Run, RunState, Stale, plan, plan_down, plan_stop,
};
use ictus_deploy::{Engine, Needs};

fn names(names: &[&str]) -> Vec<String> {
    names.iter().map(|&name| name.to_owned()).collect()
}

fn host(engine: Engine, rti: bool, federates: &[&str], blob: (&str, u64)) -> DesiredHost {
    DesiredHost {
        images: Vec::new(),
        engine,
        rti,
        federates: names(federates),
        needs: BTreeMap::new(),
        blobs: vec![Blob {
            digest: blob.0.repeat(16),
            bytes: blob.1,
            arch: "x86_64".to_owned(),
            federates: names(federates),
        }],
    }
}

/// `bench` runs the RTI and a federate, `nuc` two in containers.
pub(crate) fn demo() -> Desired {
    let facets = [
        "connections",
        "federate/lidar/parameters",
        "federate/lidar/program",
    ];
    Desired {
        version: "0.1.0".to_owned(),
        federation: "demo".to_owned(),
        digest: "d1".to_owned(),
        facets: facets
            .map(|facet| (facet.to_owned(), "1".to_owned()))
            .into(),
        hosts: BTreeMap::from([
            (
                "bench".to_owned(),
                host(Engine::Process, true, &["planner"], ("ab12", 4_404_019)),
            ),
            (
                "nuc".to_owned(),
                host(
                    Engine::Docker,
                    false,
                    &["lidar", "radar"],
                    ("cd34", 3_145_728),
                ),
            ),
        ]),
        start_limit_ms: 90_000,
        stop_limit_ms: 35_000,
    }
}

fn reached() -> Reached {
    Reached {
        version: "0.1.0".to_owned(),
        arch: "x86_64".to_owned(),
        docker: Ok(()),
        gives: Gives::default(),
        secrets_changed: BTreeMap::new(),
        disk_free: 1 << 40,
        state: PathBuf::from("/home/robot/.local/state/ictus"),
        images: BTreeMap::new(),
        blobs: BTreeSet::new(),
        run: Ok(None),
        lease: None,
    }
}

fn observed(nuc: Reached) -> BTreeMap<String, Observed> {
    let reached = |it| Observed::Reached(Box::new(it));
    BTreeMap::from([
        ("bench".to_owned(), reached(self::reached())),
        ("nuc".to_owned(), reached(nuc)),
    ])
}

/// Both hosts as they are when it runs.
pub(crate) fn running(desired: &Desired, id: &str) -> BTreeMap<String, Observed> {
    let part = |(name, host): (&String, &DesiredHost)| {
        let rti = host.rti.then(|| "rti".to_owned());
        let members = host.federates.iter().cloned().chain(rti);
        let run = Run {
            id: id.to_owned(),
            digest: desired.digest.clone(),
            facets: desired.facets.clone(),
            state: RunState::Running,
            members: members.map(|member| (member, MemberState::Lives)).collect(),
            hosts: desired.hosts.keys().cloned().collect(),
        };
        let reached = Reached {
            blobs: host.blobs.iter().map(|blob| blob.digest.clone()).collect(),
            run: Ok(Some(run)),
            ..reached()
        };
        (name.clone(), Observed::Reached(Box::new(reached)))
    };
    desired.hosts.iter().map(part).collect()
}

/// Changes what a host says about its run.
fn change(observed: &mut BTreeMap<String, Observed>, host: &str, change: impl FnOnce(&mut Run)) {
    let Some(Observed::Reached(reached)) = observed.get_mut(host) else {
        panic!("{host} was not reached");
    };
    change(reached.run.as_mut().unwrap().as_mut().unwrap());
}

fn operations(plan: &Plan) -> Vec<String> {
    let words = plan.steps.iter();
    words
        .map(|step| format!("{} {}", step.host, step.operation.name()))
        .collect()
}

#[test]
fn what_is_not_there_is_sent_prepared_and_committed_with_the_rti_first() {
    let plan = plan(&demo(), &observed(reached())).unwrap();
    assert_eq!(
        operations(&plan),
        [
            "bench lease",
            "nuc lease",
            "bench send_blob",
            "nuc send_blob",
            "bench prepare",
            "nuc prepare",
            "bench commit_rti",
            "nuc commit",
            "bench await_healthy",
            "nuc await_healthy",
            "bench release",
            "nuc release",
        ]
    );
    for step in &plan.steps {
        assert!(step.needs.iter().all(|id| *id < step.id), "{step:?}");
        assert!(!step.cause.is_empty() && step.limit_ms > 0, "{step:?}");
    }
    let needs = |index: usize| {
        plan.steps[index]
            .needs
            .iter()
            .map(|id| id.0)
            .collect::<Vec<_>>()
    };
    // Leases one after the other; sends at once; every part is prepared before the first is started.
    assert_eq!((needs(1), needs(2), needs(3)), (vec![0], vec![1], vec![1]));
    assert_eq!(
        (needs(4), needs(6), needs(7)),
        (vec![2, 3], vec![4, 5], vec![6])
    );
    same_text(
        &plan.to_string(),
        "\
demo: 3 federates start on 2 hosts
  it is not there yet

bench (process)
  + send    ab12ab12 4.2 MiB          not there: the program of federate `planner`
  + start   rti, planner              not there

nuc (docker)
  + send    cd34cd34 3.0 MiB          not there: the program of federates `lidar` and `radar`
  + start   lidar, radar              not there

plan PLANID__: 12 steps on 2 hosts, 7.2 MiB to send",
        &plan,
    );
}

/// Compares text for people; the plan's id is a digest.
fn same_text(text: &str, golden: &str, plan: &Plan) {
    let id = &plan.id[..8];
    assert_eq!(text.replace(id, "PLANID__"), golden, "{text}");
}

#[test]
fn nothing_is_planned_when_all_is_as_it_should_be() {
    let desired = demo();
    let plan = plan(&desired, &running(&desired, "r1")).unwrap();
    assert!(plan.is_empty());
    assert_eq!(
        plan.to_string(),
        "demo: 3 federates on 2 hosts run as the manifest says\nnothing to do"
    );
}

#[test]
fn a_changed_parameter_restarts_all_and_sends_nothing() {
    let old = demo();
    let mut new = old.clone();
    new.digest = "d2".to_owned();
    new.facets
        .insert("federate/lidar/parameters".to_owned(), "2".to_owned());
    let plan = plan(&new, &running(&old, "5d1e77aa00")).unwrap();
    assert_eq!(plan.bytes(), 0);
    assert_eq!(plan.causes, ["parameter changed: federate `lidar`"]);
    same_text(
        &plan.to_string(),
        "\
demo: 3 federates restart together at a planned stop
  parameter changed: federate `lidar`

bench (process)
  - stop    run 5d1e77aa
  + start   rti, planner              its part of the restart

nuc (docker)
  - stop    run 5d1e77aa
  + start   lidar, radar              its part of the restart

plan PLANID__: 12 steps on 2 hosts, 0 B to send",
        &plan,
    );
}

#[test]
fn every_difference_has_its_words() {
    type Differ = fn(&mut Desired, &mut BTreeMap<String, Observed>);
    let table: [(Differ, &str); 12] = [
        (
            |_, there| change(there, "nuc", |run| run.state = RunState::Prepared),
            "a start was left unfinished on host `nuc`",
        ),
        (
            |_, there| {
                change(there, "nuc", |run| {
                    run.state = RunState::Ended {
                        how: "failed".into(),
                    }
                })
            },
            "it has ended on host `nuc`: failed",
        ),
        (
            |_, there| change(there, "nuc", |run| run.id = "r2".into()),
            "parts of different runs: r1, r2",
        ),
        (
            |_, there| change(there, "nuc", |run| run.digest = String::new()),
            "what host `nuc` runs is not known: its record is damaged",
        ),
        (
            |_, there| {
                change(there, "nuc", |run| {
                    run.members.remove("lidar");
                })
            },
            "`lidar` is not there on host `nuc`",
        ),
        (
            |_, there| {
                change(there, "nuc", |run| {
                    run.members.insert(
                        "lidar".into(),
                        MemberState::Failed {
                            how: "killed".into(),
                        },
                    );
                })
            },
            "`lidar` on host `nuc` does not run: killed",
        ),
        (
            |_, there| {
                there.insert("nuc".into(), Observed::Reached(Box::new(reached())));
            },
            "nothing on host `nuc`",
        ),
        (
            |new, _| {
                new.digest = "d2".into();
                new.facets
                    .insert("federate/lidar/program".into(), "2".into());
            },
            "program changed: federate `lidar`",
        ),
        (
            |new, _| {
                new.digest = "d2".into();
                new.facets.insert("federate/sonar/host".into(), "2".into());
            },
            "new federate `sonar`",
        ),
        (
            |new, _| {
                new.digest = "d2".into();
                new.facets.remove("connections");
            },
            "connections changed",
        ),
        (
            |new, _| {
                new.digest = "d2".into();
                new.facets.clear();
            },
            "connections changed; no federate `lidar` any more",
        ),
        (
            |new, _| {
                new.hosts.remove("nuc");
            },
            "host `nuc` is not among the manifest's any more",
        ),
    ];
    for (differ, words) in table {
        let mut desired = demo();
        let mut there = running(&desired, "r1");
        differ(&mut desired, &mut there);
        let plan = plan(&desired, &there).unwrap();
        assert_eq!(plan.causes.join("; "), words);
        // All or none: every host that is to run it prepares its part anew.
        let prepares = plan
            .steps
            .iter()
            .filter(|step| matches!(step.operation, Operation::Prepare { .. }));
        assert_eq!(prepares.count(), desired.hosts.len(), "{words}");
    }
    // One that came to the end of its program is no reason.
    let (desired, mut there) = (demo(), running(&demo(), "r1"));
    change(&mut there, "nuc", |run| {
        run.members.insert("lidar".into(), MemberState::Completed);
    });
    assert!(plan(&desired, &there).unwrap().is_empty());
}

#[test]
fn a_host_that_is_left_out_is_stopped_and_cleared() {
    let there = running(&demo(), "r1");
    let mut desired = demo();
    desired.hosts.remove("nuc");
    let plan = plan(&desired, &there).unwrap();
    let nuc: Vec<_> = operations(&plan)
        .into_iter()
        .filter(|it| it.starts_with("nuc"))
        .collect();
    assert_eq!(
        nuc,
        ["nuc lease", "nuc stop_old", "nuc remove_old", "nuc release"]
    );
}

#[test]
fn every_refusal_names_host_cause_and_fix() {
    type Spoil = fn(&mut Reached);
    let table: [(Spoil, &str); 8] = [
        (
            |it| it.arch = "aarch64".into(),
            "host `nuc` is aarch64, but the program of federates `lidar` and `radar` is for x86_64; build the program for aarch64, or place the federate on another host",
        ),
        (
            |it| {
                it.docker = Err("the daemon does not answer; `sudo systemctl start docker`".into())
            },
            "host `nuc` has no Docker that can be used: the daemon does not answer; `sudo systemctl start docker`; make Docker usable there, or use `engine: process` for that host",
        ),
        (
            |it| it.version = "0.3.0".into(),
            "host `nuc` has ictusd 0.3.0, which is newer than ictus 0.1.0; use ictus 0.3.0 here",
        ),
        (
            |it| {
                it.run = Err(NewerRecord {
                    what: "protocol 9, known 2".into(),
                })
            },
            "the record on host `nuc` was written by a newer ictusd than the one that is there: protocol 9, known 2; `ictus host upgrade nuc` installs this version there",
        ),
        (
            |it| {
                it.lease = Some(Held {
                    who: "ann@laptop: up".into(),
                    left_ms: 11_001,
                })
            },
            "ann@laptop: up holds the lease on host `nuc`, for another 12 s unless it is renewed; wait for it; if whoever held it is gone, `ictus lock break` frees it",
        ),
        (
            |it| it.disk_free = 5,
            "host `nuc` has 5 bytes free at /home/robot/.local/state/ictus, but 3145728 bytes are to be sent; free space on \
             `nuc` (`df /home/robot/.local/state/ictus` there), or place federates on another host",
        ),
        (
            |it| {
                it.run = Ok(Some(Run {
                    id: "r0".into(),
                    digest: "d0".into(),
                    facets: BTreeMap::new(),
                    state: RunState::Running,
                    members: BTreeMap::new(),
                    hosts: BTreeSet::from(["nuc".to_owned(), "pi".to_owned()]),
                }))
            },
            "host `pi` was not asked, and run r0 has a part there; name it with `--host pi`, or among the manifest's hosts",
        ),
        (|it| it.version = "0.1.9".into(), ""),
    ];
    for (spoil, words) in table {
        let mut nuc = reached();
        spoil(&mut nuc);
        let refused = plan(&demo(), &observed(nuc)).err();
        assert_eq!(refused.map(|it| it.to_string()).unwrap_or_default(), words);
    }
    let mut newer = demo();
    newer.version = "0.3.0".to_owned();
    let old = plan(&newer, &observed(reached())).unwrap_err();
    assert_eq!(old.reasons.len(), 2, "{old}");
    let old = old.reasons[0].to_string();
    assert_eq!(
        old,
        "host `bench` has ictusd 0.1.0, which is too old for ictus 0.3.0"
    );
    newer.version = "0.2.5".to_owned();
    assert!(
        plan(&newer, &observed(reached())).is_ok(),
        "the version before is understood"
    );
    let mut realtime = demo();
    let needs = Needs {
        realtime: Some(Realtime {
            policy: RealtimePolicy::Fifo,
            priority: 60,
            lock_memory: false,
        }),
        ..Needs::default()
    };
    let bench = realtime.hosts.get_mut("bench").unwrap();
    bench.needs.insert("planner".to_owned(), needs);
    let mut there = observed(reached());
    let denied = Denied {
        why: "the limit `rtprio` is 0".to_owned(),
        fix: "raise it".to_owned(),
    };
    let none = Reached {
        gives: Gives {
            realtime: Err(denied),
            ..Gives::default()
        },
        ..reached()
    };
    there.insert("bench".to_owned(), Observed::Reached(Box::new(none)));
    let refused = plan(&realtime, &there).unwrap_err().to_string();
    assert_eq!(
        refused,
        "host `bench` cannot give federate `planner` realtime priority 60: the limit `rtprio` is 0; raise it"
    );
}

#[test]
fn a_changed_secret_restarts_and_is_named() {
    let mut there = running(&demo(), "r1");
    assert!(plan(&demo(), &there).unwrap().is_empty());
    let Some(Observed::Reached(nuc)) = there.get_mut("nuc") else {
        panic!("it is there")
    };
    let token = BTreeSet::from(["TOKEN".to_owned()]);
    nuc.secrets_changed.insert("radar".to_owned(), token);
    let plan = plan(&demo(), &there).unwrap();
    assert_eq!(plan.causes, ["secret TOKEN changed: federate `radar`"]);
    assert!(!plan.is_empty());
}

#[test]
fn what_is_not_known_is_never_taken_for_absent() {
    let mut there = running(&demo(), "r1");
    let why = "connection timed out".to_owned();
    there.insert("nuc".to_owned(), Observed::Unreachable { why });
    let words = "host `nuc` cannot be reached: connection timed out; see that `ssh` reaches it; what runs on `nuc` is unknown, so nothing is changed anywhere";
    assert_eq!(plan(&demo(), &there).unwrap_err().to_string(), words);
    assert_eq!(
        plan_down("demo", &there, true, 1).unwrap_err().to_string(),
        words
    );
    there.remove("nuc");
    assert!(
        plan(&demo(), &there)
            .unwrap_err()
            .to_string()
            .starts_with("host `nuc` was not asked")
    );
    // Down without the manifest: the run itself says where its parts are.
    assert!(plan_down("demo", &there, false, 1).is_err());
}

#[test]
fn a_saved_plan_is_refused_when_a_host_has_moved_on() {
    let desired = demo();
    let mut there = running(&desired, "r1");
    change(&mut there, "nuc", |run| run.state = RunState::Starting);
    let plan = plan(&desired, &there).unwrap();
    let saved = serde_json::to_string(&plan).unwrap();
    let loaded: Plan = serde_json::from_str(&saved).unwrap();
    assert_eq!(loaded, plan);
    loaded.still_valid(&there).unwrap();
    loaded.is_for(&desired).unwrap();
    change(&mut there, "nuc", |run| run.id = "r2".to_owned());
    let words =
        "host `nuc` has moved on: the plan was made for run r1, and run r2 is there; plan again";
    assert_eq!(loaded.still_valid(&there).unwrap_err().to_string(), words);
    there.insert(
        "nuc".to_owned(),
        Observed::Unreachable {
            why: "no route".to_owned(),
        },
    );
    assert!(matches!(
        loaded.still_valid(&there),
        Err(Stale::Unknown { .. })
    ));
    let other = Desired {
        digest: "d2".to_owned(),
        ..desired
    };
    assert_eq!(loaded.is_for(&other), Err(Stale::Manifest));
    let future = saved.replacen("\"format\":1", "\"format\":2", 1);
    let future: Plan = serde_json::from_str(&future).unwrap();
    assert_eq!(future.still_valid(&there), Err(Stale::Format { found: 2 }));
}

#[test]
fn taking_down_stops_all_and_then_removes() {
    let there = running(&demo(), "r1");
    let plan = plan_down("demo", &there, true, 35_000).unwrap();
    // The RTI's host is cleared last: it knows of the others.
    assert_eq!(
        operations(&plan),
        [
            "bench lease",
            "nuc lease",
            "bench stop_old",
            "nuc stop_old",
            "nuc remove_old",
            "bench remove_old",
            "bench release",
            "nuc release",
        ]
    );
    assert_eq!(plan.steps[5].needs, [plan.steps[4].id]);
    same_text(
        &plan.to_string(),
        "\
demo: it is taken down

bench
  - stop    run r1
  - remove  run r1                    it is taken down

nuc
  - stop    run r1
  - remove  run r1                    it is taken down

plan PLANID__: 8 steps on 2 hosts, 0 B to send",
        &plan,
    );
    assert!(
        plan_down("demo", &observed(reached()), false, 1)
            .unwrap()
            .is_empty()
    );
    assert!(
        !plan_down("demo", &observed(reached()), true, 1)
            .unwrap()
            .is_empty()
    );
}

#[test]
fn stopping_ends_what_runs_and_removes_nothing() {
    let plan = plan_stop("demo", &running(&demo(), "r1"), 35_000).unwrap();
    assert_eq!(
        operations(&plan),
        [
            "bench lease",
            "nuc lease",
            "bench stop_old",
            "nuc stop_old",
            "bench release",
            "nuc release",
        ]
    );
    assert_eq!(plan.steps[2].limit_ms, 35_000);
    let nothing = plan_stop("demo", &observed(reached()), 1).unwrap();
    assert!(nothing.is_empty(), "nobody is leased for nothing");
}
