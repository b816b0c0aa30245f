//! `ictus metrics`, with the real RTI and real federates.

use ictus_metrics::Page;
use serde_json::Value;

use crate::environment::Environment;

const PAIR: &str = "\
ictus: v1
federation: pair
programs: { fixture: { binary: FIXTURE_PROGRAM } }
timeout: 300 ms
metrics: { listen: 127.0.0.1:0 }
federates:
  source: { class: Source }
  sink: { class: Sink }
connections:
  - { from: source.out, to: sink.value, after: 1 ms }
";

fn page(environment: &Environment) -> Page {
    Page::parse(&environment.run(&["metrics"]).ok().out).unwrap()
}

/// A value of one of the pair's federates.
fn value(page: &Page, federate: &str, name: &str) -> f64 {
    let labels = [("federation", "pair"), ("federate", federate)];
    page.value(name, &labels)
        .unwrap_or_else(|| panic!("no {name} of {federate}"))
}

#[test]
fn metrics_tell_what_happened_until_down() {
    let environment = Environment::new();
    assert_eq!(environment.run(&["metrics"]).ok().out, "");
    let none = environment.run(&["metrics", "-o", "json"]).ok();
    assert_eq!(none.out.trim(), "[]");
    environment.write("pair.yaml", PAIR);
    environment.run(&["up", "--attach", "pair.yaml"]).ok();
    let page_of_run = page(&environment);
    let of = |federate, name| value(&page_of_run, federate, name);
    // Every 10 ms from 0 to 300; what arrives 1 ms after the stop tag does not.
    assert!((of("sink", "ictus_messages_received_total") - 30.0).abs() < 0.1);
    assert!(of("source", "ictus_messages_sent_total") >= 30.0);
    // A u64 each; both ends count payloads only.
    let bytes =
        |federate, messages| of(federate, "ictus_message_bytes_total") / of(federate, messages);
    let each = [
        bytes("sink", "ictus_messages_received_total"),
        bytes("source", "ictus_messages_sent_total"),
    ];
    assert_eq!(each, [8.0, 8.0]);
    assert!((of("source", "ictus_reactions_executed_total") - 31.0).abs() < 0.1);
    for federate in ["source", "sink"] {
        assert!(of(federate, "ictus_tags_completed_total") >= 30.0);
        assert!(of(federate, "ictus_tag_lag_seconds_count") >= 30.0);
        assert_eq!(of(federate, "ictus_federate_up"), 0.0);
        assert_eq!(of(federate, "ictus_federate_exits_total"), 1.0);
    }
    assert!(of("sink", "ictus_rti_grant_wait_seconds_count") >= 1.0);
    assert!(of("source", "ictus_message_launch_lag_seconds_count") >= 30.0);
    let json = environment.run(&["metrics", "-o", "json"]).ok();
    let lines: Vec<Value> = serde_json::from_str(&json.out).unwrap();
    let up = lines.iter().find(|line| {
        line["name"] == "ictus_federate_exits_total" && line["labels"]["federate"] == "sink"
    });
    assert_eq!(up.unwrap()["value"], 1.0, "{json}");
    let ps = environment.run(&["ps", "-o", "json"]).ok();
    let view: Value = serde_json::from_str(&ps.out).unwrap();
    assert!(view[0]["metrics"].is_string(), "{ps}");
    environment.run(&["down", "pair"]).ok();
    let after = environment.run(&["metrics"]).ok().out;
    assert!(!after.contains("federation="), "{after}");
}

#[test]
fn decentralized_every_message_has_slack_or_is_a_violation() {
    let environment = Environment::new();
    let text = PAIR
        .replace("timeout", "coordination: decentralized\ntimeout")
        .replace("{ class: Sink }", "{ class: Sink, stp_offset: 20 ms }");
    environment.write("pair.yaml", &text);
    environment.run(&["up", "--attach", "pair.yaml"]).ok();
    let page = page(&environment);
    let of = |name| value(&page, "sink", name);
    let received = of("ictus_messages_received_total");
    assert!(received >= 30.0);
    let slack = page.value("ictus_stp_slack_seconds_count", &[("upstream", "source")]);
    let counted = slack.unwrap_or(0.0) + of("ictus_stp_violations_total");
    // The last one may come when its tag can be none any more.
    assert!(
        (0.0..=1.0).contains(&(received - counted)),
        "{counted} of {received}"
    );
    let latency = of("ictus_message_latency_seconds_count");
    assert!(
        (0.0..=1.0).contains(&(received - latency)),
        "{latency} of {received}"
    );
    assert!((of("ictus_stp_offset_seconds") - 0.02).abs() < 1e-9);
}
