//! What a user asks of a federation that runs on hosts: everything but `up` and `down` alone.

#![expect(
    clippy::unwrap_used,
    clippy::panic,
    reason = "a test stops at the first surprise"
)]

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use ictus_tests::rig::{Rig, Traffic};
use ictus_tests::{ictus, said};
use serde_json::Value;

use super::Scenario;
use super::operator::{Operator, hosts, spread, target};

/// In this order.
pub(crate) const SCENARIOS: &[Scenario] = &[
    ("the_verbs_work_over_hosts", the_verbs_work_over_hosts),
    (
        "verify_runs_over_hosts_and_leaves_nothing",
        verify_runs_over_hosts_and_leaves_nothing,
    ),
    (
        "a_saved_plan_is_refused_when_a_host_has_moved_on",
        a_saved_plan_is_refused_when_a_host_has_moved_on,
    ),
    (
        "a_rollback_brings_back_the_generation_before",
        a_rollback_brings_back_the_generation_before,
    ),
    (
        "an_upgrade_that_does_not_come_up_is_rolled_back",
        an_upgrade_that_does_not_come_up_is_rolled_back,
    ),
    ("a_viewer_may_only_look", a_viewer_may_only_look),
];

/// What a command prints for programs.
fn json(operator: &Operator<'_>, args: &[&str]) -> Value {
    let output = operator.run(&[args, &["-o", "json"]].concat());
    serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{args:?}: {}", said(&output)))
}

fn the_verbs_work_over_hosts(rig: &Rig) {
    let operator = Operator::with_hosts(rig);
    let file = operator.manifest("diamond.yaml", &spread(rig, "diamond", &hosts(rig, "")));
    let host = target(&rig.hosts()[2]);
    operator.ok(&["up", &file, "--set", "run=1 h"]);

    let events = operator.ok(&["events", &file]);
    for name in ["h1", "h2", "h3"] {
        let healthy = format!(" {name}: healthy");
        assert!(events.contains(&healthy), "{healthy}: {events}");
    }
    // Order and chain of federates on three hosts, with the error of their clocks beside.
    let timing = operator.ok(&["timing", "diamond", "--host", &host]);
    for words in [
        "d.on_gamma before d.on_delta",
        "a to d",
        "times of different hosts",
    ] {
        assert!(timing.contains(words), "{words}: {timing}");
    }
    let metrics = operator.ok(&["metrics", &file]);
    assert!(
        metrics.contains("# host h1\n") && metrics.contains("# host h3\n"),
        "{metrics}"
    );
    let samples = json(&operator, &["metrics", &file]);
    let of_d = |it: &Value| it["labels"]["federate"] == "d" && it["host"].is_string();
    assert!(samples.as_array().unwrap().iter().any(of_d), "{samples}");

    // A host that cannot be asked is unknown; nobody says that anything failed.
    rig.hosts()[2].drop_from(rig.gateway(), Traffic::All);
    let output = operator.run(&["ps", &file, "-o", "json"]);
    assert_eq!(output.status.code(), Some(4), "{}", said(&output));
    let parts: Value = serde_json::from_slice(&output.stdout).unwrap();
    let states: Vec<_> = parts
        .as_array()
        .unwrap()
        .iter()
        .map(|it| &it["state"])
        .collect();
    assert_eq!(states, ["running", "running", "unknown"], "{parts}");
    rig.hosts()[2].heal();

    let stopped = operator.ok(&["stop", "diamond", "--host", &host]);
    assert!(stopped.contains("stopped at the stop tag"), "{stopped}");
    let again = operator.ok(&["stop", &file]);
    assert!(again.contains("nothing of it runs"), "{again}");

    // The logs of the last run and its generation stay, with their size.
    let down = operator.ok(&["down", &file]);
    for words in [
        "kept ",
        "h1: /home/robot/.local/state/ictus/federations/diamond/logs",
        "history",
    ] {
        assert!(down.contains(words), "{words}: {down}");
    }
    // Also those of one member alone, wherever it was.
    let logs = operator.ok(&["logs", "diamond", "rti", "--host", &host]);
    assert!(!logs.contains("error") && logs.contains(" rti "), "{logs}");
    let history = json(&operator, &["history", "diamond", "--host", &host]);
    assert_eq!(
        history[0]["hosts"],
        serde_json::json!(["h1", "h2", "h3"]),
        "{history}"
    );
    assert_eq!(
        history[0]["outcome"], "stopped at the stop tag",
        "{history}"
    );
    operator.ok(&["down", "diamond", "--host", &host, "--purge"]);
    operator.leave();
}

