//! Deployments as a user makes them: from `ictus host add` to `ictus down --purge`.

#![expect(
    clippy::unwrap_used,
    clippy::panic,
    reason = "a test stops at the first surprise"
)]

use std::fs;
use std::process::Command;

use ictus_tests::rig::Rig;
use ictus_tests::{root, said};
use serde_json::Value;

use super::Scenario;
use super::operator::{Operator, hosts, spread, target, timed, verify};

/// In this order.
pub(crate) const SCENARIOS: &[Scenario] = &[
    (
        "autoware_runs_in_containers_over_three_hosts",
        autoware_runs_in_containers_over_three_hosts,
    ),
    (
        "the_diamond_runs_as_processes_over_three_hosts",
        the_diamond_runs_as_processes_over_three_hosts,
    ),
    (
        "a_killed_daemon_of_a_host_adopts",
        a_killed_daemon_of_a_host_adopts,
    ),
    ("an_unknown_host_is_said", an_unknown_host_is_said),
    (
        "an_unreachable_host_is_said_and_nothing_runs",
        an_unreachable_host_is_said_and_nothing_runs,
    ),
    ("a_wrong_key_is_said", a_wrong_key_is_said),
    (
        "only_the_key_of_the_fingerprint_is_pinned",
        only_the_key_of_the_fingerprint_is_pinned,
    ),
    (
        "a_changed_host_key_names_file_and_line",
        a_changed_host_key_names_file_and_line,
    ),
    (
        "missing_docker_is_said_before_anything_runs",
        missing_docker_is_said_before_anything_runs,
    ),
    (
        "a_federate_that_exits_at_once_undoes_all_hosts",
        a_federate_that_exits_at_once_undoes_all_hosts,
    ),
    (
        "a_cut_shorter_than_any_timeout_changes_no_trace",
        a_cut_shorter_than_any_timeout_changes_no_trace,
    ),
];

fn autoware_runs_in_containers_over_three_hosts(rig: &Rig) {
    let operator = Operator::with_hosts(rig);
    for coordination in ["centralized", "decentralized"] {
        let offset = match coordination {
            "decentralized" => "defaults: { stp_offset: 3 s }\n",
            _ => "",
        };
        let head = format!(
            "coordination: {coordination}\n{offset}{}",
            hosts(rig, ", engine: docker")
        );
        let file = operator.manifest("autoware.yaml", &spread(rig, "autoware", &head));
        let run = ["--set", "run=8 s"];
        let planned = operator.run(&[&["plan", &file][..], &run].concat());
        assert_eq!(planned.status.code(), Some(2), "{}", said(&planned));
        let up = [&["up", &file, "--trace"][..], &run].concat();
        timed(&operator, coordination, &up);
        let again = timed(&operator, "again", &up);
        assert!(again.contains("already running"), "{again}");
        // The daemon of one host is killed: nothing changes, the next one adopts.
        rig.hosts()[1].exec(&["pkill", "-KILL", "-f", "[i]ctusd daemon"]);
        let parts = operator.parts(&file);
        let running = |part: &Value| part["state"] == "running";
        assert!(parts.iter().all(running), "{parts:?}");
        tell_images(rig);
        verify(&operator, &file, "autoware", "autoware");
        timed(&operator, "down", &["down", &file, "--purge"]);
    }
    operator.leave();
}

/// How large the images are that the daemons made.
#[expect(clippy::print_stdout, reason = "a test's report")]
fn tell_images(rig: &Rig) {
    let format = "{{.Repository}} {{.Size}}";
    let images = rig.hosts()[0].docker(&["images", "--format", format]);
    let ours = images.lines().filter(|line| line.contains("ictus"));
    for image in ours {
        println!("  image: {image}");
    }
}

