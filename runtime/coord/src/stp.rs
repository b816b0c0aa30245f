//! The solver of STP offsets: how long after a tag's time a federate waits, so that every message that keeps
//! its bounds is there.
//!
//! Along a link from i to j a message is, by the clock of j, at most `D_i + L + N + E - α` behind its tag, where
//! `D_i` is when i has decided all its inputs at the latest, L how long it then takes until the message leaves,
//! N the network's latency, E the clocks' error and α the link's `after`. That is the link's requirement; the
//! greatest of a federate's, and at least 0, is its offset S. `D_j` is the greatest offset that j uses plus that
//! link's `absent_after`; without one, D = S, and the system is `S = (Xᵀ)* 0` in max-plus.
//!
//! Source: Xronos paper, section IV-B.2. Physical connections take no part: they have no tag to be late for.

use std::fmt;

use crate::plan::{Bounds, ConnectionPlan};
use crate::topology::FederateId;

/// A connection between two federates, as far as the solver needs it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Link {
    /// The sender.
    pub from: FederateId,
    /// The receiver.
    pub to: FederateId,
    /// L, N and E, each at least 0; absent when they are not declared.
    pub bounds: Option<Bounds>,
    /// α in nanoseconds; 0 without `after` and for one microstep.
    pub after_ns: i64,
    /// How much longer the receiver waits before it takes this input for absent, in nanoseconds, at least 0.
    pub absent_after_ns: i64,
    /// The offset that is declared for this link alone, in nanoseconds, at least 0.
    pub declared_ns: Option<i64>,
}

/// The least offsets that suffice.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Solution {
    /// One per federate.
    pub federates: Vec<Offset>,
    /// One per link, in order.
    pub links: Vec<LinkOffset>,
}

/// The offset of one federate, in nanoseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Offset {
    /// S that the bounds require; absent when a link has none.
    pub required_ns: Option<i64>,
    /// S that is used: the declared one, else the required one.
    pub used_ns: i64,
    /// When the federate has decided all its inputs at the latest: what its receivers must reckon with.
    pub decided_ns: i64,
    /// The link of the greatest requirement, as an index; the first of several. Absent without links.
    pub by: Option<usize>,
}

/// The offset of one link, in nanoseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LinkOffset {
    /// What the bounds require, below 0 when the `after` is longer than everything else; absent without bounds.
    pub required_ns: Option<i64>,
    /// What is used: the link's declared offset, else the receiver's, else the required one, at least 0.
    pub used_ns: i64,
}

/// Why there is no solution.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SolveError {
    /// No offset suffices: a message around this cycle is later each round.
    #[error("{}", .0.describe(&|id| id.to_string()))]
    Cycle(Box<PositiveCycle>),
    /// Neither an offset nor bounds are declared for the link of this index.
    #[error("link {0} has neither bounds nor an offset")]
    Unbounded(usize),
    /// The federate would have to wait longer than 2^63 ns.
    #[error("the offset of federate {0} is beyond the range of time")]
    TooLong(FederateId),
    /// A link names a federate that is not there.
    #[error("link {0} names an unknown federate")]
    UnknownFederate(usize),
}

/// A cycle of links whose terms add up to more than 0.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PositiveCycle {
    /// The links in order, as indices; the last one leads back to the first.
    pub links: Vec<usize>,
    /// Their senders, in the same order, from the one with the lowest id on.
    pub federates: Vec<FederateId>,
    /// The sums of L, N and E in nanoseconds.
    pub bounds: Bounds,
    /// The sum of the `absent_after`, in nanoseconds.
    pub absent_after_ns: i64,
    /// The sum of α, in nanoseconds.
    pub after_ns: i64,
}

impl Link {
    /// The link of a connection, when it carries tags from one federate to another. An offset that the connection
    /// has counts as declared.
    #[must_use]
    pub fn of(wire: &ConnectionPlan) -> Option<Self> {
        (!wire.physical && wire.from.federate != wire.to.federate).then(|| Self {
            from: FederateId::new(wire.from.federate),
            to: FederateId::new(wire.to.federate),
            bounds: wire.bounds,
            after_ns: wire.after_ns.unwrap_or(0),
            absent_after_ns: wire.absent_after_ns,
            declared_ns: wire.stp_offset_ns,
        })
    }
}

