//! Declared bounds beside measured ones, for a federation under decentralized coordination.

use std::collections::BTreeMap;
use std::fmt;

use ictus_coord::measure::{Histogram, Upstream};
use ictus_coord::plan::{Bounds, ConnectionPlan, Coordination, Plan};
use ictus_coord::report::{FederateMeasures, FederationMeasures};
use ictus_coord::stp::{self, Link};
use serde::Serialize;

use crate::offsets::tenths;

/// What every federate was promised, what was measured, and what is left.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct BoundsReport {
    /// In the plan's order.
    pub federates: Vec<FederateBounds>,
}

/// One federate: its offset, and a row for every bound of what it sends and receives.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct FederateBounds {
    /// The federate.
    pub federate: String,
    /// S, in nanoseconds.
    pub offset_ns: i64,
    /// The S that the declared bounds require; absent when not all are declared.
    pub required_ns: Option<i64>,
    /// Messages that came too late.
    pub violations: u64,
    /// E of its clock alone, in nanoseconds; absent when it has said none.
    pub clock_bound_ns: Option<i64>,
    /// First what it sends, then what it receives.
    pub rows: Vec<BoundsRow>,
}

/// One bound of the messages between two federates.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct BoundsRow {
    /// What is bounded.
    pub what: Measure,
    /// The federate at the other end.
    pub peer: String,
    /// What is declared, in nanoseconds; absent when nothing is.
    pub declared_ns: Option<i64>,
    /// What was measured; absent when nothing was.
    pub measured: Option<Spread>,
    /// By how much the two clocks may falsify the measured figures, in nanoseconds, as far as it is known.
    pub band_ns: Option<i64>,
    /// Declared less the largest measured, in nanoseconds; negative when the bound was broken; absent for an estimate.
    pub margin_ns: Option<i64>,
    /// S of the sender, from whose end arrivals are measured, in nanoseconds; absent when it is 0 and for other rows.
    pub sender_offset_ns: Option<i64>,
}

/// What a row is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Measure {
    /// L at the sender: from a tag's beginning, or the end of its offset if that is earlier, to the departure.
    LaunchLag,
    /// O at the receiver: how long after its tag's time a message came.
    Offset,
    /// How long before it would have been too late; smallest last.
    Slack,
    /// How much too late.
    Lateness,
    /// L + N at the receiver, by both clocks, from the end of the sender's offset.
    Arrival,
    /// N: the arrivals less the sender's median L.
    Latency,
    /// E: the bounds of both clocks together.
    ClockError,
}

/// Figures in nanoseconds, each on the side that is not optimistic: slack is rounded down, everything else up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Spread {
    /// How many were measured.
    pub count: u64,
    /// Half of them are at most this.
    pub p50_ns: i64,
    /// 99 of 100 are at most this.
    pub p99_ns: i64,
    /// The largest; of slack, the smallest.
    pub max_ns: i64,
}

/// Bounds made of measured ones, for a manifest. Its `Display` is the manifest's section `bounds`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Suggestion {
    /// What was added to the largest measured values, in percent.
    pub margin_percent: u32,
    /// By sender and receiver, in the order of the plan's connections.
    pub links: Vec<LinkSuggestion>,
}

/// Bounds between two federates, in nanoseconds; absent what was not measured.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct LinkSuggestion {
    /// The sender.
    pub from: String,
    /// The receiver.
    pub to: String,
    /// Messages received.
    pub messages: u64,
    /// L.
    pub launch_lag_ns: Option<i64>,
    /// N.
    pub latency_ns: Option<i64>,
    /// E.
    pub clock_error_ns: Option<i64>,
    /// What the plan declares, in place of what was not measured; absent when nothing is.
    pub declared: Option<Bounds>,
}

