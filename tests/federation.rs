//! Whole federations as a user runs them: real RTI, real federates, real daemon.

#![expect(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use ictus_tests::{Sandbox, kill, root};
use serde_json::Value;
use std::io::{Read, Write};
use std::net::TcpStream;

/// Two runs of each mode, with offsets that hold when the host stands still for a second: violations would be no fault of ours.
const PATIENT: [&str; 4] = ["--runs", "2", "--stp-offset", "2 s"];

const DIAMOND: &str = "compose/diamond/federation.yaml";

fn ending<'a>(view: &'a Value, member: &str) -> &'a str {
    let federates = view["federates"].as_array().unwrap().iter();
    let mut members = std::iter::once(&view["rti"]).chain(federates);
    let found = members.find(|m| m["name"] == member).unwrap();
    found["ending"].as_str().unwrap_or("")
}

#[test]
fn up_says_each_stage_and_down_purge_leaves_nothing() {
    let sandbox = Sandbox::new();
    let output = sandbox.run(&["up", DIAMOND]);
    assert!(output.status.success(), "{}", ictus_tests::said(&output));
    let said = String::from_utf8_lossy(&output.stderr);
    let stages = [
        "checked", "built", "started", "joined", "start", "running", "healthy",
    ];
    let mut from = 0;
    for stage in stages {
        let at = said[from..].find(stage);
        from += at.unwrap_or_else(|| panic!("{stage} is missing, or out of order, in:\n{said}"));
    }
    let view = sandbox.view("diamond");
    assert_eq!(view["state"], "running");
    assert_eq!(view["federates"].as_array().unwrap().len(), 4);
    let again = sandbox.run(&["up", DIAMOND]);
    assert!(
        again.status.success(),
        "the same plan runs already: {}",
        ictus_tests::said(&again)
    );
    sandbox.ok(&["down", "diamond", "--purge"]);
    assert!(sandbox.view_names().is_empty());
    let left = sandbox.state().join("federations");
    assert!(
        !left.exists() || left.read_dir().unwrap().next().is_none(),
        "files are left"
    );
    sandbox.daemon_ends();
}

#[test]
fn down_without_purge_leaves_the_last_logs_and_names_them() {
    let sandbox = Sandbox::new();
    sandbox.ok(&["up", DIAMOND]);
    let output = sandbox.run(&["down", DIAMOND]);
    assert!(output.status.success());
    let said = ictus_tests::said(&output);
    assert!(said.contains("logs"), "{said}");
    assert!(
        sandbox.ok(&["logs", "diamond"]).contains("ticks in order"),
        "logs outlive the run"
    );
}

/// A federate with a secret, and with these keys besides.
fn keeper(sandbox: &Sandbox, more: &str) -> String {
    let token = sandbox.state().join("token");
    std::fs::write(&token, "0123456789").unwrap();
    let text = format!(
        "ictus: v1\nfederation: kept\nprograms:\n  canary: {{ package: {} }}\nfederates:\n  keeper:\n    \
         class: Keeper\n    parameters: {{ bytes: 10 }}\n    {more}secrets: [{{ name: TOKEN, file: token }}]\n",
        root().join("tests/canary").display()
    );
    sandbox.manifest("kept.yaml", &text)
}

#[test]
fn a_realtime_federate_keeps_its_memory() {
    let sandbox = Sandbox::new();
    let realtime = "realtime: { policy: fifo, priority: 5, lock_memory: true }\n    ";
    let manifest = keeper(&sandbox, realtime);
    let output = sandbox.run(&["up", &manifest]);
    let said = ictus_tests::said(&output);
    if !output.status.success() {
        let refused = "this host cannot give federate `keeper`";
        assert!(said.contains(refused), "{said}");
        eprintln!("skipped: {said}");
        return;
    }
    let pid = sandbox.pid("kept", "keeper");
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
    let locked = status.lines().find(|line| line.starts_with("VmLck:"));
    let locked = locked.unwrap().split_ascii_whitespace().nth(1).unwrap();
    assert!(locked.parse::<u64>().unwrap() > 1000, "{status}");
    sandbox.ok(&["down", "kept", "--purge"]);
}

