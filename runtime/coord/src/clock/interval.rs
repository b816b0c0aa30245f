//! Between which values an offset certainly is.

use ictus_core::{Duration, PhysicalTime};

use super::{BILLION, DRIFT_BOUND_PPB, Exchange};

/// Bounds on the offset, each as it was when an exchange gave it; both age with the drift bound.
///
/// Law `the_offset_is_inside`: as long as no clock is stepped and the drift bound holds, the offset is never outside.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Interval {
    lower: Edge,
    upper: Edge,
    drift_bound_ppb: i64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Edge {
    at: i64,
    value: i64,
}

impl Edge {
    /// How much the offset may have moved from where it was at this edge.
    fn age(self, base: i64, drift_bound_ppb: i64) -> i64 {
        let elapsed = i128::from(base.abs_diff(self.at));
        let moved = elapsed * i128::from(drift_bound_ppb) / BILLION + 1;
        i64::try_from(moved).unwrap_or(i64::MAX)
    }
}

impl Interval {
    /// What one exchange says; `None` when it contradicts itself: a clock was stepped meanwhile.
    #[must_use]
    pub fn of(exchange: &Exchange) -> Option<Self> {
        let interval = Self {
            lower: Edge {
                at: exchange.t2.as_nanos(),
                value: exchange.lower().as_nanos(),
            },
            upper: Edge {
                at: exchange.t3.as_nanos(),
                value: exchange.upper().as_nanos(),
            },
            drift_bound_ppb: DRIFT_BOUND_PPB,
        };
        let possible = exchange.is_plausible() && interval.is_possible(exchange.t3);
        possible.then_some(interval)
    }

    /// What some exchanges say together; `None` when there is none, or they contradict one another.
    #[must_use]
    pub fn of_all(exchanges: &[Exchange]) -> Option<Self> {
        let mut intervals = exchanges.iter().map(Self::of);
        let first = intervals.next()??;
        intervals.try_fold(first, |all, one| all.and(&one?))
    }

    /// What both say; `None` when they contradict each other: a clock was stepped between them.
    #[must_use]
    pub fn and(&self, newer: &Self) -> Option<Self> {
        let lower_then = self.lower_at(newer.lower.at);
        let upper_then = self.upper_at(newer.upper.at);
        let both = Self {
            lower: if newer.lower.value >= lower_then {
                newer.lower
            } else {
                self.lower
            },
            upper: if newer.upper.value <= upper_then {
                newer.upper
            } else {
                self.upper
            },
            drift_bound_ppb: self.drift_bound_ppb,
        };
        let latest = newer.upper.at.max(newer.lower.at);
        both.is_possible(PhysicalTime::from_nanos(latest))
            .then_some(both)
    }

    /// The least and the greatest value at `base`.
    #[must_use]
    pub fn at(&self, base: PhysicalTime) -> (Duration, Duration) {
        let base = base.as_nanos();
        let (lower, upper) = (self.lower_at(base), self.upper_at(base));
        (Duration::from_nanos(lower), Duration::from_nanos(upper))
    }

    /// The middle at `base`.
    #[must_use]
    pub fn middle(&self, base: PhysicalTime) -> Duration {
        let (lower, upper) = self.at(base);
        Duration::from_nanos(lower.as_nanos().midpoint(upper.as_nanos()))
    }

    /// How far `offset` may be from the truth at `base`.
    #[must_use]
    pub fn bound(&self, base: PhysicalTime, offset: Duration) -> Duration {
        let (lower, upper) = self.at(base);
        let offset = offset.as_nanos();
        let below = offset.saturating_sub(lower.as_nanos());
        let above = upper.as_nanos().saturating_sub(offset);
        Duration::from_nanos(below.max(above))
    }

    /// Whether `offset` is inside at `base`.
    #[must_use]
    pub fn contains(&self, base: PhysicalTime, offset: Duration) -> bool {
        let (lower, upper) = self.at(base);
        (lower..=upper).contains(&offset)
    }

    /// The same with another drift bound, for tests of the bound.
    #[must_use]
    pub(super) const fn with_drift_bound(self, drift_bound_ppb: i64) -> Self {
        Self {
            drift_bound_ppb,
            ..self
        }
    }

    fn is_possible(&self, base: PhysicalTime) -> bool {
        let (lower, upper) = self.at(base);
        lower <= upper
    }

    fn lower_at(&self, base: i64) -> i64 {
        let age = self.lower.age(base, self.drift_bound_ppb);
        self.lower.value.saturating_sub(age)
    }

    fn upper_at(&self, base: i64) -> i64 {
        let age = self.upper.age(base, self.drift_bound_ppb);
        self.upper.value.saturating_add(age)
    }
}
