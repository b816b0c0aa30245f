//! The servo: exchanges in, correction, bound and state out.

use ictus_core::{Duration, PhysicalTime};

use super::fit::{Drift, Window, as_float, as_nanos};
use super::{Correction, DRIFT_BOUND_PPB, Exchange, Interval, SLEW_MAX_PPB};
use crate::mutants::{Mutant, Mutants};
use crate::plan::ClockPlan;
use crate::report::{ClockSource, ClockStatus};

/// How much of what a new fit says of the drift is believed, once there is a long window.
const DRIFT_GAIN: f64 = 0.1;
/// Slewing is not made any steeper for a shorter period than this.
const SHORTEST_SLEW: Duration = Duration::from_millis(50);

/// Estimates offset and drift of one clock, and steers its correction.
///
/// Laws, checked by the simulator: the corrected clock is never further from the RTI's than the bound, except between a step
/// of either clock and the end of the first exchange that began after it; the correction never jumps after
/// [`Servo::begin`]; the bound's median is at most twice (half the smallest round trip + drift bound x period).
/// A step that is smaller than a round trip hides in it: it is taken for the way's asymmetry until the drift bound has shown it.
#[derive(Clone, Debug)]
pub struct Servo {
    /// How long slewing takes that removes 1 - 1/e of what may be noise: LF removes 1/attenuation of it every `trials`
    /// periods...
    slew_for: Duration,
    /// ... and of what is more than that.
    slew_at_once: Duration,
    trials: u32,
    until_fit: u32,
    window: Window,
    interval: Option<Interval>,
    drift_ppb: Option<f64>,
    trusted: Option<(Duration, Duration)>,
    correction: Correction,
    kept: u64,
    dropped: u64,
    steps: u64,
    mutants: Mutants,
}

/// What an exchange came to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Taken {
    /// It counts.
    Kept,
    /// Its spacing did not survive: it counts for the bound only.
    Dropped,
    /// It contradicts the earlier ones: one of the clocks was stepped, the RTI's forward by about this much or the base back.
    Step(Duration),
}

impl Servo {
    /// A servo with a plan's options that knows nothing and corrects nothing.
    #[must_use]
    pub fn new(plan: &ClockPlan) -> Self {
        let correction_ns = plan.period_ns.saturating_mul(plan.trials.max(1).into());
        let attenuated_ns = correction_ns.saturating_mul(plan.attenuation.max(1).into());
        Self {
            slew_for: Duration::from_nanos(attenuated_ns).max(SHORTEST_SLEW),
            slew_at_once: Duration::from_nanos(correction_ns).max(SHORTEST_SLEW),
            trials: plan.trials.max(1),
            until_fit: 0,
            window: Window::default(),
            interval: None,
            drift_ppb: None,
            trusted: None,
            correction: Correction::NONE,
            kept: 0,
            dropped: 0,
            steps: 0,
            mutants: Mutants::NONE,
        }
    }

    /// With rules that are wrong.
    #[doc(hidden)]
    #[must_use]
    pub const fn with_mutants(mut self, mutants: Mutants) -> Self {
        self.mutants = mutants;
        self
    }

    /// Steps to the middle of what the exchanges while joining said: before the start a clock may jump.
    pub fn begin(&mut self, base: PhysicalTime, joining: Interval) {
        self.interval = Some(self.aged(joining));
        self.correction = Correction::constant(base, joining.middle(base));
    }

    /// Takes an exchange that was complete when the base clock showed `base`; `survived`: its coded probe kept its spacing.
    pub fn take(&mut self, base: PhysicalTime, exchange: Exchange, survived: bool) -> Taken {
        let before = self.interval.map(|interval| interval.middle(exchange.t3));
        let newer = Interval::of(&exchange).map(|interval| self.aged(interval));
        let both = match (self.interval, newer) {
            (Some(older), Some(newer)) => older.and(&newer),
            (None, newer) => newer,
            (Some(_), None) => None,
        };
        if both.is_none() {
            return self.stepped(base, before, newer, exchange);
        }
        self.interval = both;
        if survived {
            self.kept += 1;
            self.window.push(exchange);
            self.fit();
        } else {
            self.dropped += 1;
        }
        self.steer(base, &exchange);
        if survived {
            Taken::Kept
        } else {
            Taken::Dropped
        }
    }

    /// Says what somebody else takes for the offset, and how far that may be off. It is followed while it is surer than what the
    /// exchanges say, and does not contradict them.
    pub const fn trust(&mut self, external: Option<(Duration, Duration)>) {
        self.trusted = external;
    }

    /// Whether somebody else is followed, when the base clock shows `base`.
    #[must_use]
    pub fn is_external(&self, base: PhysicalTime) -> bool {
        let better = |(offset, bound): (Duration, Duration)| {
            let middle = |interval: &Interval| interval.bound(base, interval.middle(base));
            self.interval
                .as_ref()
                .is_some_and(|i| i.contains(base, offset) && bound < middle(i))
        };
        self.trusted.is_some_and(better)
    }

    /// Says that an exchange was begun and not ended.
    pub const fn missed(&mut self, count: u64) {
        self.dropped += count;
    }

    /// What to add to the base clock.
    #[must_use]
    pub const fn correction(&self) -> Correction {
        self.correction
    }

    /// Between which values the offset is; `None` while nothing is known.
    #[must_use]
    pub const fn interval(&self) -> Option<Interval> {
        self.interval
    }

