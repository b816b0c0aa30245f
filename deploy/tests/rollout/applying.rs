//! What carrying out a plan does when steps fail, are not answered, or are interrupted.

use std::collections::BTreeSet;
use std::time::Duration;

use ictus_deploy::rollout::{Apply, Moment, Operation, Outcome, Phase, Step, plan, plan_down};

use super::planning::{demo, running};

fn at(seconds: u64) -> Moment {
    Moment {
        elapsed: Duration::from_secs(seconds),
        wall_ns: i64::try_from(seconds).unwrap(),
    }
}

/// A restart of run `r1` as run `r2`: nothing is sent.
fn apply() -> Apply {
    let old = demo();
    let mut new = old.clone();
    new.digest = "d2".to_owned();
    Apply::new(plan(&new, &running(&old, "r1")).unwrap(), "r2".to_owned())
}

fn steps(apply: &mut Apply, now: Moment) -> Vec<Step> {
    std::iter::from_fn(|| apply.poll_step(now)).collect()
}

fn words(steps: &[Step]) -> Vec<String> {
    let words = steps.iter();
    words
        .map(|step| format!("{} {}", step.host, step.operation.name()))
        .collect()
}

fn done(apply: &mut Apply, step: &Step) {
    let run = Some("r1".to_owned());
    let outcome = match step.operation == Operation::Lease {
        true => Outcome::Leased { run },
        false => Outcome::Done,
    };
    apply.handle_done(at(0), step.id, outcome);
}

fn failed(what: &str, rank: u8, at_ns: i64) -> Outcome {
    Outcome::Failed {
        what: what.to_owned(),
        rank,
        at_ns: Some(at_ns),
    }
}

/// Does everything up to the first step of this name, which has begun then with its like.
fn until(apply: &mut Apply, name: &str) -> Vec<Step> {
    loop {
        let begun = steps(apply, at(0));
        assert!(
            !begun.is_empty(),
            "{name} never begins: {:?}",
            apply.phase()
        );
        if begun.iter().any(|step| step.operation.name() == name) {
            return begun;
        }
        for step in &begun {
            done(apply, step);
        }
    }
}

#[test]
fn everything_in_order_ends_healthy() {
    let mut apply = apply();
    let mut order = Vec::new();
    loop {
        let begun = steps(&mut apply, at(0));
        if begun.is_empty() {
            break;
        }
        order.push(words(&begun).join(", "));
        for step in &begun {
            done(&mut apply, step);
        }
    }
    assert_eq!(
        order,
        [
            "bench lease",
            "nuc lease",
            "bench stop_old, nuc stop_old",
            "bench prepare, nuc prepare",
            "bench commit_rti",
            "nuc commit",
            "bench await_healthy, nuc await_healthy",
            "bench release, nuc release",
        ]
    );
    assert_eq!(*apply.phase(), Phase::Done);
}

#[test]
fn what_fails_before_the_commit_is_undone_wherever_it_was_asked() {
    let mut apply = apply();
    let prepares = until(&mut apply, "prepare");
    assert_eq!(*apply.phase(), Phase::Preparing);
    apply.handle_done(
        at(1),
        prepares[0].id,
        failed("no space left on device", 0, 5),
    );
    assert_eq!(*apply.phase(), Phase::Undoing);
    // `nuc` has not answered: what undoes it must not overtake it.
    let undoes = steps(&mut apply, at(1));
    assert_eq!(words(&undoes), ["bench remove_part"]);
    assert!(matches!(&undoes[0].operation, Operation::RemovePart { run } if run == "r2"));
    done(&mut apply, &undoes[0]);
    // It is never answered.
    let limit = apply.poll_timeout().unwrap();
    apply.handle_timeout(Moment {
        elapsed: limit,
        wall_ns: 9,
    });
    let undoes = steps(&mut apply, at(1));
    assert_eq!(words(&undoes), ["nuc remove_part"]);
    done(&mut apply, &undoes[0]);
    let releases = steps(&mut apply, at(1));
    assert_eq!(words(&releases), ["bench release", "nuc release"]);
    for step in &releases {
        done(&mut apply, step);
    }
    let Phase::Undone {
        cause, old_stopped, ..
    } = apply.phase().clone()
    else {
        panic!("{:?}", apply.phase());
    };
    assert_eq!(
        cause.unwrap().to_string(),
        "host `bench`, preparing: no space left on device"
    );
    assert!(old_stopped);
}

