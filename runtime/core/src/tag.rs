//! Superdense time: tags, delays, and the arithmetic every peer of a federation must share.
//!
//! Source: Lingua Franca, reactor-c `tag.c`; section 1.2 of the wire document.

use crate::time::{Duration, LogicalTime};
use std::fmt;

/// A tag: logical time and microstep, ordered lexicographically.
///
/// [`Tag::NEVER`] precedes and [`Tag::FOREVER`] follows every tag; both absorb under delays.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Tag {
    /// Nanoseconds since the Unix epoch.
    pub time: LogicalTime,
    /// Position among the tags of the same time, from 0.
    pub microstep: u32,
}

/// The delay of a connection. No delay is not a delay of zero: a zero delay is one microstep.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum Delay {
    /// No `after` at all: a message keeps its tag.
    None,
    /// `after 0`: a message arrives one microstep later.
    Microstep,
    /// `after d` with d > 0: a message arrives at (time + d, 0).
    Time(Duration),
}

impl Delay {
    /// The delay that `after duration` stands for; a negative duration stands for no delay, as on the wire.
    #[must_use]
    pub const fn after(duration: Duration) -> Self {
        match duration.as_nanos() {
            0 => Self::Microstep,
            nanos if nanos < 0 => Self::None,
            _ => Self::Time(duration),
        }
    }

    /// How much time it adds: none but for [`Delay::Time`].
    #[must_use]
    pub const fn span(self) -> Duration {
        match self {
            Self::None | Self::Microstep => Duration::ZERO,
            Self::Time(duration) => duration,
        }
    }
}

impl Tag {
    /// Before every tag: (-2^63, 0).
    pub const NEVER: Self = Self {
        time: LogicalTime::NEVER,
        microstep: 0,
    };
    /// After every tag: (2^63-1, 2^32-1).
    pub const FOREVER: Self = Self {
        time: LogicalTime::FOREVER,
        microstep: u32::MAX,
    };
    /// (0, 0): the neutral path delay.
    pub const ZERO: Self = Self {
        time: LogicalTime::from_nanos(0),
        microstep: 0,
    };

    /// The tag (`time`, `microstep`).
    #[must_use]
    pub const fn new(time: LogicalTime, microstep: u32) -> Self {
        Self { time, microstep }
    }

    /// The tag (`nanos`, 0).
    #[must_use]
    pub const fn at(nanos: i64) -> Self {
        Self::new(LogicalTime::from_nanos(nanos), 0)
    }

    /// Returns the tag of a message sent at this tag over a connection with `delay`.
    ///
    /// Law `delay_is_monotone`: short of overflow, a later tag is never delayed to an earlier one. NEVER is left alone; reaching
    /// FOREVER gives [`Tag::FOREVER`]; a microstep past 2^32-1 is [`Tag::FOREVER`] too (reactor-c wraps to 0,
    /// which would send a message into the past; a federation that gets there is stopped).
    #[must_use]
    pub const fn delayed(self, delay: Delay) -> Self {
        if self.time.as_nanos() == i64::MIN || self.time.as_nanos() == i64::MAX {
            return self;
        }
        match delay {
            Delay::None => self,
            Delay::Microstep => match self.microstep.checked_add(1) {
                Some(microstep) => Self {
                    time: self.time,
                    microstep,
                },
                None => Self::FOREVER,
            },
            Delay::Time(duration) => match self.time.saturating_add(duration) {
                LogicalTime::FOREVER => Self::FOREVER,
                time => Self { time, microstep: 0 },
            },
        }
    }

    /// As [`Tag::delayed`], but one step earlier for a positive delay: all tags up to and including the result are
    /// settled once this tag is.
    ///
    /// Law `strict_delay_is_the_tag_before`: for a positive delay it is `self.delayed(d).latest_earlier()`.
    #[must_use]
    pub const fn delayed_strict(self, delay: Delay) -> Self {
        match delay {
            Delay::None | Delay::Microstep => self.delayed(delay),
            Delay::Time(_) => {
                let delayed = self.delayed(delay);
                if delayed.time.as_nanos() == i64::MIN || delayed.time.as_nanos() == i64::MAX {
                    delayed
                } else {
                    delayed.latest_earlier()
                }
            }
        }
    }

    /// Returns the latest tag before this one. NEVER and FOREVER are left alone.
    #[must_use]
    pub const fn latest_earlier(self) -> Self {
        if self.time.as_nanos() == i64::MIN || self.time.as_nanos() == i64::MAX {
            self
        } else if self.microstep == 0 {
            let time = LogicalTime::from_nanos(self.time.as_nanos() - 1);
            if time.as_nanos() == i64::MIN {
                Self::NEVER
            } else {
                Self {
                    time,
                    microstep: u32::MAX,
                }
            }
        } else {
            Self {
                time: self.time,
                microstep: self.microstep - 1,
            }
        }
    }

    /// Returns the next tag at the same time, or `None` when the microsteps are used up or the tag is NEVER or FOREVER.
    #[must_use]
    pub const fn next_microstep(self) -> Option<Self> {
        match self.delayed(Delay::Microstep) {
            Self::FOREVER | Self::NEVER => None,
            tag => Some(tag),
        }
    }

