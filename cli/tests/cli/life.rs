//! Federations from `up` to `down`, with the real RTI and real federates.

use std::process::Command;

use serde_json::Value;

use crate::environment::{Environment, Said};

const PAIR: &str = "\
ictus: v1
federation: pair
programs: { fixture: { binary: FIXTURE_PROGRAM } }
let: { period: 10 ms }
federates:
  source: { class: Source, parameters: { period: $period } }
  sink: { class: Sink }
connections:
  - { from: source.out, to: sink.value, after: 1 ms }
";

fn with_timeout(text: &str) -> String {
    format!("{text}timeout: 300 ms\n")
}

fn pair() -> Environment {
    let environment = Environment::new();
    environment.write("pair.yaml", PAIR);
    environment
}

fn json(said: &Said) -> Value {
    serde_json::from_str(&said.out).unwrap()
}

/// Process ids of the RTI and the federates.
fn pids(view: &Value) -> Vec<u64> {
    let members = view["federates"]
        .as_array()
        .unwrap()
        .iter()
        .chain([&view["rti"]]);
    members
        .filter_map(|member| member["pid"].as_u64())
        .collect()
}

fn lives(pid: u64) -> bool {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
    let state = stat
        .rsplit(')')
        .next()
        .and_then(|rest| rest.split_whitespace().next());
    state.is_some_and(|state| state != "Z")
}

#[test]
fn up_ps_logs_stop_down_purge() {
    let environment = pair();
    let up = environment.run(&["up", "pair.yaml"]).ok();
    let stages: Vec<_> = up
        .err
        .lines()
        .filter_map(|line| line.split(' ').next())
        .collect();
    let expected = [
        "checked", "built", "started", "started", "joined", "agreed", "running", "healthy",
    ];
    assert_eq!(stages, expected, "{up}");
    assert!(up.out.contains("pair runs: 2 federates"), "{up}");

    let ps = environment.run(&["ps", "-o", "json"]).ok();
    let view = &json(&ps)[0];
    assert_eq!(
        (&view["name"], &view["state"]),
        (&"pair".into(), &"running".into())
    );
    let pids = pids(view);
    assert_eq!(pids.len(), 3);

    let logs = environment.run(&["logs", "sink", "-o", "json"]).ok();
    let first: Value = serde_json::from_str(logs.out.lines().next().unwrap()).unwrap();
    assert_eq!(first["member"], "sink");

    let stop = environment.run(&["stop", "pair.yaml"]).ok();
    assert!(stop.err.contains("pair: stopped at the stop tag"), "{stop}");
    assert!(pids.iter().all(|pid| !lives(*pid)), "{pids:?}");
    let ps = environment.run(&["ps"]).ok();
    assert!(ps.out.contains("stopped"), "{ps}");

    let down = environment.run(&["down"]).ok();
    assert!(
        down.err.contains("kept       HOME/s/federations/pair/logs"),
        "{down}"
    );
    environment.run(&["logs", "pair", "-n", "1"]).ok();
    environment.run(&["down", "pair", "--purge"]).ok();
    let again = environment.run(&["down", "pair"]);
    assert_eq!(
        (again.code, again.err.contains("there is no federation")),
        (1, true),
        "{again}"
    );
}

#[test]
fn up_twice_changes_nothing_and_another_plan_is_refused() {
    let environment = pair();
    let first = json(&environment.run(&["up", "pair.yaml", "-o", "json"]).ok());
    let again = environment.run(&["up", "pair.yaml", "-o", "json"]).ok();
    assert_eq!(json(&again)["id"], first["id"]);
    assert!(
        again.err.contains("already running from the same plan"),
        "{again}"
    );
    let other = environment.run(&["up", "pair.yaml", "--set", "period=20 ms"]);
    assert_eq!(other.code, 1, "{other}");
    assert!(other.err.contains("hint: `ictus down pair`"), "{other}");
    assert_eq!(
        json(&environment.run(&["ps", "-o", "json"]).ok())[0]["state"],
        "running"
    );
}