#[test]
fn what_cannot_be_undone_is_named() {
    let mut apply = apply();
    let prepares = until(&mut apply, "prepare");
    done(&mut apply, &prepares[1]);
    apply.handle_done(at(1), prepares[0].id, failed("port 15045 is taken", 0, 5));
    for (index, step) in steps(&mut apply, at(1)).iter().enumerate() {
        let outcome = [Outcome::Done, failed("connection closed", 0, 1)];
        apply.handle_done(at(1), step.id, outcome[index].clone());
    }
    for step in steps(&mut apply, at(1)) {
        done(&mut apply, &step);
    }
    let Phase::Failed { cause, left } = apply.phase().clone() else {
        panic!("{:?}", apply.phase());
    };
    assert_eq!(cause.unwrap().what, "port 15045 is taken");
    assert_eq!(left, BTreeSet::from(["nuc".to_owned()]));
}

#[test]
fn what_fails_after_the_commit_stops_all_parts_and_the_first_cause_is_told() {
    let mut apply = apply();
    let waits = until(&mut apply, "await_healthy");
    assert_eq!(*apply.phase(), Phase::Committing);
    // `bench` notices first that `nuc` is gone; `nuc` says why.
    apply.handle_done(
        at(1),
        waits[0].id,
        failed("federate `lidar` was lost", 3, 10),
    );
    let stops = steps(&mut apply, at(1));
    assert_eq!(words(&stops), ["bench stop_part", "nuc stop_part"]);
    for step in &stops {
        done(&mut apply, step);
    }
    apply.handle_done(
        at(2),
        waits[1].id,
        failed("federate `lidar` panicked", 0, 12),
    );
    for step in steps(&mut apply, at(2)) {
        done(&mut apply, &step);
    }
    let Phase::Failed { cause, left } = apply.phase().clone() else {
        panic!("{:?}", apply.phase());
    };
    assert_eq!(cause.unwrap().what, "federate `lidar` panicked");
    assert!(left.is_empty());
}

#[test]
fn a_host_that_moved_on_is_not_touched() {
    let mut apply = apply();
    let lease = steps(&mut apply, at(0));
    let run = Some("r9".to_owned());
    apply.handle_done(at(0), lease[0].id, Outcome::Leased { run });
    let releases = steps(&mut apply, at(0));
    assert_eq!(words(&releases), ["bench release"]);
    done(&mut apply, &releases[0]);
    let Phase::Undone {
        cause, old_stopped, ..
    } = apply.phase().clone()
    else {
        panic!("{:?}", apply.phase());
    };
    assert_eq!(
        cause.unwrap().to_string(),
        "host `bench`, taking the lease: it has moved on: the plan was made for run r1, and run r9 is there; plan again"
    );
    assert!(!old_stopped);
}

#[test]
fn of_two_who_want_the_leases_one_gets_all() {
    let mut apply = apply();
    let first = steps(&mut apply, at(0));
    assert_eq!(words(&first), ["bench lease"]);
    done(&mut apply, &first[0]);
    let second = steps(&mut apply, at(0));
    let what = "bob@pc: up holds it".to_owned();
    apply.handle_done(at(0), second[0].id, Outcome::Held { what });
    // Only what was given is given back.
    let releases = steps(&mut apply, at(0));
    assert_eq!(words(&releases), ["bench release"]);
    done(&mut apply, &releases[0]);
    assert!(steps(&mut apply, at(0)).is_empty());
    assert!(matches!(
        apply.phase(),
        Phase::Undone {
            old_stopped: false,
            held: true,
            ..
        }
    ));
}

#[test]
fn who_is_fenced_off_does_nothing_more() {
    let mut refused = apply();
    let prepares = until(&mut refused, "prepare");
    done(&mut refused, &prepares[0]);
    let what = "the number is not the last one".to_owned();
    refused.handle_done(at(0), prepares[1].id, Outcome::Held { what: what.clone() });
    let taken = Phase::TakenOver {
        host: "nuc".to_owned(),
        what: what.clone(),
    };
    assert_eq!(*refused.phase(), taken);
    assert!(steps(&mut refused, at(0)).is_empty());
    assert_eq!(refused.poll_timeout(), None);
    refused.handle_interrupt(at(0));
    assert_eq!(*refused.phase(), taken);
    let mut renewing = apply();
    until(&mut renewing, "prepare");
    renewing.handle_fenced("nuc".to_owned(), what);
    assert_eq!(*renewing.phase(), taken);
}