#[test]
fn a_federate_has_its_secret_and_another_value_is_told() {
    let sandbox = Sandbox::new();
    let manifest = keeper(&sandbox, "");
    sandbox.ok(&["up", &manifest]);
    std::fs::write(sandbox.state().join("token"), "9876543210").unwrap();
    let said = sandbox.fails(&["up", &manifest], 1);
    let changed = "with another value of secret `TOKEN` of federate `keeper`";
    assert!(
        said.contains(changed) && said.contains("ictus down kept"),
        "{said}"
    );
    sandbox.ok(&["down", "kept", "--purge"]);
}

#[test]
fn verify_finds_the_diamond_equal() {
    let answer =
        Sandbox::new().json(&[&["verify", DIAMOND, "--set", "run=2 s"][..], &PATIENT].concat());
    // Two centralized and two decentralized runs, each like the one process.
    assert_eq!(
        (&answer["equal"], &answer["of"]),
        (&4.into(), &4.into()),
        "{answer}"
    );
    assert_eq!(answer["records_per_federate"]["a"], 21, "{answer}");
}

#[test]
fn verify_finds_autoware_equal() {
    let manifest = "compose/autoware/federation.yaml";
    let answer =
        Sandbox::new().json(&[&["verify", manifest, "--set", "run=3 s"][..], &PATIENT].concat());
    // Two centralized and two decentralized runs, each like the one process.
    assert_eq!(
        (&answer["equal"], &answer["of"]),
        (&4.into(), &4.into()),
        "{answer}"
    );
    assert_eq!(
        answer["records_per_federate"].as_object().unwrap().len(),
        24
    );
}

#[test]
fn verify_finds_the_canary_different() {
    let said = Sandbox::new().fails(&["verify", "tests/canary/federation.yaml"], 1);
    assert!(said.contains("different at federate `racer`"), "{said}");
}

#[test]
fn the_diamond_keeps_its_order_for_every_delay() {
    for half in ["0 ms", "2500 us", "5 ms", "7500 us", "10 ms", "12500 us"] {
        let half = format!("half={half}");
        let set = ["--set", half.as_str(), "--set", "run=1 s"];
        let sandbox = Sandbox::new();
        let report = sandbox.json(&[&["timing", DIAMOND, "--runs", "1"][..], &set].concat());
        let run = &report["order"][0]["runs"][0];
        // Ticks at 0 ms, 100 ms, ... 1 s; what the last one sends would arrive after the stop tag (`after 0`: a microstep).
        assert_eq!(run["tags"], 10, "{half}: {report}");
        assert_eq!(run["first_first"], run["tags"], "{half}: {report}");
        assert_eq!(run["missing"], 0, "{half}: {report}");
    }
}

#[test]
fn the_timing_of_a_running_federation_can_be_read() {
    let sandbox = Sandbox::new();
    sandbox.ok(&["up", DIAMOND, "--set", "run=1 h"]);
    // What a federate reports as progress stands in its files.
    let behind = |view: &Value| {
        let mut federates = view["federates"].as_array().unwrap().iter();
        federates.any(|f| f["tags"].as_u64().unwrap_or(0) < 5)
    };
    while behind(&sandbox.view("diamond")) {}
    let report = sandbox.json(&["timing", "diamond"]);
    let run = &report["end_to_end"][0]["runs"][0];
    assert!(run["full"]["count"].as_u64().unwrap() >= 3, "{report}");
    assert_eq!(run["missing"], 0, "{report}");
    sandbox.ok(&["down", "diamond", "--purge"]);
}

#[test]
fn a_killed_federate_stops_the_federation_in_order() {
    let sandbox = Sandbox::new();
    sandbox.ok(&["up", DIAMOND]);
    kill(sandbox.pid("diamond", "b"));
    let view = sandbox.ended("diamond");
    assert_eq!(view["outcome"]["outcome"], "failed", "{view}");
    assert_eq!(view["outcome"]["failure"]["member"], "b", "{view}");
    for survivor in ["a", "c", "d"] {
        assert!(ending(&view, survivor).contains("11"), "{survivor}: {view}");
    }
}

