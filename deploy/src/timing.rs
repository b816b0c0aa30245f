//! What the timing files of a run say: order of reactions, order of pairs, end-to-end latency.

mod bounds;
mod report;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::{Path, PathBuf};

use ictus_coord::plan::Plan;
use serde::{Deserialize, Serialize};

pub use self::bounds::{
    BoundsReport, BoundsRow, FederateBounds, LinkSuggestion, Measure, Spread, Suggestion,
    bounds_report, suggest,
};
pub use self::report::{
    ChainReport, ChainRun, OrderReport, OrderRun, PairReport, PairsReport, Summary, TimingReport,
};
use crate::trace::{TraceTag, complete_lines, files};

/// What a run needs to settle: a steady figure leaves out this much logical time.
const STEADY_NS: i64 = 5_000_000_000;

/// What to report, resolved to reactor paths and reaction indices. Stored as `timing.json` beside the plan
/// of a run.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TimingSpec {
    /// Which of two reactions ran first at each tag.
    #[serde(default)]
    pub order: Vec<OrderSpec>,
    /// In which order several reactions ran between two ticks.
    #[serde(default)]
    pub pairs: Vec<PairsSpec>,
    /// Latency along chains.
    #[serde(default)]
    pub end_to_end: Vec<ChainSpec>,
}

impl TimingSpec {
    /// Whether nothing is asked.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.order.is_empty() && self.pairs.is_empty() && self.end_to_end.is_empty()
    }
}

/// A reaction, as trace and timing files name it.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReactionRef {
    /// The federate.
    pub federate: String,
    /// The reactor's path, with the federate's name first.
    pub path: String,
    /// The position in its reactor.
    pub index: u32,
    /// The method's name.
    pub name: String,
}

/// Which of two reactions ran first at each tag.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OrderSpec {
    /// The one expected first.
    pub first: ReactionRef,
    /// The one expected second.
    pub second: ReactionRef,
}

/// In which order several reactions ran between two ticks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PairsSpec {
    /// What the report calls it.
    pub name: String,
    /// The reaction whose executions divide the run into ticks.
    pub tick: ReactionRef,
    /// The reactions compared, pair by pair.
    pub reactions: Vec<ReactionRef>,
}

/// A chain: latency from the source's start to the last hop's end.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ChainSpec {
    /// What the report calls it.
    pub name: String,
    /// Where the chain starts, by a timer as a rule.
    pub source: ReactionRef,
    /// The hops after the source, in order; the last one's latest end is the chain's end.
    pub hops: Vec<HopSpec>,
}

/// One hop of a chain: the first execution of any of `reactions` at a tag not before the earlier hop's tag
/// plus the delay.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HopSpec {
    /// The reactions that count as this hop; at one tag, all that run are waited for.
    pub reactions: Vec<ReactionRef>,
    /// The least logical delay from the earlier hop, in nanoseconds.
    pub delay_ns: i64,
    /// Microsteps after that: of the earlier tag when `delay_ns` is 0, else of the later time.
    pub delay_microsteps: u32,
    /// The hop samples what the earlier one left behind: its tag must be strictly later.
    #[serde(default)]
    pub sampled: bool,
}

/// Why there is no report.
#[derive(Debug, thiserror::Error)]
pub enum TimingError {
    /// The directory or a file in it cannot be read.
    #[error("cannot read {path}", path = path.display())]
    Unreadable {
        /// The directory or file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// A line is not a timing record.
    #[error("{path}:{line}: not a timing record: {what}", path = path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// What is wrong with it.
        what: &'static str,
    },
    /// The manifest has no `timing`, so there is nothing to report.
    #[error("the manifest has no `timing`")]
    NothingAsked,
}

/// Reports on one run.
///
/// # Errors
/// When a timing file cannot be read or a line is no record, and when nothing is asked.
pub fn report(
    timing_dir: &Path,
    spec: &TimingSpec,
    plan: &Plan,
) -> Result<TimingReport, TimingError> {
    report_runs(&[timing_dir.to_path_buf()], spec, plan)
}

