//! What is put in comes out as a page that a strict reader takes.
#![allow(
    clippy::unwrap_used,
    clippy::print_stderr,
    missing_docs,
    reason = "tests"
)]

use ictus_core::Duration;
use ictus_metrics::catalogue::{ALL, BOUNDS_NS, STP_SLACK, TAGS_COMPLETED};
use ictus_metrics::{Kind, Metric, Page, Registry, Unit};
use proptest::prelude::*;
use std::collections::BTreeSet;
use std::io::{Seek, Write};
use std::process::{Command, Stdio};

#[test]
fn names_say_type_and_unit() {
    let names: BTreeSet<&str> = ALL.iter().map(|metric| metric.name).collect();
    assert_eq!(names.len(), ALL.len(), "every metric once");
    for metric in ALL {
        let name = metric.name;
        assert!(name.starts_with("ictus_"), "{name}");
        assert_eq!(
            name.ends_with("_total"),
            metric.kind == Kind::Counter,
            "{name}"
        );
        let base = name.strip_suffix("_total").unwrap_or(name);
        let unit = match metric.unit {
            Unit::None => "",
            Unit::Seconds => "_seconds",
            Unit::Bytes => "_bytes",
            Unit::Ratio => "_ratio",
        };
        assert!(base.ends_with(unit), "{name}");
        if unit.is_empty() {
            assert!(
                !base.ends_with("_seconds") && !base.ends_with("_bytes"),
                "{name}"
            );
        }
        assert!(
            metric.kind != Kind::Histogram || metric.unit == Unit::Seconds,
            "{name}"
        );
        assert!(
            metric.help.ends_with('.') && !metric.help.contains(['\n', '\\']),
            "{name}"
        );
        let labels: BTreeSet<&str> = metric.labels.iter().copied().collect();
        assert_eq!(labels.len(), metric.labels.len(), "{name}");
        assert!(!labels.contains("le") && !labels.contains("job") && !labels.contains("instance"));
    }
    assert!(BOUNDS_NS.is_sorted());
}

/// Every metric with one series.
fn full() -> Registry {
    let mut registry = Registry::default();
    for metric in ALL {
        put(&mut registry, metric, "x", 3);
    }
    registry
}

fn put(registry: &mut Registry, metric: Metric, label: &str, value: u64) {
    let labels = vec![label; metric.labels.len()];
    match metric.kind {
        Kind::Counter => registry.count(metric, &labels, value),
        Kind::Gauge => registry.set_duration(metric, &labels, -5),
        Kind::Histogram => {
            let edge = Duration::from_nanos(i64::try_from(value).unwrap_or(i64::MAX));
            registry.observed(metric, &labels, [(edge, value)].into_iter(), value);
        }
    }
}

#[test]
fn every_metric_of_the_catalogue_can_be_shown() {
    let page = Page::parse(&full().text()).unwrap();
    let samples = |metric: &Metric| match metric.kind {
        Kind::Counter | Kind::Gauge => 1,
        Kind::Histogram => BOUNDS_NS.len() + 3,
    };
    assert_eq!(page.samples().len(), ALL.iter().map(samples).sum::<usize>());
}

#[test]
fn buckets_are_cumulative_and_what_lies_across_a_bound_counts_above_it() {
    let mut registry = Registry::default();
    let counts = [(1_000, 1), (1_001, 2), (20_000_000_000, 4)];
    let counts = counts.map(|(edge, count)| (Duration::from_nanos(edge), count));
    registry.observed(
        STP_SLACK,
        &["f", "b", "a"],
        counts.into_iter(),
        1_500_000_000,
    );
    let page = Page::parse(&registry.text()).unwrap();
    let le = |le| page.value("ictus_stp_slack_seconds_bucket", &[("le", le)]);
    assert_eq!(le("0.000001"), Some(1.0));
    assert_eq!(le("0.000002"), Some(3.0));
    assert_eq!(le("10"), Some(3.0));
    assert_eq!(le("+Inf"), Some(7.0));
    assert_eq!(page.value("ictus_stp_slack_seconds_sum", &[]), Some(1.5));
}

#[test]
fn what_does_not_fit_is_left_out() {
    let mut registry = Registry::default();
    registry.count(TAGS_COMPLETED, &["f"], 1);
    registry.set(TAGS_COMPLETED, &["f", "a"], 1.0);
    assert_eq!(registry.text(), "");
    registry.count(TAGS_COMPLETED, &["f", "a"], 1);
    registry.count(TAGS_COMPLETED, &["f", "a"], 2);
    let page = Page::parse(&registry.text()).unwrap();
    assert_eq!(page.samples().len(), 1);
    assert_eq!(page.value("ictus_tags_completed_total", &[]), Some(1.0));
}