#[test]
fn an_interrupt_undoes_and_a_second_one_waits_no_more() {
    let mut apply = apply();
    let prepares = until(&mut apply, "prepare");
    apply.handle_interrupt(at(0));
    done(&mut apply, &prepares[0]);
    assert_eq!(words(&steps(&mut apply, at(0))), ["bench remove_part"]);
    let mut once = apply.clone();
    apply.handle_interrupt(at(0));
    let left = BTreeSet::from(["bench".to_owned(), "nuc".to_owned()]);
    assert_eq!(*apply.phase(), Phase::Failed { cause: None, left });
    done(&mut once, &prepares[1]);
    let begun = steps(&mut once, at(0));
    assert_eq!(words(&begun), ["nuc remove_part"]);
}

#[test]
fn an_interrupt_after_health_changes_nothing() {
    let mut apply = apply();
    let releases = until(&mut apply, "release");
    apply.handle_interrupt(at(0));
    apply.handle_done(at(0), releases[0].id, failed("connection closed", 0, 1));
    done(&mut apply, &releases[1]);
    assert_eq!(*apply.phase(), Phase::Done);
}

#[test]
fn a_lease_that_is_lost_after_health_or_given_back_is_no_news() {
    let mut healthy = apply();
    let releases = until(&mut healthy, "release");
    healthy.handle_fenced("nuc".to_owned(), "lost".to_owned());
    for step in &releases {
        done(&mut healthy, step);
    }
    assert_eq!(*healthy.phase(), Phase::Done);
    let mut undone = apply();
    until(&mut undone, "prepare");
    undone.handle_interrupt(at(0));
    undone.handle_fenced("nuc".to_owned(), "lost".to_owned());
    assert!(matches!(undone.phase(), Phase::TakenOver { .. }));
}

#[test]
fn late_and_foreign_answers_are_not_heard() {
    let mut apply = apply();
    let lease = steps(&mut apply, at(0));
    let before = apply.phase().clone();
    let mut foreign = lease[0].id;
    foreign.0 = 999;
    apply.handle_done(at(0), foreign, Outcome::Done);
    let mut waiting = lease[0].id;
    waiting.0 = 3;
    apply.handle_done(at(0), waiting, Outcome::Done);
    assert_eq!(
        (apply.phase(), steps(&mut apply.clone(), at(0)).len()),
        (&before, 0)
    );
}

/// The RTI's host starts its federates at once: one that ends before the others were even asked to begin is the cause.
#[test]
fn a_part_that_ends_while_others_begin_is_the_first_cause() {
    let mut apply = apply();
    let rti = until(&mut apply, "commit_rti");
    done(&mut apply, &rti[0]);
    let commit = steps(&mut apply, at(0));
    assert_eq!(words(&commit), ["nuc commit"]);
    apply.handle_lost(at(1), "bench", failed("`a` exited with 1", 0, 5));
    assert_eq!(*apply.phase(), Phase::Stopping);
    // What comes later is a consequence.
    apply.handle_done(at(2), commit[0].id, failed("not joined in time", 0, 9));
    let stops = steps(&mut apply, at(2));
    assert_eq!(words(&stops), ["bench stop_part", "nuc stop_part"]);
    for step in &stops {
        done(&mut apply, step);
    }
    for step in &steps(&mut apply, at(2)) {
        done(&mut apply, step);
    }
    let Phase::Failed { cause, left } = apply.phase().clone() else {
        panic!("{:?}", apply.phase());
    };
    assert!(cause.unwrap().what.contains("`a` exited with 1"));
    assert!(left.is_empty());
}

#[test]
fn who_is_healthy_with_all_others_is_lost_to_nobody() {
    let mut apply = apply();
    for step in &until(&mut apply, "await_healthy") {
        done(&mut apply, step);
    }
    apply.handle_lost(at(1), "bench", failed("the connection was lost", 0, 5));
    assert_eq!(*apply.phase(), Phase::Committing);
}

#[test]
fn what_is_taken_down_on_some_hosts_only_is_said_so() {
    let observed = running(&demo(), "r1");
    let plan = plan_down("demo", &observed, true, 60_000).unwrap();
    let mut apply = Apply::new(plan, "r2".to_owned());
    let removals = until(&mut apply, "remove_old");
    // The RTI's host is last.
    assert_eq!(words(&removals), ["nuc remove_old"]);
    apply.handle_done(at(1), removals[0].id, failed("it is busy", 0, 5));
    for step in &steps(&mut apply, at(1)) {
        done(&mut apply, step);
    }
    let Phase::Failed { left, .. } = apply.phase().clone() else {
        panic!("{:?}", apply.phase());
    };
    assert_eq!(left, BTreeSet::from(["bench".to_owned(), "nuc".to_owned()]));
}