    /// Returns the least tag after this one: the inverse of [`Tag::latest_earlier`]. NEVER and FOREVER are left alone.
    #[must_use]
    pub const fn successor(self) -> Self {
        match self.next_microstep() {
            Some(tag) => tag,
            None if self.microstep == u32::MAX && self.time.as_nanos() != i64::MAX => Self {
                time: self.time,
                microstep: 0,
            }
            .delayed(Delay::Time(Duration::from_nanos(1))),
            None => self,
        }
    }

    /// Adds a path delay given as a tag; the later connection of a path is the argument.
    ///
    /// NEVER absorbs, then FOREVER; a positive time in `path` drops this tag's microstep. Not commutative.
    /// Law `path_addition_is_monotone`: short of overflow, in both arguments when the paths differ by whole delays.
    #[must_use]
    pub const fn plus_path(self, path: Self) -> Self {
        let (a, b) = (self.time.as_nanos(), path.time.as_nanos());
        if a == i64::MIN || b == i64::MIN {
            return Self::NEVER;
        }
        if a == i64::MAX || b == i64::MAX {
            return Self::FOREVER;
        }
        let microstep = if b > 0 { 0 } else { self.microstep };
        match (a.checked_add(b), microstep.checked_add(path.microstep)) {
            (Some(time), Some(microstep)) if time != i64::MAX => Self {
                time: LogicalTime::from_nanos(time),
                microstep,
            },
            _ => Self::FOREVER,
        }
    }

    /// The path delay of one connection: (0,0) for none, (0,1) for `after 0`, (d,0) for `after d`.
    #[must_use]
    pub const fn of_delay(delay: Delay) -> Self {
        Self::ZERO.delayed(delay)
    }
}

impl fmt::Display for Tag {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::NEVER => f.write_str("NEVER"),
            Self::FOREVER => f.write_str("FOREVER"),
            Self { time, microstep } => write!(f, "({}, {microstep})", time.as_nanos()),
        }
    }
}

impl fmt::Debug for Tag {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn tag() -> impl Strategy<Value = Tag> {
        prop_oneof![
            1 => Just(Tag::NEVER),
            1 => Just(Tag::FOREVER),
            2 => (i64::MAX - 10..i64::MAX, 0u32..4)
                .prop_map(|(t, m)| Tag::new(LogicalTime::from_nanos(t), m)),
            8 => (-5i64..20, 0u32..4).prop_map(|(t, m)| Tag::new(LogicalTime::from_nanos(t), m)),
        ]
    }

    fn delay() -> impl Strategy<Value = Delay> {
        (-1i64..10).prop_map(|d| Delay::after(Duration::from_nanos(d)))
    }

    proptest! {
        #[test]
        fn delay_is_monotone(a in tag(), b in tag(), d in delay()) {
            let (low, high) = (a.min(b), a.max(b));
            prop_assert!(low.delayed(d) <= high.delayed(d));
        }

        #[test]
        fn strict_delay_is_the_tag_before(a in tag(), d in 1i64..10) {
            let d = Delay::Time(Duration::from_nanos(d));
            prop_assert_eq!(a.delayed_strict(d), a.delayed(d).latest_earlier());
        }

        #[test]
        fn latest_earlier_is_the_predecessor(a in tag(), b in tag()) {
            prop_assume!(a != Tag::NEVER && a != Tag::FOREVER);
            let before = a.latest_earlier();
            prop_assert!(before < a);
            prop_assert_eq!(before.successor(), a);
            prop_assert!(!(before < b && b < a));
        }

        #[test]
        fn path_addition_is_monotone(a in tag(), b in tag(), c in delay(), d in delay()) {
            let (p, q) = (Tag::of_delay(c), Tag::of_delay(d));
            prop_assert!(a.min(b).plus_path(p) <= a.max(b).plus_path(p));
            prop_assume!(a.microstep == 0 || p.time == q.time);
            prop_assert!(a.plus_path(p.min(q)) <= a.plus_path(p.max(q)));
        }

        #[test]
        fn a_path_of_one_connection_is_its_delay(a in tag(), d in delay()) {
            prop_assert_eq!(a.plus_path(Tag::of_delay(d)), a.delayed(d));
        }
    }

    #[test]
    fn delays_of_the_wire_document() {
        let g = Tag::new(LogicalTime::from_nanos(7), 3);
        let table = [
            (
                Delay::None,
                Tag::new(LogicalTime::from_nanos(7), 3),
                Tag::new(LogicalTime::from_nanos(7), 3),
            ),
            (
                Delay::Microstep,
                Tag::new(LogicalTime::from_nanos(7), 4),
                Tag::new(LogicalTime::from_nanos(7), 4),
            ),
            (
                Delay::Time(Duration::from_nanos(5)),
                Tag::at(12),
                Tag::new(LogicalTime::from_nanos(11), u32::MAX),
            ),
        ];
        for (delay, expected, strict) in table {
            assert_eq!(g.delayed(delay), expected);
            assert_eq!(g.delayed_strict(delay), strict);
        }
    }
}
