//! Physical time as an input.

use ictus_core::{Duration, PhysicalTime};
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::{SystemTime, UNIX_EPOCH};

/// Where physical time comes from: the host's clock, a simulated one, a test's.
///
/// Law: `now` never decreases. Physical actions read it from any thread.
pub trait Clock: Send + Sync + std::fmt::Debug {
    /// The present reading.
    fn now(&self) -> PhysicalTime;
}

/// The host's real-time clock plus a correction, never going back.
///
/// All federates of a host read the same clock, so that without corrections their times compare exactly.
#[derive(Debug, Default)]
pub struct SystemClock {
    correction_ns: AtomicI64,
    latest_ns: AtomicI64,
}

impl SystemClock {
    /// The host's clock as it is.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds `offset` to every later reading.
    pub fn correct(&self, offset: Duration) {
        self.correction_ns
            .fetch_add(offset.as_nanos(), Ordering::Relaxed);
    }
}

impl Clock for SystemClock {
    fn now(&self) -> PhysicalTime {
        // A clock before 1970 or after 2262 reads as the epoch: the federation then starts there, consistently.
        let since_epoch = SystemTime::now()
            .duration_since(UNIX_EPOCH)
            .unwrap_or_default();
        let host = i64::try_from(since_epoch.as_nanos()).unwrap_or(0);
        let reading = host.saturating_add(self.correction_ns.load(Ordering::Relaxed));
        let latest = self.latest_ns.load(Ordering::Relaxed);
        if reading > latest {
            self.latest_ns.store(reading, Ordering::Relaxed);
        }
        PhysicalTime::from_nanos(reading.max(latest))
    }
}
