//! Secrets from the operator to a federate and nowhere else; and what a host cannot give.

#![expect(
    clippy::unwrap_used,
    clippy::panic,
    reason = "a test stops at the first surprise"
)]

use std::fs;

use ictus_tests::rig::{Host, Rig};
use ictus_tests::{root, said};
use serde_json::Value;

use super::Scenario;
use super::operator::{Operator, hosts};

/// In this order.
pub(crate) const SCENARIOS: &[Scenario] = &[
    (
        "a_secret_is_found_in_its_file_and_nowhere_else",
        a_secret_is_found_in_its_file_and_nowhere_else,
    ),
    (
        "a_missing_secret_is_named_before_anything_runs",
        a_missing_secret_is_named_before_anything_runs,
    ),
    (
        "a_host_that_lost_its_secrets_waits_for_up",
        a_host_that_lost_its_secrets_waits_for_up,
    ),
    (
        "what_a_host_cannot_give_is_said_in_the_plan",
        what_a_host_cannot_give_is_said_in_the_plan,
    ),
];

/// Values that stand nowhere else, of the same length.
pub(crate) const CANARY: &str = "zzq-canary-7f3ad1c96e08";
const OTHER: &str = "zzq-second-0b52e8d4f71c";

/// `keeper` on the second host has a secret, `counter` on the first hears from it.
pub(crate) fn manifest(operator: &Operator<'_>, engine: &str, secret: &str) -> String {
    let text = format!(
        "ictus: v1\nfederation: kept\n{}programs:\n  canary: {{ package: {} }}\nfederates:\n  \
         keeper: {{ host: h2, class: Keeper, parameters: {{ bytes: {} }}, secrets: [{secret}] }}\n  \
         counter: {{ host: h1, class: Counter }}\nconnections:\n  \
         - {{ from: keeper.out, to: counter.input }}\n",
        hosts(operator.rig, &format!(", engine: {engine}")),
        root().join("tests/canary").display(),
        CANARY.len(),
    );
    operator.manifest("kept.yaml", &text)
}

pub(crate) const FROM_FILE: &str = "{ name: TOKEN, file: token }";

/// Where values are on a host: files (those of the engine's images and logs among them), arguments and environments of
/// all processes, what the engine tells of containers, and images. The values are in no argument and no file of the search.
fn found(host: &Host, values: &[&str]) -> Vec<String> {
    let value = values.join("\n");
    let script = format!(
        "grep -rsF -D skip -l -f /dev/fd/3 /home /root /tmp /var /etc /opt /srv /mnt /run /dev/shm /small 3<<'END' | sed 's/^/file /'\n\
         {value}\nEND\n\
         cat /proc/[0-9]*/environ /proc/[0-9]*/cmdline 2>/dev/null | grep -aqF -f /dev/fd/3 3<<'END' && echo process\n\
         {value}\nEND\n\
         docker ps --all --quiet | xargs --no-run-if-empty docker inspect | grep -qF -f /dev/fd/3 3<<'END' && echo inspect\n\
         {value}\nEND\n\
         docker images --quiet | xargs --no-run-if-empty docker save | grep -aqF -f /dev/fd/3 3<<'END' && echo image\n\
         {value}\nEND\n\
         true\n"
    );
    let found = host.script(&script, &[]);
    found.lines().map(str::to_owned).collect()
}

/// Nobody has the value but, on the second host, a private file in memory.
fn only_in_its_file(operator: &Operator<'_>, value: &str) {
    let [first, second, _] = operator.rig.hosts() else {
        panic!("three hosts")
    };
    assert_eq!(found(first, &[value]), Vec::<String>::new());
    let on_second = found(second, &[value]);
    let [line] = on_second.as_slice() else {
        panic!("{on_second:?}")
    };
    let path = line.strip_prefix("file ").unwrap();
    assert!(
        path.starts_with("/dev/shm/ictus-1000-") && path.ends_with("/kept/keeper/TOKEN"),
        "{path}"
    );
    let stat = second.exec(&["stat", "--format", "%a %U", path]);
    assert_eq!(stat.trim(), "400 robot");
    let kind = second.exec(&["stat", "--file-system", "--format", "%T", path]);
    assert_eq!(kind.trim(), "tmpfs");
    // The search does find what is there.
    assert!(operator.home.path().join("token").exists());
    let home = operator.home.path();
    let mine = std::process::Command::new("grep")
        .args(["-rlF", "-D", "skip", value])
        .arg(home)
        .output()
        .unwrap();
    let mine = String::from_utf8(mine.stdout).unwrap();
    assert_eq!(mine.trim(), home.join("token").to_str().unwrap());
}

fn a_secret_is_found_in_its_file_and_nowhere_else(rig: &Rig) {
    let operator = Operator::with_hosts(rig);
    let token = operator.home.path().join("token");
    for engine in ["process", "docker"] {
        fs::write(&token, CANARY).unwrap();
        let file = manifest(&operator, engine, FROM_FILE);
        operator.ok(&["up", &file]);
        only_in_its_file(&operator, CANARY);
        let cores = "for it in /proc/[0-9]*; do grep -qsz ^TOKEN_FILE= $it/environ && grep 'Max core' $it/limits; done; true";
        let cores = rig.hosts()[1].script(cores, &[]);
        assert!(!cores.is_empty());
        for line in cores.lines() {
            let words: Vec<_> = line.split_ascii_whitespace().collect();
            // Less than any core has, and a pipe gets none either.
            assert_eq!(words[4..6], ["1", "1"], "{cores}");
        }
        let again = operator.ok(&["up", &file]);
        assert!(again.contains("already running"), "{again}");
        fs::write(&token, OTHER).unwrap();
        let planned = operator.fails(&["plan", &file], 2);
        let cause = "secret TOKEN changed: federate `keeper`";
        assert!(planned.contains(cause), "{planned}");
        operator.ok(&["up", &file]);
        only_in_its_file(&operator, OTHER);
        operator.ok(&["down", &file]);
        // Logs and records are still there, and have neither.
        for host in rig.hosts() {
            let left = found(host, &[CANARY, OTHER]);
            assert_eq!(left, Vec::<String>::new(), "{}", host.name);
            assert_eq!(host.exec(&["find", "/dev/shm", "-mindepth", "1"]), "");
        }
        operator.ok(&["down", &file, "--purge"]);
    }
    operator.leave();
}

