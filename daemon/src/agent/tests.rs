use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Duration;

use ictus_coord::plan::{FederatePlan, OnFailure, Plan};
use ictus_deploy::{FederateKind, FederateRun, Settings, TimingSpec};
use serde_json::json;

use super::{Action, Agent, MemberEvent, MemberId, Now};
use crate::api::{Event, FailureKind, Outcome, StartRequest, State};
use crate::supervisor::exit::{Ending, ExitRecord};
use crate::supervisor::protocol::StopSignal;
use crate::supervisor::spec::PROTOCOL;

const A: MemberId = MemberId::Federate(0);
const B: MemberId = MemberId::Federate(1);

fn request() -> StartRequest {
    let names = ["a", "b"];
    let plan = names.map(|name| FederatePlan {
        name: name.to_owned(),
        class: Some("C".to_owned()),
        program: Some("p".to_owned()),
        ..FederatePlan::default()
    });
    let run = |(name, id): (&&str, u16)| FederateRun {
        id,
        name: (*name).to_owned(),
        executable: PathBuf::from("/bin/program"),
        kind: FederateKind::Ours,
        env: BTreeMap::new(),
        needs: ictus_deploy::Needs::default(),
        portable: false,
    };
    StartRequest {
        manifest: PathBuf::from("/m/federation.yaml"),
        cwd: PathBuf::from("/m"),
        plan: Plan {
            federation: "pair".to_owned(),
            extensions: true,
            federates: plan.to_vec(),
            ..Plan::default()
        },
        federates: names.iter().zip(0..).map(run).collect(),
        settings: Settings::default(),
        timing: TimingSpec::default(),
        trace: false,
        part: None,
    }
}

fn at(seconds: u64) -> Now {
    let wall_ns = i64::try_from(seconds).unwrap() * 1_000_000_000;
    Now {
        since: Duration::from_secs(seconds),
        wall_ns,
    }
}

/// An agent and what it has asked for since the last look.
struct World {
    agent: Agent,
    now: Now,
}

impl World {
    fn start() -> Self {
        Self::start_with(&request())
    }

    fn start_with(request: &StartRequest) -> Self {
        Self {
            agent: Agent::start(at(0), request, None),
            now: at(0),
        }
    }

    /// A federation that is healthy, with nothing left to look at.
    fn healthy() -> Self {
        let mut world = Self::start();
        world.up();
        assert_eq!(world.agent.state(), State::Running);
        world.actions();
        world
    }

    fn up(&mut self) {
        self.started(MemberId::Rti);
        self.rti(json!({"event": "listening", "port": 4711}));
        self.started(A);
        self.started(B);
        self.rti(json!({"event": "joined", "federate": 0}));
        self.rti(json!({"event": "joined", "federate": 1}));
        self.rti(json!({"event": "start", "start_ns": 5}));
        self.running(A, "a");
        self.running(B, "b");
    }

    fn on(&mut self, id: MemberId, event: MemberEvent) {
        self.agent.handle_member(self.now, id, event);
    }

    fn started(&mut self, id: MemberId) {
        self.on(id, MemberEvent::Started { pid: 7 });
    }

    fn rti(&mut self, line: serde_json::Value) {
        self.on(MemberId::Rti, MemberEvent::Reported { line });
    }

    fn running(&mut self, id: MemberId, name: &str) {
        let line = json!({"event": "running", "federate": name});
        self.on(id, MemberEvent::Reported { line });
    }

    fn record(now: Now, ending: Ending) -> ExitRecord {
        ExitRecord {
            protocol: PROTOCOL,
            instance: String::new(),
            name: String::new(),
            pid: Some(7),
            started_ns: 0,
            ended_ns: now.wall_ns,
            ending,
            last_status: None,
            reports: Vec::new(),
            first_lines: vec!["first words".to_owned()],
            log_lines_lost: 0,
        }
    }

    fn ends(&mut self, id: MemberId, ending: Ending) {
        let record = Box::new(Self::record(self.now, ending));
        self.on(id, MemberEvent::Ended { record });
        self.on(id, MemberEvent::Closed);
    }

    fn actions(&mut self) -> Vec<Action> {
        std::iter::from_fn(|| self.agent.poll_action()).collect()
    }

    fn signals(&mut self) -> Vec<(MemberId, StopSignal)> {
        let signal = |action| match action {
            Action::Signal { member, signal } => Some((member, signal)),
            Action::Launch { .. } | Action::Tell(_) => None,
        };
        self.actions().into_iter().filter_map(signal).collect()
    }

