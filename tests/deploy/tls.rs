//! What protects the messages between hosts.

#![expect(clippy::panic, reason = "a test stops at the first surprise")]

use ictus_tests::rig::Rig;

use super::Scenario;
use super::operator::{Operator, hosts, spread, timed, verify};

/// In this order.
pub(crate) const SCENARIOS: &[Scenario] = &[
    (
        "messages_between_hosts_are_under_tls",
        messages_between_hosts_are_under_tls,
    ),
    (
        "containers_of_a_decentralized_federation_meet_under_tls",
        containers_of_a_decentralized_federation_meet_under_tls,
    ),
];

/// The diamond over all hosts, which says nothing of `security`.
pub(crate) fn diamond(operator: &Operator<'_>, head: &str, more: &str) -> String {
    let hosts = hosts(operator.rig, more).replace("security: trusted-network\n", "");
    let text = spread(operator.rig, "diamond", &format!("{head}{hosts}"));
    assert!(!text.contains("security"), "{text}");
    operator.manifest("diamond.yaml", &text)
}

fn messages_between_hosts_are_under_tls(rig: &Rig) {
    let operator = Operator::with_hosts(rig);
    let file = diamond(&operator, "", "");
    let up = ["up", &file, "--set", "run=7 s", "--trace"];
    timed(&operator, "mtls", &up);
    // Other certificates would be made, and are no change.
    let again = operator.ok(&up);
    assert!(again.contains("already running"), "{again}");
    let tls = "/home/robot/.local/state/ictus/federations/diamond/tls";
    let listed = rig.hosts().iter().map(|host| {
        let modes = host.exec(&["find", tls, "-type", "f", "-printf", "%m %P\n"]);
        assert!(
            modes.lines().all(|line| line.starts_with("600 ")),
            "{modes}"
        );
        modes.lines().count()
    });
    // Four federates and the RTI, and three files each.
    assert_eq!(listed.sum::<usize>(), 15);
    // A neighbour that speaks in the clear is heard by nobody.
    let parts = operator.parts(&file);
    let mut ports = parts.iter().filter_map(|part| part["rti_port"].as_u64());
    let port = ports.next().unwrap_or_else(|| panic!("{parts:?}"));
    let hello = format!(
        "exec 3<>/dev/tcp/{}/{port}; printf '\\001\\003\\000\\004test' >&3; cat <&3 | head -c 1 | od -An -tu1",
        rig.hosts()[0].address
    );
    let answer = rig.hosts()[1].exec(&["timeout", "20", "bash", "-c", &hello]);
    // An alert of TLS, neither ACK nor REJECT.
    assert_eq!(answer.trim(), "21", "{answer}");
    verify(&operator, &file, "diamond", "diamond");
    let events = operator.ok(&["events", &file]);
    assert!(events.contains("the RTI refused"), "{events}");
    operator.ok(&["down", &file, "--purge"]);
    operator.leave();
}

fn containers_of_a_decentralized_federation_meet_under_tls(rig: &Rig) {
    let operator = Operator::with_hosts(rig);
    let head = "coordination: decentralized\ndefaults: { stp_offset: 3 s }\n";
    let file = diamond(&operator, head, ", engine: docker");
    let up = ["up", &file, "--set", "run=6 s", "--trace"];
    timed(&operator, "mtls", &up);
    for host in rig.hosts() {
        let ids = host.docker(&["ps", "-q"]);
        let ids: Vec<_> = ids.lines().collect();
        let told = host.docker(&[&["inspect"][..], &ids].concat());
        assert!(!told.contains("PRIVATE KEY"), "a key is in the open");
        assert!(told.contains("key.pem"), "{told}");
    }
    verify(&operator, &file, "diamond", "diamond");
    operator.ok(&["down", &file, "--purge"]);
    operator.leave();
}
