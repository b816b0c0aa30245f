//! A page in the classic text format, read back.

use std::collections::{BTreeMap, BTreeSet};

use crate::catalogue::{ALL, Kind, Metric};

/// A page that was found to be right: every sample belongs to a metric of the catalogue, has its labels, follows its
/// `# TYPE`, occurs once, and histograms are cumulative and complete.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Page {
    samples: Vec<Sample>,
}

/// One line of a page.
#[derive(Clone, Debug, PartialEq)]
pub struct Sample {
    /// The name, with `_bucket`, `_sum` or `_count` for a histogram.
    pub name: String,
    /// The labels in the page's order.
    pub labels: Labels,
    /// The value.
    pub value: f64,
}

/// Names and values of labels.
type Labels = Vec<(String, String)>;

/// Where and why a page is wrong.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PageError {
    /// The line's number, from 1.
    pub line: usize,
    /// What is wrong.
    pub what: &'static str,
}

impl std::fmt::Display for PageError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "line {}: {}", self.line, self.what)
    }
}

impl std::error::Error for PageError {}

/// What is known of the family that is being read.
#[derive(Default)]
struct Reader {
    page: Page,
    family: Option<Metric>,
    helped: Option<Metric>,
    seen: BTreeSet<&'static str>,
    series: BTreeSet<(String, Labels)>,
    histograms: BTreeMap<(&'static str, Labels), Parts>,
}

/// What was read of one histogram.
#[derive(Default)]
struct Parts {
    bound: Option<f64>,
    cumulative: f64,
    infinite: bool,
    sum: bool,
    count: Option<f64>,
}

impl Page {
    /// Reads a page.
    ///
    /// # Errors
    /// The first line that is not as the format, or the catalogue, wants it.
    pub fn parse(text: &str) -> Result<Self, PageError> {
        let mut reader = Reader::default();
        let mut last = 0;
        for (line, number) in text.split_inclusive('\n').zip(1..) {
            let at = |what| PageError { line: number, what };
            let line = line
                .strip_suffix('\n')
                .ok_or_else(|| at("the last line does not end"))?;
            reader.line(line).map_err(at)?;
            last = number;
        }
        let at_end = |what| PageError { line: last, what };
        reader.finish().map_err(at_end)
    }

    /// All samples in order.
    #[must_use]
    pub fn samples(&self) -> &[Sample] {
        &self.samples
    }

    /// The value of a sample that has at least these labels; absent when there is none.
    #[must_use]
    pub fn value(&self, name: &str, labels: &[(&str, &str)]) -> Option<f64> {
        let has = |sample: &Sample, (name, value): &(&str, &str)| {
            sample.labels.iter().any(|(n, v)| n == name && v == value)
        };
        self.samples
            .iter()
            .find(|sample| sample.name == name && labels.iter().all(|label| has(sample, label)))
            .map(|sample| sample.value)
    }
}

impl Reader {
    fn line(&mut self, line: &str) -> Result<(), &'static str> {
        if let Some(rest) = line.strip_prefix("# HELP ") {
            let (name, help) = rest.split_once(' ').ok_or("a HELP without text")?;
            let metric = find(name)?;
            if metric.help != help {
                return Err("not the catalogue's help");
            }
            if !self.seen.insert(metric.name) {
                return Err("a metric in two places");
            }
            self.helped = Some(metric);
            self.family = None;
            return Ok(());
        }
        if let Some(rest) = line.strip_prefix("# TYPE ") {
            let (name, kind) = rest.split_once(' ').ok_or("a TYPE without a type")?;
            let metric = self.helped.take().ok_or("a TYPE without its HELP")?;
            let right = match metric.kind {
                Kind::Counter => "counter",
                Kind::Gauge => "gauge",
                Kind::Histogram => "histogram",
            };
            if metric.name != name || kind != right {
                return Err("not the catalogue's type");
            }
            self.family = Some(metric);
            return Ok(());
        }
        let family = self.family.ok_or("a sample without a TYPE")?;
        let sample = sample(line)?;
        let key = (sample.name.clone(), sample.labels.clone());
        if !self.series.insert(key) {
            return Err("a sample twice");
        }
        self.check(family, &sample)?;
        self.page.samples.push(sample);
        Ok(())
    }

