//! The datagrams of continuous synchronization.

use ictus_core::PhysicalTime;

use crate::wire::kind;

/// The longest datagram in bytes; a longer one is none of ours.
pub const LONGEST: usize = 11;

/// A datagram from the RTI: one byte of type, a reading of the RTI's clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Datagram {
    /// An exchange begins.
    T1(PhysicalTime),
    /// T3 came then.
    T4(PhysicalTime),
    /// As much after T4 as the readings differ: what was between them on the way is known by how the distance has changed.
    CodedProbe(PhysicalTime),
}

impl Datagram {
    /// The bytes on the wire.
    ///
    /// Law `datagrams_round_trip`: decoding gives the datagram back.
    #[must_use]
    pub fn encode(self) -> [u8; 9] {
        let (kind, time) = match self {
            Self::T1(time) => (kind::CLOCK_SYNC_T1, time),
            Self::T4(time) => (kind::CLOCK_SYNC_T4, time),
            Self::CodedProbe(time) => (kind::CLOCK_SYNC_CODED_PROBE, time),
        };
        let mut bytes = [kind; 9];
        bytes[1..].copy_from_slice(&time.as_nanos().to_le_bytes());
        bytes
    }

    /// The datagram, when the bytes are exactly one. Law `strange_datagrams_are_none`: any bytes may come.
    #[must_use]
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let &[kind, ref time @ ..] = bytes else {
            return None;
        };
        let time = PhysicalTime::from_nanos(i64::from_le_bytes(time.try_into().ok()?));
        match kind {
            kind::CLOCK_SYNC_T1 => Some(Self::T1(time)),
            kind::CLOCK_SYNC_T4 => Some(Self::T4(time)),
            kind::CLOCK_SYNC_CODED_PROBE => Some(Self::CodedProbe(time)),
            _ => None,
        }
    }
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
    /// The bytes on the wire and how many of them there are.
    #[must_use]
    pub fn encode(self) -> ([u8; LONGEST], usize) {
        let mut bytes = [kind::CLOCK_SYNC_T3; LONGEST];
        bytes[1..3].copy_from_slice(&self.federate.to_le_bytes());
        let Some(echo) = self.echo else {
            return (bytes, 3);
        };
        bytes[3..].copy_from_slice(&echo.as_nanos().to_le_bytes());
        (bytes, LONGEST)
    }

    /// The datagram, when the bytes are exactly one.
    #[must_use]
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let &[kind::CLOCK_SYNC_T3, low, high, ref echo @ ..] = bytes else {
            return None;
        };
        let echo = match echo {
            [] => None,
            echo => {
                let nanos = i64::from_le_bytes(echo.try_into().ok()?);
                Some(PhysicalTime::from_nanos(nanos))
            }
        };
        let federate = u16::from_le_bytes([low, high]);
        Some(Self { federate, echo })
    }
}
