//! Networks that fail: cuts that are longer or shorter than the failure timeout, a pulled cable.

#![expect(
    clippy::unwrap_used,
    clippy::panic,
    reason = "a test stops at the first surprise"
)]

use ictus_coord::report::FederationMeasures;
use ictus_tests::rig::{Host, Rig, Traffic};
use ictus_tests::root;
use serde_json::Value;

use super::Scenario;
use super::operator::{Operator, hosts, spread};

/// In this order.
pub(crate) const SCENARIOS: &[Scenario] = &[
    (
        "a_cut_longer_than_the_failure_timeout_stops_in_order",
        a_cut_longer_than_the_failure_timeout_stops_in_order,
    ),
    (
        "violations_of_a_cut_are_counted",
        violations_of_a_cut_are_counted,
    ),
    (
        "a_cable_pulled_for_good_stops_in_order",
        a_cable_pulled_for_good_stops_in_order,
    ),
    (
        "a_shut_way_is_named_with_the_rule_that_opens_it",
        a_shut_way_is_named_with_the_rule_that_opens_it,
    ),
    (
        "only_ports_of_the_range_are_needed",
        only_ports_of_the_range_are_needed,
    ),
];

/// The last line of a federate's trace on `host`: where and why it ended.
fn end_of_trace(host: &Host, federation: &str, federate: &str) -> String {
    let path =
        format!("/home/robot/.local/state/ictus/federations/{federation}/trace/{federate}.trace");
    let text = host.exec(&["tail", "-n", "1", &path]);
    assert!(text.starts_with("# end"), "{federate}: {text}");
    text
}

/// How a member says that it ended, from all parts.
fn ending<'a>(parts: &'a [Value], member: &str) -> &'a str {
    let all = parts.iter().flat_map(|part| {
        let federates = part["federates"].as_array().unwrap().iter();
        federates.chain([&part["rti"]])
    });
    let found = all.into_iter().find(|it| it["name"] == member);
    found.unwrap()["ending"].as_str().unwrap_or("")
}

/// The three hosts; federates a and d of the diamond and the RTI are on the first, b on the second, c on the third.
fn three(rig: &Rig) -> [&Host; 3] {
    let mut hosts = rig.hosts().iter();
    std::array::from_fn(|_| hosts.next().unwrap())
}

/// c's host is gone for the others: they stopped at one tag, and one line says why.
fn expect_c_lost(operator: &Operator<'_>, file: &str, [first, second, third]: [&Host; 3]) {
    let parts = operator.parts(file);
    for (member, code) in [("a", "11"), ("b", "11"), ("c", "10"), ("d", "11")] {
        let ending = ending(&parts, member);
        assert!(ending.contains(code), "{member}: {ending}: {parts:?}");
    }
    let a = end_of_trace(first, "diamond", "a");
    let d = end_of_trace(first, "diamond", "d");
    let b = end_of_trace(second, "diamond", "b");
    let tag = |line: &str| line.split('\t').next().map(str::to_owned);
    assert_eq!((tag(&a), tag(&a)), (tag(&b), tag(&d)), "{a}{b}{d}");
    let said = operator.ok(&["ps", file]);
    let headlines: Vec<&str> = said
        .lines()
        .filter(|it| it.contains("` failed: "))
        .collect();
    let [headline] = headlines.as_slice() else {
        panic!("one headline: {said}");
    };
    let address = third.address.to_string();
    let host = format!("host `{}`: c: ", third.name);
    for words in [&host, "was lost", &address] {
        assert!(headline.contains(words), "{words} is missing in {headline}");
    }
}

fn a_cut_longer_than_the_failure_timeout_stops_in_order(rig: &Rig) {
    let operator = Operator::with_hosts(rig);
    let head = format!("defaults: {{ failure_timeout: 3 s }}\n{}", hosts(rig, ""));
    let file = operator.manifest("diamond.yaml", &spread(rig, "diamond", &head));
    operator.ok(&["up", &file, "--set", "run=1 h", "--trace"]);
    let all @ [first, second, third] = three(rig);
    third.partition_from(first, Traffic::Data);
    third.partition_from(second, Traffic::Data);
    // ssh is not cut: until all parts have ended, the cut host's too.
    operator.ok(&["logs", "--follow", &file]);
    expect_c_lost(&operator, &file, all);
    let said = operator.ok(&["ps", &file]);
    assert!(said.contains("no answer from"), "{said}");
    for host in all {
        host.heal();
    }
    operator.ok(&["down", &file, "--purge"]);
    operator.leave();
}

fn a_cable_pulled_for_good_stops_in_order(rig: &Rig) {
    let operator = Operator::with_hosts(rig);
    let head = format!("defaults: {{ failure_timeout: 3 s }}\n{}", hosts(rig, ""));
    let file = operator.manifest("diamond.yaml", &spread(rig, "diamond", &head));
    operator.ok(&["up", &file, "--set", "run=1 h", "--trace"]);
    let all @ [first, second, third] = three(rig);
    third.cut_cable();
    // Nobody can ask the third, whose federate ends by itself all the same.
    for host in [first, second, third] {
        let ended = "while pgrep -f '[-]-federate' > /dev/null; do sleep 0.1; done";
        host.exec(&["sh", "-c", ended]);
    }
    third.restore_cable();
    expect_c_lost(&operator, &file, all);
    operator.ok(&["down", &file, "--purge"]);
    operator.leave();
}

