//! Reading and writing the protocol's scalars and shared bodies.

use ictus_core::{Delay, Duration, LogicalTime, PhysicalTime, Tag};

use super::{DecodeError, NeighborStructure, PeerMessage, PortAbsent, TaggedMessage, ToRti, kind};
use crate::plan::Wire;

/// Takes scalars from the front of a slice; every method gives `None` when bytes are missing.
pub(super) struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Reader<'a> {
    pub(super) const fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0 }
    }

    pub(super) const fn consumed(&self) -> usize {
        self.at
    }

    pub(super) fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        let array = *self.bytes.get(self.at..)?.first_chunk::<N>()?;
        self.at += N;
        Some(array)
    }

    fn slice(&mut self, length: usize) -> Option<&'a [u8]> {
        let slice = self.bytes.get(self.at..)?.get(..length)?;
        self.at += length;
        Some(slice)
    }

    pub(super) fn u8(&mut self) -> Option<u8> {
        self.array::<1>().map(|[byte]| byte)
    }

    pub(super) fn u16(&mut self) -> Option<u16> {
        self.array().map(u16::from_le_bytes)
    }

    pub(super) fn u32(&mut self) -> Option<u32> {
        self.array().map(u32::from_le_bytes)
    }

    pub(super) fn i32(&mut self) -> Option<i32> {
        self.array().map(i32::from_le_bytes)
    }

    fn i64(&mut self) -> Option<i64> {
        self.array().map(i64::from_le_bytes)
    }

    pub(super) fn time(&mut self) -> Option<PhysicalTime> {
        self.i64().map(PhysicalTime::from_nanos)
    }

    pub(super) fn tag(&mut self) -> Option<Tag> {
        let bytes: [u8; 12] = self.array()?;
        let (time, microstep) = bytes.split_first_chunk::<8>()?;
        let microstep = u32::from_le_bytes(*microstep.first_chunk()?);
        Some(match LogicalTime::from_nanos(i64::from_le_bytes(*time)) {
            LogicalTime::NEVER => Tag::NEVER,
            LogicalTime::FOREVER => Tag::FOREVER,
            time => Tag::new(time, microstep),
        })
    }

    fn delay(&mut self) -> Option<Delay> {
        self.i64()
            .map(|nanos| Delay::after(Duration::from_nanos(nanos)))
    }

    pub(super) fn short_bytes(&mut self) -> Option<&'a [u8]> {
        let length = self.u8()?;
        self.slice(usize::from(length))
    }

    pub(super) fn message(
        &mut self,
        max_payload: u32,
    ) -> Result<Option<TaggedMessage<'a>>, DecodeError> {
        let Some((port, federate, length)) = self.message_head() else {
            return Ok(None);
        };
        within(length, max_payload)?;
        Ok(self
            .message_rest(length)
            .map(|(tag, payload)| TaggedMessage {
                port,
                federate,
                tag,
                payload,
            }))
    }

    /// The body of an untagged message.
    pub(super) fn peer_message(
        &mut self,
        max_payload: u32,
    ) -> Result<Option<PeerMessage<'a>>, DecodeError> {
        let Some((port, federate, length)) = self.message_head() else {
            return Ok(None);
        };
        within(length, max_payload)?;
        let payload = usize::try_from(length).ok().and_then(|n| self.slice(n));
        Ok(payload.map(|payload| PeerMessage {
            port,
            federate,
            payload,
        }))
    }

    pub(super) fn address_query(&mut self, wire: Wire) -> Option<ToRti<'a>> {
        let federate = self.u16()?;
        let transient = match wire {
            Wire::V0_12 => None,
            Wire::V0_13 => Some(self.flag()?),
        };
        Some(ToRti::AddressQuery {
            federate,
            transient,
        })
    }

    /// Any byte but 0 is true, as in C.
    pub(super) fn flag(&mut self) -> Option<bool> {
        self.u8().map(|byte| byte != 0)
    }

    fn message_head(&mut self) -> Option<(u16, u16, u32)> {
        Some((self.u16()?, self.u16()?, self.u32()?))
    }

    fn message_rest(&mut self, length: u32) -> Option<(Tag, &'a [u8])> {
        let tag = self.tag()?;
        Some((tag, self.slice(usize::try_from(length).ok()?)?))
    }

    pub(super) fn absent(&mut self) -> Option<PortAbsent> {
        Some(PortAbsent {
            port: self.u16()?,
            federate: self.u16()?,
            tag: self.tag()?,
        })
    }

    pub(super) fn neighbors(&mut self) -> Result<Option<NeighborStructure>, DecodeError> {
        let (Some(upstream), Some(downstream)) = (self.i32(), self.i32()) else {
            return Ok(None);
        };
        let upstream = neighbor_count(upstream)?;
        let downstream = neighbor_count(downstream)?;
        let left = self.bytes.len() - self.at;
        if left < upstream * 10 + downstream * 2 {
            return Ok(None);
        }
        Ok(self.neighbor_lists(upstream, downstream))
    }

    fn neighbor_lists(&mut self, upstream: usize, downstream: usize) -> Option<NeighborStructure> {
        let upstream = (0..upstream)
            .map(|_| Some((self.u16()?, self.delay()?)))
            .collect::<Option<_>>()?;
        let downstream = (0..downstream).map(|_| self.u16()).collect::<Option<_>>()?;
        Some(NeighborStructure {
            upstream,
            downstream,
        })
    }
}

