//! Values on their way to a page.

use std::collections::{BTreeMap, BTreeSet};

use ictus_core::Duration;
use prometheus::proto;
use prometheus::proto::{LabelPair, MetricFamily, MetricType};
use prometheus::{TEXT_FORMAT, TextEncoder};

use crate::catalogue::{BOUNDS_NS, Kind, Metric};

/// The content type of [`Registry::text`].
pub const CONTENT_TYPE: &str = TEXT_FORMAT;

/// What one scrape shows.
///
/// Law: whatever is put in, the text is one that [`crate::Page::parse`] takes. So a series that is there already is not replaced,
/// and what does not fit the metric (its type, its number of labels) is left out.
#[derive(Debug, Default)]
pub struct Registry {
    families: BTreeMap<&'static str, MetricFamily>,
    series: BTreeSet<(&'static str, Vec<String>)>,
}

impl Registry {
    /// A counter's value so far.
    pub fn count(&mut self, metric: Metric, labels: &[&str], value: u64) {
        let mut counter = proto::Counter::default();
        counter.set_value(float(value));
        if let Some(sample) = self.sample(metric, Kind::Counter, labels) {
            sample.set_counter(counter);
        }
    }

    /// A gauge's value. One that is not finite says nothing and is left out.
    pub fn set(&mut self, metric: Metric, labels: &[&str], value: f64) {
        if !value.is_finite() {
            return;
        }
        let mut gauge = proto::Gauge::default();
        gauge.set_value(value);
        if let Some(sample) = self.sample(metric, Kind::Gauge, labels) {
            sample.set_gauge(gauge);
        }
    }

    /// A gauge that is a duration, in seconds.
    pub fn set_duration(&mut self, metric: Metric, labels: &[&str], nanos: i64) {
        self.set(metric, labels, seconds(nanos));
    }

    /// A gauge that is true (1) or false (0).
    pub fn set_flag(&mut self, metric: Metric, labels: &[&str], flag: bool) {
        self.set(metric, labels, f64::from(u8::from(flag)));
    }

    /// A histogram: `counts` are upper edges, ascending, and how many observations lie between that and the edge
    /// before; `sum_ns` is the sum of all observations. What lies across a bound counts as above it.
    pub fn observed(
        &mut self,
        metric: Metric,
        labels: &[&str],
        counts: impl Iterator<Item = (Duration, u64)>,
        sum_ns: u64,
    ) {
        let mut below = [0_u64; BOUNDS_NS.len()];
        let mut total = 0_u64;
        for (edge, count) in counts {
            total = total.saturating_add(count);
            let first = BOUNDS_NS.partition_point(|bound| *bound < edge.as_nanos());
            for cumulative in below.iter_mut().skip(first) {
                *cumulative = cumulative.saturating_add(count);
            }
        }
        let buckets = BOUNDS_NS.iter().zip(below).map(|(bound, count)| {
            let mut bucket = proto::Bucket::default();
            bucket.set_upper_bound(seconds(*bound));
            bucket.set_cumulative_count(count);
            bucket
        });
        let mut histogram = proto::Histogram::default();
        histogram.set_bucket(buckets.collect());
        histogram.set_sample_count(total);
        histogram.set_sample_sum(float(sum_ns) / 1e9);
        if let Some(sample) = self.sample(metric, Kind::Histogram, labels) {
            sample.set_histogram(histogram);
        }
    }

    /// The page, in the classic text format 0.0.4.
    #[must_use]
    pub fn text(&self) -> String {
        let families: Vec<_> = self.families.values().cloned().collect();
        // Fails only for a family without a name or a sample, and there is none.
        TextEncoder::new()
            .encode_to_string(&families)
            .unwrap_or_default()
    }

    /// A new sample; absent when it does not fit or is there already.
    fn sample(
        &mut self,
        metric: Metric,
        kind: Kind,
        labels: &[&str],
    ) -> Option<&mut proto::Metric> {
        if metric.kind != kind || metric.labels.len() != labels.len() {
            return None;
        }
        let values: Vec<String> = labels.iter().map(|value| (*value).to_owned()).collect();
        if !self.series.insert((metric.name, values.clone())) {
            return None;
        }
        let pairs = metric.labels.iter().zip(values).map(|(name, value)| {
            let mut pair = LabelPair::default();
            pair.set_name((*name).to_owned());
            pair.set_value(value);
            pair
        });
        let family = self.families.entry(metric.name).or_insert_with(|| {
            let mut family = MetricFamily::default();
            family.set_name(metric.name.to_owned());
            family.set_help(metric.help.to_owned());
            family.set_field_type(match kind {
                Kind::Counter => MetricType::COUNTER,
                Kind::Gauge => MetricType::GAUGE,
                Kind::Histogram => MetricType::HISTOGRAM,
            });
            family
        });
        let samples = family.mut_metric();
        samples.push(proto::Metric::from_label(pairs.collect()));
        samples.last_mut()
    }
}

#[expect(
    clippy::cast_precision_loss,
    reason = "the format's numbers are doubles"
)]
const fn float(value: u64) -> f64 {
    value as f64
}

/// Seconds; dividing keeps the decimals that a person wrote.
#[expect(
    clippy::cast_precision_loss,
    reason = "the format's numbers are doubles"
)]
fn seconds(nanos: i64) -> f64 {
    nanos as f64 / 1e9
}
