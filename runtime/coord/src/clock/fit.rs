//! The line of offset and drift through a window of exchanges.

use std::collections::VecDeque;

use ictus_core::{Duration, PhysicalTime};

use super::{Exchange, SLEW_MAX_PPB};

/// The most exchanges that are looked at.
const WINDOW: usize = 256;
/// Older ones say nothing of the present drift.
const OLDEST: Duration = Duration::from_secs(60);
/// Fewer say nothing of it either: noise tilts the line.
const FEWEST: usize = 64;
/// The search for the drift ends at a tenth of a part per 10^9.
const SEARCH_STEPS: usize = 40;

/// The window. Offsets are kept relative to the first, so that they are exact as floating-point numbers.
#[derive(Clone, Debug, Default)]
pub(super) struct Window {
    exchanges: VecDeque<Exchange>,
}

/// Points of both directions: time and offset relative to the newest exchange, in nanoseconds.
struct Points {
    lower: Vec<(f64, f64)>,
    upper: Vec<(f64, f64)>,
    /// The newest exchange's `t3` and upper offset.
    origin: (PhysicalTime, i64),
}

impl Window {
    pub(super) fn push(&mut self, exchange: Exchange) {
        while self.exchanges.front().is_some_and(|oldest| {
            self.exchanges.len() >= WINDOW || exchange.t3.since(oldest.t3) > OLDEST
        }) {
            self.exchanges.pop_front();
        }
        self.exchanges.push_back(exchange);
    }

    pub(super) fn is_full(&self) -> bool {
        self.exchanges.len() >= WINDOW
    }

    pub(super) fn clear(&mut self) {
        self.exchanges.clear();
    }

    /// Forgets the older half.
    pub(super) fn halve(&mut self) {
        self.exchanges.drain(..self.exchanges.len() / 2);
    }

    /// The drift of the line with the largest margin between the directions, in parts per 10^9, or why there is none.
    pub(super) fn drift(&self) -> Drift {
        if self.exchanges.len() < FEWEST {
            return Drift::Unknown;
        }
        let Some(points) = self.points() else {
            return Drift::Unknown;
        };
        let most = as_float(SLEW_MAX_PPB) * 1e-9;
        let (mut low, mut high) = (-most, most);
        for _ in 0..SEARCH_STEPS {
            let third = (high - low) / 3.0;
            let (left, right) = (low + third, high - third);
            if points.margin(left) < points.margin(right) {
                low = left;
            } else {
                high = right;
            }
        }
        let drift = f64::midpoint(low, high);
        if points.margin(drift) < 0.0 {
            Drift::Bent
        } else {
            Drift::Is(drift * 1e9)
        }
    }

    /// The offset at `base` in the middle between the directions, when the drift is `drift_ppb`.
    pub(super) fn offset(&self, base: PhysicalTime, drift_ppb: f64) -> Option<Duration> {
        let points = self.points()?;
        let drift = drift_ppb * 1e-9;
        let (lower, upper) = points.edges(drift);
        let elapsed = as_float(base.since(points.origin.0).as_nanos());
        let relative = as_nanos(f64::midpoint(lower, upper) + drift * elapsed);
        Some(Duration::from_nanos(
            points.origin.1.saturating_add(relative),
        ))
    }

    fn points(&self) -> Option<Points> {
        let newest = self.exchanges.back()?;
        let origin = (newest.t3, newest.upper().as_nanos());
        let place = |at: PhysicalTime, offset: Duration| {
            let relative = offset.as_nanos().saturating_sub(origin.1);
            (as_float(at.since(origin.0).as_nanos()), as_float(relative))
        };
        let exchanges = || self.exchanges.iter();
        Some(Points {
            lower: exchanges().map(|e| place(e.t2, e.lower())).collect(),
            upper: exchanges().map(|e| place(e.t3, e.upper())).collect(),
            origin,
        })
    }
}

/// What a window says of the drift.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Drift {
    /// Too little.
    Unknown,
    /// No line fits between the directions: the drift has changed.
    Bent,
    /// This, in parts per 10^9.
    Is(f64),
}

impl Points {
    /// Where lines of this slope touch the lower and the upper points, at the origin's time.
    fn edges(&self, slope: f64) -> (f64, f64) {
        let level = |&(time, offset): &(f64, f64)| offset - slope * time;
        let lower = self.lower.iter().map(level).fold(f64::MIN, f64::max);
        let upper = self.upper.iter().map(level).fold(f64::MAX, f64::min);
        (lower, upper)
    }

    fn margin(&self, slope: f64) -> f64 {
        let (lower, upper) = self.edges(slope);
        upper - lower
    }
}

/// Exact up to 2^53 ns, that is 104 days.
#[expect(
    clippy::cast_precision_loss,
    reason = "spans of a window, and what they differ by"
)]
pub(super) const fn as_float(nanos: i64) -> f64 {
    nanos as f64
}

/// Clamped to the range.
#[expect(
    clippy::cast_possible_truncation,
    reason = "a conversion from float saturates"
)]
pub(super) fn as_nanos(nanos: f64) -> i64 {
    nanos.round() as i64
}