    /// What the outcome says of a stop that had to kill.
    #[track_caller]
    fn missed(&self) -> String {
        let Some(Outcome::Failed {
            failure,
            was_healthy: true,
        }) = self.agent.outcome()
        else {
            panic!("{:?}", self.agent.outcome());
        };
        let expected = (FailureKind::Timeout, None);
        assert_eq!((failure.kind, failure.member.clone()), expected);
        failure.what.clone()
    }

    fn time_out(&mut self) {
        self.now.since = self.agent.poll_timeout().unwrap();
        self.agent.handle_timeout(self.now);
    }
}

const OK: Ending = Ending::Exited { code: 0 };
const KILLED: Ending = Ending::Killed { signal: 9 };

#[test]
fn federates_are_launched_with_the_port_the_rti_reports() {
    let mut world = World::start();
    let launch = |member, rti_port| Action::Launch { member, rti_port };
    assert_eq!(world.actions(), [launch(MemberId::Rti, None)]);
    world.started(MemberId::Rti);
    world.actions();
    world.rti(json!({"event": "listening", "port": 4711}));
    let expected = [
        Action::Tell(Event::Listening { port: 4711 }),
        launch(A, Some(4711)),
        launch(B, Some(4711)),
    ];
    assert_eq!(world.actions(), expected);
}

#[test]
fn healthy_needs_every_join_the_start_tag_and_every_first_tag() {
    let mut world = World::start();
    world.up();
    let told: Vec<_> = world.actions();
    assert_eq!(told.last(), Some(&Action::Tell(Event::Healthy)));
    assert_eq!(
        told.iter()
            .filter(|it| **it == Action::Tell(Event::Healthy))
            .count(),
        1
    );
    assert_eq!(world.agent.poll_timeout(), None);
}

#[test]
fn a_federate_that_exits_at_once_undoes_the_start_and_is_the_headline() {
    let mut world = World::start();
    world.started(MemberId::Rti);
    world.rti(json!({"event": "listening", "port": 4711}));
    world.started(A);
    world.started(B);
    world.actions();
    world.now = at(1);
    world.ends(A, Ending::Exited { code: 3 });
    let term = StopSignal::Term;
    assert_eq!(world.signals(), [(MemberId::Rti, term), (B, term)]);
    world.now = at(2);
    world.ends(B, Ending::Exited { code: 10 });
    world.ends(MemberId::Rti, Ending::Exited { code: 1 });
    let Some(Outcome::Failed {
        failure,
        was_healthy,
    }) = world.agent.outcome()
    else {
        panic!("{:?}", world.agent.outcome());
    };
    assert_eq!(
        (failure.member.as_deref(), failure.what.as_str()),
        (Some("a"), "exit code 3")
    );
    assert_eq!(failure.lines, ["first words"]);
    assert!(!was_healthy);
}

#[test]
fn the_cause_is_the_headline_even_when_its_consequence_is_seen_first() {
    let mut world = World::healthy();
    world.now = at(3);
    world.ends(B, Ending::Exited { code: 11 });
    world.now = at(2);
    world.ends(A, KILLED);
    world.ends(MemberId::Rti, Ending::Exited { code: 1 });
    let Some(Outcome::Failed {
        failure,
        was_healthy: true,
    }) = world.agent.outcome()
    else {
        panic!("{:?}", world.agent.outcome());
    };
    assert_eq!(
        (failure.member.as_deref(), failure.what.as_str()),
        (Some("a"), "killed by SIGKILL")
    );
}

#[test]
fn a_federates_own_words_are_kept_apart_from_what_happened() {
    let mut world = World::healthy();
    let line = json!({
        "event": "ended", "federate": "a", "elapsed_ns": 1, "microstep": 0, "code": 3, "reason": "no map"
    });
    world.on(A, MemberEvent::Reported { line });
    world.ends(A, Ending::Exited { code: 3 });
    world.ends(B, Ending::Exited { code: 11 });
    world.ends(MemberId::Rti, Ending::Exited { code: 1 });
    let Some(Outcome::Failed { failure, .. }) = world.agent.outcome() else {
        panic!("{:?}", world.agent.outcome());
    };
    assert_eq!(failure.what, "exit code 3");
    assert_eq!(failure.words(), "exit code 3: no map");
}