/// A beat on the first host, an ear on the second, the RTI on the third; both hosts have a range of ports.
fn beat(rig: &Rig, head: &str, host_keys: &str) -> String {
    let [first, second, third] = three(rig);
    let hosts = hosts(rig, host_keys).replace(
        &format!("rti: {{ host: {} }}", first.name),
        &format!("rti: {{ host: {} }}", third.name),
    );
    format!(
        "ictus: v1\nfederation: beat\ncoordination: decentralized\n{head}{hosts}\
         programs:\n  canary: {{ package: {} }}\nfederates:\n  \
         beat: {{ host: {}, class: Beat }}\n  ear: {{ host: {}, class: Ear }}\nconnections:\n  \
         - {{ from: beat.out, to: ear.input }}\n",
        root().join("tests/canary").display(),
        first.name,
        second.name,
    )
}

fn a_shut_way_is_named_with_the_rule_that_opens_it(rig: &Rig) {
    let operator = Operator::with_hosts(rig);
    let [first, second, _] = three(rig);
    let head = "defaults: { stp_offset: 1 s }\n";
    let file = operator.manifest("beat.yaml", &beat(rig, head, ", ports: 15045-15047"));
    let open = operator.fails(&["plan", &file], 2);
    assert!(!open.contains("cannot reach"), "{open}");
    second.drop_from(first.address, Traffic::Tcp(15_045));
    let said = operator.fails(&["plan", &file], 4);
    let (from, to) = (first.address, second.address);
    let pair = format!(
        "host `{}` ({from}) cannot reach host `{}` ({to}) at TCP port 15045: no answer within",
        first.name, second.name
    );
    let rule = format!("iptables -I INPUT -p tcp -s {from} --dport 15045:15047 -j ACCEPT");
    for words in [&pair, &rule] {
        assert!(said.contains(words), "{words} is missing in {said}");
    }
    assert_eq!(said.matches("cannot reach").count(), 1, "{said}");
    second.heal();
    operator.fails(&["plan", &file], 2);
    operator.leave();
}

fn only_ports_of_the_range_are_needed(rig: &Rig) {
    let operator = Operator::with_hosts(rig);
    for host in rig.hosts() {
        for peer in rig.hosts().iter().filter(|peer| peer.name != host.name) {
            let peer = peer.address.to_string();
            for protocol in [&["-p", "tcp", "--syn"][..], &["-p", "udp"]] {
                let head = ["iptables", "--wait", "-t", "raw", "-A", "RIG", "-s", &peer];
                let rest = [
                    "-m",
                    "multiport",
                    "!",
                    "--dports",
                    "15045:15047",
                    "-j",
                    "DROP",
                ];
                host.exec(&[&head, protocol, &rest].concat());
            }
        }
    }
    let head =
        "timeout: 2 s\nclock: { sync: on }\ndefaults: { stp_offset: 3 s, join_timeout: 20 s }\n";
    let file = operator.manifest("beat.yaml", &beat(rig, head, ", ports: 15045-15047"));
    operator.ok(&["up", &file]);
    let logs = operator.ok(&["logs", "--follow", &file]);
    for part in operator.parts(&file) {
        assert_eq!(part["outcome"]["outcome"], "completed", "{part}");
    }
    assert!(logs.contains("heard 101 in time and 0 tardy"), "{logs}");
    operator.ok(&["down", &file, "--purge"]);
    operator.leave();
}

/// Each tick of the beat was heard in time, or is counted as a violation; which ones is up to the cut.
fn violations_of_a_cut_are_counted(rig: &Rig) {
    let operator = Operator::with_hosts(rig);
    let [first, second, _] = three(rig);
    let head = "timeout: 15 s\ndefaults: { stp_offset: 200 ms, failure_timeout: 1 min }\n";
    let file = operator.manifest("beat.yaml", &beat(rig, head, ""));
    operator.ok(&["up", &file]);
    first.partition_from(second, Traffic::Data);
    // All are there while it lasts, which is longer than the offset.
    let parts = operator.parts(&file);
    let running = |part: &Value| part["state"] == "running";
    assert!(parts.iter().all(running), "{parts:?}");
    first.heal();
    second.heal();
    let logs = operator.ok(&["logs", "--follow", &file]);
    for part in operator.parts(&file) {
        assert_eq!(part["outcome"]["outcome"], "completed", "{part}");
    }
    let line = logs.lines().find(|line| line.contains("in time and"));
    let mut numbers = line
        .unwrap()
        .split(' ')
        .filter_map(|word| word.parse().ok());
    let (tardy, heard): (u64, u64) = (numbers.next_back().unwrap(), numbers.next_back().unwrap());
    let counted = violations(second, "beat", "ear");
    assert_eq!(heard + counted, 751, "{heard} in time, {counted} counted");
    assert!(
        (1..=counted).contains(&tardy),
        "{tardy} tardy, {counted} counted"
    );
    operator.ok(&["down", &file, "--purge"]);
    operator.leave();
}

/// The STP violations that a host's daemon keeps of a federate whose federation has ended.
fn violations(host: &Host, federation: &str, federate: &str) -> u64 {
    let path = format!("/home/robot/.local/state/ictus/federations/{federation}/measures.json");
    let kept: FederationMeasures = serde_json::from_str(&host.exec(&["cat", &path])).unwrap();
    let mut federates = kept.federates.iter();
    let measured = federates.find(|it| it.federate == federate).unwrap();
    measured
        .upstreams
        .values()
        .map(|it| it.stp_violations)
        .sum()
}