/// Reports on several runs of one federation: per run, and how far they drift apart.
///
/// # Errors
/// When a timing file cannot be read or a line is no record, and when nothing is asked.
pub fn report_runs(
    timing_dirs: &[PathBuf],
    spec: &TimingSpec,
    plan: &Plan,
) -> Result<TimingReport, TimingError> {
    if spec.is_empty() {
        return Err(TimingError::NothingAsked);
    }
    let mut runs = Vec::new();
    for dir in timing_dirs {
        runs.push(Run::read(dir, spec)?);
    }
    let timeout = plan.timeout_ns;
    let by_run = |chain: &ChainSpec| {
        runs.iter()
            .map(|run| chain_run(run, chain, timeout))
            .collect()
    };
    Ok(TimingReport {
        runs: runs.len(),
        order: spec
            .order
            .iter()
            .map(|order| OrderReport {
                first: order.first.to_string(),
                second: order.second.to_string(),
                runs: runs.iter().map(|run| order_run(run, order)).collect(),
            })
            .collect(),
        pairs: spec
            .pairs
            .iter()
            .map(|pairs| pairs_report(&runs, pairs))
            .collect(),
        end_to_end: spec
            .end_to_end
            .iter()
            .map(|chain| ChainReport::new(chain.name.clone(), by_run(chain)))
            .collect(),
    })
}

impl fmt::Display for ReactionRef {
    /// The name as the manifest writes it: `federate.reactor.reaction`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{}", self.path, self.name)
    }
}

/// One executed reaction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Execution {
    tag: TraceTag,
    /// Physical, in nanoseconds after the start tag's time.
    start: i64,
    end: i64,
}

/// The timing files of one run, as far as they are asked about.
#[derive(Debug, Default)]
struct Run {
    /// By path and index, in order of tags.
    executions: BTreeMap<(String, u32), Vec<Execution>>,
}

impl Run {
    fn read(dir: &Path, spec: &TimingSpec) -> Result<Self, TimingError> {
        let unreadable = |path: &Path| {
            let path = path.to_path_buf();
            move |source| TimingError::Unreadable { path, source }
        };
        let mut run = Self::asked(spec);
        for path in files(dir, "timing").map_err(unreadable(dir))? {
            let text = std::fs::read_to_string(&path).map_err(unreadable(&path))?;
            run.add(complete_lines(&text))
                .map_err(|(line, what)| TimingError::Malformed { path, line, what })?;
        }
        run.sort();
        Ok(run)
    }

    fn asked(spec: &TimingSpec) -> Self {
        let order = spec
            .order
            .iter()
            .flat_map(|order| [&order.first, &order.second]);
        let pairs = spec
            .pairs
            .iter()
            .flat_map(|pairs| pairs.reactions.iter().chain([&pairs.tick]));
        let chains = spec.end_to_end.iter().flat_map(|chain| {
            chain
                .hops
                .iter()
                .flat_map(|hop| &hop.reactions)
                .chain([&chain.source])
        });
        let keys = order.chain(pairs).chain(chains);
        let executions = keys
            .map(|one| ((one.path.clone(), one.index), Vec::new()))
            .collect();
        Self { executions }
    }

    fn add(&mut self, text: &str) -> Result<(), (usize, &'static str)> {
        for (index, line) in text.lines().enumerate() {
            if line.is_empty() || line.starts_with('#') {
                continue;
            }
            let wrong = |what| (index + 1, what);
            let mut fields = line.split('\t');
            let tag = TraceTag::parse(fields.next(), fields.next()).map_err(wrong)?;
            let path = fields.next().ok_or(wrong("no path"))?;
            let mut number = |what| {
                fields
                    .next()
                    .and_then(|field| field.parse::<i64>().ok())
                    .ok_or(wrong(what))
            };
            let (reaction, start, end) =
                (number("no index")?, number("no start")?, number("no end")?);
            let reaction = u32::try_from(reaction).map_err(|_| wrong("no index"))?;
            if let Some(known) = self.executions.get_mut(&(path.to_owned(), reaction)) {
                known.push(Execution { tag, start, end });
            }
        }
        Ok(())
    }