#[test]
fn an_end_before_the_start_is_a_failure_even_with_code_0() {
    let mut world = World::start();
    world.started(MemberId::Rti);
    world.rti(json!({"event": "listening", "port": 4711}));
    world.started(A);
    world.ends(A, OK);
    world.ends(B, OK);
    world.ends(MemberId::Rti, OK);
    let Some(Outcome::Failed { failure, .. }) = world.agent.outcome() else {
        panic!("{:?}", world.agent.outcome());
    };
    assert_eq!(failure.what, "exit code 0 before the start");
}

#[test]
fn who_does_not_join_in_time_is_named() {
    let mut world = World::start();
    world.started(MemberId::Rti);
    world.rti(json!({"event": "listening", "port": 4711}));
    world.started(A);
    world.started(B);
    world.rti(json!({"event": "joined", "federate": 0}));
    world.time_out();
    for id in [A, B, MemberId::Rti] {
        world.ends(id, Ending::Killed { signal: 15 });
    }
    let Some(Outcome::Failed { failure, .. }) = world.agent.outcome() else {
        panic!("{:?}", world.agent.outcome());
    };
    assert_eq!(failure.kind, FailureKind::Timeout);
    assert_eq!(failure.what, "not joined in time: b");
}

#[test]
fn a_stop_climbs_the_ladder_and_names_who_missed_the_stop_tag() {
    let mut world = World::healthy();
    world.agent.handle_stop(world.now);
    assert_eq!(world.signals(), [(MemberId::Rti, StopSignal::Term)]);
    world.rti(json!({"event": "stop", "elapsed_ns": 5, "microstep": 0}));
    world.ends(A, OK);
    world.time_out();
    assert_eq!(world.signals(), [(B, StopSignal::Term)]);
    world.time_out();
    assert_eq!(
        world.signals(),
        [(MemberId::Rti, StopSignal::Kill), (B, StopSignal::Kill)]
    );
    world.ends(B, KILLED);
    world.ends(MemberId::Rti, KILLED);
    assert_eq!(world.missed(), "did not reach the stop tag in time: b");
}

#[test]
fn a_stop_that_is_forced_at_once_names_who_was_killed() {
    let mut world = World::healthy();
    world.agent.handle_stop(world.now);
    world.ends(A, OK);
    world.agent.handle_kill(world.now);
    // It may see the end of the RTI before its own SIGKILL.
    world.ends(B, Ending::Exited { code: 10 });
    world.ends(MemberId::Rti, KILLED);
    assert_eq!(world.missed(), "did not reach the stop tag in time: b");
}

#[test]
fn who_ends_by_itself_despite_a_forced_stop_has_not_missed_the_stop_tag() {
    let mut world = World::healthy();
    world.agent.handle_stop(world.now);
    world.agent.handle_kill(world.now);
    for id in [A, B, MemberId::Rti] {
        world.ends(id, OK);
    }
    let missed = Vec::new();
    assert_eq!(world.agent.outcome(), Some(&Outcome::Stopped { missed }));
}

#[test]
fn an_rti_that_hangs_after_its_federates_is_named() {
    let mut world = World::healthy();
    world.ends(A, OK);
    world.ends(B, OK);
    world.agent.handle_kill(world.now);
    world.ends(MemberId::Rti, KILLED);
    assert_eq!(world.missed(), "did not reach the stop tag in time: rti");
}

#[test]
fn even_a_process_that_survives_sigkill_does_not_hold_the_stop() {
    let mut world = World::healthy();
    world.agent.handle_kill(world.now);
    assert_eq!(world.agent.outcome(), None);
    world.time_out();
    assert_eq!(world.missed(), "did not reach the stop tag in time: a, b");
}

#[test]
fn the_grace_of_a_stop_counts_from_the_stop_tag() {
    let mut world = World::healthy();
    world.agent.handle_stop(world.now);
    world.rti(json!({"event": "stop", "elapsed_ns": 20_000_000_000_i64, "microstep": 0}));
    let grace = Settings::default().stop_grace;
    let until = world.agent.poll_timeout().unwrap();
    assert!(
        until >= Duration::from_secs(20) + grace - Duration::from_secs(1),
        "{until:?}"
    );
}

#[test]
fn the_programs_own_end_is_completed() {
    let mut world = World::healthy();
    world.ends(A, OK);
    world.ends(B, OK);
    assert_eq!(world.agent.state(), State::Stopping);
    world.ends(MemberId::Rti, OK);
    assert_eq!(world.agent.outcome(), Some(&Outcome::Completed));
}

