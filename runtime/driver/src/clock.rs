//! Physical time as an input.

use ictus_clock::{HostClock, Skew};
use ictus_coord::clock::Correction;
use ictus_coord::plan::{ClockPlan, ClockSync, FederatePlan};
use ictus_core::{Duration, PhysicalTime};
use std::sync::atomic::{AtomicI64, AtomicU64, Ordering, fence};

/// Where physical time comes from: the host's clock, a simulated one, a test's.
///
/// Law: `now` never decreases, once the federation has started. Physical actions read it from any thread.
pub trait Clock: Send + Sync + std::fmt::Debug {
    /// The present reading.
    fn now(&self) -> PhysicalTime;
}

/// The host's clock plus a correction, never going back.
///
/// Without corrections it is the system clock as it is, so that the times of all federates of a host compare exactly. With
/// them it begins with the system clock's time and is continued by a clock that nobody steps: `init` by one that the host's
/// time service may slew, `on` by the bare crystal, whose rate the servo corrects alone.
///
/// Reading takes no lock: a correction is written beside the one in force and then takes its place.
#[derive(Debug)]
pub struct SystemClock {
    host: HostClock,
    slots: [Slot; 2],
    /// How many corrections there have been; the last one's slot is the lowest bit.
    version: AtomicU64,
    latest_ns: AtomicI64,
}

/// A [`Correction`].
#[derive(Debug, Default)]
struct Slot {
    from: AtomicI64,
    offset: AtomicI64,
    drift_ppb: AtomicI64,
    slew_ppb: AtomicI64,
    slew_until: AtomicI64,
}

impl SystemClock {
    /// The host's system clock as it is.
    #[must_use]
    pub fn new() -> Self {
        Self::of(HostClock::system())
    }

    /// The clock of one federate of a plan, as the plan wants it synchronized and, for tests, wrong.
    #[must_use]
    pub fn of_plan(clock: &ClockPlan, federate: &FederatePlan) -> Self {
        let host = match clock.sync {
            ClockSync::Off | ClockSync::External => HostClock::system(),
            ClockSync::Init => HostClock::steady(),
            ClockSync::On => HostClock::raw(),
        };
        Self::of(host.with_skew(Skew {
            offset_ns: federate.test_clock_offset_ns,
            drift_ppb: federate.test_clock_drift_ppb,
        }))
    }

    /// A clock of the host's, nothing added.
    #[must_use]
    pub fn of(host: HostClock) -> Self {
        Self {
            host,
            slots: [Slot::default(), Slot::default()],
            version: AtomicU64::new(0),
            latest_ns: AtomicI64::new(i64::MIN),
        }
    }

    /// The clock to which corrections are added.
    #[must_use]
    pub const fn host(&self) -> &HostClock {
        &self.host
    }

    /// The base clock's reading: what [`SystemClock::now`] would be without corrections.
    #[must_use]
    pub fn base(&self) -> PhysicalTime {
        self.host.now()
    }

    /// Puts a correction in force. Only one thread may do that.
    pub(crate) fn correct(&self, correction: Correction) {
        let version = self.version.load(Ordering::Relaxed) + 1;
        self.slot(version).store(correction);
        self.version.store(version, Ordering::Release);
    }

    /// Puts a correction in force that may make the clock jump, back as well: before the start nothing depends on it.
    pub(crate) fn step(&self, correction: Correction) {
        self.correct(correction);
        self.latest_ns.store(i64::MIN, Ordering::Relaxed);
    }

    /// The correction in force.
    #[must_use]
    pub fn correction(&self) -> Correction {
        loop {
            let version = self.version.load(Ordering::Acquire);
            let correction = self.slot(version).load();
            // A slot is written again only after the other one has taken its place.
            fence(Ordering::Acquire);
            if self.version.load(Ordering::Relaxed) == version {
                return correction;
            }
        }
    }