    fn sort(&mut self) {
        for executions in self.executions.values_mut() {
            executions.sort_by_key(|execution| execution.tag);
        }
    }

    fn of(&self, reaction: &ReactionRef) -> &[Execution] {
        let key = (reaction.path.clone(), reaction.index);
        self.executions.get(&key).map_or(&[], Vec::as_slice)
    }

    /// The first execution of a reaction at a tag from `tag` on.
    fn from(&self, reaction: &ReactionRef, tag: TraceTag) -> Option<Execution> {
        let all = self.of(reaction);
        all.get(all.partition_point(|execution| execution.tag < tag))
            .copied()
    }
}

fn order_run(run: &Run, order: &OrderSpec) -> OrderRun {
    let by_tag = |reaction: &ReactionRef| -> BTreeMap<TraceTag, i64> {
        run.of(reaction)
            .iter()
            .map(|execution| (execution.tag, execution.start))
            .collect()
    };
    let (first, second) = (by_tag(&order.first), by_tag(&order.second));
    let tags: BTreeSet<TraceTag> = first.keys().chain(second.keys()).copied().collect();
    let mut result = OrderRun {
        tags: tags.len(),
        ..OrderRun::default()
    };
    for tag in tags {
        match (first.get(&tag), second.get(&tag)) {
            (Some(first), Some(second)) if first <= second => result.first_first += 1,
            (Some(_), Some(_)) => result.second_first += 1,
            (Some(_), None) | (None, Some(_)) | (None, None) => result.missing += 1,
        }
    }
    result
}

/// One tick: when each of the compared reactions first ran in it, if it did.
#[derive(Clone, Debug, Default)]
struct Window {
    first: Vec<Option<(TraceTag, i64)>>,
}

/// For every pair of reactions, the share of ticks in which the one listed first ran first.
fn pairs_report(runs: &[Run], spec: &PairsSpec) -> PairsReport {
    let orders: Vec<Vec<Window>> = runs.iter().map(|run| windows(run, spec)).collect();
    let mut pairs = Vec::new();
    for (left, one) in spec.reactions.iter().enumerate() {
        for (right, other) in spec.reactions.iter().enumerate().skip(left + 1) {
            let percent = orders
                .iter()
                .map(|windows| share(windows, left, right))
                .collect();
            pairs.push(PairReport::new(one.to_string(), other.to_string(), percent));
        }
    }
    PairsReport {
        name: spec.name.clone(),
        ticks: orders.iter().map(Vec::len).collect(),
        drifting: pairs.iter().filter(|pair| pair.drift_points > 0.0).count(),
        flipped: pairs.iter().filter(|pair| pair.flipped).count(),
        pairs,
    }
}

/// For every tick, when each reaction first ran in it. A tick goes from one execution of the tick's reaction up
/// to the next one.
fn windows(run: &Run, spec: &PairsSpec) -> Vec<Window> {
    let ticks = run.of(&spec.tick);
    let windows = ticks.windows(2).map(|pair| {
        let [from, to] = pair else {
            return Window::default();
        };
        let first = |reaction: &ReactionRef| {
            let all = run.of(reaction);
            let begin = all.partition_point(|execution| execution.tag < from.tag);
            let inside = all
                .get(begin..)?
                .iter()
                .take_while(|execution| execution.tag <= to.tag);
            let mut inside = inside
                .filter(|execution| execution.start >= from.start && execution.start < to.start);
            inside
                .next()
                .map(|execution| (execution.tag, execution.start))
        };
        Window {
            first: spec.reactions.iter().map(first).collect(),
        }
    });
    windows.collect()
}

/// The percentage of ticks in which `left` ran before `right`, of those in which both ran.
fn share(windows: &[Window], left: usize, right: usize) -> Option<f64> {
    let mut both = 0_u32;
    let mut before = 0_u32;
    for window in windows {
        let (Some(Some(left)), Some(Some(right))) =
            (window.first.get(left), window.first.get(right))
        else {
            continue;
        };
        both += 1;
        before += u32::from(left <= right);
    }
    (both > 0).then(|| 100.0 * f64::from(before) / f64::from(both))
}

