//! Members and hosts that are lost while a federation runs over two hosts.

#![expect(
    clippy::unwrap_used,
    clippy::panic,
    reason = "a test stops at the first surprise"
)]

use ictus_tests::rig::{Host, Rig, Traffic};
use ictus_tests::said;
use serde_json::Value;

use super::Scenario;
use super::operator::{Operator, target};
use super::rows::{pair, ticking};

/// In this order.
pub(crate) const SCENARIOS: &[Scenario] = &[
    (
        "a_killed_federate_of_one_host_stops_all_hosts",
        a_killed_federate_of_one_host_stops_all_hosts,
    ),
    (
        "a_killed_rti_ends_the_federates_of_all_hosts",
        a_killed_rti_ends_the_federates_of_all_hosts,
    ),
    (
        "a_host_that_cannot_be_asked_is_unknown_and_not_failed",
        a_host_that_cannot_be_asked_is_unknown_and_not_failed,
    ),
];

/// The pair runs: the RTI and `ticker` on the first host, `counter` on the second.
fn running(rig: &Rig) -> (Operator<'_>, &[Host], String) {
    let hosts = &rig.hosts()[..2];
    let operator = Operator::new(rig);
    operator.add(hosts);
    let text = pair(hosts, [""; 2], &ticking(&operator));
    // A host that runs nothing is not asked, so it may be dead or, as here, not be ours.
    let spare = target(&rig.hosts()[2]);
    let text = text.replacen(
        "hosts:\n",
        &format!("hosts:\n  spare: {{ ssh: \"{spare}\" }}\n"),
        1,
    );
    let file = operator.manifest("pair.yaml", &text);
    operator.ok(&["up", &file]);
    (operator, hosts, file)
}

/// Waits for the end, and gives how each part ended, in the order of hosts.
fn ended(operator: &Operator<'_>, file: &str) -> Vec<Value> {
    operator.ok(&["logs", "--follow", file]);
    let parts = operator.parts(file);
    assert_eq!(parts.len(), 2, "{parts:?}");
    for part in &parts {
        assert_eq!(part["state"], "ended", "{part}");
    }
    parts
}

/// How a member ended.
fn ending(part: &Value, name: &str) -> String {
    let federates = part["federates"].as_array().unwrap().iter();
    let mut members = federates.chain([&part["rti"]]);
    let found = members.find(|member| member["name"] == name);
    let found = found.unwrap_or_else(|| panic!("no {name} in {part}"));
    found["ending"].as_str().unwrap_or_default().to_owned()
}

fn a_killed_federate_of_one_host_stops_all_hosts(rig: &Rig) {
    let (operator, hosts, file) = running(rig);
    hosts[1].exec(&["pkill", "-KILL", "-f", "[-]-federate counter"]);
    let parts = ended(&operator, &file);
    assert!(
        ending(&parts[1], "counter").contains("SIGKILL"),
        "{parts:?}"
    );
    // The other one ended in order, and says because of whom.
    let outcome = &parts[0]["outcome"];
    assert_eq!(outcome["outcome"], "failed", "{outcome}");
    assert!(outcome.to_string().contains("counter"), "{outcome}");
    operator.ok(&["down", &file, "--purge"]);
    operator.remove(hosts);
}

fn a_killed_rti_ends_the_federates_of_all_hosts(rig: &Rig) {
    let (operator, hosts, file) = running(rig);
    hosts[0].exec(&["pkill", "-KILL", "-f", "ictus [r]ti "]);
    let parts = ended(&operator, &file);
    for (part, federate) in parts.iter().zip(["ticker", "counter"]) {
        let how = ending(part, federate);
        assert!(how.contains("exit code 10"), "{how}: {part}");
    }
    operator.ok(&["down", &file, "--purge"]);
    operator.remove(hosts);
}

fn a_host_that_cannot_be_asked_is_unknown_and_not_failed(rig: &Rig) {
    let (operator, hosts, file) = running(rig);
    hosts[1].drop_from(rig.gateway(), Traffic::Tcp(22));
    let asked = operator.run(&["ps", &file]);
    let text = said(&asked);
    assert_eq!(asked.status.code(), Some(4), "{text}");
    assert!(
        text.contains("h2: unknown") && !text.contains("failed"),
        "{text}"
    );
    assert!(
        text.contains("pair on h1"),
        "what is known is shown: {text}"
    );
    // Nothing is concluded from it.
    hosts[1].heal();
    let parts = operator.parts(&file);
    let runs = parts.iter().all(|part| part["state"] == "running");
    assert!(runs && parts.len() == 2, "{parts:?}");
    operator.ok(&["down", &file, "--purge"]);
    operator.remove(hosts);
}
