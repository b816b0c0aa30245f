//! A crystal: a rate that wanders within limits.

use ictus_core::{Duration, PhysicalTime};

use crate::seed::Rng;

/// The rate changes this often, in nanoseconds of true time.
const STRIDE: i64 = 100_000_000;
/// Two of these never drift apart faster than the servo's bound, in parts per 10^9.
const RATE_MAX_PPB: i64 = 49_900;

/// A clock, advanced with true time.
#[derive(Clone, Debug)]
pub(super) struct Wandering {
    /// The reading at `since`, the last change of rate.
    shown: i64,
    since: i64,
    rate_ppb: i64,
    wander_ppb: i64,
}

impl Wandering {
    pub(super) fn draw(rng: &mut Rng, shown: i64) -> Self {
        Self {
            shown,
            since: 0,
            rate_ppb: between(rng, RATE_MAX_PPB),
            wander_ppb: *rng.pick(&[0, 2, 20]),
        }
    }

    /// Lets true time pass.
    pub(super) fn advance(&mut self, now: i64, rng: &mut Rng) {
        while now - self.since >= STRIDE {
            self.shown = self.at(self.since + STRIDE);
            self.since += STRIDE;
            let rate = self.rate_ppb + between(rng, self.wander_ppb);
            self.rate_ppb = rate.clamp(-RATE_MAX_PPB, RATE_MAX_PPB);
        }
    }

    /// Moves the clock.
    pub(super) const fn step(&mut self, by: i64) {
        self.shown += by;
    }

    /// What the clock shows at `true_time`, now or a little before.
    pub(super) fn reading(&self, true_time: i64) -> PhysicalTime {
        PhysicalTime::from_nanos(self.at(true_time))
    }

    const fn at(&self, true_time: i64) -> i64 {
        let elapsed = true_time - self.since;
        self.shown + elapsed + elapsed * self.rate_ppb / 1_000_000_000
    }
}

fn between(rng: &mut Rng, most: i64) -> i64 {
    rng.span(Duration::from_nanos(-most), Duration::from_nanos(most))
        .as_nanos()
}
