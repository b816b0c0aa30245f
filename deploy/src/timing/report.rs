//! What is found in timing files, as data and as a page to read.

use std::fmt;

use serde::Serialize;

/// What was found, over one or several runs.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct TimingReport {
    /// How many runs were read.
    pub runs: usize,
    /// Which of two reactions ran first.
    pub order: Vec<OrderReport>,
    /// In which order reactions ran between two ticks.
    pub pairs: Vec<PairsReport>,
    /// Latency along chains.
    pub end_to_end: Vec<ChainReport>,
}

/// Which of two reactions ran first at each tag.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct OrderReport {
    /// The reaction expected first.
    pub first: String,
    /// The reaction expected second.
    pub second: String,
    /// One per run.
    pub runs: Vec<OrderRun>,
}

/// The order of two reactions in one run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct OrderRun {
    /// Tags at which at least one ran.
    pub tags: usize,
    /// Tags at which the first ran first.
    pub first_first: usize,
    /// Tags at which the second ran first.
    pub second_first: usize,
    /// Tags at which one of them did not run.
    pub missing: usize,
}

/// In which order reactions ran between two ticks, pair by pair.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct PairsReport {
    /// The manifest's name of the report.
    pub name: String,
    /// Ticks per run.
    pub ticks: Vec<usize>,
    /// Every pair.
    pub pairs: Vec<PairReport>,
    /// Pairs whose percentage is not the same in every run.
    pub drifting: usize,
    /// Pairs whose dominant order is not the same in every run.
    pub flipped: usize,
}

/// The order of one pair.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct PairReport {
    /// The reaction listed first.
    pub one: String,
    /// The reaction listed second.
    pub other: String,
    /// Per run, the percentage of ticks in which `one` ran first, of those in which both ran; absent when they
    /// never did.
    pub percent: Vec<Option<f64>>,
    /// The largest difference between two runs, in percentage points.
    pub drift_points: f64,
    /// Whether `one` was mostly first in one run and mostly second in another.
    pub flipped: bool,
}

impl PairReport {
    pub(super) fn new(one: String, other: String, percent: Vec<Option<f64>>) -> Self {
        let known = || percent.iter().flatten().copied();
        let (least, most) = (known().fold(100.0, f64::min), known().fold(0.0, f64::max));
        let flipped = least < 50.0 && most > 50.0;
        Self {
            one,
            other,
            drift_points: (most - least).max(0.0),
            flipped,
            percent,
        }
    }
}

/// Latency along a chain.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ChainReport {
    /// The manifest's name of the chain.
    pub name: String,
    /// One per run.
    pub runs: Vec<ChainRun>,
    /// The least and the largest median of the runs in milliseconds, steady where there is one; absent when no
    /// chain ended.
    pub medians_ms: Option<(f64, f64)>,
}

impl ChainReport {
    pub(super) fn new(name: String, runs: Vec<ChainRun>) -> Self {
        let medians = || {
            runs.iter()
                .filter_map(|run| run.steady.or(run.full))
                .map(|s| s.p50_ms)
        };
        let least = medians().min_by(f64::total_cmp);
        let medians_ms = least.zip(medians().max_by(f64::total_cmp));
        Self {
            name,
            runs,
            medians_ms,
        }
    }
}

/// Latency along a chain in one run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct ChainRun {
    /// Executions of the source.
    pub ticks: usize,
    /// Executions of the source whose chain did not end although it had to.
    pub missing: usize,
    /// Executions of the source that were too late in the run for their chain to end.
    pub unfinished: usize,
    /// Source's start to chain's end, the whole run; absent when no chain ended.
    pub full: Option<Summary>,
    /// The same without the first five seconds.
    pub steady: Option<Summary>,
    /// The jitter of the source's timer: its physical start minus its tag's time. What no runtime can undercut.
    pub floor: Option<Summary>,
    /// The same without the first five seconds.
    pub steady_floor: Option<Summary>,
}

/// A distribution in milliseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Summary {
    /// How many samples.
    pub count: usize,
    /// The mean.
    pub mean_ms: f64,
    /// The sample standard deviation.
    pub std_ms: f64,
    /// The median.
    pub p50_ms: f64,
    /// The 99th percentile: the least sample that 99 % do not exceed.
    pub p99_ms: f64,
    /// The largest.
    pub max_ms: f64,
}

