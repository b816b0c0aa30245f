//! A host's clock: an offset and a linear drift against true time, plus what the federate corrects.

use ictus_core::{Duration, PhysicalTime};

/// True time 0 in nanoseconds since the Unix epoch.
const EPOCH: i64 = 1_700_000_000_000_000_000;

const MILLION: i128 = 1_000_000;

/// A host's clock.
#[derive(Clone, Copy, Debug, Default)]
pub struct HostClock {
    offset: i64,
    drift_ppm: i64,
    correction: i64,
}

impl HostClock {
    /// A clock that is `offset` off at true time 0 and gains `drift_ppm` microseconds a second.
    #[must_use]
    pub const fn new(offset: Duration, drift_ppm: i64) -> Self {
        Self {
            offset: offset.as_nanos(),
            drift_ppm,
            correction: 0,
        }
    }

    /// Adds to every later reading.
    pub const fn correct(&mut self, offset: Duration) {
        self.correction += offset.as_nanos();
    }

    /// What the clock shows at `true_time`, nanoseconds since the simulation began.
    #[must_use]
    #[expect(clippy::cast_possible_truncation, reason = "simulations last minutes")]
    pub const fn reading(&self, true_time: i64) -> PhysicalTime {
        let gained = (true_time as i128 * self.drift_ppm as i128 / MILLION) as i64;
        PhysicalTime::from_nanos(EPOCH + true_time + gained + self.offset + self.correction)
    }

    /// The first true time at which the clock shows `reading` or more; `None` when that is out of range.
    #[must_use]
    pub fn when(&self, reading: PhysicalTime) -> Option<i64> {
        let shown = reading
            .as_nanos()
            .checked_sub(EPOCH + self.offset + self.correction)?;
        let exact = i128::from(shown) * MILLION / (MILLION + i128::from(self.drift_ppm));
        let mut true_time = i64::try_from(exact).ok()?.checked_sub(2)?;
        while self.reading(true_time) < reading {
            true_time += 1;
        }
        Some(true_time)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wait_ends_at_its_time() {
        for drift in [-500, 0, 500] {
            let clock = HostClock::new(Duration::from_millis(-7), drift);
            for true_time in [0, 1, 999_999_937, 60_000_000_000] {
                let reading = clock.reading(true_time);
                let when = clock.when(reading).unwrap();
                assert!(clock.reading(when) >= reading && clock.reading(when - 1) < reading);
            }
        }
    }
}