/// Puts what a plan declares beside what was measured. Absent under centralized coordination, where nothing waits for
/// an offset.
#[must_use]
pub fn bounds_report(plan: &Plan, measures: &FederationMeasures) -> Option<BoundsReport> {
    (plan.coordination == Coordination::Decentralized).then(|| {
        let survey = Survey::new(plan, measures);
        let federates = (0_u16..).zip(&plan.federates);
        BoundsReport {
            federates: federates.map(|(id, _)| survey.federate(id)).collect(),
        }
    })
}

/// Bounds that would have held, with a margin: the largest measured value and `margin_percent` of it, rounded up to
/// 10 us. L + N of a link is kept as a whole; N is what is left of it beside L.
#[must_use]
pub fn suggest(plan: &Plan, measures: &FederationMeasures, margin_percent: u32) -> Suggestion {
    let survey = Survey::new(plan, measures);
    Suggestion {
        margin_percent,
        links: survey
            .pairs
            .iter()
            .map(|pair| survey.suggest(pair, margin_percent))
            .collect(),
    }
}

/// All connections from one federate to another that carry tags.
#[derive(Debug)]
struct Pair<'a> {
    from: u16,
    to: u16,
    wires: Vec<&'a ConnectionPlan>,
}

#[derive(Debug)]
struct Survey<'a> {
    plan: &'a Plan,
    measures: BTreeMap<&'a str, &'a FederateMeasures>,
    pairs: Vec<Pair<'a>>,
    /// S by federate, as the declared bounds require it, given what the senders wait.
    required: Vec<Option<i64>>,
}

impl<'a> Survey<'a> {
    fn new(plan: &'a Plan, measures: &'a FederationMeasures) -> Self {
        let mut pairs: Vec<Pair<'a>> = Vec::new();
        for wire in plan
            .connections
            .iter()
            .filter(|wire| Link::of(wire).is_some())
        {
            let (from, to) = (wire.from.federate, wire.to.federate);
            match pairs
                .iter_mut()
                .find(|pair| (pair.from, pair.to) == (from, to))
            {
                Some(pair) => pair.wires.push(wire),
                None => pairs.push(Pair {
                    from,
                    to,
                    wires: vec![wire],
                }),
            }
        }
        let all = measures.federates.iter();
        Self {
            plan,
            measures: all.map(|one| (one.federate.as_str(), one)).collect(),
            pairs,
            required: required(plan),
        }
    }

