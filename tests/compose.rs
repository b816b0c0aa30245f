//! `ictus compose`: the committed files, what both generations of Compose say of them, and a federation that
//! docker-compose runs.

#![expect(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use std::fs;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::Duration;

use ictus_deploy::compose::monitoring::PROMETHEUS_CONFIG;
use ictus_deploy::trace::{TraceSet, Verdict, compare};
use ictus_tests::{Sandbox, ictus, root, said};
use sha2::{Digest, Sha256};

/// How long any command may take, in seconds; `timeout` of coreutils sees to it.
const BOUND_S: &str = "200";
const EXAMPLES: [&str; 4] = ["autoware", "diamond", "inconsistency", "pairing"];

/// A manifest that asks for everything that a container can be given.
const EVERYTHING: &str = "\
ictus: v1
federation: everything
deploy: compose
authentication: true
wire: \"0.13\"
clock: { sync: on, period: 5 ms, trials: 7, max_error: 1 ms, on_exceed: warn }
timeout: 2 s
metrics: { listen: 127.0.0.1:9464 }
programs: { diamond: { package: PACKAGE } }
federates:
  a:
    class: A
    parameters: { period: 100 ms, work: 1 ms }
    env: { PRICE: \"$$5\", QUOTED: \"it's \\\"so\\\": yes\" }
    env_file: [a.env]
    secrets: [MAP_KEY, { name: TOKEN, file: token }]
    cpus: [0, 1]
    memory: 64 MiB
    pids: 50
    user: \"1000:50\"
    devices: [/dev/null]
    volumes: [{ host: /usr/share, at: /data, read_only: true }]
    realtime: { policy: fifo, priority: 60, lock_memory: true }
  b: { class: Worker, on_failure: continue, parameters: { seed: 1, max_work: 10 ms } }
  viewer: { image: \"registry.lan/viewer:1.2\", id: 2, args: [-x], ports: { inputs: { frame: { id: 0 } } } }
connections:
  - { from: a.alpha, to: b.input }
  - { from: b.out, to: viewer.frame }
defaults: { stop_grace: 1500 ms, join_timeout: 7 s, logs: { max_size: 1 MiB, max_files: 2 } }
";

fn bounded(program: &str) -> Command {
    let mut command = Command::new("timeout");
    command.args(["--kill-after=5", BOUND_S, program]);
    command.stdin(Stdio::null()).current_dir(root());
    command
}

fn ok(command: &mut Command) -> String {
    let output = command.output().unwrap();
    assert!(output.status.success(), "{command:?}: {}", said(&output));
    String::from_utf8(output.stdout).unwrap()
}

/// Whether a command that is needed is there; without it a test is left out, but not in CI.
#[expect(clippy::print_stderr, reason = "a test that does not run says so")]
fn has(command: &mut Command, fix: &str) -> bool {
    let there = command.output().is_ok_and(|output| output.status.success());
    if !there {
        eprintln!("skipped: {fix}");
        assert!(
            std::env::var_os("CI").is_none_or(|ci| ci != "true"),
            "{fix}"
        );
    }
    there
}

fn has_compose() -> bool {
    let fix = "there is no docker-compose (`.ci/setup hosts` installs it)";
    has(bounded("docker-compose").arg("version"), fix)
}

fn has_engine() -> bool {
    let fix = "no Docker engine answers (`.ci/setup hosts` starts one)";
    has(bounded("docker").arg("version"), fix)
}

fn manifest(sandbox: &Sandbox) -> String {
    let package = root().join("compose/diamond");
    for (name, text) in [("a.env", "FROM_FILE=one two\n"), ("token", "canary-4711\n")] {
        fs::write(sandbox.state().join(name), text).unwrap();
    }
    let text = EVERYTHING.replace("PACKAGE", package.to_str().unwrap());
    sandbox.manifest("everything.yaml", &text)
}

/// The file as docker-compose 1.29 understands it.
fn config(file: &Path) -> Output {
    let mut command = bounded("docker-compose");
    command.args(["--project-name", "x", "--file"]).arg(file);
    command.arg("config").env("ICTUS_FEDERATION_ID", "key");
    command
        .env("MAP_KEY_FILE", "/etc/hostname")
        .output()
        .unwrap()
}

#[test]
fn the_committed_files_are_what_is_printed() {
    let sandbox = Sandbox::new();
    for example in EXAMPLES {
        let directory = root().join("compose").join(example);
        let file = directory.join("compose.yaml");
        let printed = sandbox.ok(&["compose", directory.to_str().unwrap()]);
        if std::env::var_os("UPDATE_GOLDEN").is_some() {
            fs::write(&file, &printed).unwrap();
        }
        let committed = fs::read_to_string(&file).unwrap_or_default();
        assert_eq!(
            committed, printed,
            "UPDATE_GOLDEN=1 writes compose/{example}/compose.yaml"
        );
    }
}

#[test]
fn both_generations_of_compose_take_what_is_printed() {
    if !has_compose() {
        return;
    }
    let sandbox = Sandbox::new();
    let everything = manifest(&sandbox);
    let tests = root().join("tests/compose");
    let diamond = root().join("compose/diamond");
    let diamond = diamond.to_str().unwrap();
    let cases = [
        vec!["compose", &everything],
        vec!["compose", diamond, "--monitoring", "--trace", "./trace"],
        vec!["compose", diamond],
    ];
    for (number, arguments) in cases.iter().enumerate() {
        let file = sandbox.state().join(format!("{number}.yaml"));
        fs::write(&file, sandbox.ok(arguments)).unwrap();
        let output = config(&file);
        assert!(output.status.success(), "{arguments:?}: {}", said(&output));
        let schema = tests.join("compose-spec.json");
        ok(bounded("python3")
            .arg(tests.join("validate.py"))
            .arg(schema)
            .arg(&file));
    }
}

/// Everything the manifest says arrives, and nothing of a secret.
#[test]
fn everything_arrives_and_no_secret_does() {
    if !has_compose() {
        return;
    }
    let sandbox = Sandbox::new();
    let everything = manifest(&sandbox);
    let text = sandbox.ok(&["compose", &everything]);
    let again = sandbox.ok(&["compose", &everything]);
    assert_eq!(text, again);
    assert!(!text.contains("canary-4711"));
    let file = sandbox.state().join("compose.yaml");
    fs::write(&file, &text).unwrap();
    let output = config(&file);
    let config = String::from_utf8_lossy(&output.stdout);
    for words in [
        "- key",
        "- -a",
        "- '0.13'",
        "- '5000000'",
        "- exchanges-per-interval",
        "- '7'",
        "- --continue",
        "- '7000'",
        "PRICE: $$5",
        "FROM_FILE: one two",
        "TOKEN_FILE: /run/secrets/a.TOKEN",
        "MAP_KEY_FILE: /run/secrets/a.MAP_KEY",
        "file: /etc/hostname",
        "cpuset: 0,1",
        "mem_limit: 67108864",
        "memswap_limit: 67108864",
        "pids_limit: 50",
        "user: '1000:50'",
        "/dev/null:/dev/null:rw",
        "target: /data",
        "rtprio: 60",
        "memlock: -1",
        "stop_grace_period: 1",
        "max-size: '1048576'",
        "max-file: '2'",
        "restart: \"no\"",
        "image: registry.lan/viewer:1.2",
        "- -x",
        "127.0.0.1:9464:9464/tcp",
        "- --status-socket",
    ] {
        assert!(
            config.contains(words),
            "{words} is missing in {config}\n{text}"
        );
    }
    // The key is asked for, and never made up.
    let mut command = bounded("docker-compose");
    command
        .arg("--file")
        .arg(&file)
        .arg("config")
        .env("MAP_KEY_FILE", "/etc/hostname");
    let refused = command.env_remove("ICTUS_FEDERATION_ID").output().unwrap();
    let words = said(&refused);
    assert!(
        !refused.status.success() && words.contains("the key of the federation"),
        "{words}"
    );
}

#[test]
fn several_hosts_are_not_for_compose() {
    let sandbox = Sandbox::new();
    let package = root().join("compose/diamond");
    let head = "ictus: v1\nfederation: spread\nhosts: { h1: { ssh: 10.0.0.1 }, h2: { ssh: 10.0.0.2 } }\n\
        security: trusted-network\nrti: { host: h1 }\ntimeout: 1 s\n";
    let federate = "{ class: A, parameters: { period: 100 ms, work: 1 ms }";
    let text = format!(
        "{head}programs: {{ diamond: {{ package: {} }} }}\nfederates:\n  a: {federate}, host: h1 }}\n  b: {federate}, host: h2 }}\n",
        package.display()
    );
    let file = sandbox.manifest("spread.yaml", &text);
    let said = sandbox.fails(&["compose", &file], 1);
    assert!(
        said.contains("a compose file is for one host") && said.contains("h1, h2"),
        "{said}"
    );
    let file = sandbox.manifest("spread.yaml", &format!("{text}deploy: compose\n"));
    let said = sandbox.fails(&["up", &file], 3);
    assert!(said.contains("F045"), "{said}");
}

#[test]
fn prometheus_takes_its_configuration() {
    let fix = "there is no promtool (Debian: prometheus)";
    if !has(bounded("promtool").arg("--version"), fix) {
        return;
    }
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("prometheus.yml");
    fs::write(&file, PROMETHEUS_CONFIG).unwrap();
    ok(bounded("promtool").args(["check", "config"]).arg(&file));
}

/// A federation of this work tree alone, gone with the value.
struct Project {
    name: String,
    sandbox: Sandbox,
}

impl Project {
    /// An example under a name of its own, with these keys besides.
    fn of(example: &str, what: &str, keys: &str) -> (Self, String) {
        let digest = Sha256::digest(root().as_os_str().as_encoded_bytes());
        let digits = digest[..4].iter().map(|byte| format!("{byte:02x}"));
        let name = format!("{what}-{}", digits.collect::<String>());
        let directory = root().join("compose").join(example);
        let text = fs::read_to_string(directory.join("federation.yaml")).unwrap();
        let text = text
            .replace(
                &format!("federation: {example}\n"),
                &format!("federation: {name}\n{keys}"),
            )
            .replace("package: .", &format!("package: {}", directory.display()));
        let sandbox = Sandbox::new();
        let project = Self { name, sandbox };
        project.remove();
        let manifest = project.sandbox.manifest("federation.yaml", &text);
        (project, manifest)
    }

    /// What the engine has of it, by kind.
    fn left(&self) -> Vec<String> {
        let label = format!("label=com.docker.compose.project=ictus-{}", self.name);
        let image = format!("label=ictus.compose={}", self.name);
        let list = |arguments: &[&str]| ok(bounded("docker").args(arguments));
        let mut left = vec![list(&["ps", "-aq", "--filter", &label])];
        left.push(list(&["network", "ls", "-q", "--filter", &label]));
        left.push(list(&["volume", "ls", "-q", "--filter", &label]));
        left.push(list(&["images", "-q", "--filter", &image]));
        left.retain(|found| !found.is_empty());
        left
    }

    /// Whatever a failed test left behind.
    fn remove(&self) {
        let label = format!("label=com.docker.compose.project=ictus-{}", self.name);
        let image = format!("label=ictus.compose={}", self.name);
        for (list, remove) in [
            (
                vec!["ps", "-aq", "--filter", &label],
                vec!["rm", "-f", "-v"],
            ),
            (
                vec!["network", "ls", "-q", "--filter", &label],
                vec!["network", "rm"],
            ),
            (
                vec!["volume", "ls", "-q", "--filter", &label],
                vec!["volume", "rm"],
            ),
            (vec!["images", "-q", "--filter", &image], vec!["rmi", "-f"]),
        ] {
            let Ok(found) = bounded("docker").args(list).output() else {
                return;
            };
            let found = String::from_utf8_lossy(&found.stdout).into_owned();
            if !found.trim().is_empty() {
                drop(
                    bounded("docker")
                        .args(remove)
                        .args(found.split_whitespace())
                        .output(),
                );
            }
        }
    }

    /// The trace of one process from the same plan.
    fn in_one_process(&self, arguments: &[&str], program: &str) -> TraceSet {
        let answer = self.sandbox.json(&[&["plan"], arguments].concat());
        let plan = self.sandbox.state().join("plan.json");
        fs::write(&plan, answer["plan"].to_string()).unwrap();
        let directory = self.sandbox.state().join("one");
        fs::create_dir(&directory).unwrap();
        let program: PathBuf = ictus().with_file_name(program);
        ok(bounded(program.to_str().unwrap())
            .arg("--plan")
            .arg(&plan)
            .arg("--trace")
            .arg(&directory));
        TraceSet::read(&directory).unwrap()
    }
}

impl Drop for Project {
    fn drop(&mut self) {
        self.remove();
    }
}

/// A directory into which federates of any user write.
fn shared(path: &Path) {
    fs::create_dir(path).unwrap();
    fs::set_permissions(path, fs::Permissions::from_mode(0o1777)).unwrap();
}

/// The page of a collector's container.
fn collected(container: &str) -> String {
    let format = "{{range .NetworkSettings.Networks}}{{.IPAddress}}{{end}}";
    let address = ok(bounded("docker").args(["inspect", "--format", format, container]));
    let mut stream = TcpStream::connect((address.trim(), 9464)).unwrap();
    stream
        .set_read_timeout(Some(Duration::from_secs(10)))
        .unwrap();
    stream.write_all(b"GET /metrics HTTP/1.0\r\n\r\n").unwrap();
    let mut page = String::new();
    stream.read_to_string(&mut page).unwrap();
    page
}

#[test]
fn the_diamond_runs_under_docker_compose_as_in_one_process() {
    if !has_compose() || !has_engine() {
        return;
    }
    let (project, manifest) = Project::of("diamond", "diamond", "");
    let sandbox = &project.sandbox;
    let trace = sandbox.state().join("trace");
    shared(&trace);
    // Containers run as another user, who must get there.
    fs::set_permissions(sandbox.state(), fs::Permissions::from_mode(0o755)).unwrap();
    let file = sandbox.state().join("compose.yaml");
    // As a user does it: the file is what the command prints.
    let run = ["--set", "run=3 s"];
    let options = ["--build", "--monitoring", "--trace", "./trace"];
    let printed = sandbox.ok(&[&["compose", &manifest], &run[..], &options].concat());
    fs::write(&file, printed).unwrap();
    let compose = |arguments: &[&str]| {
        let mut command = bounded("docker-compose");
        command.args([
            "--project-name",
            &format!("ictus-{}", project.name),
            "--file",
        ]);
        command.arg(&file).args(arguments);
        command
    };
    // Prometheus and Grafana cannot be pulled here.
    ok(&mut compose(&[
        "up",
        "--detach",
        "collector",
        "a",
        "b",
        "c",
        "d",
    ]));
    let ids = ok(&mut compose(&["ps", "-q", "rti", "a", "b", "c", "d"]));
    let ids: Vec<_> = ids.split_whitespace().collect();
    assert_eq!(ids.len(), 5);
    let codes = ok(bounded("docker").arg("wait").args(&ids));
    let logs = ok(&mut compose(&["logs", "--no-color"]));
    assert_eq!(codes, "0\n".repeat(5), "{logs}");
    assert!(logs.contains("ictus rti: listening"), "{logs}");
    // The collector still knows what they measured.
    let page = collected(ok(&mut compose(&["ps", "-q", "collector"])).trim());
    let tags = |name: &str| {
        page.contains(&format!("federate=\"{name}\"")) && page.contains("tags_completed_total")
    };
    assert!(["a", "b", "c", "d"].iter().all(|name| tags(name)), "{page}");
    assert!(page.contains("reason=\"completed\""), "{page}");
    let many = TraceSet::read(&trace).unwrap();
    let one = project.in_one_process(&[&[manifest.as_str()], &run[..]].concat(), "diamond");
    let verdict = compare(&one, &many);
    assert!(matches!(verdict, Verdict::Equal { .. }), "{verdict:?}");
    assert!(many.records_per_federate().values().all(|count| *count > 0));
    ok(&mut compose(&["down", "--volumes"]));
    ok(bounded("docker").args([
        "image",
        "prune",
        "--all",
        "--force",
        "--filter",
        &format!("label=ictus.compose={}", project.name),
    ]));
    assert_eq!(project.left(), Vec::<String>::new());
}

/// The same by `up`, `ps`, `logs` and `down` on a manifest that says so.
#[test]
fn a_manifest_for_compose_is_started_shown_and_taken_down() {
    if !has_compose() || !has_engine() {
        return;
    }
    let (project, manifest) = Project::of("diamond", "stack", "deploy: compose\n");
    let (sandbox, name) = (&project.sandbox, project.name.as_str());
    let started = sandbox.ok(&["up", &manifest, "--set", "run=1 h"]);
    assert!(started.contains("was started: 4 federates"), "{started}");
    let again = sandbox.ok(&["up", &manifest, "--set", "run=1 h"]);
    assert!(again.contains("was started"), "{again}");
    for given in [name, &manifest] {
        let shown = sandbox.ok(&["ps", given]);
        assert!(shown.contains("rti") && shown.contains(name), "{shown}");
    }
    let logs = sandbox.ok(&["logs", name, "rti"]);
    assert!(logs.contains("listening on port 15045"), "{logs}");
    let views = sandbox.json(&["ps"]);
    assert_eq!(views[0]["name"], name, "{views}");
    assert_eq!(views[0]["state"], "compose", "{views}");
    let refused = sandbox.fails(&["ps", name, "-o", "json"], 1);
    assert!(refused.contains("shows it as text"), "{refused}");
    let refused = sandbox.fails(&["ps", name, "--watch"], 1);
    assert!(refused.contains("docker-compose"), "{refused}");
    let refused = sandbox.fails(&["stop", name], 1);
    assert!(refused.contains("docker-compose runs"), "{refused}");
    // Its images stay until it is purged, by whatever it is called.
    sandbox.ok(&["down", name]);
    assert_eq!(sandbox.json(&["ps"]), serde_json::json!([]));
    assert_eq!(project.left().len(), 1);
    sandbox.ok(&["down", &manifest]);
    sandbox.ok(&["down", name, "--purge"]);
    assert_eq!(project.left(), Vec::<String>::new());
    let kept = fs::read_dir(sandbox.state().join("compose")).unwrap();
    assert_eq!(kept.count(), 0);
}