fn verify_runs_over_hosts_and_leaves_nothing(rig: &Rig) {
    let operator = Operator::with_hosts(rig);
    let file = operator.manifest("diamond.yaml", &spread(rig, "diamond", &hosts(rig, "")));
    let modes = ["--modes", "one,centralized", "--set", "run=2 s"];
    let answer = json(&operator, &[&["verify", &file][..], &modes].concat());
    assert_eq!(
        (&answer["equal"], &answer["of"]),
        (&1.into(), &1.into()),
        "{answer}"
    );
    let records = answer["records_per_federate"].as_object().unwrap();
    assert_eq!(records.len(), 4, "{answer}");
    operator.leave();
}

fn a_saved_plan_is_refused_when_a_host_has_moved_on(rig: &Rig) {
    let operator = Operator::with_hosts(rig);
    let file = operator.manifest("diamond.yaml", &spread(rig, "diamond", &hosts(rig, "")));
    let plan = operator.home.path().join("plan.json");
    let plan = plan.to_str().unwrap();
    let save = |run: &str| operator.fails(&["plan", &file, "--set", run, "--out", plan], 2);
    save("run=1 h");
    let up = operator.ok(&["up", "--plan", plan]);
    assert!(up.contains("diamond runs: 4 federates"), "{up}");
    // The same plan again: another run is there by now.
    let said = operator.fails(&["up", "--plan", plan], 9);
    for words in ["host `h1` has moved on", "no run", "already runs"] {
        assert!(said.contains(words), "{words}: {said}");
    }
    // One for another parameter, and somebody else deploys before it is carried out.
    save("run=2 h");
    operator.ok(&["up", &file, "--set", "run=3 h"]);
    let said = operator.fails(&["up", "--plan", plan], 9);
    assert!(
        said.contains("has moved on") && said.contains("by now: "),
        "{said}"
    );
    // The manifest changes: what was planned is not what would be done.
    save("run=2 h");
    let text = fs::read_to_string(&file).unwrap();
    fs::write(&file, text.replace("seed: 1", "seed: 7")).unwrap();
    let said = operator.fails(&["up", "--plan", plan], 9);
    assert!(said.contains("federate/b/parameters"), "{said}");
    for part in operator.parts(&file) {
        assert_eq!(part["state"], "running", "nothing was touched: {part}");
    }
    operator.ok(&["down", &file, "--purge"]);
    operator.leave();
}

fn a_rollback_brings_back_the_generation_before(rig: &Rig) {
    let operator = Operator::with_hosts(rig);
    let file = operator.manifest("diamond.yaml", &spread(rig, "diamond", &hosts(rig, "")));
    let digest = || {
        let parts = operator.parts(&file);
        assert!(
            parts.iter().all(|part| part["state"] == "running"),
            "{parts:?}"
        );
        parts[0]["digest"].as_str().unwrap().to_owned()
    };
    operator.ok(&["up", &file, "--set", "run=1 h"]);
    let first = digest();
    operator.ok(&["up", &file, "--set", "run=2 h"]);
    let second = digest();
    assert_ne!(first, second);
    // Shown like a plan, with what changes; then it is carried out, and nothing is sent.
    let shown = operator.fails(&["rollback", &file, "--dry-run"], 2);
    assert!(
        shown.contains("generation 1 ") && shown.contains("coordination changed"),
        "{shown}"
    );
    assert_eq!(digest(), second, "only shown");
    operator.ok(&["rollback", &file]);
    assert_eq!(digest(), first);
    let same = operator.ok(&["up", &file, "--set", "run=1 h"]);
    assert!(same.contains("already running"), "{same}");
    // What was brought back is a generation, too; the last three are kept.
    operator.ok(&["rollback", &file, "--to", "2"]);
    assert_eq!(digest(), second);
    let entries = json(&operator, &["history", &file]);
    let told = |key: &str| -> Vec<Value> {
        let entries = entries.as_array().unwrap().iter();
        entries.map(|it| it[key].clone()).collect()
    };
    assert_eq!(told("number"), [4, 3, 2, 1], "{entries}");
    assert_eq!(told("kept"), [true, true, true, false], "{entries}");
    let gone = operator.fails(&["rollback", &file, "--to", "1"], 1);
    assert!(
        gone.contains("not kept") && gone.contains("4, 3, 2"),
        "{gone}"
    );
    // Taken down, its programs are still there.
    operator.ok(&["down", &file]);
    operator.ok(&["rollback", &file, "--to", "3"]);
    assert_eq!(digest(), first);
    operator.ok(&["down", &file, "--purge"]);
    operator.leave();
}