    fn name(&self, id: u16) -> &'a str {
        let federate = self.plan.federates.get(usize::from(id));
        federate.map_or("", |federate| federate.name.as_str())
    }

    fn offset(&self, id: u16) -> i64 {
        let federate = self.plan.federates.get(usize::from(id));
        federate.map_or(0, |federate| federate.stp_offset_ns)
    }

    fn of(&self, id: u16) -> Option<&'a FederateMeasures> {
        self.measures.get(self.name(id)).copied()
    }

    fn clock_bound(&self, id: u16) -> Option<i64> {
        self.of(id)?.clock.as_ref()?.bound_ns
    }

    /// E of a pair: both clocks' bounds.
    fn band(&self, pair: &Pair<'_>) -> Option<i64> {
        let one = self.clock_bound(pair.from)?;
        Some(one.saturating_add(self.clock_bound(pair.to)?))
    }

    /// The longest that the receiver waits for a message of a pair.
    fn wait(&self, pair: &Pair<'_>) -> i64 {
        let own = |wire: &&ConnectionPlan| wire.stp_offset_ns.unwrap_or(self.offset(pair.to));
        let waits = pair.wires.iter().map(own);
        waits.max().unwrap_or(0).max(0)
    }

    fn federate(&self, id: u16) -> FederateBounds {
        let known = self.of(id);
        let violations = known.map_or(0, |known| {
            let each = known.upstreams.values().map(|peer| peer.stp_violations);
            each.fold(0, u64::saturating_add)
        });
        let sent = self.pairs.iter().filter(|pair| pair.from == id);
        let received = self.pairs.iter().filter(|pair| pair.to == id);
        FederateBounds {
            federate: self.name(id).to_owned(),
            offset_ns: self.offset(id),
            required_ns: self.required.get(usize::from(id)).copied().flatten(),
            violations,
            clock_bound_ns: self.clock_bound(id),
            rows: sent
                .map(|pair| self.sent(pair))
                .chain(received.flat_map(|pair| self.received(pair)))
                .collect(),
        }
    }

    fn launch_lag(&self, pair: &Pair<'_>) -> Option<&'a Histogram> {
        let peer = self.of(pair.from)?.downstreams.get(self.name(pair.to))?;
        (!peer.launch_lag.is_empty()).then_some(&peer.launch_lag)
    }

    fn sent(&self, pair: &Pair<'_>) -> BoundsRow {
        let declared = declared(pair).map(|bounds| bounds.launch_lag_ns);
        let measured = self.launch_lag(pair).and_then(Spread::of);
        BoundsRow::new(Measure::LaunchLag, self.name(pair.to), declared, measured)
    }

    fn received(&self, pair: &Pair<'_>) -> Vec<BoundsRow> {
        let name = self.name(pair.from);
        let upstream = self.of(pair.to).and_then(|known| known.upstreams.get(name));
        let (bounds, band) = (declared(pair), self.band(pair));
        let wait = self.wait(pair);
        let after = pair.wires.iter().map(|wire| wire.after_ns.unwrap_or(0));
        let base = self.offset(pair.from) - after.min().unwrap_or(0);
        let needed = upstream.and_then(|it| needed(wait, base, it));
        let slack = upstream.and_then(|it| {
            let at = |q: f64| it.slack.quantile_floor(q).as_nanos();
            (!it.slack.is_empty()).then(|| Spread {
                count: it.slack.count(),
                p50_ns: at(0.5),
                p99_ns: at(0.01),
                max_ns: it.slack.min().as_nanos(),
            })
        });
        let lateness = upstream.and_then(|it| Spread::of(&it.lateness));
        let arrival = upstream.and_then(|it| Spread::of(&it.arrival));
        let lag = self.launch_lag(pair).and_then(Spread::of);
        let latency = arrival.zip(lag).map(|(arrival, lag)| {
            let less = |ns: i64| ns.saturating_sub(lag.p50_ns).max(0);
            Spread {
                count: arrival.count,
                p50_ns: less(arrival.p50_ns),
                p99_ns: less(arrival.p99_ns),
                max_ns: less(arrival.max_ns),
            }
        });
        let error = band.map(|ns| Spread {
            count: 1,
            p50_ns: ns,
            p99_ns: ns,
            max_ns: ns,
        });
        let of = |term: fn(Bounds) -> i64| bounds.map(term);
        let sum = of(|it| it.launch_lag_ns.saturating_add(it.latency_ns));
        let banded = |row: BoundsRow| BoundsRow {
            band_ns: band,
            ..row
        };
        let mut rows = vec![
            BoundsRow::new(Measure::Offset, name, Some(wait), needed),
            BoundsRow::new(Measure::Slack, name, None, slack),
        ];
        if lateness.is_some() {
            rows.push(BoundsRow::new(Measure::Lateness, name, None, lateness));
        }
        rows.extend([
            BoundsRow {
                sender_offset_ns: Some(self.offset(pair.from)).filter(|ns| *ns > 0),
                ..banded(BoundsRow::new(Measure::Arrival, name, sum, arrival))
            },
            // The largest arrival less the median L may exceed N although N was kept: no margin.
            BoundsRow {
                margin_ns: None,
                ..banded(BoundsRow::new(
                    Measure::Latency,
                    name,
                    of(|it| it.latency_ns),
                    latency,
                ))
            },
            BoundsRow::new(Measure::ClockError, name, of(|it| it.clock_error_ns), error),
        ]);
        rows
    }

    fn suggest(&self, pair: &Pair<'_>, margin_percent: u32) -> LinkSuggestion {
        let (from, to) = (self.name(pair.from), self.name(pair.to));
        let upstream = self.of(pair.to).and_then(|known| known.upstreams.get(from));
        let grown = |ns: i64| rounded_up(ns, margin_percent);
        let launch_lag_ns = self.launch_lag(pair).map(|lag| grown(lag.max().as_nanos()));
        // A message that came too late left later than the tag's time by all that the receiver waited, and more.
        let late = upstream.filter(|it| !it.lateness.is_empty()).map(|it| {
            let after = pair
                .wires
                .iter()
                .map(|wire| wire.after_ns.unwrap_or(0))
                .max();
            it.lateness
                .max()
                .as_nanos()
                .saturating_add(self.wait(pair))
                .saturating_add(after.unwrap_or(0))
                .saturating_sub(self.offset(pair.from))
        });
        // One that came before its sender had waited its offset tells nothing of the network.
        let arrival = upstream.map(|it| it.arrival.max().as_nanos());
        let arrival = arrival.into_iter().chain(late).max().filter(|ns| *ns > 0);
        let latency_ns = arrival.map(|ns| (grown(ns) - launch_lag_ns.unwrap_or(0)).max(0));
        LinkSuggestion {
            from: from.to_owned(),
            to: to.to_owned(),
            messages: upstream.map_or(0, |it| it.messages),
            launch_lag_ns,
            latency_ns,
            clock_error_ns: self.band(pair).map(|ns| rounded_up(ns, 0)),
            declared: declared(pair),
        }
    }
}

