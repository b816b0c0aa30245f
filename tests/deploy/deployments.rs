//! Deployments as a user makes them: from `ictus host add` to `ictus down --purge`.

#![expect(
    clippy::unwrap_used,
    clippy::panic,
    reason = "a test stops at the first surprise"
)]

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use ictus_deploy::trace::{TraceSet, Verdict, compare};
use ictus_tests::rig::{Host, Rig};
use ictus_tests::{ictus, root, said};
use serde_json::Value;
use tempfile::TempDir;

use super::Scenario;

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

/// How long any command may take, in seconds; `timeout` of coreutils sees to it.
const BOUND_S: &str = "200";

/// Who deploys: a home directory of its own, with the rig's key.
struct Operator<'r> {
    rig: &'r Rig,
    home: TempDir,
}

impl<'r> Operator<'r> {
    /// One who knows no host yet.
    fn new(rig: &'r Rig) -> Self {
        let home = tempfile::Builder::new().prefix("ictus-").tempdir().unwrap();
        let ssh = home.path().join(".ssh");
        fs::create_dir(&ssh).unwrap();
        fs::set_permissions(&ssh, fs::Permissions::from_mode(0o700)).unwrap();
        let key = ssh.join("id_ed25519");
        fs::copy(rig.key(), &key).unwrap();
        fs::set_permissions(&key, fs::Permissions::from_mode(0o600)).unwrap();
        Self { rig, home }
    }

    /// One whose hosts are ready.
    fn with_hosts(rig: &'r Rig) -> Self {
        let operator = Self::new(rig);
        for host in rig.hosts() {
            let said = operator.ok(&["host", "add", &target(host), "--accept-new"]);
            assert!(said.contains("ictusd"), "{said}");
        }
        operator
    }

    fn run(&self, args: &[&str]) -> Output {
        Command::new("timeout")
            .args(["--kill-after=5", BOUND_S])
            .arg(ictus())
            .args(args)
            .current_dir(root())
            .env("HOME", self.home.path())
            .env("ICTUS_STATE_DIR", self.home.path().join("state"))
            .env("ICTUS_DAEMON_IDLE_MS", "1000")
            .env_remove("XDG_RUNTIME_DIR")
            .env_remove("SSH_AUTH_SOCK")
            .stdin(Stdio::null())
            .output()
            .unwrap()
    }

    /// Expects success; gives both streams.
    fn ok(&self, args: &[&str]) -> String {
        let output = self.run(args);
        assert!(output.status.success(), "ictus {args:?}: {}", said(&output));
        said(&output)
    }

    /// Expects this exit code; gives both streams.
    fn fails(&self, args: &[&str], code: i32) -> String {
        let output = self.run(args);
        let text = said(&output);
        assert_eq!(output.status.code(), Some(code), "ictus {args:?}: {text}");
        text
    }

    /// The parts of a federation, by host.
    fn parts(&self, manifest: &str) -> Vec<Value> {
        let output = self.run(&["ps", manifest, "-o", "json"]);
        serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{}", said(&output)))
    }

    fn manifest(&self, name: &str, text: &str) -> String {
        let path = self.home.path().join(name);
        fs::write(&path, text).unwrap();
        path.to_str().unwrap().to_owned()
    }

    /// Removes everything from every host, so that the leak checker finds nothing.
    fn leave(self) {
        for host in self.rig.hosts() {
            self.ok(&["host", "rm", &target(host)]);
        }
    }
}

fn target(host: &Host) -> String {
    format!("robot@{}", host.address)
}

/// The `hosts:` of a manifest: the rig's, with these keys besides.
fn hosts(rig: &Rig, more: &str) -> String {
    let line = |host: &Host| format!("  {}: {{ ssh: \"{}\"{more} }}\n", host.name, target(host));
    let lines: String = rig.hosts().iter().map(line).collect();
    format!(
        "hosts:\n{lines}security: trusted-network\nrti: {{ host: {} }}\n",
        rig.hosts()[0].name
    )
}

/// A manifest of compose/ with `hosts`, its federates dealt out to them in turn.
fn spread(rig: &Rig, example: &str, head: &str) -> String {
    let path = root().join("compose").join(example);
    let text = fs::read_to_string(path.join("federation.yaml")).unwrap();
    let mut spread = String::new();
    let (mut in_federates, mut turn) = (false, 0);
    for line in text.lines() {
        if !line.starts_with([' ', '#']) && !line.is_empty() {
            in_federates = line.starts_with("federates:");
        }
        let federate = in_federates && line.starts_with("  ") && line.contains("{ class:");
        if federate {
            let host = &rig.hosts()[turn % rig.hosts().len()].name;
            turn += 1;
            spread.push_str(&line.replace("{ class:", &format!("{{ host: {host}, class:")));
        } else {
            spread.push_str(&line.replace("package: .", &format!("package: {}", path.display())));
        }
        spread.push('\n');
        if line.starts_with("ictus: v1") {
            spread.push_str(head);
        }
    }
    assert!(turn >= rig.hosts().len(), "{spread}");
    spread
}