fn the_diamond_runs_as_processes_over_three_hosts(rig: &Rig) {
    let operator = Operator::with_hosts(rig);
    let file = operator.manifest("diamond.yaml", &spread(rig, "diamond", &hosts(rig, "")));
    timed(
        &operator,
        "first",
        &["up", &file, "--set", "run=1 h", "--trace"],
    );
    // While it runs there is nothing to do.
    let again = timed(
        &operator,
        "again",
        &["up", &file, "--set", "run=1 h", "--trace"],
    );
    assert!(again.contains("already running"), "{again}");
    // Another parameter: everybody restarts at a planned stop, and no program is sent.
    let changed = timed(
        &operator,
        "changed",
        &["up", &file, "--set", "run=3 s", "--trace"],
    );
    assert!(
        changed.contains("restart together at a planned stop"),
        "{changed}"
    );
    assert!(changed.contains("0 B sent"), "{changed}");
    verify(&operator, &file, "diamond", "diamond");
    // Without the manifest, from any machine that knows one host.
    let host = target(&rig.hosts()[1]);
    operator.ok(&["down", "diamond", "--host", &host, "--purge"]);
    operator.leave();
}

fn a_killed_daemon_of_a_host_adopts(rig: &Rig) {
    let operator = Operator::with_hosts(rig);
    let file = operator.manifest("diamond.yaml", &spread(rig, "diamond", &hosts(rig, "")));
    operator.ok(&["up", &file, "--set", "run=1 h"]);
    let before = operator.parts(&file);
    rig.hosts()[1].exec(&["pkill", "-KILL", "-f", "[i]ctusd daemon"]);
    let parts = operator.parts(&file);
    let running = |part: &Value| part["state"] == "running";
    assert!(parts.iter().all(running), "{parts:?}");
    // The same processes of the same run.
    let who = |part: &Value| (part["id"].clone(), part["federates"][0]["pid"].clone());
    let (before, after): (Vec<_>, Vec<_>) = (
        before.iter().map(who).collect(),
        parts.iter().map(who).collect(),
    );
    assert_eq!(before, after);
    operator.ok(&["down", &file, "--purge"]);
    operator.leave();
}

fn an_unknown_host_is_said(rig: &Rig) {
    let operator = Operator::new(rig);
    let text = spread(rig, "diamond", &hosts(rig, "")).replacen("{ host: h1,", "{ host: h9,", 1);
    let file = operator.manifest("diamond.yaml", &text);
    let said = operator.fails(&["up", &file], 3);
    assert!(
        said.contains("h9") && said.contains("diamond.yaml:"),
        "{said}"
    );
}

fn an_unreachable_host_is_said_and_nothing_runs(rig: &Rig) {
    let operator = Operator::with_hosts(rig);
    let file = operator.manifest("diamond.yaml", &spread(rig, "diamond", &hosts(rig, "")));
    let [first, _, last] = rig.hosts() else {
        panic!("three hosts")
    };
    last.cut_cable();
    let said = operator.fails(&["up", &file], 4);
    assert!(said.contains(&format!("host `{}`", last.name)), "{said}");
    let left = first.exec(&[
        "sh",
        "-c",
        "ls /home/robot/.local/state/ictus/federations 2>&1 || true",
    ]);
    assert!(left.contains("No such file"), "{left}");
    last.restore_cable();
    operator.leave();
}

fn a_wrong_key_is_said(rig: &Rig) {
    let operator = Operator::new(rig);
    let host = target(&rig.hosts()[0]);
    let key = operator.home.path().join(".ssh/id_ed25519");
    fs::remove_file(&key).unwrap();
    let made = Command::new("ssh-keygen")
        .args(["-q", "-t", "ed25519", "-N", "", "-f"])
        .arg(&key)
        .status();
    assert!(made.unwrap().success());
    let said = operator.fails(&["host", "add", &host, "--accept-new"], 4);
    assert!(
        said.contains("id_ed25519") || said.contains("key"),
        "{said}"
    );
}