/// S by federate, as the declared bounds require it, given what the senders wait.
fn required(plan: &Plan) -> Vec<Option<i64>> {
    let used = plan.federates.iter().map(|one| Some(one.stp_offset_ns));
    let links: Vec<Link> = plan.connections.iter().filter_map(Link::of).collect();
    let solution = stp::solve(&links, &used.collect::<Vec<_>>()).unwrap_or_default();
    let federates = solution.federates.iter();
    federates.map(|offset| offset.required_ns).collect()
}

/// The largest bounds of a pair's connections; absent when one has none.
fn declared(pair: &Pair<'_>) -> Option<Bounds> {
    let mut wires = pair.wires.iter().map(|wire| wire.bounds);
    let first = wires.next()??;
    wires.try_fold(first, |largest, bounds| {
        let bounds = bounds?;
        Some(Bounds {
            launch_lag_ns: largest.launch_lag_ns.max(bounds.launch_lag_ns),
            latency_ns: largest.latency_ns.max(bounds.latency_ns),
            clock_error_ns: largest.clock_error_ns.max(bounds.clock_error_ns),
        })
    })
}

/// How long after their tags' times messages came, when the receiver waits so long: `wait` less the slack of those in time,
/// `wait` and the lateness of the others; never less than was needed. The buckets of slack are wide where the wait is long, so
/// its quantiles give way to those of the arrivals, from `base` on, which are as sure. They also tell how late one was
/// that came after the wait but harmed nobody: its slack is 0. An arrival of 0 tells nothing: it may have come before `base`.
#[expect(
    clippy::cast_precision_loss,
    reason = "a share of counts; 2^53 messages are out of reach"
)]
fn needed(wait: i64, base: i64, upstream: &Upstream) -> Option<Spread> {
    let Upstream {
        slack,
        lateness,
        arrival,
        ..
    } = upstream;
    let (early, late) = (slack.count(), lateness.count());
    let count = early.saturating_add(late);
    if count == 0 {
        return None;
    }
    let by_arrival = |share: f64| {
        let span = arrival.quantile(share).as_nanos();
        (span > 0).then(|| base.saturating_add(span))
    };
    let in_time = |share: f64| {
        let at_least = wait.saturating_sub(slack.quantile(1.0 - share).as_nanos());
        let at_most = wait.saturating_sub(slack.quantile_floor(1.0 - share).as_nanos());
        by_arrival(share)
            .filter(|ns| *ns >= at_least)
            .unwrap_or(at_most)
    };
    let at = |q: f64| {
        let rank = q * count as f64;
        if rank <= early as f64 {
            in_time(rank / early as f64)
        } else {
            let share = (rank - early as f64) / late as f64;
            wait.saturating_add(lateness.quantile(share).as_nanos())
        }
    };
    // Least slack, greatest lateness and greatest arrival are exact.
    let least = (early > 0).then(|| wait.saturating_sub(slack.min().as_nanos()));
    let most = (late > 0).then(|| wait.saturating_add(lateness.max().as_nanos()));
    let p50_ns = at(0.5);
    let p99_ns = at(0.99).max(p50_ns);
    let max_ns = least.into_iter().chain(most).chain(by_arrival(1.0)).max();
    Some(Spread {
        count,
        p50_ns,
        p99_ns,
        max_ns: max_ns.map_or(p99_ns, |ns| ns.max(p99_ns)),
    })
}