fn an_upgrade_that_does_not_come_up_is_rolled_back(rig: &Rig) {
    let operator = Operator::with_hosts(rig);
    let file = operator.manifest("diamond.yaml", &spread(rig, "diamond", &hosts(rig, "")));
    operator.ok(&["up", &file, "--set", "run=1 h"]);
    let host = target(&rig.hosts()[0]);
    let runs = || {
        let parts = operator.parts(&file);
        assert!(
            parts.iter().all(|part| part["state"] == "running"),
            "{parts:?}"
        );
        parts[0]["id"].clone()
    };
    let run = runs();
    // A federate is a static program, too, but no daemon.
    let broken = ictus().with_file_name("diamond");
    let broken = broken.to_str().unwrap();
    let said = operator.fails(&["host", "upgrade", &host, "--program", broken], 1);
    for words in ["does not come up", "the one before serves again"] {
        assert!(said.contains(words), "{words}: {said}");
    }
    assert_eq!(runs(), run, "the old one has adopted what runs");
    operator.ok(&["host", "upgrade", &host]);
    assert_eq!(runs(), run, "and the new one");
    let left = rig.hosts()[0].exec(&["ls", "/home/robot/.local/share/ictus/bin"]);
    assert_eq!(left, "ictusd\n");
    operator.ok(&["down", &file, "--purge"]);
    operator.leave();
}

/// What ssh says to somebody with this key who asks for a file.
fn reads_by_ssh(rig: &Rig, key: &Path, host: &str) -> Output {
    let options = [
        "-F",
        "none",
        "-o",
        "BatchMode=yes",
        "-o",
        "IdentitiesOnly=yes",
    ];
    let known = format!("UserKnownHostsFile={}", rig.known_hosts().display());
    Command::new("timeout")
        .args(["20", "ssh"])
        .args(options)
        .args(["-o", &known, "-i", key.to_str().unwrap()])
        .args([host, "cat /etc/passwd"])
        .output()
        .unwrap()
}

fn a_viewer_may_only_look(rig: &Rig) {
    let operator = Operator::with_hosts(rig);
    let file = operator.manifest("diamond.yaml", &spread(rig, "diamond", &hosts(rig, "")));
    operator.ok(&["up", &file, "--set", "run=1 h"]);
    // One with a key of its own, which the hosts let in for this command only.
    let viewer = Operator::new(rig);
    let ssh = viewer.home.path().join(".ssh");
    fs::copy(rig.known_hosts(), ssh.join("known_hosts")).unwrap();
    let key = ssh.join("id_ed25519");
    fs::remove_file(&key).unwrap();
    let made = Command::new("ssh-keygen")
        .args(["-q", "-t", "ed25519", "-N", "", "-C", "viewer", "-f"])
        .arg(&key)
        .status();
    assert!(made.unwrap().success());
    let public = fs::read_to_string(key.with_extension("pub")).unwrap();
    let fixed = r#"command="~/.local/share/ictus/bin/ictusd dial-stdio --viewer""#;
    let admit = |options: &str| {
        let line = format!("{options} {}", public.trim());
        let script =
            r#"cd .ssh && cp -p authorized_keys before && printf '%s\n' "$1" >>authorized_keys"#;
        for host in rig.hosts() {
            host.exec_as_robot(&["sh", "-ec", script, "sh", &line]);
        }
    };
    let dismiss = || {
        for host in rig.hosts() {
            host.exec_as_robot(&["sh", "-ec", "cd .ssh && mv before authorized_keys"]);
        }
    };
    admit(&format!("restrict,{fixed}"));
    let host = target(&rig.hosts()[0]);
    let at = ["diamond", "--host", &host];
    let looked = viewer.ok(&[&["ps"][..], &at].concat());
    assert!(looked.contains("diamond on h3"), "{looked}");
    let events = viewer.ok(&[&["events"][..], &at].concat());
    assert!(events.contains("h1: healthy"), "{events}");
    viewer.ok(&[&["timing"][..], &at].concat());
    for verb in ["logs", "stop", "down"] {
        let output = viewer.run(&[&[verb][..], &at].concat());
        let text = said(&output);
        assert!(!output.status.success(), "{verb}: {text}");
        assert!(text.contains("may only look"), "{verb}: {text}");
    }
    // Nor by ssh itself: the command is what the key stands for, and nothing is forwarded.
    let asked = reads_by_ssh(rig, &key, &host);
    assert!(!said(&asked).contains("robot:"), "{}", said(&asked));
    let check = operator.ok(&["host", "check", &host]);
    assert!(!check.contains("without `restrict`"), "{check}");
    dismiss();
    admit(fixed);
    let check = operator.ok(&["host", "check", &host]);
    assert!(
        check.contains("the key of viewer has `command=` without `restrict`"),
        "{check}"
    );
    dismiss();
    operator.ok(&["down", &file, "--purge"]);
    operator.leave();
}
