//! `ictus up` killed at each boundary of its phases: run again it converges, and `down --purge` leaves nothing.

#![expect(
    clippy::unwrap_used,
    clippy::panic,
    reason = "a test stops at the first surprise"
)]

use std::fs;
use std::io::{BufRead, BufReader};
use std::os::unix::process::ExitStatusExt;
use std::process::Stdio;
use std::thread;
use std::time::{Duration, Instant};

use ictus_tests::rig::{Host, Rig};

use rustix::process::{Pid, Signal, kill_process};

use super::Scenario;
use super::operator::Operator;
use super::rows::{kept, pair, ticking};

/// In this order.
pub(crate) const SCENARIOS: &[Scenario] = &[
    (
        "an_up_killed_at_each_phase_converges_when_run_again",
        an_up_killed_at_each_phase_converges_when_run_again,
    ),
    (
        "a_program_that_is_removed_after_it_was_seen_is_sent_again",
        a_program_that_is_removed_after_it_was_seen_is_sent_again,
    ),
];

/// How long an undoing may take.
const UNDO_MAX: Duration = Duration::from_secs(60);

/// Where a start is cut off: the words that its last line begins with, how many such lines there are, and whether what
/// runs by then may still run when it is made again.
const BOUNDARIES: &[(&str, usize, bool)] = &[
    ("planned ", 1, false),
    ("leased ", 1, false),
    ("sent ", 2, false),
    ("prepared ", 2, false),
    ("started    the RTI", 1, true),
    // The last of the start's own words before it may have ended.
    ("agreed ", 1, true),
];

fn an_up_killed_at_each_phase_converges_when_run_again(rig: &Rig) {
    let hosts = &rig.hosts()[..2];
    let operator = Operator::new(rig);
    operator.add(hosts);
    // One of each engine.
    let engines = [", engine: docker", ""];
    let file = operator.manifest("pair.yaml", &pair(hosts, engines, &ticking(&operator)));
    for (index, (line, count, may_run)) in BOUNDARIES.iter().enumerate() {
        cut_off(&operator, &file, line, *count);
        if !may_run {
            // After the last such line the RTI may be started, and is taken away again.
            for host in hosts {
                assert_eq!(settled(host), "", "after `{line}` on {}", host.name);
            }
        }
        // Whoever had the lease is gone. Once it is waited for until it ends; otherwise it is taken away.
        if index != 1 {
            operator.ok(&["lock", "break", &file]);
        }
        let again = operator.ok(&["up", &file]);
        let waited = again.contains("waiting for it");
        assert_eq!(waited, index == 1, "after `{line}`: {again}");
        let parts = operator.parts(&file);
        assert_eq!(parts.len(), 2, "after `{line}`: {parts:?}");
        assert!(
            parts.iter().all(|part| part["state"] == "running"),
            "after `{line}`: {parts:?}"
        );
        operator.ok(&["down", &file, "--purge"]);
        for host in hosts {
            assert_eq!(kept(host), "", "after `{line}` on {}", host.name);
            assert_eq!(members(host), "", "after `{line}` on {}", host.name);
            let images = host.docker(&["images", "-q"]);
            assert_eq!(images, "", "after `{line}` on {}", host.name);
        }
    }
    operator.remove(hosts);
}

/// The host's ictusd for once: when the lease is asked for, it puts the real one in its place and removes the programs.
const REMOVES_PROGRAMS: &str = r#"#!/bin/sh
real=${0%/*}/real/ictusd
[ "$1" = dial-stdio ] || exec "$real" "$@"
{
    if IFS= read -r first; then
        case $first in
        *" /v1/leases/"*)
            ln -f "$real" "$0"
            rm -r "$HOME/.local/state/ictus/blobs"
            ;;
        esac
        printf '%s\n' "$first"
        exec cat
    fi
} | "$real" "$@"
"#;

/// Somebody else's change may remove what nobody seems to need, until the lease is taken.
fn a_program_that_is_removed_after_it_was_seen_is_sent_again(rig: &Rig) {
    let hosts = &rig.hosts()[..1];
    let operator = Operator::new(rig);
    operator.add(hosts);
    let file = operator.manifest("pair.yaml", &pair(hosts, [""; 2], &ticking(&operator)));
    // It is there and nobody needs it.
    cut_off(&operator, &file, "sent ", 1);
    operator.ok(&["lock", "break", &file]);
    let script = "cd $1; mkdir real; mv ictusd real; printf %s \"$2\" >ictusd; chmod 755 ictusd";
    let bin = ".local/share/ictus/bin";
    hosts[0].exec_as_robot(&["sh", "-ec", script, "sh", bin, REMOVES_PROGRAMS]);
    let up = operator.ok(&["up", &file]);
    assert!(up.lines().any(|told| told.starts_with("sent ")), "{up}");
    let script = "cd $1; test ictusd -ef real/ictusd; rm -r real";
    hosts[0].exec_as_robot(&["sh", "-ec", script, "sh", bin]);
    operator.ok(&["down", &file, "--purge"]);
    operator.remove(hosts);
}

/// The process that a `timeout` runs; absent when it has ended.
fn child_of(timeout: u32) -> Option<Pid> {
    let path = format!("/proc/{timeout}/task/{timeout}/children");
    let children = fs::read_to_string(path).unwrap_or_default();
    children.trim().parse().ok().and_then(Pid::from_raw)
}

/// Starts a federation and kills whoever starts it as soon as it has said so many lines that begin so.
fn cut_off(operator: &Operator<'_>, manifest: &str, line: &str, count: usize) {
    let mut up = operator.command(&["up", manifest]);
    let mut up = up
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut said = Vec::new();
    for told in BufReader::new(up.stderr.take().unwrap()).lines() {
        said.push(told.unwrap());
        if said.iter().filter(|told| told.starts_with(line)).count() == count {
            break;
        }
    }
    let found = said.iter().filter(|told| told.starts_with(line)).count();
    assert_eq!(found, count, "{}", said.join("\n"));
    if let Some(pid) = child_of(up.id()) {
        kill_process(pid, Signal::KILL).ok();
    }
    let status = up.wait().unwrap();
    // `timeout` ends as its child did, who may have been faster.
    let faster = line == "agreed " && status.success();
    assert!(
        faster || status.signal() == Some(9),
        "it was not killed: {said:?}"
    );
}

/// The federates and the RTI that run on a host.
fn members(host: &Host) -> String {
    let output = host.output(&["pgrep", "-af", "([-]-federate|ictusd? [r]ti )"]);
    match output.status.code() {
        Some(0 | 1) => String::from_utf8(output.stdout).unwrap(),
        _ => panic!("{}", ictus_tests::said(&output)),
    }
}

/// The same once what is being undone is, or has had its time.
fn settled(host: &Host) -> String {
    let end = Instant::now() + UNDO_MAX;
    loop {
        let left = members(host);
        if left.is_empty() || Instant::now() >= end {
            return left;
        }
        thread::sleep(Duration::from_millis(100));
    }
}
