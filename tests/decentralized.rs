//! Decentralized coordination, faults that programs handle, physical connections: on real processes.

#![expect(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use ictus_tests::{Sandbox, kill, root};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

/// A federation of the canary package: its federates and connections.
fn manifest(sandbox: &Sandbox, name: &str, head: &str, rest: &str) -> String {
    let package = root().join("tests/canary");
    let text = format!(
        "ictus: v1\nfederation: {name}\n{head}\nprograms:\n  canary: {{ package: {} }}\n{rest}\n",
        package.display()
    );
    sandbox.manifest(&format!("{name}.yaml"), &text)
}

fn ending<'a>(view: &'a Value, member: &str) -> &'a str {
    let federates = view["federates"].as_array().unwrap().iter();
    let mut members = std::iter::once(&view["rti"]).chain(federates);
    let found = members.find(|m| m["name"] == member).unwrap();
    found["ending"].as_str().unwrap_or("")
}

/// A beat that needs 5 ms from its tag to its message, and an ear with the same tags.
const BEAT: &str = "federates:
  beat: { class: Beat, parameters: { work: 5 ms } }
  ear: { class: Ear }
connections:
  - { from: beat.out, to: ear.input }";

/// The ear's last line: how many it heard in time, and how many tardy.
fn heard(sandbox: &Sandbox, federation: &str) -> (u64, u64) {
    let logs = sandbox.ok(&["logs", federation]);
    let line = logs.lines().find(|line| line.contains("in time and"));
    assert!(line.is_some(), "{logs}");
    let line = line.unwrap();
    let mut numbers = line.split(' ').filter_map(|word| word.parse::<u64>().ok());
    let (tardy, heard) = (numbers.next_back().unwrap(), numbers.next_back().unwrap());
    (heard, tardy)
}

/// The STP violations that the daemon knows of at `federate`.
fn violations(sandbox: &Sandbox, federation: &str, federate: &str) -> u64 {
    let metrics = sandbox.ok(&["metrics"]);
    let wanted = [
        "ictus_stp_violations_total{",
        &format!("federate=\"{federate}\""),
        &format!("federation=\"{federation}\""),
    ];
    let of_it = |line: &&str| wanted.iter().all(|word| line.contains(word));
    let count = |line: &str| line.rsplit(' ').next().unwrap().parse::<f64>().unwrap();
    let sum: f64 = metrics.lines().filter(of_it).map(count).sum();
    format!("{sum:.0}").parse().unwrap()
}

#[test]
fn what_comes_too_late_is_handled_and_counted_at_an_offset_of_zero() {
    let sandbox = Sandbox::new();
    let head = "coordination: decentralized\ntimeout: 1 s\ndefaults: { stp_offset: 0 s }";
    let file = manifest(&sandbox, "late", head, BEAT);
    sandbox.ok(&["up", &file]);
    let view = sandbox.ended("late");
    assert_eq!(view["outcome"]["outcome"], "completed", "{view}");
    let (heard, tardy) = heard(&sandbox, "late");
    // 51 ticks, and each is either heard in time or counted. How many are late is up to the host; what comes after the
    // ear's last tag is counted but cannot be handled any more.
    let counted = violations(&sandbox, "late", "ear");
    assert_eq!(heard + counted, 51, "{heard} in time, {counted} counted");
    assert!(
        (1..=counted).contains(&tardy),
        "{tardy} tardy, {counted} counted"
    );
}

#[test]
fn an_offset_that_is_large_enough_lets_nothing_be_late() {
    let sandbox = Sandbox::new();
    let head = "coordination: decentralized\ntimeout: 1 s\ndefaults: { stp_offset: 5 s }";
    let file = manifest(&sandbox, "early", head, BEAT);
    sandbox.ok(&["up", &file]);
    sandbox.ended("early");
    assert_eq!(heard(&sandbox, "early"), (51, 0));
    assert_eq!(violations(&sandbox, "early", "ear"), 0);
}

#[test]
fn one_stp_violation_too_many_stops_the_federation() {
    let sandbox = Sandbox::new();
    let head = "coordination: decentralized\ndefaults: { stp_offset: 0 s, on_stp_violation: { stop_after: 3 } }";
    let file = manifest(&sandbox, "strict", head, BEAT);
    sandbox.ok(&["up", &file]);
    let view = sandbox.ended("strict");
    assert_eq!(view["outcome"]["failure"]["member"], "ear", "{view}");
    assert!(ending(&view, "ear").contains("14"), "{view}");
    assert!(
        ending(&view, "beat").contains('0'),
        "stopped in order: {view}"
    );
}