/// What one source execution led to.
enum Outcome {
    /// The chain's end: the last hop's tag and its latest end.
    Ended(TraceTag, i64),
    /// A hop did not run any more.
    Open,
}

fn chain_run(run: &Run, chain: &ChainSpec, timeout_ns: Option<i64>) -> ChainRun {
    let sources = run.of(&chain.source);
    let outcomes: Vec<Outcome> = sources
        .iter()
        .map(|source| follow(run, chain, source.tag))
        .collect();
    let sampled = chain.hops.iter().any(|hop| hop.sampled);
    let mut result = ChainRun {
        ticks: sources.len(),
        ..ChainRun::default()
    };
    let mut samples: Vec<(i64, i64)> = Vec::new();
    for (index, (source, outcome)) in sources.iter().zip(&outcomes).enumerate() {
        match outcome {
            Outcome::Ended(tag, end) => {
                // Without sampling, two source tags cannot share an end: the first one's was left out.
                let shared =
                    matches!(outcomes.get(index + 1), Some(Outcome::Ended(next, _)) if next == tag);
                if shared && !sampled {
                    result.missing += 1;
                } else {
                    samples.push((source.tag.time_ns, end.saturating_sub(source.start)));
                }
            }
            Outcome::Open => {
                let due = due(chain, source.tag);
                let inside = |timeout| {
                    due <= TraceTag {
                        time_ns: timeout,
                        microstep: 0,
                    }
                };
                if !sampled && timeout_ns.is_some_and(inside) {
                    result.missing += 1;
                } else {
                    result.unfinished += 1;
                }
            }
        }
    }
    let floor: Vec<(i64, i64)> = sources
        .iter()
        .map(|source| {
            (
                source.tag.time_ns,
                source.start.saturating_sub(source.tag.time_ns),
            )
        })
        .collect();
    let steady = |samples: &[(i64, i64)]| {
        Summary::of(
            samples
                .iter()
                .filter(|(time, _)| *time >= STEADY_NS)
                .map(|(_, value)| *value),
        )
    };
    result.full = Summary::of(samples.iter().map(|(_, value)| *value));
    result.steady = steady(&samples);
    result.floor = Summary::of(floor.iter().map(|(_, value)| *value));
    result.steady_floor = steady(&floor);
    result
}

/// Follows one source tag through the hops.
fn follow(run: &Run, chain: &ChainSpec, source: TraceTag) -> Outcome {
    let mut tag = source;
    let mut end = i64::MIN;
    for hop in &chain.hops {
        let mut earliest = later(tag, hop);
        if hop.sampled {
            earliest = earliest.max(TraceTag {
                microstep: tag.microstep.saturating_add(1),
                ..tag
            });
        }
        let found: Vec<Execution> = hop
            .reactions
            .iter()
            .filter_map(|reaction| run.from(reaction, earliest))
            .collect();
        let Some(first) = found.iter().map(|execution| execution.tag).min() else {
            return Outcome::Open;
        };
        tag = first;
        let ends = found
            .iter()
            .filter(|execution| execution.tag == first)
            .map(|one| one.end);
        end = ends.max().unwrap_or(end);
    }
    Outcome::Ended(tag, end)
}

/// The earliest tag at which a chain that starts at `source` can end.
fn due(chain: &ChainSpec, source: TraceTag) -> TraceTag {
    chain.hops.iter().fold(source, later)
}

/// A tag plus a hop's least delay.
fn later(tag: TraceTag, hop: &HopSpec) -> TraceTag {
    if hop.delay_ns > 0 {
        let time_ns = tag.time_ns.saturating_add(hop.delay_ns);
        TraceTag {
            time_ns,
            microstep: hop.delay_microsteps,
        }
    } else {
        TraceTag {
            microstep: tag.microstep.saturating_add(hop.delay_microsteps),
            ..tag
        }
    }
}
