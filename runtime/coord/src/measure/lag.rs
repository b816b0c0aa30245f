//! Whether a federate's lag keeps growing.

use ictus_core::{Duration, PhysicalTime};

/// How long a window of samples is.
const WINDOW: Duration = Duration::from_secs(1);
/// How many windows in a row must have grown.
const GROWTHS: u32 = 5;
/// A lag that is none yet, however it grows.
const LIMIT: Duration = Duration::from_millis(100);

/// Watches the lag behind physical time.
///
/// The minimum of a one-second window stands for it, so that a burst that is worked off counts for nothing. The federate
/// is *falling behind* when the minimum has grown for 5 windows in a row and exceeds 100 ms; it has *caught up* when a
/// window's minimum is at most 100 ms again. Windows without a sample are passed over.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LagWatch {
    window: Option<Window>,
    /// The minimum of the window before.
    before: Option<Duration>,
    growths: u32,
    behind: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Window {
    ends: PhysicalTime,
    least: Duration,
}

/// What changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LagNews {
    /// The lag keeps growing.
    FallingBehind {
        /// The least lag of the last window.
        lag: Duration,
    },
    /// The lag is small again.
    CaughtUp {
        /// The least lag of the last window.
        lag: Duration,
    },
}

impl LagWatch {
    /// Whether the federate is falling behind at the moment.
    #[must_use]
    pub const fn behind(&self) -> bool {
        self.behind
    }

    /// Takes a sample: at `now` (which does not go back) the federate is `lag` behind.
    pub fn sample(&mut self, now: PhysicalTime, lag: Duration) -> Option<LagNews> {
        match &mut self.window {
            Some(window) if now < window.ends => {
                window.least = window.least.min(lag);
                None
            }
            window => {
                let ends = now.saturating_add(WINDOW);
                let ended = window.replace(Window { ends, least: lag });
                ended.and_then(|ended| self.close(ended.least))
            }
        }
    }

    fn close(&mut self, least: Duration) -> Option<LagNews> {
        let grown = self.before.is_some_and(|before| least > before);
        self.before = Some(least);
        self.growths = if grown {
            self.growths.saturating_add(1)
        } else {
            0
        };
        if self.behind && least <= LIMIT {
            self.behind = false;
            return Some(LagNews::CaughtUp { lag: least });
        }
        if !self.behind && self.growths >= GROWTHS && least > LIMIT {
            self.behind = true;
            return Some(LagNews::FallingBehind { lag: least });
        }
        None
    }
}