#[test]
fn a_killed_federate_stops_a_decentralized_federation_in_order() {
    let sandbox = Sandbox::new();
    let head = "coordination: decentralized\ndefaults: { stp_offset: 100 ms }";
    let file = manifest(&sandbox, "killed", head, BEAT);
    sandbox.ok(&["up", &file]);
    kill(sandbox.pid("killed", "beat"));
    let view = sandbox.ended("killed");
    assert_eq!(view["outcome"]["failure"]["member"], "beat", "{view}");
    assert!(ending(&view, "ear").contains("11"), "{view}");
}

#[test]
fn a_federate_that_may_be_outlived_stops_nobody() {
    for coordination in ["centralized", "decentralized"] {
        let sandbox = Sandbox::new();
        let head = format!(
            "coordination: {coordination}\ntimeout: 4 s\ndefaults: {{ stp_offset: 5 s, on_failure: continue, stop_grace: 1 s }}"
        );
        let head = if coordination == "centralized" {
            head.replace("stp_offset: 5 s, ", "")
        } else {
            head
        };
        let file = manifest(&sandbox, "outlived", &head, BEAT);
        sandbox.ok(&["up", &file]);
        kill(sandbox.pid("outlived", "beat"));
        let view = sandbox.ended("outlived");
        assert_eq!(view["outcome"]["failure"]["member"], "beat", "{view}");
        // It goes on to the time-out, alone.
        assert!(
            !ending(&view, "ear").contains("11"),
            "{coordination}: {view}"
        );
        // It goes on to the time-out, and nobody hurries it.
        assert!(!ending(&view, "ear").contains("signal"), "{view}");
        let (heard, tardy) = heard(&sandbox, "outlived");
        assert!(
            heard < 201 && tardy == 0,
            "{coordination}: {heard}, {tardy}"
        );
    }
}

#[test]
fn a_killed_rti_ends_every_decentralized_federate_with_its_own_code() {
    let sandbox = Sandbox::new();
    let head = "coordination: decentralized\ndefaults: { stp_offset: 100 ms }";
    let file = manifest(&sandbox, "headless", head, BEAT);
    sandbox.ok(&["up", &file]);
    kill(sandbox.pid("headless", "rti"));
    let view = sandbox.ended("headless");
    for federate in ["beat", "ear"] {
        assert!(ending(&view, federate).contains("10"), "{view}");
    }
}

/// Reads the log until it has `words`; the bound of the command is the bound of the wait.
fn wait_for_log(sandbox: &Sandbox, federation: &str, words: &str) {
    while !sandbox.ok(&["logs", federation]).contains(words) {}
}

#[test]
fn a_watchdog_fires_while_the_network_is_cut_and_no_tag_advances() {
    let sandbox = Sandbox::new();
    let rest = "federates:
  beat: { class: Beat }
  guard: { class: Guard, parameters: { patience: 300 ms } }
connections:
  - { from: beat.out, to: guard.input }";
    let file = manifest(&sandbox, "cut", "timeout: 1 h", rest);
    sandbox.ok(&["up", &file]);
    // The RTI says nothing any more, which to its federates is a cut network.
    let rti = Pid::from_raw(sandbox.pid("cut", "rti")).unwrap();
    kill_process(rti, Signal::STOP).unwrap();
    wait_for_log(&sandbox, "cut", "silence 1");
    assert!(
        !sandbox.ok(&["logs", "cut"]).contains("alarm 1"),
        "the alarm has a tag, and none is granted"
    );
    kill_process(rti, Signal::CONT).unwrap();
    // A cut that ends in time changes nothing else: the alarm gets its tag, and the federation goes on.
    wait_for_log(&sandbox, "cut", "alarm 1");
    sandbox.ok(&["stop", "cut"]);
    let view = sandbox.ended("cut");
    assert_ne!(view["outcome"]["outcome"], "failed", "{view}");
    sandbox.ok(&["down", "cut", "--purge"]);
}