    /// How far the corrected clock may be from the RTI's, when the base clock shows `base`; `None` while nothing is known.
    #[must_use]
    pub fn bound(&self, base: PhysicalTime) -> Option<Duration> {
        let interval = self.interval?;
        let applied = if self.mutants.has(Mutant::ClockSlewNotInBound) {
            interval.middle(base)
        } else {
            self.correction.at(base)
        };
        let bound = interval.bound(base, applied);
        if self.mutants.has(Mutant::ClockAsymmetryForgotten) {
            let (lower, upper) = interval.at(base);
            let half = (upper - lower).as_nanos() / 2;
            return Some(Duration::from_nanos(bound.as_nanos() - half));
        }
        Some(bound)
    }

    /// Whether the corrected clock is where the exchanges say it should be; not after a step until it has slewed there.
    #[must_use]
    pub fn is_synchronized(&self, base: PhysicalTime) -> bool {
        let applied = self.correction.at(base);
        self.interval
            .is_some_and(|interval| interval.contains(base, applied))
    }

    /// All of it, when the base clock shows `base`.
    #[must_use]
    pub fn status(&self, base: PhysicalTime) -> ClockStatus {
        ClockStatus {
            bound_ns: self.bound(base).map(Duration::as_nanos),
            probes_kept: self.kept,
            probes_dropped: self.dropped,
            steps: self.steps,
            ..Self::status_of(base, &self.correction, self.interval.as_ref())
        }
    }

    /// What a correction and an interval say of a clock, when its base shows `base`; nothing is counted.
    #[must_use]
    pub fn status_of(
        base: PhysicalTime,
        correction: &Correction,
        interval: Option<&Interval>,
    ) -> ClockStatus {
        let applied = correction.at(base);
        ClockStatus {
            source: ClockSource::Builtin,
            offset_ns: applied.as_nanos(),
            drift_ppb: -correction.drift_ppb,
            bound_ns: interval.map(|interval| interval.bound(base, applied).as_nanos()),
            synchronized: interval.is_some_and(|interval| interval.contains(base, applied)),
            ..ClockStatus::default()
        }
    }

    fn aged(&self, interval: Interval) -> Interval {
        let forgotten = self.mutants.has(Mutant::ClockBoundWithoutDrift);
        interval.with_drift_bound(if forgotten { 0 } else { DRIFT_BOUND_PPB })
    }

    /// All that was known was of another time line. The drift is a property of the crystals: it stays.
    fn stepped(
        &mut self,
        base: PhysicalTime,
        before: Option<Duration>,
        newer: Option<Interval>,
        exchange: Exchange,
    ) -> Taken {
        self.steps += 1;
        if self.mutants.has(Mutant::ClockStepIgnored) {
            return Taken::Dropped;
        }
        self.interval = newer;
        self.window.clear();
        self.until_fit = 0;
        let Some(newer) = newer else {
            self.dropped += 1;
            return Taken::Step(Duration::ZERO);
        };
        self.kept += 1;
        self.window.push(exchange);
        self.steer(base, &exchange);
        let (before, after) = (before.unwrap_or_default(), newer.middle(exchange.t3));
        Taken::Step(Duration::from_nanos(
            after.as_nanos().saturating_sub(before.as_nanos()),
        ))
    }

    /// Looks for the drift, every `trials` exchanges.
    fn fit(&mut self) {
        self.until_fit = self.until_fit.saturating_sub(1);
        if self.until_fit > 0 {
            return;
        }
        self.until_fit = self.trials;
        match self.window.drift() {
            Drift::Unknown => {}
            Drift::Bent => self.window.halve(),
            Drift::Is(fitted) => {
                // While the window grows each fit knows much more than those before it.
                let known = self.drift_ppb.filter(|_| self.window.is_full());
                let most = as_float(DRIFT_BOUND_PPB);
                let drift = known.map_or(fitted, |drift| drift + (fitted - drift) * DRIFT_GAIN);
                self.drift_ppb = Some(drift.clamp(-most, most));
            }
        }
    }

    /// Bends the correction towards where the offset is.
    fn steer(&mut self, base: PhysicalTime, latest: &Exchange) {
        let Some(interval) = self.interval else {
            return;
        };
        let applied = self.correction.at(base);
        let drift = self.drift_ppb.unwrap_or(0.0);
        let external = self.trusted.filter(|_| self.is_external(base));
        let fitted = if let Some((offset, _)) = external {
            Some(offset)
        } else if self.mutants.has(Mutant::ClockUnfiltered) {
            Interval::of(latest).map(|latest| latest.middle(base))
        } else {
            self.drift_ppb
                .and_then(|drift| self.window.offset(base, drift))
        };
        let (lower, upper) = interval.at(base);
        let target = fitted.map_or_else(
            || interval.middle(base),
            |fitted| fitted.clamp(lower, upper),
        );
        let error = target.as_nanos().saturating_sub(applied.as_nanos());
        let half_width = (upper - lower).as_nanos() / 2;
        let is_noise = error.saturating_abs() < half_width / 4;
        let slew_for = if is_noise {
            self.slew_for
        } else {
            self.slew_at_once
        };
        let slew_for = as_float(slew_for.as_nanos());
        let most = as_float(SLEW_MAX_PPB);
        let slew = (as_float(error) / slew_for * 1e9).clamp(-most, most);
        let lasts = if slew == 0.0 {
            0.0
        } else {
            as_float(error) / slew * 1e9
        };
        self.correction = Correction {
            from: base,
            offset: applied,
            drift_ppb: as_nanos(drift),
            slew_ppb: as_nanos(slew),
            slew_until: base.saturating_add(Duration::from_nanos(as_nanos(lasts))),
        };
    }
}