/// `ns` and so many percent of it, rounded up to 10 us.
fn rounded_up(ns: i64, percent: u32) -> i64 {
    const STEP: i128 = 10_000;
    let grown = i128::from(ns.max(0)) * i128::from(100 + u64::from(percent));
    let steps = grown.div_euclid(100 * STEP) + i128::from(grown.rem_euclid(100 * STEP) > 0);
    i64::try_from(steps * STEP).unwrap_or(i64::MAX)
}

impl Spread {
    fn of(histogram: &Histogram) -> Option<Self> {
        (!histogram.is_empty()).then(|| Self {
            count: histogram.count(),
            p50_ns: histogram.quantile(0.5).as_nanos(),
            p99_ns: histogram.quantile(0.99).as_nanos(),
            max_ns: histogram.max().as_nanos(),
        })
    }
}

impl BoundsRow {
    fn new(what: Measure, peer: &str, declared_ns: Option<i64>, measured: Option<Spread>) -> Self {
        let margin = declared_ns.zip(measured);
        Self {
            what,
            peer: peer.to_owned(),
            declared_ns,
            measured,
            band_ns: None,
            margin_ns: margin.map(|(declared, spread)| declared.saturating_sub(spread.max_ns)),
            sender_offset_ns: None,
        }
    }
}

impl fmt::Display for BoundsReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let rows = self.federates.iter().flat_map(|one| &one.rows);
        let wide = rows
            .map(|row| row.label().chars().count())
            .max()
            .unwrap_or(0);
        let head = ["declared", "p50", "p99", "max", "margin"].map(column);
        write!(f, "{:wide$}  {} {:>8}", "bounds, in ms", head.concat(), "n")?;
        for federate in &self.federates {
            write!(f, "\n{federate}")?;
            for row in &federate.rows {
                let line = format!("  {:wide$}{}", row.label(), row.cells());
                write!(f, "\n{}", line.trim_end())?;
            }
        }
        Ok(())
    }
}

impl fmt::Display for FederateBounds {
    /// The federate's own line, without its rows.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (name, offset) = (&self.federate, tenths(self.offset_ns));
        write!(f, "{name}: S {offset}")?;
        if let Some(required) = self.required_ns {
            write!(f, ", required {}", tenths(required))?;
        }
        match self.clock_bound_ns {
            Some(bound) => write!(f, "; E {}", at_most(bound))?,
            None => write!(f, "; E unknown")?,
        }
        write!(f, "; violations {}", self.violations)
    }
}

impl BoundsRow {
    /// What the row is about, for people.
    fn label(&self) -> String {
        let peer = &self.peer;
        let band = self
            .band_ns
            .map_or(String::new(), |ns| format!(" (+-{})", at_most(ns)));
        match self.what {
            Measure::LaunchLag => format!("L to {peer}"),
            Measure::Offset => format!("S for {peer}"),
            Measure::Slack => format!("slack of {peer} (p50, p1, least)"),
            Measure::Lateness => format!("too late from {peer}"),
            Measure::Arrival if self.sender_offset_ns.is_some() => {
                format!("L+N after S of {peer}{band}")
            }
            Measure::Arrival => format!("L+N from {peer}{band}"),
            Measure::Latency => format!("N from {peer}, estimate"),
            Measure::ClockError => format!("E with {peer}"),
        }
    }