#[test]
fn a_physical_connection_drops_the_tag_in_both_modes() {
    for coordination in ["centralized", "decentralized"] {
        let sandbox = Sandbox::new();
        let offset = match coordination {
            "centralized" => "",
            _ => "\ndefaults: { stp_offset: 0 s }",
        };
        let head = format!("coordination: {coordination}\ntimeout: 1 s{offset}");
        let rest = "federates:
  beat: { class: Beat }
  stamped: { class: Stamped }
connections:
  - { from: beat.out, to: stamped.input, physical: true }";
        let file = manifest(&sandbox, "physical", &head, rest);
        sandbox.ok(&["up", &file]);
        let view = sandbox.ended("physical");
        assert_eq!(view["outcome"]["outcome"], "completed", "{view}");
        let logs = sandbox.ok(&["logs", "physical"]);
        let line = logs.lines().find(|line| line.contains("early")).unwrap();
        // What comes at the very end may get a tag after the stop tag.
        let mut numbers = line.split([' ', ',']).filter_map(|w| w.parse::<u64>().ok());
        let (early, heard) = (numbers.next_back().unwrap(), numbers.next_back().unwrap());
        assert!(
            (45..=51).contains(&heard) && early == 0,
            "{coordination}: {line}"
        );
        assert_eq!(violations(&sandbox, "physical", "stamped"), 0);
    }
}

#[test]
fn lf_0_13_layouts_authentication_and_continuous_clocks_go_together() {
    let sandbox = Sandbox::new();
    let head = "coordination: decentralized\ntimeout: 1 s\nwire: \"0.13\"\nauthentication: true
clock: { sync: on, max_error: 100 ms }\ndefaults: { stp_offset: 5 s }";
    let file = manifest(&sandbox, "proven", head, BEAT);
    sandbox.ok(&["up", &file]);
    let view = sandbox.ended("proven");
    assert_eq!(view["outcome"]["outcome"], "completed", "{view}");
    assert_eq!(heard(&sandbox, "proven"), (51, 0));
    let metrics = sandbox.ok(&["metrics"]);
    assert!(
        metrics.contains("ictus_clock_error_bound_seconds{"),
        "{metrics}"
    );
}

#[test]
fn a_clock_that_is_too_uncertain_is_refused_at_the_start() {
    let sandbox = Sandbox::new();
    let head = "timeout: 1 s\nclock: { sync: init, max_error: 1 ns }";
    let file = manifest(&sandbox, "unsure", head, BEAT);
    let said = sandbox.fails(&["up", &file], 1);
    assert!(said.contains("clock") && said.contains("1 ns"), "{said}");
    let view = sandbox.view("unsure");
    let codes: Vec<&str> = ["beat", "ear"].map(|name| ending(&view, name)).into();
    assert!(codes.iter().any(|code| code.contains("13")), "{view}");
    // What is only warned of starts.
    let head = "timeout: 200 ms\nclock: { sync: init, max_error: 1 ns, on_exceed: warn }";
    let file = manifest(&sandbox, "warned", head, BEAT);
    sandbox.ok(&["up", &file]);
    let view = sandbox.ended("warned");
    assert_eq!(view["outcome"]["outcome"], "completed", "{view}");
}

#[test]
fn the_programs_own_offsets_come_from_the_solver() {
    let sandbox = Sandbox::new();
    let head = "coordination: decentralized\ntimeout: 1 s
bounds: { launch_lag: 20 ms, latency: 400 ms, clock_error: 0 ms }\ndefaults: { stp_offset: auto }";
    let file = manifest(&sandbox, "solved", head, BEAT);
    let plan = sandbox.ok(&["plan", &file]);
    let words =
        "ear 420.0 ms = beat offset 0 + beat launch lag 20.0 + network 400.0 + clock 0 - after 0";
    assert!(plan.contains(words), "{plan}");
    sandbox.ok(&["up", &file]);
    sandbox.ended("solved");
    let report = sandbox.ok(&["timing", "solved"]);
    for words in ["ear: S 420", "violations 0", "L+N from beat", "L to ear"] {
        assert!(report.contains(words), "{words} is missing in {report}");
    }
    let suggested = sandbox.ok(&["timing", "solved", "--suggest"]);
    assert!(
        suggested.contains("bounds:") && suggested.contains("launch_lag"),
        "{suggested}"
    );
}