#[test]
fn a_federate_that_exits_at_once_is_named_and_nothing_is_left_running() {
    let environment = pair();
    let text = PAIR.replace("class: Sink", "class: Sink, env: { FIXTURE: exit }");
    environment.write("bad.yaml", &text);
    let up = environment.run(&["up", "bad.yaml"]);
    assert_eq!(up.code, 1, "{up}");
    let expected = "error: federate `sink`: exit code 3; everything was undone\n";
    assert!(up.err.contains(expected), "{up}");
    let ps = json(&environment.run(&["ps", "-o", "json"]).ok());
    assert!(pids(&ps[0]).iter().all(|pid| !lives(*pid)));
}

#[test]
fn ctrl_c_before_healthy_undoes_everything() {
    let environment = pair();
    let text = PAIR.replace("class: Sink", "class: Sink, env: { FIXTURE: hang }");
    environment.write("hang.yaml", &text);
    let mut up = environment.start(&["up", "hang.yaml"]);
    up.wait_for("2/2 federates");
    up.interrupt();
    let (code, rest) = up.end();
    assert_eq!(code, 1, "{rest}");
    assert!(rest.contains("undone"), "{rest}");
    let ps = json(&environment.run(&["ps", "-o", "json"]).ok());
    assert!(pids(&ps[0]).iter().all(|pid| !lives(*pid)));
}

#[test]
fn not_healthy_in_time_exits_with_6() {
    let environment = pair();
    let text = PAIR.replace("class: Sink", "class: Sink, env: { FIXTURE: hang }");
    environment.write(
        "hang.yaml",
        &format!("{text}defaults: {{ join_timeout: 5 s }}\n"),
    );
    let up = environment.run(&["up", "hang.yaml"]);
    assert_eq!(up.code, 6, "{up}");
    assert!(up.err.contains("not joined in time: sink"), "{up}");
}

#[test]
fn attached_the_first_ctrl_c_is_an_ordered_stop() {
    let environment = pair();
    let mut up = environment.start(&["up", "pair.yaml", "--attach"]);
    up.wait_for("healthy");
    up.interrupt();
    let (code, rest) = up.end();
    assert_eq!(code, 0, "{rest}");
    let ps = environment.run(&["ps"]).ok();
    assert!(ps.out.contains("stopped"), "{ps}");
}

#[test]
fn the_daemon_may_die_and_nobody_notices() {
    let environment = pair();
    let before = json(&environment.run(&["up", "pair.yaml", "-o", "json"]).ok());
    kill_daemon(&environment);
    let after = json(&environment.run(&["ps", "-o", "json"]).ok());
    assert_eq!(
        (&after[0]["id"], &after[0]["state"]),
        (&before["id"], &"running".into())
    );
    assert_eq!(pids(&after[0]), pids(&before));
    let stop = environment.run(&["stop"]).ok();
    assert!(stop.err.contains("stopped at the stop tag"), "{stop}");
}

#[test]
fn attached_the_daemon_may_die_and_ctrl_c_still_stops() {
    let environment = pair();
    let mut up = environment.start(&["up", "pair.yaml", "--attach"]);
    up.wait_for("healthy");
    kill_daemon(&environment);
    up.wait_for("attached to the next one");
    up.interrupt();
    let (code, rest) = up.end();
    assert_eq!(code, 0, "{rest}");
    let ps = environment.run(&["ps"]).ok();
    assert!(ps.out.contains("stopped"), "{ps}");
}

#[test]
fn up_attaches_to_what_runs_already() {
    let environment = pair();
    environment.run(&["up", "pair.yaml"]).ok();
    let mut up = environment.start(&["up", "pair.yaml", "--attach"]);
    up.wait_for("already running");
    up.interrupt();
    let (code, rest) = up.end();
    assert_eq!(code, 0, "{rest}");
    let ps = environment.run(&["ps"]).ok();
    assert!(ps.out.contains("stopped"), "{ps}");
}

#[test]
fn attached_a_closed_output_is_an_ordered_stop() {
    let environment = pair();
    let mut up = environment
        .command(&["up", "pair.yaml", "--attach"])
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::null())
        .spawn()
        .unwrap();
    // Closed before anything is written to it.
    drop(up.stdout.take());
    let status = up.wait().unwrap();
    assert!(status.code().is_some(), "it ends by itself: {status}");
    let view = json(&environment.run(&["ps", "-o", "json"]).ok());
    assert_eq!(view[0]["state"], "ended", "{view}");
}

