//! Who deploys in a scenario, and the manifests that it writes.

#![expect(
    clippy::unwrap_used,
    clippy::panic,
    reason = "a test stops at the first surprise"
)]

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::PathBuf;
use std::process::{Command, Output, Stdio};
use std::time::Instant;

use ictus_tests::rig::{Host, Rig};
use ictus_tests::{ictus, root, said};
use serde_json::Value;
use tempfile::TempDir;

/// How long any command may take, in seconds; `timeout` of coreutils sees to it.
pub(crate) const BOUND_S: &str = "200";

/// Who deploys: a home directory of its own, with the rig's key.
pub(crate) struct Operator<'r> {
    pub(crate) rig: &'r Rig,
    pub(crate) home: TempDir,
}

impl<'r> Operator<'r> {
    /// One who knows no host yet.
    pub(crate) fn new(rig: &'r Rig) -> Self {
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
    pub(crate) fn with_hosts(rig: &'r Rig) -> Self {
        let operator = Self::new(rig);
        operator.add(rig.hosts());
        operator
    }

    /// Gets these hosts ready.
    pub(crate) fn add(&self, hosts: &[Host]) {
        at_once(hosts, |host| {
            let said = self.ok(&["host", "add", &target(host), "--accept-new"]);
            assert!(said.contains("ictusd"), "{said}");
        });
    }

    /// `ictus ARGS`, bounded in time.
    pub(crate) fn command(&self, args: &[&str]) -> Command {
        let mut command = Command::new("timeout");
        command
            .args(["--kill-after=5", BOUND_S])
            .arg(ictus())
            .args(args)
            .current_dir(root())
            .env("HOME", self.home.path())
            .env("ICTUS_STATE_DIR", self.home.path().join("state"))
            .env("ICTUS_DAEMON_IDLE_MS", "1000")
            .env_remove("XDG_RUNTIME_DIR")
            .env_remove("SSH_AUTH_SOCK")
            .stdin(Stdio::null());
        command
    }

    pub(crate) fn run(&self, args: &[&str]) -> Output {
        self.command(args).output().unwrap()
    }

    /// Expects success; gives both streams.
    pub(crate) fn ok(&self, args: &[&str]) -> String {
        let output = self.run(args);
        assert!(output.status.success(), "ictus {args:?}: {}", said(&output));
        said(&output)
    }

    /// Expects this exit code; gives both streams.
    pub(crate) fn fails(&self, args: &[&str], code: i32) -> String {
        let output = self.run(args);
        let text = said(&output);
        assert_eq!(output.status.code(), Some(code), "ictus {args:?}: {text}");
        text
    }

    /// The parts of a federation, by host.
    pub(crate) fn parts(&self, manifest: &str) -> Vec<Value> {
        let output = self.run(&["ps", manifest, "-o", "json"]);
        serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{}", said(&output)))
    }

    pub(crate) fn manifest(&self, name: &str, text: &str) -> String {
        let path = self.home.path().join(name);
        fs::write(&path, text).unwrap();
        path.to_str().unwrap().to_owned()
    }

    /// Removes everything from every host, so that the leak checker finds nothing.
    pub(crate) fn leave(self) {
        let rig = self.rig;
        self.remove(rig.hosts());
    }

    /// The same for these hosts.
    pub(crate) fn remove(self, hosts: &[Host]) {
        at_once(hosts, |host| drop(self.ok(&["host", "rm", &target(host)])));
    }
}

fn at_once(hosts: &[Host], each: impl Fn(&Host) + Sync) {
    std::thread::scope(|scope| {
        for host in hosts {
            scope.spawn(|| each(host));
        }
    });
}

pub(crate) fn target(host: &Host) -> String {
    format!("robot@{}", host.address)
}

/// The `hosts:` of a manifest: the rig's, with these keys besides.
pub(crate) fn hosts(rig: &Rig, more: &str) -> String {
    let line = |host: &Host| format!("  {}: {{ ssh: \"{}\"{more} }}\n", host.name, target(host));
    let lines: String = rig.hosts().iter().map(line).collect();
    format!(
        "hosts:\n{lines}security: trusted-network\nrti: {{ host: {} }}\n",
        rig.hosts()[0].name
    )
}

/// A manifest of compose/ with `hosts`, its federates dealt out to them in turn.
pub(crate) fn spread(rig: &Rig, example: &str, head: &str) -> String {
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

/// The static program of an example.
pub(crate) fn program(name: &str) -> PathBuf {
    ictus().with_file_name(name)
}

/// Runs to the end of its time-out, and has `ictus verify` compare what the hosts wrote with one process.
pub(crate) fn verify(operator: &Operator<'_>, manifest: &str, name: &str, example: &str) {
    operator.ok(&["logs", "--follow", manifest]);
    for part in operator.parts(manifest) {
        assert_eq!(part["outcome"]["outcome"], "completed", "{part}");
    }
    let output = operator.run(&["verify", manifest, "--last", "-o", "json"]);
    assert!(output.status.success(), "{example}: {}", said(&output));
    let answer: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(answer["federation"], name, "{answer}");
    assert_eq!(
        (&answer["equal"], &answer["of"]),
        (&1.into(), &1.into()),
        "{answer}"
    );
    let records = answer["records_per_federate"].as_object().unwrap();
    assert!(
        records.values().all(|count| count.as_u64() > Some(0)),
        "{answer}"
    );
}

/// The figures of a start.
#[expect(clippy::print_stdout, reason = "a test's report")]
pub(crate) fn tell(what: &str, up: &str) {
    for line in up
        .lines()
        .filter(|line| line.starts_with("sent ") || line.starts_with("healthy "))
    {
        println!("  {what}: {line}");
    }
}

/// The figures of a command: what `tell` prints, and how long it took from outside.
#[expect(clippy::print_stdout, reason = "a test's report")]
pub(crate) fn timed(operator: &Operator<'_>, what: &str, args: &[&str]) -> String {
    let began = Instant::now();
    let said = operator.ok(args);
    println!("  {what}: {:.2} s in all", began.elapsed().as_secs_f64());
    tell(what, &said);
    said
}