    const fn slot(&self, version: u64) -> &Slot {
        if version.is_multiple_of(2) {
            &self.slots[0]
        } else {
            &self.slots[1]
        }
    }
}

impl Default for SystemClock {
    fn default() -> Self {
        Self::new()
    }
}

impl Clock for SystemClock {
    #[inline]
    fn now(&self) -> PhysicalTime {
        let corrected = self.version.load(Ordering::Relaxed) > 0;
        let reading = if corrected {
            // First the correction: one that comes later may begin before the reading.
            let correction = self.correction();
            correction.reading(self.host.now())
        } else {
            self.host.now()
        };
        let reading = reading.as_nanos();
        let latest = self.latest_ns.load(Ordering::Relaxed);
        if reading <= latest {
            return PhysicalTime::from_nanos(latest);
        }
        let latest = self.latest_ns.fetch_max(reading, Ordering::Relaxed);
        PhysicalTime::from_nanos(reading.max(latest))
    }
}

impl Slot {
    fn store(&self, correction: Correction) {
        let set = |slot: &AtomicI64, value| slot.store(value, Ordering::Relaxed);
        // What is written now must not be seen before the version that made this slot free.
        fence(Ordering::Release);
        set(&self.from, correction.from.as_nanos());
        set(&self.offset, correction.offset.as_nanos());
        set(&self.drift_ppb, correction.drift_ppb);
        set(&self.slew_ppb, correction.slew_ppb);
        set(&self.slew_until, correction.slew_until.as_nanos());
    }

    fn load(&self) -> Correction {
        let get = |slot: &AtomicI64| slot.load(Ordering::Relaxed);
        Correction {
            from: PhysicalTime::from_nanos(get(&self.from)),
            offset: Duration::from_nanos(get(&self.offset)),
            drift_ppb: get(&self.drift_ppb),
            slew_ppb: get(&self.slew_ppb),
            slew_until: PhysicalTime::from_nanos(get(&self.slew_until)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::AtomicBool;

    /// A correction whose parts belong together: the check is that no reader ever sees parts of two.
    fn numbered(number: i64) -> Correction {
        Correction {
            from: PhysicalTime::from_nanos(number),
            offset: Duration::from_nanos(number),
            drift_ppb: number,
            slew_ppb: number,
            slew_until: PhysicalTime::from_nanos(number),
        }
    }

    #[test]
    fn a_correction_is_read_whole() {
        let clock = SystemClock::new();
        let done = AtomicBool::new(false);
        std::thread::scope(|scope| {
            let reader = scope.spawn(|| {
                while !done.load(Ordering::Relaxed) {
                    let correction = clock.correction();
                    assert_eq!(correction, numbered(correction.drift_ppb));
                }
            });
            for number in 1..200_000 {
                clock.correct(numbered(number));
            }
            done.store(true, Ordering::Relaxed);
            reader.join().unwrap();
        });
    }

    #[test]
    fn time_never_goes_back() {
        let clock = SystemClock::of(HostClock::raw());
        let before = clock.now();
        clock.correct(Correction::constant(clock.base(), Duration::from_secs(-5)));
        assert_eq!(clock.now(), clock.now());
        assert!(
            clock.now() >= before,
            "it stands until the host's clock is there"
        );
        clock.correct(Correction::constant(clock.base(), Duration::from_secs(5)));
        assert!(clock.now() >= before + Duration::from_secs(5));
        clock.step(Correction::constant(clock.base(), Duration::from_secs(-5)));
        assert!(clock.now() < before, "before the start it may");
    }

    #[test]
    fn a_plan_makes_a_clock_wrong() {
        let plan = ClockPlan::default();
        let federate = FederatePlan {
            test_clock_offset_ns: 3_600_000_000_000,
            ..FederatePlan::default()
        };
        let right = SystemClock::of_plan(&plan, &FederatePlan::default()).now();
        let wrong = SystemClock::of_plan(&plan, &federate).now();
        assert!(wrong >= right + Duration::from_secs(3_600));
    }
}