#[test]
fn a_killed_rti_ends_every_federate_with_its_own_code() {
    let sandbox = Sandbox::new();
    sandbox.ok(&["up", DIAMOND]);
    kill(sandbox.pid("diamond", "rti"));
    let view = sandbox.ended("diamond");
    assert_eq!(view["outcome"]["failure"]["member"], "rti", "{view}");
    for federate in ["a", "b", "c", "d"] {
        assert!(ending(&view, federate).contains("10"), "{federate}: {view}");
    }
    let logs = sandbox.ok(&["logs", "diamond"]);
    assert!(logs.contains("the RTI was lost (127.0.0.1:"), "{logs}");
}

#[test]
fn a_killed_daemon_changes_nothing() {
    let sandbox = Sandbox::new();
    sandbox.ok(&["up", DIAMOND]);
    let (before, daemon) = (sandbox.view("diamond"), sandbox.daemon_pid());
    kill(daemon);
    let after = sandbox.view("diamond");
    assert_ne!(sandbox.daemon_pid(), daemon);
    assert_eq!(
        (&after["id"], &after["state"]),
        (&before["id"], &before["state"])
    );
    assert_eq!(sandbox.pid("diamond", "a"), member_pid(&before, "a"));
    let view = sandbox.ended("diamond");
    assert_eq!(view["outcome"]["outcome"], "completed", "{view}");
}

fn member_pid(view: &Value, name: &str) -> i32 {
    let mut federates = view["federates"].as_array().unwrap().iter();
    let pid = federates.find(|m| m["name"] == name).unwrap()["pid"]
        .as_i64()
        .unwrap();
    i32::try_from(pid).unwrap()
}

#[test]
fn a_panic_is_reported_with_reactor_and_tag_and_stops_the_others() {
    let sandbox = Sandbox::new();
    sandbox.ok(&["up", "tests/canary/faulty.yaml"]);
    let view = sandbox.ended("faulty");
    assert_eq!(view["outcome"]["failure"]["member"], "faulty", "{view}");
    assert!(ending(&view, "counter").contains("11"), "{view}");
    let logs = sandbox.ok(&["logs", "faulty"]);
    for words in ["tick of faulty", "490 ms", "tick 50 was the last straw"] {
        assert!(logs.contains(words), "{words:?} is missing in {logs}");
    }
    assert!(
        logs.contains("ictus: panicked at tests/canary/src/main.rs:"),
        "{logs}"
    );
    assert!(!logs.contains("BACKTRACE"), "{logs}");
}

#[test]
fn a_federation_that_never_waits_stops_in_order() {
    let sandbox = Sandbox::new();
    let package = root().join("compose/diamond");
    let manifest = sandbox.manifest(
        "hasty.yaml",
        &format!(
            "ictus: v1\nfederation: hasty\nfast: true\nprograms:\n  diamond: {{ package: {} }}\nfederates:\n  a: {{ class: A, parameters: {{ work: 0 ms }} }}\n",
            package.display()
        ),
    );
    sandbox.ok(&["up", &manifest]);
    let said = sandbox.run(&["down", "hasty"]);
    assert!(ictus_tests::said(&said).contains("stopped at the stop tag"));
}

#[test]
fn random_bytes_at_the_rti_disturb_nobody() {
    let sandbox = Sandbox::new();
    sandbox.ok(&["up", DIAMOND]);
    let port = u16::try_from(sandbox.view("diamond")["rti_port"].as_u64().unwrap()).unwrap();
    for junk in [
        &b"GET / HTTP/1.1\r\n\r\n"[..],
        &[1, 0, 0, 250, 7],
        &[16; 64],
        &[255; 1024],
    ] {
        let mut stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
        // The RTI may refuse before it has read everything.
        drop(stream.write_all(junk));
        drop(stream.read(&mut [0; 16]));
    }
    let view = sandbox.ended("diamond");
    assert_eq!(view["outcome"]["outcome"], "completed", "{view}");
}