fn a_missing_secret_is_named_before_anything_runs(rig: &Rig) {
    let operator = Operator::with_hosts(rig);
    let file = manifest(&operator, "process", "NO_SUCH_TOKEN");
    let said = operator.fails(&["up", &file], 1);
    let words = "secret `NO_SUCH_TOKEN` of federate `keeper` has no value: the environment variable NO_SUCH_TOKEN is not set";
    assert!(said.contains(words), "{said}");
    let said = operator.fails(&["plan", &file], 2);
    assert!(
        said.contains(words) && said.contains("not compared"),
        "{said}"
    );
    let file = manifest(&operator, "process", FROM_FILE);
    let said = operator.fails(&["up", &file], 1);
    let place = operator.home.path().join("token");
    let words = format!("{} cannot be read: No such file", place.display());
    assert!(said.contains(&words), "{said}");
    for host in rig.hosts() {
        let federations = "ls /home/robot/.local/state/ictus/federations 2>&1 || true";
        let left = host.script(federations, &[]);
        assert!(left.contains("No such file"), "{left}");
    }
    operator.leave();
}

fn a_host_that_lost_its_secrets_waits_for_up(rig: &Rig) {
    let operator = Operator::with_hosts(rig);
    fs::write(operator.home.path().join("token"), CANARY).unwrap();
    let file = manifest(&operator, "process", FROM_FILE);
    operator.ok(&["up", &file]);
    let second = &rig.hosts()[1];
    // As when its power fails: what runs and what is in memory is gone.
    second.script(
        "pkill -KILL -f '[i]ctusd daemon'; pkill -KILL -u robot -f '[s]upervise'\n\
         while pgrep -u robot -f '[-]-federate' > /dev/null; do :; done\n\
         rm -rf /dev/shm/ictus-*\n",
        &[],
    );
    let parts = operator.parts(&file);
    let states: Vec<_> = parts.iter().map(|part| &part["state"]).collect();
    assert!(
        states.contains(&&Value::from("waiting_for_secrets")),
        "{states:?}"
    );
    let listed = operator.run(&["ps", &file]);
    assert!(
        said(&listed).contains("waiting for secrets"),
        "{}",
        said(&listed)
    );
    let planned = operator.fails(&["plan", &file], 2);
    assert!(planned.contains("it waits for secrets"), "{planned}");
    let running = second.output(&["pgrep", "-f", "[-]-federate"]);
    assert_eq!(running.status.code(), Some(1), "{}", said(&running));
    operator.ok(&["up", &file]);
    only_in_its_file(&operator, CANARY);
    operator.ok(&["down", &file, "--purge"]);
    operator.leave();
}

/// Test hosts give no realtime scheduling: their users have no limit for it, and their containers no budget.
fn what_a_host_cannot_give_is_said_in_the_plan(rig: &Rig) {
    let operator = Operator::with_hosts(rig);
    let refused = |engine: &str, needs: &str, words: &[&str]| {
        let text = format!(
            "ictus: v1\nfederation: needy\n{}programs:\n  canary: {{ package: {} }}\nfederates:\n  \
             faulty: {{ host: h2, class: Faulty, {needs} }}\n",
            hosts(rig, &format!(", engine: {engine}")),
            root().join("tests/canary").display(),
        );
        let file = operator.manifest("needy.yaml", &text);
        for command in ["plan", "up"] {
            let said = operator.fails(&[command, &file], 1);
            for words in words {
                assert!(said.contains(words), "{words} is missing in {said}");
            }
        }
    };
    let realtime = "realtime: { policy: fifo, priority: 60 }";
    let who = "host `h2` cannot give federate `faulty`";
    let limit = "realtime priority 60: ";
    refused("process", realtime, &[who, limit, "; "]);
    let checked = operator.ok(&["host", "check", &super::operator::target(&rig.hosts()[1])]);
    assert!(checked.contains("realtime scheduling: no: "), "{checked}");
    assert!(
        checked.contains("secrets: in /dev/shm/ictus-1000-"),
        "{checked}"
    );
    let budgets = rig.hosts()[1].output(&["ls", "/sys/fs/cgroup/cpu/cpu.rt_runtime_us"]);
    if budgets.status.success() {
        refused(
            "docker",
            realtime,
            &[who, limit, "budgets", "engine: process"],
        );
    }
    refused(
        "process",
        "cpus: [0, 4000]",
        &[who, "processor 4000: it has 0"],
    );
    refused("docker", "cpus: [4000]", &[who, "processor 4000: it has 0"]);
    refused(
        "process",
        "user: root",
        &[who, "user `root`: its daemon runs as user 1000"],
    );
    for host in rig.hosts() {
        let running = host.output(&["pgrep", "-f", "[-]-federate"]);
        assert_eq!(running.status.code(), Some(1), "{}", said(&running));
    }
    operator.leave();
}
