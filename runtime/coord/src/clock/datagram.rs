//! The datagrams of continuous synchronization.

use ictus_core::PhysicalTime;

use crate::wire::kind;

/// The longest datagram in bytes; a longer one is none of ours.
pub const LONGEST: usize = 17;

/// A datagram from the RTI: one byte of type, a reading of the RTI's clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Datagram {
    /// An exchange begins.
    T1(PhysicalTime),
    /// T3 came.
    T4 {
        /// When.
        came: PhysicalTime,
        /// When T1 left, which nobody knew when it was written; only for who repeats T1.
        left: Option<PhysicalTime>,
    },
    /// As much after T4 as the readings differ: what was between them on the way is known by how the distance has changed.
    CodedProbe(PhysicalTime),
}

/// The bytes of a datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Encoded {
    bytes: [u8; LONGEST],
    length: usize,
}

impl Encoded {
    fn new(kind: u8) -> Self {
        let bytes = [kind; LONGEST];
        Self { bytes, length: 1 }
    }

    fn put(mut self, bytes: &[u8]) -> Self {
        let end = self.length + bytes.len();
        self.bytes[self.length..end].copy_from_slice(bytes);
        self.length = end;
        self
    }

    fn time(self, time: PhysicalTime) -> Self {
        self.put(&time.as_nanos().to_le_bytes())
    }
}

impl std::ops::Deref for Encoded {
    type Target = [u8];
    fn deref(&self) -> &[u8] {
        &self.bytes[..self.length]
    }
}

impl Datagram {
    /// The bytes on the wire.
    ///
    /// Law `datagrams_round_trip`: decoding gives the datagram back.
    #[must_use]
    pub fn encode(self) -> Encoded {
        match self {
            Self::T1(time) => Encoded::new(kind::CLOCK_SYNC_T1).time(time),
            Self::T4 { came, left } => {
                let short = Encoded::new(kind::CLOCK_SYNC_T4).time(came);
                left.map_or(short, |left| short.time(left))
            }
            Self::CodedProbe(time) => Encoded::new(kind::CLOCK_SYNC_CODED_PROBE).time(time),
        }
    }

    /// The datagram, when the bytes are exactly one. Law `strange_datagrams_are_none`: any bytes may come.
    #[must_use]
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let (first, rest) = bytes.split_at_checked(9)?;
        let &[kind, ref first @ ..] = first else {
            return None;
        };
        let first = time(first)?;
        match (kind, rest) {
            (kind::CLOCK_SYNC_T1, []) => Some(Self::T1(first)),
            (kind::CLOCK_SYNC_T4, rest) => Some(Self::T4 {
                came: first,
                left: if rest.is_empty() {
                    None
                } else {
                    Some(time(rest)?)
                },
            }),
            (kind::CLOCK_SYNC_CODED_PROBE, []) => Some(Self::CodedProbe(first)),
            _ => None,
        }
    }
}

fn time(bytes: &[u8]) -> Option<PhysicalTime> {
    let nanos = i64::from_le_bytes(bytes.try_into().ok()?);
    Some(PhysicalTime::from_nanos(nanos))
}

/// A datagram from a federate: T3. Between ours it repeats the T1 that it answers, so that one that comes late answers nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FromFederate {
    /// The federate's id.
    pub federate: u16,
    /// The reading in T1; absent from LF's federates, and for LF's RTI.
    pub echo: Option<PhysicalTime>,
}

impl FromFederate {
    /// The bytes on the wire.
    #[must_use]
    pub fn encode(self) -> Encoded {
        let short = Encoded::new(kind::CLOCK_SYNC_T3).put(&self.federate.to_le_bytes());
        self.echo.map_or(short, |echo| short.time(echo))
    }

    /// The datagram, when the bytes are exactly one.
    #[must_use]
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let &[kind::CLOCK_SYNC_T3, low, high, ref echo @ ..] = bytes else {
            return None;
        };
        let echo = if echo.is_empty() {
            None
        } else {
            Some(time(echo)?)
        };
        let federate = u16::from_le_bytes([low, high]);
        Some(Self { federate, echo })
    }
}