fn kill_daemon(environment: &Environment) {
    let daemon = std::fs::read_dir("/proc")
        .unwrap()
        .flatten()
        .filter_map(|entry| entry.file_name().to_str()?.parse::<u64>().ok())
        .find(|pid| is_daemon_of(*pid, &environment.state()))
        .unwrap();
    let killed = Command::new("kill")
        .args(["-9", &daemon.to_string()])
        .status();
    assert!(killed.unwrap().success());
}

fn is_daemon_of(pid: u64, state: &std::path::Path) -> bool {
    let read = |name: &str| std::fs::read(format!("/proc/{pid}/{name}")).unwrap_or_default();
    let environment = format!("ICTUS_STATE_DIR={}", state.display());
    let has = |bytes: &[u8], word: &str| {
        bytes
            .split(|byte| *byte == 0)
            .any(|it| it == word.as_bytes())
    };
    has(&read("cmdline"), "daemon") && has(&read("environ"), &environment)
}

#[test]
fn verify_finds_equal_traces_and_different_ones() {
    let environment = pair();
    environment.write("equal.yaml", &with_timeout(PAIR));
    let equal = environment
        .run(&["verify", "equal.yaml", "--runs", "2"])
        .ok();
    // One process against two centralized and two decentralized runs.
    assert!(equal.out.ends_with("equal 4 of 4\n"), "{equal}");
    assert!(
        equal
            .err
            .contains("200.0 ms per connection: equal, 0 violations"),
        "{equal}"
    );
    environment.write(
        "race.yaml",
        &with_timeout(
            &PAIR
                .replace(
                    "class: Source, parameters: { period: $period }",
                    "class: Racer",
                )
                .replace("let: { period: 10 ms }\n", ""),
        ),
    );
    let race = environment.run(&["verify", "race.yaml"]);
    assert_eq!(race.code, 1, "{race}");
    assert!(
        race.err.contains("different at federate `source`"),
        "{race}"
    );
    assert!(
        environment
            .run(&["ps", "-o", "json"])
            .ok()
            .out
            .starts_with("[]"),
        "no run is left"
    );
}

/// Bounds that hold on any machine; the one of the clock does not matter on one host.
const BOUNDS: &str = "\
coordination: decentralized
bounds: { launch_lag: 2 s, latency: 1 s, clock_error: 0 s }
";

#[test]
fn verify_runs_the_modes_that_it_is_asked_for() {
    let environment = pair();
    environment.write("pair.yaml", &with_timeout(&format!("{PAIR}{BOUNDS}")));
    let said = environment.run(&[
        "verify",
        "pair.yaml",
        "--modes",
        "decentralized,one",
        "-o",
        "json",
    ]);
    let answer: Value = serde_json::from_str(&said.ok().out).unwrap();
    assert_eq!(answer["reference"], "one", "{answer}");
    assert_eq!(answer["offsets"], "offsets of the manifest", "{answer}");
    assert_eq!(answer["of"], 1, "{answer}");
    let run = &answer["runs"][0];
    assert_eq!(
        (&run["mode"], &run["violations"]),
        (&"decentralized".into(), &0.into()),
        "{answer}"
    );
    assert_eq!(run["hash"], answer["hash"], "{answer}");
    let alone = environment.run(&["verify", "pair.yaml", "--modes", "centralized"]);
    assert!(alone.err.contains("nothing to compare it with"), "{alone}");
    environment.write("fast.yaml", &with_timeout(&format!("{PAIR}fast: true\n")));
    let fast = environment.run(&["verify", "fast.yaml"]).ok();
    assert!(
        fast.err.contains("left out   decentralized: `fast`"),
        "{fast}"
    );
    assert!(fast.out.ends_with("equal 1 of 1\n"), "{fast}");
    let fast = environment.run(&["verify", "fast.yaml", "--modes", "one,decentralized"]);
    assert!(fast.err.contains("cannot run decentralized"), "{fast}");
}