fn only_the_key_of_the_fingerprint_is_pinned(rig: &Rig) {
    let operator = Operator::new(rig);
    let host = &rig.hosts()[0];
    let at = target(host);
    let known = operator.home.path().join(".ssh/known_hosts");
    let wrong = format!("SHA256:{}", "A".repeat(43));
    let said = operator.fails(&["host", "add", &at, "--fingerprint", &wrong], 4);
    assert!(said.contains("is not trusted"), "{said}");
    assert!(!known.exists(), "nothing is pinned");
    let keys = Command::new("ssh-keygen")
        .arg("-lf")
        .arg(rig.known_hosts())
        .output();
    let keys = String::from_utf8(keys.unwrap().stdout).unwrap();
    let address = host.address.to_string();
    let mut lines = keys.lines().map(|line| line.split(' ').collect::<Vec<_>>());
    let own = lines.find(|line| line[2] == address && line[3] == "(ED25519)");
    let right = own.unwrap()[1];
    operator.ok(&["host", "add", &at, "--fingerprint", right]);
    let pinned = fs::read_to_string(&known).unwrap();
    assert_eq!(pinned.lines().count(), 1, "{pinned}");
    assert!(pinned.contains(" ssh-ed25519 "), "{pinned}");
    let listed = operator.ok(&["host", "ls"]);
    assert!(listed.contains(&at), "{listed}");
    operator.remove(std::slice::from_ref(host));
}

fn a_changed_host_key_names_file_and_line(rig: &Rig) {
    let operator = Operator::new(rig);
    let host = &rig.hosts()[0];
    // The key of another host under this one's address.
    let known = fs::read_to_string(rig.known_hosts()).unwrap();
    let other = rig.hosts()[1].address.to_string();
    let wrong = known.lines().filter(|line| line.starts_with(&other));
    let wrong: String = wrong
        .map(|line| format!("{}\n", line.replace(&other, &host.address.to_string())))
        .collect();
    fs::write(operator.home.path().join(".ssh/known_hosts"), wrong).unwrap();
    let said = operator.fails(&["host", "check", &target(host)], 4);
    assert!(
        said.contains("has changed") && said.contains("known_hosts:"),
        "{said}"
    );
}

fn missing_docker_is_said_before_anything_runs(rig: &Rig) {
    let operator = Operator::with_hosts(rig);
    let more = ", engine: docker";
    let file = operator.manifest("diamond.yaml", &spread(rig, "diamond", &hosts(rig, more)));
    rig.hosts()[2].stop_docker();
    let said = operator.fails(&["up", &file], 1);
    assert!(
        said.contains(&rig.hosts()[2].name) && said.contains("Docker"),
        "{said}"
    );
    rig.hosts()[2].start_docker();
    operator.leave();
}

fn a_federate_that_exits_at_once_undoes_all_hosts(rig: &Rig) {
    let operator = Operator::with_hosts(rig);
    let canary = root().join("tests/canary");
    let text = format!(
        "ictus: v1\nfederation: faulty\n{}programs:\n  canary: {{ package: {} }}\nfederates:\n  \
         faulty: {{ host: h2, class: Faulty, parameters: {{ at: 1 }} }}\n  watcher: {{ host: h1, class: Watcher }}\n\
         ",
        hosts(rig, ""),
        canary.display()
    );
    let file = operator.manifest("faulty.yaml", &text);
    let said = operator.fails(&["up", &file], 1);
    for words in [
        "host `h2`",
        "tick 1 was the last straw",
        "everything was stopped",
    ] {
        assert!(said.contains(words), "{words} is missing in {said}");
    }
    for host in rig.hosts() {
        let found = host.output(&["pgrep", "-f", "[-]-federate"]);
        assert_eq!(
            found.status.code(),
            Some(1),
            "{}",
            ictus_tests::said(&found)
        );
    }
    operator.ok(&["down", &file, "--purge"]);
    operator.leave();
}

fn a_cut_shorter_than_any_timeout_changes_no_trace(rig: &Rig) {
    let operator = Operator::with_hosts(rig);
    let file = operator.manifest("diamond.yaml", &spread(rig, "diamond", &hosts(rig, "")));
    operator.ok(&["up", &file, "--set", "run=8 s", "--trace"]);
    let [first, second, _] = rig.hosts() else {
        panic!("three hosts")
    };
    first.partition_from(second, ictus_tests::rig::Traffic::Data);
    // Nobody has given up: ssh still answers, and says so.
    let parts = operator.parts(&file);
    assert_eq!(parts.len(), 3, "{parts:?}");
    let running = |part: &Value| part["state"] == "running";
    assert!(parts.iter().all(running), "{parts:?}");
    first.heal();
    second.heal();
    verify(&operator, &file, "diamond", "diamond");
    operator.ok(&["down", &file, "--purge"]);
    operator.leave();
}