    fn check(&mut self, family: Metric, sample: &Sample) -> Result<(), &'static str> {
        let mut labels = sample.labels.clone();
        let le = if sample.name.ends_with("_bucket") && family.kind == Kind::Histogram {
            labels.pop().filter(|(name, _)| name == "le")
        } else {
            None
        };
        if !labels
            .iter()
            .map(|(name, _)| name.as_str())
            .eq(family.labels.iter().copied())
        {
            return Err("not the catalogue's labels");
        }
        if family.kind != Kind::Gauge && (sample.value < 0.0 || !sample.value.is_finite()) {
            return Err("a count that is none");
        }
        if family.kind != Kind::Histogram {
            return if sample.name == family.name {
                Ok(())
            } else {
                Err("a sample of another metric")
            };
        }
        let part = sample.name.strip_prefix(family.name);
        let parts = self.histograms.entry((family.name, labels)).or_default();
        match (part, le) {
            (Some("_bucket"), Some((_, le))) => parts.bucket(&le, sample.value),
            (Some("_sum"), None) => {
                parts.sum = true;
                Ok(())
            }
            (Some("_count"), None) => {
                parts.count = Some(sample.value);
                Ok(())
            }
            _ => Err("a sample of another metric"),
        }
    }

    fn finish(self) -> Result<Page, &'static str> {
        if self.helped.is_some() {
            return Err("a HELP without its TYPE");
        }
        let complete =
            |parts: &Parts| parts.infinite && parts.sum && parts.count == Some(parts.cumulative);
        if !self.histograms.values().all(complete) {
            return Err("an incomplete histogram");
        }
        Ok(self.page)
    }
}

impl Parts {
    fn bucket(&mut self, le: &str, cumulative: f64) -> Result<(), &'static str> {
        let bound = number(le)?;
        if self.bound.is_some_and(|before| bound <= before) || cumulative < self.cumulative {
            return Err("buckets that do not ascend");
        }
        self.infinite = bound == f64::INFINITY;
        self.bound = Some(bound);
        self.cumulative = cumulative;
        Ok(())
    }
}

fn find(name: &str) -> Result<Metric, &'static str> {
    let found = ALL.iter().find(|metric| metric.name == name);
    found
        .copied()
        .ok_or("a metric that is not in the catalogue")
}

fn number(text: &str) -> Result<f64, &'static str> {
    if text == "+Inf" {
        return Ok(f64::INFINITY);
    }
    let allowed = |byte: u8| byte.is_ascii_digit() || b"+-.eE".contains(&byte);
    let value = text.bytes().all(allowed).then(|| text.parse().ok());
    value.flatten().ok_or("not a number")
}

/// `name{label="value",...} value`
fn sample(line: &str) -> Result<Sample, &'static str> {
    let end = line.find(['{', ' ']).ok_or("not a sample")?;
    let (name, mut rest) = line.split_at(end);
    let mut labels = Vec::new();
    if let Some(inner) = rest.strip_prefix('{') {
        rest = inner;
        loop {
            let (label, after) = rest.split_once("=\"").ok_or("a label without a value")?;
            let (value, after) = unescape(after)?;
            labels.push((label.to_owned(), value));
            if let Some(after) = after.strip_prefix(',') {
                rest = after;
            } else {
                rest = after.strip_prefix('}').ok_or("labels without an end")?;
                break;
            }
        }
    }
    let value = rest.strip_prefix(' ').ok_or("no space before the value")?;
    Ok(Sample {
        name: name.to_owned(),
        labels,
        value: number(value)?,
    })
}

/// A label's value up to its quote, and what follows that.
fn unescape(text: &str) -> Result<(String, &str), &'static str> {
    let mut value = String::new();
    let mut chars = text.char_indices();
    while let Some((index, char)) = chars.next() {
        match char {
            '"' => {
                let rest = text.get(index + 1..).unwrap_or_default();
                return Ok((value, rest));
            }
            '\\' => match chars.next() {
                Some((_, 'n')) => value.push('\n'),
                Some((_, char @ ('\\' | '"'))) => value.push(char),
                Some(_) | None => return Err("an escape that does not exist"),
            },
            char => value.push(char),
        }
    }
    Err("a label's value without an end")
}