/// Solves the system. `declared` has one entry per federate: its S, when the manifest gives it.
///
/// Laws: every link's `required_ns` is what its sender's `decided_ns` and its own terms add up to; without
/// declared offsets every offset is 0 or reached exactly along a path that begins at an offset of 0 (so it is the
/// least); no offset falls when a bound grows. O(federates x links), as a rule O(links).
///
/// # Errors
///
/// When a cycle is positive, whatever offsets are declared, and when a link without bounds has no declared offset.
pub fn solve(links: &[Link], declared: &[Option<i64>]) -> Result<Solution, SolveError> {
    for (index, link) in links.iter().enumerate() {
        if link.from.index().max(link.to.index()) >= declared.len() {
            return Err(SolveError::UnknownFederate(index));
        }
    }
    refuse_positive_cycles(links, declared.len())?;
    let mut decided = vec![0_i128; declared.len()];
    let used = |link: &Link, decided: &[i128]| {
        let given = link.declared_ns.or(declared[link.to.index()]);
        given
            .map(i128::from)
            .or_else(|| Some(decided[link.from.index()] + weight(link)?))
    };
    // Without a positive cycle no path that matters has more links than there are federates.
    for _ in 0..=declared.len() {
        let mut settled = true;
        for (index, link) in links.iter().enumerate() {
            let offset = used(link, &decided).ok_or(SolveError::Unbounded(index))?;
            let until = offset.max(0) + i128::from(link.absent_after_ns);
            let to = &mut decided[link.to.index()];
            if until > *to {
                *to = until;
                settled = false;
            }
        }
        if settled {
            break;
        }
    }
    Solution::new(links, declared, &decided)
}

impl Solution {
    /// Gathers what follows from the fixed point.
    fn new(links: &[Link], declared: &[Option<i64>], decided: &[i128]) -> Result<Self, SolveError> {
        let mut federates: Vec<Offset> = Vec::with_capacity(declared.len());
        for (id, until) in decided.iter().enumerate() {
            let decided_ns = i64::try_from(*until)
                .map_err(|_| SolveError::TooLong(FederateId::from_index(id)))?;
            federates.push(Offset {
                required_ns: Some(0),
                used_ns: 0,
                decided_ns,
                by: None,
            });
        }
        let mut offsets = Vec::with_capacity(links.len());
        let mut greatest: Vec<Option<i64>> = vec![None; declared.len()];
        for (index, link) in links.iter().enumerate() {
            let to = link.to.index();
            let required = weight(link)
                .map(|weight| decided[link.from.index()] + weight)
                .map(|sum| i64::try_from(sum).map_err(|_| SolveError::TooLong(link.to)))
                .transpose()?;
            let federate = &mut federates[to];
            federate.required_ns = federate.required_ns.zip(required).map(|(a, b)| a.max(b));
            if required.is_some_and(|sum| greatest[to].is_none_or(|least| sum > least)) {
                greatest[to] = required;
                federate.by = Some(index);
            }
            let given = link.declared_ns.or(declared[to]).or(required);
            let used_ns = given.ok_or(SolveError::Unbounded(index))?.max(0);
            offsets.push(LinkOffset {
                required_ns: required,
                used_ns,
            });
        }
        for (federate, given) in federates.iter_mut().zip(declared) {
            federate.used_ns = given.or(federate.required_ns).unwrap_or(0);
        }
        Ok(Self {
            federates,
            links: offsets,
        })
    }
}

/// L + N + E - α.
fn weight(link: &Link) -> Option<i128> {
    let bounds = link.bounds?;
    let lags = [
        bounds.launch_lag_ns,
        bounds.latency_ns,
        bounds.clock_error_ns,
    ];
    Some(lags.map(i128::from).iter().sum::<i128>() - i128::from(link.after_ns))
}

/// Longest paths from everywhere at once; one that still grows after as many rounds as there are federates goes
/// around a positive cycle.
fn refuse_positive_cycles(links: &[Link], federates: usize) -> Result<(), SolveError> {
    let mut length = vec![0_i128; federates];
    let mut by: Vec<Option<usize>> = vec![None; federates];
    for _ in 0..=federates {
        let mut grown = None;
        for (index, link) in links.iter().enumerate() {
            let Some(weight) = weight(link) else {
                continue;
            };
            let sum = length[link.from.index()] + weight + i128::from(link.absent_after_ns);
            if sum > length[link.to.index()] {
                length[link.to.index()] = sum;
                by[link.to.index()] = Some(index);
                grown = Some(link.to);
            }
        }
        let Some(last) = grown else {
            return Ok(());
        };
        if let Some(cycle) = cycle_behind(links, &by, last) {
            return Err(SolveError::Cycle(Box::new(cycle)));
        }
    }
    Ok(())
}