fn within(length: u32, limit: u32) -> Result<(), DecodeError> {
    if length > limit {
        return Err(DecodeError::PayloadTooLong { length, limit });
    }
    Ok(())
}

fn neighbor_count(count: i32) -> Result<usize, DecodeError> {
    u16::try_from(count)
        .map(usize::from)
        .map_err(|_| DecodeError::NeighborCount(count))
}

/// Appends scalars to a buffer.
pub(super) struct Writer<'a>(pub(super) &'a mut Vec<u8>);

impl Writer<'_> {
    pub(super) fn bytes(&mut self, bytes: &[u8]) -> &mut Self {
        self.0.extend_from_slice(bytes);
        self
    }

    pub(super) fn u8(&mut self, value: u8) -> &mut Self {
        self.0.push(value);
        self
    }

    pub(super) fn u16(&mut self, value: u16) -> &mut Self {
        self.bytes(&value.to_le_bytes())
    }

    pub(super) fn u32(&mut self, value: u32) -> &mut Self {
        self.bytes(&value.to_le_bytes())
    }

    pub(super) fn i32(&mut self, value: i32) -> &mut Self {
        self.bytes(&value.to_le_bytes())
    }

    fn i64(&mut self, value: i64) -> &mut Self {
        self.bytes(&value.to_le_bytes())
    }

    pub(super) fn tag(&mut self, tag: Tag) -> &mut Self {
        self.i64(tag.time.as_nanos()).u32(tag.microstep)
    }

    pub(super) fn time(&mut self, kind: u8, time: PhysicalTime) {
        self.u8(kind).i64(time.as_nanos());
    }

    pub(super) fn tag_only(&mut self, kind: u8, tag: Tag) {
        let mut message = [kind; 13];
        message[1..9].copy_from_slice(&tag.time.as_nanos().to_le_bytes());
        message[9..].copy_from_slice(&tag.microstep.to_le_bytes());
        self.bytes(&message);
    }

    /// At most 255 bytes, after their number.
    pub(super) fn short_bytes(&mut self, bytes: &[u8]) {
        let length = u8::try_from(bytes.len()).unwrap_or(u8::MAX);
        self.u8(length).bytes(&bytes[..usize::from(length)]);
    }

    /// The payload's length is a u32 on the wire.
    pub(super) fn message(&mut self, kind: u8, message: &TaggedMessage<'_>) {
        let length = u32::try_from(message.payload.len()).expect("a payload is under 4 GiB");
        let mut head = [kind; 21];
        head[1..3].copy_from_slice(&message.port.to_le_bytes());
        head[3..5].copy_from_slice(&message.federate.to_le_bytes());
        head[5..9].copy_from_slice(&length.to_le_bytes());
        head[9..17].copy_from_slice(&message.tag.time.as_nanos().to_le_bytes());
        head[17..].copy_from_slice(&message.tag.microstep.to_le_bytes());
        self.bytes(&head).bytes(message.payload);
    }

    /// The payload's length is a u32 on the wire.
    pub(super) fn peer_message(&mut self, message: &PeerMessage<'_>) {
        let length = u32::try_from(message.payload.len()).expect("a payload is under 4 GiB");
        self.u8(kind::P2P_MESSAGE)
            .u16(message.port)
            .u16(message.federate)
            .u32(length)
            .bytes(message.payload);
    }

    pub(super) fn absent(&mut self, absent: &PortAbsent) {
        self.u8(kind::PORT_ABSENT)
            .u16(absent.port)
            .u16(absent.federate)
            .tag(absent.tag);
    }

    pub(super) fn neighbors(&mut self, neighbors: &NeighborStructure) {
        let count = |n: usize| i32::try_from(n).expect("a federate has under 65536 neighbours");
        self.u8(kind::NEIGHBOR_STRUCTURE);
        self.i32(count(neighbors.upstream.len()))
            .i32(count(neighbors.downstream.len()));
        for &(federate, delay) in &neighbors.upstream {
            self.u16(federate).i64(delay_nanos(delay));
        }
        for &federate in &neighbors.downstream {
            self.u16(federate);
        }
    }
}

const fn delay_nanos(delay: Delay) -> i64 {
    match delay {
        Delay::None => i64::MIN,
        Delay::Microstep => 0,
        Delay::Time(duration) => duration.as_nanos(),
    }
}
