//! Logical time, physical time and durations: signed nanoseconds, never mixed implicitly.
//!
//! Both time lines count nanoseconds since the Unix epoch in an `i64`, as Lingua Franca does, so that tags and
//! clock readings cross the wire unchanged. They are different types on purpose: the only way from one to the
//! other is by name ([`PhysicalTime::as_logical`], [`LogicalTime::as_physical`]).

use std::fmt;
use std::ops::{Add, Neg, Sub};

/// A signed span of time in nanoseconds.
///
/// Arithmetic with operators panics on overflow; `saturating_*` and `checked_*` exist where input may be hostile.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct Duration(i64);

impl Duration {
    /// No time at all.
    pub const ZERO: Self = Self(0);
    /// One nanosecond, the resolution of both time lines.
    pub const NANOSECOND: Self = Self(1);
    /// The longest span; behaves as "for ever" where it is a bound.
    pub const MAX: Self = Self(i64::MAX);

    /// From nanoseconds.
    #[must_use]
    pub const fn from_nanos(nanos: i64) -> Self {
        Self(nanos)
    }

    /// From microseconds, saturating.
    #[must_use]
    pub const fn from_micros(micros: i64) -> Self {
        Self(micros.saturating_mul(1_000))
    }

    /// From milliseconds, saturating.
    #[must_use]
    pub const fn from_millis(millis: i64) -> Self {
        Self(millis.saturating_mul(1_000_000))
    }

    /// From seconds, saturating.
    #[must_use]
    pub const fn from_secs(secs: i64) -> Self {
        Self(secs.saturating_mul(1_000_000_000))
    }

    /// In nanoseconds.
    #[must_use]
    pub const fn as_nanos(self) -> i64 {
        self.0
    }

    /// The sum, clamped to the ends of the range.
    #[must_use]
    pub const fn saturating_add(self, other: Self) -> Self {
        Self(self.0.saturating_add(other.0))
    }

    /// This span as the standard library's unsigned type; negative spans become zero.
    #[must_use]
    pub fn to_std(self) -> std::time::Duration {
        std::time::Duration::from_nanos(u64::try_from(self.0).unwrap_or(0))
    }
}

impl Add for Duration {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self(self.0 + other.0)
    }
}

impl Sub for Duration {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        Self(self.0 - other.0)
    }
}

impl Neg for Duration {
    type Output = Self;
    fn neg(self) -> Self {
        Self(-self.0)
    }
}

impl fmt::Display for Duration {
    /// The largest unit that divides the span: `100 ms`, `1500 us`, `7 ns`, `0 ns`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let nanos = self.0;
        match nanos {
            n if n != 0 && n % 1_000_000_000 == 0 => write!(f, "{} s", n / 1_000_000_000),
            n if n != 0 && n % 1_000_000 == 0 => write!(f, "{} ms", n / 1_000_000),
            n if n != 0 && n % 1_000 == 0 => write!(f, "{} us", n / 1_000),
            n => write!(f, "{n} ns"),
        }
    }
}

impl fmt::Debug for Duration {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl From<std::time::Duration> for Duration {
    fn from(duration: std::time::Duration) -> Self {
        Self(i64::try_from(duration.as_nanos()).unwrap_or(i64::MAX))
    }
}

/// `100.ms()`, `5.secs()`: durations as they are said.
pub trait DurationExt {
    /// This many nanoseconds.
    fn ns(self) -> Duration;
    /// This many microseconds.
    fn us(self) -> Duration;
    /// This many milliseconds.
    fn ms(self) -> Duration;
    /// This many seconds.
    fn secs(self) -> Duration;
}

impl DurationExt for i64 {
    fn ns(self) -> Duration {
        Duration::from_nanos(self)
    }
    fn us(self) -> Duration {
        Duration::from_micros(self)
    }
    fn ms(self) -> Duration {
        Duration::from_millis(self)
    }
    fn secs(self) -> Duration {
        Duration::from_secs(self)
    }
}

macro_rules! time_line {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub struct $name(i64);

        impl $name {
            /// Before every time (-2^63 ns). Absorbs: adding to it leaves it.
            pub const NEVER: Self = Self(i64::MIN);
            /// After every time (2^63-1 ns). Absorbs: adding to it leaves it.
            pub const FOREVER: Self = Self(i64::MAX);

            /// From nanoseconds since the Unix epoch.
            #[must_use]
            pub const fn from_nanos(nanos: i64) -> Self {
                Self(nanos)
            }

            /// In nanoseconds since the Unix epoch.
            #[must_use]
            pub const fn as_nanos(self) -> i64 {
                self.0
            }

            /// This time plus `duration`; NEVER and FOREVER absorb, and a sum out of range becomes the nearer of them.
            #[must_use]
            pub const fn saturating_add(self, duration: Duration) -> Self {
                match self {
                    Self::NEVER | Self::FOREVER => self,
                    Self(nanos) => Self(nanos.saturating_add(duration.0)),
                }
            }

            /// The span from `earlier` to this time, clamped to the range of [`Duration`].
            #[must_use]
            pub const fn since(self, earlier: Self) -> Duration {
                Duration(self.0.saturating_sub(earlier.0))
            }
        }

        impl Add<Duration> for $name {
            type Output = Self;
            fn add(self, duration: Duration) -> Self {
                self.saturating_add(duration)
            }
        }

        impl Sub for $name {
            type Output = Duration;
            fn sub(self, earlier: Self) -> Duration {
                self.since(earlier)
            }
        }

        impl fmt::Debug for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                match *self {
                    Self::NEVER => f.write_str("NEVER"),
                    Self::FOREVER => f.write_str("FOREVER"),
                    Self(nanos) => write!(f, "{nanos}"),
                }
            }
        }
    };
}

time_line! {
    /// A point on the logical time line: nanoseconds since the Unix epoch, the first half of a [`Tag`](crate::Tag).
    LogicalTime
}

time_line! {
    /// A reading of a clock: nanoseconds since the Unix epoch, plus whatever clock synchronization adds.
    PhysicalTime
}

impl LogicalTime {
    /// The physical time at which this logical time is due.
    #[must_use]
    pub const fn as_physical(self) -> PhysicalTime {
        PhysicalTime(self.0)
    }
}

impl PhysicalTime {
    /// The logical time that this clock reading stands for.
    #[must_use]
    pub const fn as_logical(self) -> LogicalTime {
        LogicalTime(self.0)
    }
}

mod text;
pub use text::ParseDurationError;