#[test]
fn an_rti_that_ends_before_its_federates_is_no_failure_when_all_have_resigned() {
    let mut world = World::healthy();
    world.ends(MemberId::Rti, OK);
    assert_eq!(world.agent.state(), State::Stopping);
    world.ends(A, OK);
    world.ends(B, OK);
    assert_eq!(world.agent.outcome(), Some(&Outcome::Completed));
}

#[test]
fn an_rti_that_failed_because_of_a_federate_is_not_the_headline() {
    let mut world = World::healthy();
    world.rti(json!({"event": "failed", "federate": 0, "reason": "gone"}));
    world.now = at(1);
    world.ends(MemberId::Rti, Ending::Exited { code: 1 });
    world.now = at(2);
    world.ends(A, KILLED);
    world.ends(B, Ending::Exited { code: 11 });
    let Some(Outcome::Failed { failure, .. }) = world.agent.outcome() else {
        panic!("{:?}", world.agent.outcome());
    };
    assert_eq!(failure.member.as_deref(), Some("a"));
}

#[test]
fn a_federate_that_may_be_outlived_hurries_nobody_and_is_the_failure_in_the_end() {
    let mut request = request();
    request.plan.federates[0].on_failure = OnFailure::Continue;
    let mut world = World::start_with(&request);
    world.up();
    world.actions();
    world.ends(A, KILLED);
    assert_eq!(world.agent.poll_timeout(), None, "the others go on");
    assert_eq!(world.agent.outcome(), None);
    world.ends(B, Ending::Exited { code: 0 });
    world.ends(MemberId::Rti, Ending::Exited { code: 1 });
    let Some(Outcome::Failed { failure, .. }) = world.agent.outcome() else {
        panic!("{:?}", world.agent.outcome());
    };
    assert_eq!(failure.member.as_deref(), Some("a"));
}

#[test]
fn a_lost_rti_ends_the_run_in_bounded_time() {
    let mut world = World::healthy();
    world.ends(MemberId::Rti, KILLED);
    world.time_out();
    assert_eq!(
        world.signals(),
        [(A, StopSignal::Term), (B, StopSignal::Term)]
    );
    world.ends(A, Ending::Exited { code: 10 });
    world.ends(B, Ending::Exited { code: 10 });
    let Some(Outcome::Failed { failure, .. }) = world.agent.outcome() else {
        panic!("{:?}", world.agent.outcome());
    };
    assert_eq!(failure.member.as_deref(), Some("rti"));
}

#[test]
fn a_killed_supervisor_is_said_to_have_vanished() {
    let mut world = World::healthy();
    world.on(A, MemberEvent::Closed);
    world.ends(B, Ending::Exited { code: 11 });
    world.ends(MemberId::Rti, Ending::Exited { code: 1 });
    let Some(Outcome::Failed { failure, .. }) = world.agent.outcome() else {
        panic!("{:?}", world.agent.outcome());
    };
    assert_eq!(failure.what, "vanished together with its supervisor");
}

#[test]
fn who_goes_away_before_healthy_undoes_and_after_it_does_not() {
    let mut world = World::start();
    world.started(MemberId::Rti);
    world.agent.handle_starter_gone(world.now);
    assert_eq!(world.signals(), [(MemberId::Rti, StopSignal::Term)]);
    world.ends(MemberId::Rti, OK);
    assert_eq!(world.agent.outcome(), Some(&Outcome::Aborted));
    let mut world = World::healthy();
    world.agent.handle_starter_gone(world.now);
    assert_eq!(world.agent.state(), State::Running);
}

#[test]
fn what_is_foreign_is_never_signalled() {
    let mut agent = Agent::adopt(at(0), &request(), (State::Running, None), |_| true);
    agent.handle_member(
        at(0),
        A,
        MemberEvent::Foreign {
            why: "another instance".to_owned(),
        },
    );
    agent.handle_kill(at(1));
    while let Some(action) = agent.poll_action() {
        assert!(!matches!(action, Action::Signal { member: A, .. }));
    }
}

#[test]
fn an_adopted_half_start_is_undone() {
    let mut agent = Agent::adopt(at(0), &request(), (State::Starting, None), |id| {
        id == MemberId::Rti
    });
    let signal = Action::Signal {
        member: MemberId::Rti,
        signal: StopSignal::Term,
    };
    assert_eq!(agent.poll_action(), Some(signal));
    assert_eq!(agent.poll_action(), None);
}

#[path = "reports.rs"]
mod reports;
