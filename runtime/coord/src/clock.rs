//! Physical time: the servo that compares a federate's clock with the RTI's, and both ends of the probes.
//!
//! Everything here is counted on two clocks. The federate's *base* clock is the host's as it is: it is never corrected, so
//! readings of it compare. The RTI's clock is the reference. What must be added to the base to get the reference is the
//! *offset*; it changes by at most [`DRIFT_BOUND_PPB`].
//!
//! - [`Interval`]: between which values the offset certainly is. Each exchange gives a lower and an upper value by causality
//!   alone; both age with the drift bound. Half its width is the error bound E of a clock in its middle.
//! - [`Servo`]: where in the interval the offset most likely is. Of the last exchanges whose coded probe kept its spacing, the
//!   line of offset and drift with the largest margin between the two directions; the correction follows it by slewing.
//! - [`Prober`] (RTI) and [`Follower`] (federate): T1, T3, T4 and the coded probe over UDP, LF's datagrams.
//!
//! Source: Geng et al., "Exploiting a Natural Network Effect for Scalable, Fine-grained Clock Synchronization" (NSDI 2018);
//! sections 3.5 and 4 of the wire document. Marzullo's interval instead of the paper's network effect: there is one reference.

use ictus_core::{Duration, PhysicalTime};

mod datagram;
mod fit;
mod follower;
mod interval;
mod prober;
mod servo;

pub use datagram::{Datagram, Encoded, FromFederate, LONGEST};
pub use follower::{Follower, Heard};
pub use interval::Interval;
pub use prober::{Prober, Transmit};
pub use servo::{Servo, Taken};

/// How fast the offset between two clocks may change, in parts per 10^9: two crystals of 50 ppm each.
pub const DRIFT_BOUND_PPB: i64 = 100_000;

/// How much a correction may change the rate of a clock beyond its drift, in parts per 10^9.
pub const SLEW_MAX_PPB: i64 = 500_000;

const BILLION: i128 = 1_000_000_000;

/// One exchange: T1 from the RTI, T3 back, T4 again.
///
/// `t1` is not after T1 left, `t2` not before it came; `t3` not after T3 left, `t4` not before it came. That is all that the
/// bounds rest on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Exchange {
    /// The RTI's clock when it sent T1.
    pub t1: PhysicalTime,
    /// The base clock when T1 came.
    pub t2: PhysicalTime,
    /// The base clock when T3 was sent.
    pub t3: PhysicalTime,
    /// The RTI's clock when T3 came.
    pub t4: PhysicalTime,
}

impl Exchange {
    /// How long the two messages were on their way together; negative only when a clock was stepped meanwhile.
    #[must_use]
    pub const fn round_trip(&self) -> Duration {
        let reference = self.t4.since(self.t1).as_nanos();
        let base = self.t3.since(self.t2).as_nanos();
        Duration::from_nanos(reference.saturating_sub(base))
    }

    /// The offset at `t2` is this or more.
    #[must_use]
    pub const fn lower(&self) -> Duration {
        self.t1.since(self.t2)
    }

    /// The offset at `t3` is this or less.
    #[must_use]
    pub const fn upper(&self) -> Duration {
        self.t4.since(self.t3)
    }

    /// Whether all four are times that a clock may show (1970 to 2116): differences of such times have room.
    #[must_use]
    pub fn is_plausible(&self) -> bool {
        let range = 0..=i64::MAX / 2;
        let times = [self.t1, self.t2, self.t3, self.t4];
        times.iter().all(|time| range.contains(&time.as_nanos()))
    }
}

/// What is added to a base clock: piecewise linear, so that the sum never jumps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Correction {
    /// From when on, by the base clock.
    pub from: PhysicalTime,
    /// What is added at that time.
    pub offset: Duration,
    /// What is gained from then on, in parts per 10^9...
    pub drift_ppb: i64,
    /// ... and beside it until `slew_until`, to get where the offset is.
    pub slew_ppb: i64,
    /// When slewing ends, by the base clock.
    pub slew_until: PhysicalTime,
}

impl Correction {
    /// Nothing is added.
    pub const NONE: Self = Self::constant(PhysicalTime::from_nanos(0), Duration::ZERO);

    /// The same is added for ever.
    #[must_use]
    pub const fn constant(from: PhysicalTime, offset: Duration) -> Self {
        Self {
            from,
            offset,
            drift_ppb: 0,
            slew_ppb: 0,
            slew_until: from,
        }
    }

    /// What is added at `base`.
    #[must_use]
    pub fn at(&self, base: PhysicalTime) -> Duration {
        let elapsed = base.since(self.from).as_nanos();
        let slewed = base.min(self.slew_until).since(self.from).as_nanos();
        let gained = i128::from(elapsed) * i128::from(self.drift_ppb)
            + i128::from(slewed) * i128::from(self.slew_ppb);
        let gained = i64::try_from(gained / BILLION).unwrap_or(0);
        Duration::from_nanos(self.offset.as_nanos().saturating_add(gained))
    }

    /// What a corrected clock shows at `base`.
    #[must_use]
    pub fn reading(&self, base: PhysicalTime) -> PhysicalTime {
        base.saturating_add(self.at(base))
    }
}
