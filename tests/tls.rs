//! Federations under TLS, on this machine: the real RTI and real federates, with certificates made as `ictus up` makes them.

#![expect(
    clippy::unwrap_used,
    clippy::panic,
    reason = "a test stops at the first surprise"
)]

use ictus_deploy::trace::{TraceSet, Verdict, compare};
use ictus_stream::{Authority, Member};
use ictus_tests::{Sandbox, ictus, root, said};
use std::fs;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

/// Nothing may take longer, in seconds.
const BOUND_S: &str = "120";

/// The diamond with certificates, and its RTI.
struct World {
    sandbox: Sandbox,
    names: Vec<String>,
    program: PathBuf,
    rti: Child,
    port: u16,
}

impl World {
    fn new(head: &str) -> Self {
        let sandbox = Sandbox::new();
        let path = root().join("compose/diamond");
        let text = fs::read_to_string(path.join("federation.yaml")).unwrap();
        let text = text.replace("package: .", &format!("package: {}", path.display()));
        let text = text.replacen("ictus: v1\n", &format!("ictus: v1\n{head}"), 1);
        let manifest = sandbox.manifest("diamond.yaml", &text);
        // Builds the program, too.
        let planned = sandbox.json(&["plan", &manifest, "--set", "run=1 s"]);
        let plan = &planned["plan"];
        fs::write(sandbox.state().join("plan.json"), plan.to_string()).unwrap();
        let federates = plan["federates"].as_array().unwrap().iter();
        let names: Vec<_> = federates
            .map(|federate| federate["name"].as_str().unwrap().to_owned())
            .collect();
        let program = planned["executables"]["a"].as_str().unwrap();
        certify(&sandbox.state().join("tls"), &names);
        let mut rti = bounded(&ictus());
        rti.args(["rti", "-i", "x", "-n", &names.len().to_string(), "-p", "0"])
            .args(["--status-fd", "1", "--tls"])
            .arg(sandbox.state().join("tls/rti"))
            .stdout(Stdio::piped());
        let mut rti = rti.spawn().unwrap();
        let mut line = String::new();
        let mut status = BufReader::new(rti.stdout.take().unwrap());
        status.read_line(&mut line).unwrap();
        // Nobody reads on; the RTI does not wait for that.
        std::mem::forget(status);
        let said: serde_json::Value = serde_json::from_str(&line).unwrap();
        let port = said["port"].as_u64().unwrap_or_else(|| panic!("{line}"));
        Self {
            sandbox,
            names,
            program: program.into(),
            rti,
            port: u16::try_from(port).unwrap(),
        }
    }

    /// A federate with these certificates.
    fn federate(&self, name: &str, tls: &str) -> Command {
        let state = self.sandbox.state();
        let mut federate = self.program();
        federate
            .args(["--federate", name, "-i", "x", "--rti"])
            .arg(format!("127.0.0.1:{}", self.port))
            .arg("--tls")
            .arg(state.join(tls))
            .arg("--trace")
            .arg(self.directory("many"));
        federate
    }

    fn program(&self) -> Command {
        let mut program = bounded(&self.program);
        program
            .arg("--plan")
            .arg(self.sandbox.state().join("plan.json"));
        program
    }

    fn directory(&self, name: &str) -> PathBuf {
        let path = self.sandbox.state().join(name);
        fs::create_dir_all(&path).unwrap();
        path
    }

    /// All join, and end as one process does.
    fn runs(mut self) {
        let start = |name: &String| {
            let mut federate = self.federate(name, &format!("tls/{name}"));
            (federate.stderr(Stdio::piped())).spawn().unwrap()
        };
        let federates: Vec<Child> = self.names.iter().map(start).collect();
        for federate in federates {
            succeeds(&federate.wait_with_output().unwrap());
        }
        assert!(self.rti.wait().unwrap().success());
        let (one, many) = (self.directory("one"), self.directory("many"));
        succeeds(&self.program().arg("--trace").arg(&one).output().unwrap());
        let traces = [one, many].map(|path| TraceSet::read(&path).unwrap());
        let verdict = compare(&traces[0], &traces[1]);
        assert!(matches!(verdict, Verdict::Equal { .. }), "{verdict:?}");
        let records = traces[1].records_per_federate();
        assert_eq!(records.len(), self.names.len(), "{records:?}");
    }
}

fn bounded(program: &Path) -> Command {
    let mut command = Command::new("timeout");
    command.args(["--kill-after=5", BOUND_S]).arg(program);
    command.stdin(Stdio::null());
    command
}

fn succeeds(output: &Output) {
    assert!(output.status.success(), "{}", said(output));
}

/// Certificates of a run of their own for the RTI and these federates.
fn certify(directory: &Path, names: &[String]) {
    let authority = Authority::new("run").unwrap();
    let give = |name: &str, member| {
        let papers = authority.certify(member).unwrap();
        papers.write(&directory.join(name)).unwrap();
    };
    give("rti", Member::Rti);
    for (id, name) in (0..).zip(names) {
        give(name, Member::Federate(id));
    }
}

#[test]
fn a_centralized_federation_under_tls_is_like_one_process() {
    World::new("").runs();
}

#[test]
fn a_decentralized_federation_under_tls_is_like_one_process() {
    World::new("coordination: decentralized\ndefaults: { stp_offset: 2 s }\n").runs();
}

#[test]
fn a_federate_with_other_certificates_says_why_it_does_not_join() {
    let world = World::new("");
    certify(&world.sandbox.state().join("other"), &world.names);
    let table = [
        ("other/a", "its certificate is not of this run"),
        (
            "tls/b",
            "the certificate is federate 1's, and this is federate 0",
        ),
        ("nowhere", "authority.pem"),
    ];
    for (tls, words) in table {
        let output = world.federate("a", tls).output().unwrap();
        let said = said(&output);
        assert_eq!(output.status.code(), Some(12), "{tls}: {said}");
        assert!(said.contains(words), "{tls}: {said}");
    }
    // None of them stands in the way of those who belong here.
    world.runs();
}