#[test]
fn wrong_pages_are_refused() {
    let help = "# HELP ictus_tags_completed_total Tags completed.\n";
    let head = format!("{help}# TYPE ictus_tags_completed_total counter\n");
    let sample = "ictus_tags_completed_total{federation=\"f\",federate=\"a\"} 1\n";
    assert!(Page::parse(&format!("{head}{sample}")).is_ok());
    for (text, why) in [
        (sample.to_owned(), "line 1: a sample without a TYPE"),
        (format!("{head}{sample}{sample}"), "line 4: a sample twice"),
        (
            format!("{head}{sample}{head}"),
            "line 4: a metric in two places",
        ),
        (
            format!("{head}{}", sample.trim_end()),
            "line 3: the last line does not end",
        ),
        (
            head.replace("counter", "gauge"),
            "line 2: not the catalogue's type",
        ),
        (
            head.replace("completed.", "done."),
            "line 1: not the catalogue's help",
        ),
        (help.to_owned(), "line 1: a HELP without its TYPE"),
        (
            head.replace("tags", "togs"),
            "line 1: a metric that is not in the catalogue",
        ),
        (
            format!("{head}{}", sample.replace("federate", "fed")),
            "line 3: not the catalogue's labels",
        ),
        (
            format!("{head}{}", sample.replace(" 1", " -1")),
            "line 3: a count that is none",
        ),
        (
            format!("{head}{}", sample.replace(" 1", " one")),
            "line 3: not a number",
        ),
        (
            format!("{head}{}", sample.replace("tags", "togs")),
            "line 3: a sample of another metric",
        ),
        (
            format!("{head}{}", sample.replace("\"}", "}")),
            "line 3: a label's value without an end",
        ),
    ] {
        assert_eq!(Page::parse(&text).unwrap_err().to_string(), why, "{text}");
    }
    let full = full().text();
    for (from, why) in [
        ("ictus_stp_slack_seconds_sum", "an incomplete histogram"),
        (
            "ictus_stp_slack_seconds_bucket{federation=\"x\",federate=\"x\",upstream=\"x\",le=\"+Inf\"}",
            "an incomplete histogram",
        ),
    ] {
        let text: String = full
            .split_inclusive('\n')
            .filter(|line| !line.starts_with(from))
            .collect();
        let error = Page::parse(&text).unwrap_err();
        assert!(text.len() < full.len() && error.what == why, "{error}");
    }
}

#[test]
fn promtool_agrees() {
    let mut file = tempfile::tempfile().unwrap();
    file.write_all(full().text().as_bytes()).unwrap();
    file.rewind().unwrap();
    let promtool = Command::new("promtool")
        .args(["check", "metrics"])
        .stdin(file)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .output();
    let Ok(output) = promtool else {
        assert!(std::env::var_os("CI").is_none(), "CI skips nothing");
        eprintln!("skipped: there is no promtool (Debian: prometheus)");
        return;
    };
    let said = String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
    assert!(output.status.success() && said.is_empty(), "{said}");
}

proptest! {
    #[test]
    fn whatever_is_put_in_the_page_reads(
        puts in prop::collection::vec((0..ALL.len(), "(?s).{0,6}", any::<u64>()), 0..40)
    ) {
        let mut registry = Registry::default();
        let mut series = BTreeSet::new();
        for (index, label, value) in puts {
            put(&mut registry, ALL[index], &label, value);
            series.insert((index, if ALL[index].labels.is_empty() { String::new() } else { label }));
        }
        let text = registry.text();
        let page = Page::parse(&text);
        prop_assert!(page.is_ok(), "{page:?}\n{text}");
        for (index, label) in series {
            let metric = ALL[index];
            let name = match metric.kind {
                Kind::Counter | Kind::Gauge => metric.name.to_owned(),
                Kind::Histogram => format!("{}_count", metric.name),
            };
            let labels: Vec<_> = metric.labels.iter().map(|name| (*name, label.as_str())).collect();
            prop_assert!(page.as_ref().unwrap().value(&name, &labels).is_some());
        }
    }

    #[test]
    fn no_text_breaks_the_reader(text in "(?s).{0,80}") {
        drop(Page::parse(&text));
    }
}