    /// The figures, each in its column.
    fn cells(&self) -> String {
        let measured: fn(i64) -> String = match self.what {
            Measure::Slack => at_least,
            Measure::LaunchLag
            | Measure::Offset
            | Measure::Lateness
            | Measure::Arrival
            | Measure::Latency
            | Measure::ClockError => at_most,
        };
        let cell = |ns: Option<i64>, text: fn(i64) -> String| ns.map_or("-".to_owned(), text);
        let of = |figure: fn(Spread) -> i64| cell(self.measured.map(figure), measured);
        let cells = [
            cell(self.declared_ns, at_least),
            of(|it| it.p50_ns),
            of(|it| it.p99_ns),
            of(|it| it.max_ns),
            cell(self.margin_ns, at_least),
        ];
        let count = match (self.what, self.measured) {
            (Measure::ClockError, _) => String::new(),
            (_, spread) => spread.map_or(0, |it| it.count).to_string(),
        };
        let cells = cells.each_ref().map(|cell| column(cell));
        format!("{} {count:>8}", cells.concat())
    }
}

/// A cell, never without a space before it.
fn column(cell: &str) -> String {
    format!(" {cell:>9}")
}

/// Milliseconds with three decimals, rounded down.
fn at_least(ns: i64) -> String {
    let micros = ns.div_euclid(1_000);
    let sign = if micros < 0 { "-" } else { "" };
    let micros = micros.unsigned_abs();
    format!("{sign}{}.{:03}", micros / 1_000, micros % 1_000)
}

/// Milliseconds with three decimals, rounded up.
fn at_most(ns: i64) -> String {
    at_least(ns.saturating_add(999))
}

impl Suggestion {
    /// The largest of a bound over all links that have it.
    fn general(&self, term: fn(&LinkSuggestion) -> Option<i64>) -> Option<i64> {
        self.links.iter().filter_map(term).max()
    }

    /// Whether nothing was measured.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        let terms = |one: &LinkSuggestion| one.launch_lag_ns.or(one.latency_ns);
        self.general(terms).is_none()
    }
}

/// A bound's name in the manifest, where a link has it, and where declared bounds have it.
type Term = (
    &'static str,
    fn(&LinkSuggestion) -> Option<i64>,
    fn(Bounds) -> i64,
);

/// The bounds in the manifest's order.
const TERMS: [Term; 3] = [
    ("launch_lag", |one| one.launch_lag_ns, |it| it.launch_lag_ns),
    ("latency", |one| one.latency_ns, |it| it.latency_ns),
    (
        "clock_error",
        |one| one.clock_error_ns,
        |it| it.clock_error_ns,
    ),
];

impl fmt::Display for Suggestion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let span = |ns: i64| match ns {
            0 => "0 s".to_owned(),
            ns => format!("{} ms", stp::milliseconds(ns)),
        };
        let margin = self.margin_percent;
        write!(
            f,
            "# The largest measured values and {margin} % more.\nbounds:"
        )?;
        for (name, term, declared) in TERMS {
            let promised = self
                .links
                .iter()
                .filter_map(|link| link.declared.map(declared));
            match (self.general(term), promised.max()) {
                (Some(ns), _) => write!(f, "\n  {name}: {}", span(ns))?,
                (None, Some(ns)) => {
                    write!(f, "\n  {name}: {}   # declared, not measured", span(ns))?;
                }
                (None, None) => write!(f, "\n  {name}: 0 s   # not measured")?,
            }
        }
        write!(f, "\n  links:")?;
        for link in &self.links {
            let terms = TERMS.iter().filter_map(|(name, term, _)| {
                let ns = term(link)?;
                Some(format!("{name}: {}", span(ns)))
            });
            let terms: Vec<String> = terms.collect();
            let LinkSuggestion {
                from, to, messages, ..
            } = link;
            let terms = terms.join(", ");
            write!(
                f,
                "\n    {from} -> {to}: {{ {terms} }} # {messages} messages"
            )?;
        }
        Ok(())
    }
}