/// What was measured stays until `down`, so nothing has to be waited for.
#[test]
fn timing_shows_declared_and_measured_bounds_of_a_decentralized_run() {
    let environment = pair();
    environment.write("pair.yaml", &with_timeout(&format!("{PAIR}{BOUNDS}")));
    let mut up = environment.start(&["up", "pair.yaml", "--attach"]);
    up.wait_for("healthy");
    let (code, rest) = up.end();
    assert_eq!(code, 0, "{rest}");
    let said = environment.run(&["timing", "-o", "json"]).ok();
    let answer: Value = serde_json::from_str(&said.out).unwrap();
    let [source, sink] = [0, 1].map(|index| &answer["bounds"]["federates"][index]);
    assert_eq!(source["rows"][0]["what"], "launch_lag", "{answer}");
    assert_eq!(source["rows"][0]["measured"]["count"], 30, "{answer}");
    assert_eq!(sink["offset_ns"], 2_999_000_000_i64, "{answer}");
    assert_eq!(sink["violations"], 0, "{answer}");
    assert!(sink["rows"][0]["margin_ns"].is_i64(), "{answer}");
    let table = environment.run(&["timing"]).ok();
    assert!(
        table.out.contains("\nsink: S 2999.0, required 2999.0;"),
        "{table}"
    );
    let suggested = environment.run(&["timing", "--suggest"]).ok().out;
    let (pair, _) = BOUNDS.split_once("bounds").unwrap();
    environment.write("suggested.yaml", &format!("{PAIR}{pair}{suggested}"));
    // What was not measured is as declared, and says so.
    assert!(
        suggested.contains("# declared, not measured"),
        "{suggested}"
    );
    environment
        .run(&["check", "--no-build", "suggested.yaml"])
        .ok();
}

#[test]
fn centralized_federations_have_no_bounds_to_suggest() {
    let environment = pair();
    environment.run(&["up", "pair.yaml"]).ok();
    let said = environment.run(&["timing", "--suggest"]);
    assert!(said.err.contains("coordinated centrally"), "{said}");
}

#[test]
fn verify_outlives_a_daemon_that_had_nothing_to_do() {
    let environment = pair();
    environment.write("equal.yaml", &format!("{PAIR}timeout: 3 s\n"));
    let mut command = environment.command(&["verify", "equal.yaml"]);
    // The run in one process takes longer.
    let said = command
        .env("ICTUS_DAEMON_IDLE_MS", "1500")
        .output()
        .unwrap();
    assert!(
        said.status.success(),
        "{}",
        String::from_utf8_lossy(&said.stderr)
    );
}

#[test]
fn a_terminated_verify_leaves_no_run() {
    let environment = pair();
    environment.write("long.yaml", &format!("{PAIR}timeout: 1 h\n"));
    let mut verify = environment
        .command(&["verify", "long.yaml"])
        .stdout(std::process::Stdio::null())
        .stderr(std::process::Stdio::null())
        .spawn()
        .unwrap();
    // The run in one process has its directory: the command waits for it.
    let runs = environment.state().join("federations");
    while !runs
        .read_dir()
        .is_ok_and(|mut entries| entries.next().is_some())
    {
        assert_eq!(verify.try_wait().unwrap(), None);
    }
    let pid = verify.id().to_string();
    assert!(Command::new("kill").arg(&pid).status().unwrap().success());
    assert_eq!(verify.wait().unwrap().code(), Some(1));
    let left = runs.read_dir().map_or(0, Iterator::count);
    assert_eq!(left, 0, "no run is left");
}

#[test]
fn a_run_that_fails_under_verify_leaves_its_logs() {
    let environment = pair();
    let text = PAIR.replace(
        "class: Sink",
        "class: Sink, env: { FIXTURE: exit-federated }",
    );
    environment.write("bad.yaml", &with_timeout(&text));
    let verify = environment.run(&["verify", "bad.yaml"]);
    assert_eq!(verify.code, 1, "{verify}");
    let (_, log) = verify.err.rsplit_once("the whole log is HOME/").unwrap();
    assert!(environment.path(log.trim_end()).is_file(), "{verify}");
}

#[test]
fn nothing_is_left_after_a_purge_of_the_last_one() {
    let environment = pair();
    environment.run(&["up", "pair.yaml"]).ok();
    environment.run(&["down", "--purge"]).ok();
    assert!(!environment.state().exists());
}