#[test]
fn a_port_in_use_is_one_clear_error() {
    let sandbox = Sandbox::new();
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port();
    let package = root().join("compose/diamond");
    let manifest = sandbox.manifest(
        "taken.yaml",
        &format!(
            "ictus: v1\nfederation: taken\nrti: {{ port: {port} }}\nprograms:\n  diamond: {{ package: {} }}\nfederates:\n  a: {{ class: A }}\n",
            package.display()
        ),
    );
    let said = sandbox.fails(&["up", &manifest], 1);
    assert!(
        said.contains(&port.to_string()) && said.contains("in use"),
        "{said}"
    );
    assert_eq!(sandbox.view("taken")["outcome"]["failure"]["member"], "rti");
}

#[test]
fn a_federate_that_exits_at_once_undoes_the_start() {
    let sandbox = Sandbox::new();
    let package = root().join("compose/diamond");
    let manifest = sandbox.manifest(
        "quitter.yaml",
        &format!(
            "ictus: v1\nfederation: quitter\nprograms:\n  diamond: {{ package: {} }}\nfederates:\n  a: {{ class: A }}\n  q: {{ binary: /bin/false, id: 1 }}\n",
            package.display()
        ),
    );
    let said = sandbox.fails(&["up", &manifest], 1);
    assert!(said.contains('q') && said.contains("exit"), "{said}");
    let view = sandbox.view("quitter");
    assert_eq!(view["state"], "ended", "{view}");
    assert_eq!(view["outcome"]["failure"]["member"], "q", "{view}");
}

#[test]
fn a_program_that_does_not_build_is_said_with_its_first_error() {
    let sandbox = Sandbox::new();
    let package = sandbox.state().join("broken");
    std::fs::create_dir_all(package.join("src")).unwrap();
    let cargo =
        "[package]\nname = \"broken\"\nversion = \"0.1.0\"\nedition = \"2024\"\n[workspace]\n";
    std::fs::write(package.join("Cargo.toml"), cargo).unwrap();
    std::fs::write(
        package.join("src/main.rs"),
        "fn main() { let x: u32 = \"no\"; }\n",
    )
    .unwrap();
    let manifest = sandbox.manifest(
        "broken/federation.yaml",
        "ictus: v1\nfederation: broken\nprograms:\n  broken: { package: . }\nfederates:\n  a: { class: A }\n",
    );
    let said = sandbox.fails(&["up", &manifest], 3);
    assert!(
        said.contains("mismatched types") && said.contains("src/main.rs"),
        "{said}"
    );
}

/// What only these tests ask of a sandbox.
trait Ask {
    fn view_names(&self) -> Vec<String>;
    fn daemon_pid(&self) -> i32;
    fn daemon_ends(&self);
}

impl Ask for Sandbox {
    fn view_names(&self) -> Vec<String> {
        let views = self.json(&["ps"]);
        let views = views.as_array().unwrap().iter();
        views
            .map(|view| view["name"].as_str().unwrap().to_owned())
            .collect()
    }

    fn daemon_pid(&self) -> i32 {
        let daemons: Vec<String> = self
            .processes()
            .into_iter()
            .filter(|p| p.ends_with("daemon\0"))
            .collect();
        assert_eq!(daemons.len(), 1, "{daemons:?}");
        daemons[0].split(' ').next().unwrap().parse().unwrap()
    }

    /// The on-demand daemon owns nothing and ends by itself; the kernel says when.
    fn daemon_ends(&self) {
        for process in self.processes() {
            let pid = process.split(' ').next().unwrap().parse().unwrap();
            let pid = rustix::process::Pid::from_raw(pid).unwrap();
            let flags = rustix::process::PidfdFlags::empty();
            let Ok(fd) = rustix::process::pidfd_open(pid, flags) else {
                continue;
            };
            let mut fds = [rustix::event::PollFd::new(
                &fd,
                rustix::event::PollFlags::IN,
            )];
            let bound = rustix::event::Timespec {
                tv_sec: 30,
                tv_nsec: 0,
            };
            let ended = rustix::event::poll(&mut fds, Some(&bound)).unwrap();
            assert_eq!(ended, 1, "{process} is left");
        }
    }
}
