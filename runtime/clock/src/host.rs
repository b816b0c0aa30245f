//! Readings of the host's clock.

use ictus_core::{Duration, PhysicalTime};
use rustix::time::{ClockId, Timespec, clock_gettime};

const BILLION: i64 = 1_000_000_000;
/// The system clock and the steady one are read this often in pairs; the closest pair tells how far they are apart.
const PAIRS: usize = 8;
/// The two drift apart slowly while the host slews; a faster change is a step.
const STEP_LEAST: Duration = Duration::from_millis(1);

/// A clock of this host, as nanoseconds since the Unix epoch. Never corrected here.
#[derive(Clone, Copy, Debug)]
pub struct HostClock {
    source: Source,
    skew: Skew,
    /// The reading from which the artificial drift counts.
    skewed_since: i64,
}

#[derive(Clone, Copy, Debug)]
enum Source {
    /// CLOCK_REALTIME: what the host takes for the time, steps and all.
    System,
    /// Another clock plus a constant.
    Steady { clock: ClockId, ahead: i64 },
}

/// Tests only: how wrong a clock is made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Skew {
    /// From the beginning on, in nanoseconds.
    pub offset_ns: i64,
    /// What it gains, in parts per 10^9.
    pub drift_ppb: i64,
}

impl HostClock {
    /// The system clock: equal in all processes of a host at all times, and stepped when somebody steps it.
    #[must_use]
    pub fn system() -> Self {
        Self::of(Source::System)
    }

    /// The time of the system clock now, continued by CLOCK_MONOTONIC: slewed by the host's time service, never stepped.
    #[must_use]
    pub fn steady() -> Self {
        Self::continued(ClockId::Monotonic)
    }

    /// The time of the system clock now, continued by CLOCK_MONOTONIC_RAW: the bare crystal, for who corrects it alone.
    #[must_use]
    pub fn raw() -> Self {
        Self::continued(ClockId::MonotonicRaw)
    }

    /// The same clock, wrong.
    #[must_use]
    pub fn with_skew(mut self, skew: Skew) -> Self {
        self.skewed_since = self.unskewed();
        self.skew = skew;
        self
    }

    /// The present reading.
    #[must_use]
    pub fn now(&self) -> PhysicalTime {
        let reading = self.unskewed();
        if self.skew == Skew::default() {
            return PhysicalTime::from_nanos(reading);
        }
        let elapsed = i128::from(reading - self.skewed_since);
        let gained = elapsed * i128::from(self.skew.drift_ppb) / i128::from(BILLION);
        let gained = i64::try_from(gained).unwrap_or(0);
        PhysicalTime::from_nanos(reading + self.skew.offset_ns + gained)
    }

    /// How far the system clock is ahead of this one.
    #[must_use]
    pub fn behind_system(&self) -> Duration {
        let (pair, _) = closest_pair(|| self.now().as_nanos());
        Duration::from_nanos(pair)
    }

    fn of(source: Source) -> Self {
        Self {
            source,
            skew: Skew::default(),
            skewed_since: 0,
        }
    }

    fn continued(clock: ClockId) -> Self {
        let (ahead, _) = closest_pair(|| nanos(clock_gettime(clock)));
        Self::of(Source::Steady { clock, ahead })
    }

    fn unskewed(&self) -> i64 {
        match self.source {
            Source::System => system(),
            Source::Steady { clock, ahead } => nanos(clock_gettime(clock)) + ahead,
        }
    }
}

/// Notices when somebody steps the system clock.
#[derive(Clone, Debug)]
pub struct StepWatch {
    steady: HostClock,
    behind: Duration,
}

impl StepWatch {
    /// From now on.
    #[must_use]
    pub fn new() -> Self {
        Self {
            steady: HostClock::steady(),
            behind: Duration::ZERO,
        }
    }

    /// By how much the system clock was stepped since the last call; `None` when it was not.
    pub fn look(&mut self) -> Option<Duration> {
        let behind = self.steady.behind_system();
        let by = behind - std::mem::replace(&mut self.behind, behind);
        (by >= STEP_LEAST || by <= -STEP_LEAST).then_some(by)
    }
}

impl Default for StepWatch {
    fn default() -> Self {
        Self::new()
    }
}

/// How far the system clock is ahead of another, and how long it took to find out.
fn closest_pair(other: impl Fn() -> i64) -> (i64, i64) {
    let pair = |_| {
        let before = other();
        let system = system();
        let after = other();
        (after - before, system - before.midpoint(after))
    };
    let (width, ahead) = (0..PAIRS).map(pair).min().unwrap_or_default();
    (ahead, width)
}

/// A clock before 1970 or after 2262 reads as the epoch: the federation then starts there, consistently.
pub(crate) fn system() -> i64 {
    nanos(clock_gettime(ClockId::Realtime)).max(0)
}

fn nanos(time: Timespec) -> i64 {
    time.tv_sec
        .checked_mul(BILLION)
        .and_then(|nanos| nanos.checked_add(time.tv_nsec))
        .unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steady_clocks_begin_with_the_systems() {
        for clock in [HostClock::steady(), HostClock::raw()] {
            let behind = clock.behind_system().as_nanos().abs();
            assert!(behind < 100_000_000, "{behind} ns apart");
        }
        assert_eq!(StepWatch::new().look(), None);
    }

    #[test]
    fn a_skewed_clock_is_wrong_by_that_much() {
        let offset_ns = 50_000_000_000;
        let skew = Skew {
            offset_ns,
            drift_ppb: 1_000_000_000,
        };
        let clock = HostClock::raw();
        let wrong = clock.with_skew(skew);
        let (first, second) = (clock.now(), clock.now());
        let apart = wrong.now().since(second).as_nanos() - offset_ns;
        assert!(apart >= second.since(first).as_nanos(), "twice as fast");
    }
}