/// The cycle that the chain of determining links behind a federate runs into, if it does. Such a cycle is positive: each
/// of its links has raised its receiver since the one before it was raised.
fn cycle_behind(links: &[Link], by: &[Option<usize>], last: FederateId) -> Option<PositiveCycle> {
    let before = |at: FederateId| by[at.index()].map(|index| (index, links[index].from));
    let mut at = last;
    for _ in 0..by.len() {
        at = before(at)?.1;
    }
    let first = at;
    let mut cycle = Vec::new();
    loop {
        let (index, from) = before(at)?;
        cycle.push(index);
        at = from;
        if at == first {
            break;
        }
    }
    cycle.reverse();
    let lowest = (0..cycle.len()).min_by_key(|position| links[cycle[*position]].from)?;
    cycle.rotate_left(lowest);
    Some(PositiveCycle::new(links, cycle))
}

impl PositiveCycle {
    fn new(links: &[Link], cycle: Vec<usize>) -> Self {
        let mut sums = Self {
            links: Vec::new(),
            federates: Vec::new(),
            bounds: Bounds::default(),
            absent_after_ns: 0,
            after_ns: 0,
        };
        let add = |sum: &mut i64, term: i64| *sum = sum.saturating_add(term);
        for link in cycle.iter().map(|index| &links[*index]) {
            let bounds = link.bounds.unwrap_or_default();
            sums.federates.push(link.from);
            add(&mut sums.bounds.launch_lag_ns, bounds.launch_lag_ns);
            add(&mut sums.bounds.latency_ns, bounds.latency_ns);
            add(&mut sums.bounds.clock_error_ns, bounds.clock_error_ns);
            add(&mut sums.absent_after_ns, link.absent_after_ns);
            add(&mut sums.after_ns, link.after_ns);
        }
        sums.links = cycle;
        sums
    }

    /// By how much a message is later after one round, in nanoseconds; more than 0.
    #[must_use]
    pub fn growth_ns(&self) -> i64 {
        [
            self.bounds.launch_lag_ns,
            self.bounds.latency_ns,
            self.bounds.clock_error_ns,
            self.absent_after_ns,
        ]
        .into_iter()
        .fold(0_i64, i64::saturating_add)
        .saturating_sub(self.after_ns)
    }

    /// The cycle and its terms in words: `planner -> brake -> planner grows by 3.2 ms each round: L 2 ms + N 1 ms +
    /// E 0.2 ms - after 0`.
    #[must_use]
    pub fn describe(&self, name: &dyn Fn(FederateId) -> String) -> String {
        let around = self.federates.iter().chain(self.federates.first());
        let names: Vec<String> = around.map(|id| name(*id)).collect();
        let mut text = format!(
            "{} grows by {} each round: L {} + N {} + E {}",
            names.join(" -> "),
            Span(self.growth_ns()),
            Span(self.bounds.launch_lag_ns),
            Span(self.bounds.latency_ns),
            Span(self.bounds.clock_error_ns),
        );
        if self.absent_after_ns != 0 {
            text.push_str(&format!(" + absent_after {}", Span(self.absent_after_ns)));
        }
        text.push_str(&format!(" - after {}", Span(self.after_ns)));
        text
    }
}

/// Nanoseconds, shown as milliseconds; nothing is rounded.
struct Span(i64);

impl fmt::Display for Span {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.0 == 0 {
            return f.write_str("0");
        }
        write!(f, "{} ms", milliseconds(self.0))
    }
}

/// Nanoseconds as decimal milliseconds without a needless zero: `2`, `0.2`, `-0.000001`. Exact.
#[must_use]
pub fn milliseconds(ns: i64) -> String {
    let sign = if ns < 0 { "-" } else { "" };
    let (whole, rest) = (ns.unsigned_abs() / 1_000_000, ns.unsigned_abs() % 1_000_000);
    let fraction = format!("{rest:06}");
    let fraction = fraction.trim_end_matches('0');
    let point = if fraction.is_empty() { "" } else { "." };
    format!("{sign}{whole}{point}{fraction}")
}

#[cfg(test)]
mod tests;