/// The traces that the hosts have, in one directory.
fn gather(rig: &Rig, name: &str, into: &Path) {
    fs::create_dir_all(into).unwrap();
    for host in rig.hosts() {
        let directory = format!("/home/robot/.local/state/ictus/federations/{name}/trace");
        let listed = host.exec(&["ls", &directory]);
        for file in listed.lines() {
            let text = host.exec(&["cat", &format!("{directory}/{file}")]);
            fs::write(into.join(file), text).unwrap();
        }
    }
}

/// The trace of one process from the same plan.
fn in_one_process(rig: &Rig, name: &str, program: &Path, into: &Path) {
    fs::create_dir_all(into).unwrap();
    let plan = into.with_extension("json");
    let path = format!("/home/robot/.local/state/ictus/federations/{name}/plan.json");
    fs::write(&plan, rig.hosts()[0].exec(&["cat", &path])).unwrap();
    let output = Command::new("timeout")
        .args(["--kill-after=5", BOUND_S])
        .arg(program)
        .arg("--plan")
        .arg(&plan)
        .arg("--trace")
        .arg(into)
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", said(&output));
}

/// The static program of an example.
fn program(name: &str) -> PathBuf {
    ictus().with_file_name(name)
}

/// Runs to the end of its time-out, and compares what the hosts wrote with one process.
fn verify(operator: &Operator<'_>, manifest: &str, name: &str, example: &str) {
    operator.ok(&["logs", "--follow", manifest]);
    for part in operator.parts(manifest) {
        assert_eq!(part["outcome"]["outcome"], "completed", "{part}");
    }
    let directory = operator.home.path();
    let (one, many) = (directory.join("one"), directory.join("many"));
    for old in [&one, &many] {
        fs::remove_dir_all(old).ok();
    }
    gather(operator.rig, name, &many);
    in_one_process(operator.rig, name, &program(example), &one);
    let (one, many) = (
        TraceSet::read(&one).unwrap(),
        TraceSet::read(&many).unwrap(),
    );
    let verdict = compare(&one, &many);
    assert!(matches!(verdict, Verdict::Equal { .. }), "{verdict:?}");
    let records = many.records_per_federate();
    assert!(records.values().all(|count| *count > 0), "{records:?}");
}

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
        let run = ["--set", "run=4 s"];
        let planned = operator.run(&[&["plan", &file][..], &run].concat());
        assert_eq!(planned.status.code(), Some(2), "{}", said(&planned));
        let up = operator.ok(&[&["up", &file, "--trace"][..], &run].concat());
        tell(coordination, &up);
        verify(&operator, &file, "autoware", "autoware");
        operator.ok(&["down", &file, "--purge"]);
    }
    operator.leave();
}

fn the_diamond_runs_as_processes_over_three_hosts(rig: &Rig) {
    let operator = Operator::with_hosts(rig);
    let file = operator.manifest("diamond.yaml", &spread(rig, "diamond", &hosts(rig, "")));
    let first = operator.ok(&["up", &file, "--set", "run=1 h", "--trace"]);
    tell("first", &first);
    // While it runs there is nothing to do.
    let again = operator.ok(&["up", &file, "--set", "run=1 h", "--trace"]);
    assert!(again.contains("already running"), "{again}");
    // Another parameter: everybody restarts at a planned stop, and no program is sent.
    let changed = operator.ok(&["up", &file, "--set", "run=3 s", "--trace"]);
    assert!(
        changed.contains("restart together at a planned stop"),
        "{changed}"
    );
    assert!(changed.contains("0 B sent"), "{changed}");
    tell("changed", &changed);
    verify(&operator, &file, "diamond", "diamond");
    // Without the manifest, from any machine that knows one host.
    let host = target(&rig.hosts()[1]);
    operator.ok(&["down", "diamond", "--host", &host, "--purge"]);
    operator.leave();
}

/// The figures of a start.
#[expect(clippy::print_stdout, reason = "a test's report")]
fn tell(what: &str, up: &str) {
    for line in up
        .lines()
        .filter(|line| line.starts_with("sent ") || line.starts_with("healthy "))
    {
        println!("  {what}: {line}");
    }
}

fn a_killed_daemon_of_a_host_adopts(rig: &Rig) {
    let operator = Operator::with_hosts(rig);
    for engine in ["process", "docker"] {
        let more = format!(", engine: {engine}");
        let file = operator.manifest("diamond.yaml", &spread(rig, "diamond", &hosts(rig, &more)));
        operator.ok(&["up", &file, "--set", "run=15 s", "--trace"]);
        rig.hosts()[1].exec(&["pkill", "-KILL", "-f", "[i]ctusd daemon"]);
        let parts = operator.parts(&file);
        assert!(
            parts.iter().all(|part| part["state"] == "running"),
            "{parts:?}"
        );
        verify(&operator, &file, "diamond", "diamond");
        operator.ok(&["down", &file, "--purge"]);
    }
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
    operator.ok(&["up", &file, "--set", "run=15 s", "--trace"]);
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