impl Summary {
    /// Of samples in nanoseconds; absent when there is none.
    pub(super) fn of(samples: impl Iterator<Item = i64>) -> Option<Self> {
        let mut samples: Vec<f64> = samples.map(|nanos| nanos as f64 / 1e6).collect();
        samples.sort_by(f64::total_cmp);
        let max_ms = *samples.last()?;
        let count = samples.len();
        let mean_ms = samples.iter().sum::<f64>() / count as f64;
        let squares: f64 = samples
            .iter()
            .map(|sample| (sample - mean_ms).powi(2))
            .sum();
        let std_ms = if count > 1 {
            (squares / (count - 1) as f64).sqrt()
        } else {
            0.0
        };
        let at = |percent: usize| {
            let rank = (count * percent).div_ceil(100).max(1) - 1;
            samples.get(rank).copied().unwrap_or(max_ms)
        };
        Some(Self {
            count,
            mean_ms,
            std_ms,
            p50_ms: at(50),
            p99_ms: at(99),
            max_ms,
        })
    }
}

impl fmt::Display for TimingReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let sections = self
            .order
            .iter()
            .map(ToString::to_string)
            .chain(self.pairs.iter().map(ToString::to_string))
            .chain(self.end_to_end.iter().map(ToString::to_string));
        write!(f, "{}", sections.collect::<Vec<_>>().join("\n\n"))
    }
}

impl fmt::Display for OrderReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "order at each tag: {} before {}",
            self.first, self.second
        )?;
        for (number, run) in self.runs.iter().enumerate() {
            let percent = 100.0 * run.first_first as f64 / (run.tags.max(1)) as f64;
            let OrderRun {
                tags,
                first_first: _,
                second_first,
                missing,
            } = run;
            write!(
                f,
                "\n  {}{percent:.1} % of {tags} tags, {second_first} the other way, {missing} missing",
                run_name(self.runs.len(), number)
            )?;
        }
        Ok(())
    }
}

impl fmt::Display for PairsReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ticks: Vec<String> = self.ticks.iter().map(ToString::to_string).collect();
        write!(
            f,
            "order of pairs: {} ({} ticks)",
            self.name,
            ticks.join(", ")
        )?;
        let wide = |name: fn(&PairReport) -> &str| {
            self.pairs
                .iter()
                .map(|pair| name(pair).chars().count())
                .max()
                .unwrap_or(0)
        };
        let (one, other) = (wide(|pair| &pair.one), wide(|pair| &pair.other));
        for pair in &self.pairs {
            write!(f, "\n  {:one$} before {:other$} ", pair.one, pair.other)?;
            for percent in &pair.percent {
                match percent {
                    Some(percent) => write!(f, " {percent:5.1} %")?,
                    None => write!(f, "       -")?,
                }
            }
            if pair.percent.len() > 1 {
                write!(f, "  drift {:.1}", pair.drift_points)?;
            }
        }
        if self.ticks.len() > 1 {
            let (drifting, flipped, all) = (self.drifting, self.flipped, self.pairs.len());
            write!(f, "\n  {drifting} of {all} pairs drift, {flipped} flip")?;
        }
        Ok(())
    }
}

impl fmt::Display for ChainReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "end to end: {}", self.name)?;
        let head = ["mean", "std", "p50", "p99", "max"]
            .map(|word| format!("{word:>9}"))
            .concat();
        write!(f, "\n  {:28}{:>7}{head}  ms", "", "n")?;
        for (number, run) in self.runs.iter().enumerate() {
            let name = run_name(self.runs.len(), number);
            row(f, &format!("{name}end to end"), run.full)?;
            row(f, &format!("{name}timer floor"), run.floor)?;
            if run.steady.is_some() {
                row(f, &format!("{name}end to end from 5 s"), run.steady)?;
                row(f, &format!("{name}timer floor from 5 s"), run.steady_floor)?;
            }
            let ChainRun {
                ticks,
                missing,
                unfinished,
                ..
            } = run;
            write!(
                f,
                "\n  {name}{ticks} ticks, {missing} missing, {unfinished} cut by the end"
            )?;
        }
        if let (Some((least, most)), true) = (self.medians_ms, self.runs.len() > 1) {
            write!(f, "\n  medians of the runs: {least:.3} to {most:.3} ms")?;
        }
        Ok(())
    }
}

fn row(f: &mut fmt::Formatter<'_>, name: &str, summary: Option<Summary>) -> fmt::Result {
    let Some(Summary {
        count,
        mean_ms,
        std_ms,
        p50_ms,
        p99_ms,
        max_ms,
    }) = summary
    else {
        return write!(f, "\n  {name:28}{:>7}", 0);
    };
    let figures = [mean_ms, std_ms, p50_ms, p99_ms, max_ms].map(|figure| format!("{figure:9.3}"));
    write!(f, "\n  {name:28}{count:7}{}", figures.concat())
}

/// What stands before a run's line, when there are several.
fn run_name(runs: usize, number: usize) -> String {
    if runs > 1 {
        format!("run {}: ", number + 1)
    } else {
        String::new()
    }
}
