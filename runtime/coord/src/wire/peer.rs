//! Messages between two federates: one stream per (sender, receiver), used in one direction.
//!
//! The sender begins with [`ToPeer::Hello`], the receiver answers it with a [`FromPeer`] and writes nothing else.
//!
//! Source: sections 3.6, 7 and 11 of the wire document.

use ictus_core::Tag;

use super::codec::{Reader, Writer};
use super::{DecodeError, PortAbsent, RejectReason, TaggedMessage, kind};
use crate::plan::Wire;

/// A message from a federate to a federate that it sends to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ToPeer<'a> {
    /// Who the sender is; the first message of a stream.
    Hello {
        /// The sender's id.
        federate: u16,
        /// The federation id, at most 255 bytes (a longer one is cut when it is encoded).
        federation: &'a [u8],
        /// Whether the sender is transient; only LF 0.13's layout carries it, else it is false.
        transient: bool,
    },
    /// A message on a physical connection.
    Message(PeerMessage<'a>),
    /// A message on a logical connection.
    TaggedMessage(TaggedMessage<'a>),
    /// An absent input.
    PortAbsent(PortAbsent),
}

/// A message on a physical connection: it has no tag.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PeerMessage<'a> {
    /// The destination's port id.
    pub port: u16,
    /// The destination.
    pub federate: u16,
    /// The serialized value, opaque here.
    pub payload: &'a [u8],
}

/// What a federate answers to [`ToPeer::Hello`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FromPeer {
    /// The stream is open.
    Ack,
    /// The stream is refused; it closes.
    Reject(RejectReason),
}

impl<'a> ToPeer<'a> {
    /// The message's name in LF's terms, for people.
    #[must_use]
    pub const fn name(&self) -> &'static str {
        match self {
            Self::Hello { .. } => "P2P_SENDING_FED_ID",
            Self::Message(_) => "P2P_MESSAGE",
            Self::TaggedMessage(_) => "P2P_TAGGED_MESSAGE",
            Self::PortAbsent(_) => "PORT_ABSENT",
        }
    }

    /// Appends the message's bytes, in the layout of `wire`, to `out`.
    ///
    /// Law `to_peer_round_trip`: decoding gives the message back.
    ///
    /// # Panics
    ///
    /// When a payload is longer than `u32::MAX` bytes.
    pub fn encode(&self, wire: Wire, out: &mut Vec<u8>) {
        let mut w = Writer(out);
        match self {
            Self::Hello {
                federate,
                federation,
                transient,
            } => {
                w.u8(kind::P2P_FEDERATE_ID).u16(*federate);
                if wire == Wire::V0_13 {
                    w.u8(u8::from(*transient));
                }
                w.short_bytes(federation);
            }
            Self::Message(message) => w.peer_message(message),
            Self::TaggedMessage(message) => w.message(kind::P2P_TAGGED_MESSAGE, message),
            Self::PortAbsent(absent) => w.absent(absent),
        }
    }

    /// Decodes the message at the start of `bytes` and says how many bytes it takes; `None` when more are needed.
    ///
    /// Laws `decode_never_panics` and `every_prefix_is_incomplete`. Nothing is copied.
    ///
    /// # Errors
    ///
    /// When the type is unknown or a payload is longer than `max_payload` bytes; the stream cannot be read any further.
    pub fn decode(
        bytes: &'a [u8],
        wire: Wire,
        max_payload: u32,
    ) -> Result<Option<(Self, usize)>, DecodeError> {
        let mut r = Reader::new(bytes);
        let Some(kind) = r.u8() else { return Ok(None) };
        let message = match kind {
            kind::P2P_TAGGED_MESSAGE => r.message(max_payload)?.map(Self::TaggedMessage),
            kind::P2P_MESSAGE => r.peer_message(max_payload)?.map(Self::Message),
            kind::PORT_ABSENT => r.absent().map(Self::PortAbsent),
            kind::P2P_FEDERATE_ID => Self::decode_hello(wire, &mut r),
            _ => return Err(DecodeError::UnknownType(kind)),
        };
        Ok(message.map(|message| (message, r.consumed())))
    }

    fn decode_hello(wire: Wire, r: &mut Reader<'a>) -> Option<Self> {
        let federate = r.u16()?;
        let transient = match wire {
            Wire::V0_12 => false,
            Wire::V0_13 => r.flag()?,
        };
        let federation = r.short_bytes()?;
        Some(Self::Hello {
            federate,
            federation,
            transient,
        })
    }
}

impl FromPeer {
    /// Appends the message's bytes to `out`.
    ///
    /// Law `from_peer_round_trip`: decoding gives the message back.
    pub fn encode(&self, out: &mut Vec<u8>) {
        let mut w = Writer(out);
        match self {
            Self::Ack => w.u8(kind::ACK),
            Self::Reject(reason) => w.u8(kind::REJECT).u8(reason.code()),
        };
    }

    /// Decodes the message at the start of `bytes` and says how many bytes it takes; `None` when more are needed.
    ///
    /// Laws as [`ToPeer::decode`].
    ///
    /// # Errors
    ///
    /// When the type is unknown; the stream cannot be read any further.
    pub fn decode(bytes: &[u8]) -> Result<Option<(Self, usize)>, DecodeError> {
        let mut r = Reader::new(bytes);
        let Some(kind) = r.u8() else { return Ok(None) };
        let message = match kind {
            kind::ACK => Some(Self::Ack),
            kind::REJECT => r
                .u8()
                .map(|code| Self::Reject(RejectReason::from_code(code))),
            _ => return Err(DecodeError::UnknownType(kind)),
        };
        Ok(message.map(|message| (message, r.consumed())))
    }
}

/// Appends a message for a peer whose payload is written in place: one copy, straight from the value.
///
/// With a tag it is a P2P_TAGGED_MESSAGE (logical connection), without one a P2P_MESSAGE (physical connection).
///
/// # Panics
///
/// When the payload is longer than `u32::MAX` bytes.
#[inline]
pub fn encode_peer_message(
    port: u16,
    federate: u16,
    tag: Option<Tag>,
    out: &mut Vec<u8>,
    payload: impl FnOnce(&mut Vec<u8>),
) {
    let start = out.len();
    let mut w = Writer(out);
    match tag {
        Some(tag) => {
            let head = TaggedMessage {
                port,
                federate,
                tag,
                payload: &[],
            };
            w.message(kind::P2P_TAGGED_MESSAGE, &head);
        }
        None => w.peer_message(&PeerMessage {
            port,
            federate,
            payload: &[],
        }),
    }
    super::write_payload(start, out, payload);
}

#[cfg(test)]
mod tests {
    use proptest::collection::vec;
    use proptest::prelude::*;

    use super::super::{MAX_PAYLOAD, ToRti};
    use super::*;

    const WIRES: [Wire; 2] = [Wire::V0_12, Wire::V0_13];

    /// Every message once: payload or federation id, port, federate, time, microstep.
    fn messages(
        (payload, port, federate, time, microstep): &(Vec<u8>, u16, u16, i64, u32),
    ) -> [ToPeer<'_>; 5] {
        let (port, federate) = (*port, *federate);
        let tag = Tag::new(ictus_core::LogicalTime::from_nanos(*time), *microstep);
        let hello = |transient| ToPeer::Hello {
            federate,
            federation: payload,
            transient,
        };
        [
            hello(false),
            hello(true),
            ToPeer::Message(PeerMessage {
                port,
                federate,
                payload,
            }),
            ToPeer::TaggedMessage(TaggedMessage {
                port,
                federate,
                tag,
                payload,
            }),
            ToPeer::PortAbsent(PortAbsent {
                port,
                federate,
                tag,
            }),
        ]
    }

    fn parts() -> impl Strategy<Value = (Vec<u8>, u16, u16, i64, u32)> {
        let time = i64::MIN + 1..i64::MAX;
        (
            vec(any::<u8>(), 0..40),
            any::<u16>(),
            any::<u16>(),
            time,
            any::<u32>(),
        )
    }

    /// LF 0.12's hello does not say whether the sender is transient.
    fn as_told(message: ToPeer<'_>, wire: Wire) -> ToPeer<'_> {
        match message {
            ToPeer::Hello {
                federate,
                federation,
                ..
            } if wire == Wire::V0_12 => ToPeer::Hello {
                federate,
                federation,
                transient: false,
            },
            ToPeer::Hello { .. }
            | ToPeer::Message(_)
            | ToPeer::TaggedMessage(_)
            | ToPeer::PortAbsent(_) => message,
        }
    }

    proptest! {
        #[test]
        fn to_peer_round_trip(parts in parts(), rest in vec(any::<u8>(), 0..4)) {
            for (wire, message) in WIRES.into_iter().flat_map(|w| messages(&parts).map(|m| (w, m))) {
                let mut bytes = Vec::new();
                message.encode(wire, &mut bytes);
                let length = bytes.len();
                bytes.extend_from_slice(&rest);
                let expected = Ok(Some((as_told(message, wire), length)));
                prop_assert_eq!(ToPeer::decode(&bytes, wire, MAX_PAYLOAD), expected);
            }
        }

        #[test]
        fn every_prefix_is_incomplete(parts in parts()) {
            for (wire, message) in WIRES.into_iter().flat_map(|w| messages(&parts).map(|m| (w, m))) {
                let mut bytes = Vec::new();
                message.encode(wire, &mut bytes);
                for prefix in 0..bytes.len() {
                    prop_assert_eq!(ToPeer::decode(&bytes[..prefix], wire, MAX_PAYLOAD), Ok(None));
                }
            }
        }

        #[test]
        fn decode_never_panics(
            kind in prop_oneof![16u8..19, Just(23), Just(13), Just(0), any::<u8>()],
            rest in vec(any::<u8>(), 0..60),
        ) {
            let bytes = [&[kind], rest.as_slice()].concat();
            for wire in WIRES {
                if let Ok(Some((_, consumed))) = ToPeer::decode(&bytes, wire, MAX_PAYLOAD) {
                    prop_assert!(0 < consumed && consumed <= bytes.len());
                }
                if let Ok(Some((_, consumed))) = ToRti::decode_limited(&bytes, wire, MAX_PAYLOAD) {
                    prop_assert!(0 < consumed && consumed <= bytes.len());
                }
            }
            if let Ok(Some((_, consumed))) = FromPeer::decode(&bytes) {
                prop_assert!(0 < consumed && consumed <= bytes.len());
            }
        }

        #[test]
        fn in_place_is_as_encoded(parts in parts()) {
            let [_, _, untagged, tagged, _] = messages(&parts);
            let (payload, port, federate, ..) = &parts;
            let ToPeer::TaggedMessage(TaggedMessage { tag, .. }) = tagged else { unreachable!() };
            for (message, tag) in [(untagged, None), (tagged, Some(tag))] {
                let (mut whole, mut in_place) = (vec![9; 3], vec![9; 3]);
                message.encode(Wire::V0_12, &mut whole);
                encode_peer_message(*port, *federate, tag, &mut in_place, |out| out.extend(payload));
                prop_assert_eq!(whole, in_place);
            }
        }

        #[test]
        fn from_peer_round_trip(code in any::<u8>(), rest in vec(any::<u8>(), 0..4)) {
            for message in [FromPeer::Ack, FromPeer::Reject(RejectReason::from_code(code))] {
                let mut bytes = Vec::new();
                message.encode(&mut bytes);
                let length = bytes.len();
                for prefix in 0..length {
                    prop_assert_eq!(FromPeer::decode(&bytes[..prefix]), Ok(None));
                }
                bytes.extend_from_slice(&rest);
                prop_assert_eq!(FromPeer::decode(&bytes), Ok(Some((message, length))));
            }
        }
    }

    #[test]
    fn bytes_of_the_wire_document() {
        let hello = ToPeer::Hello {
            federate: 258,
            federation: b"ab",
            transient: true,
        };
        let mut bytes = Vec::new();
        hello.encode(Wire::V0_12, &mut bytes);
        assert_eq!(bytes, [16, 2, 1, 2, b'a', b'b']);
        bytes.clear();
        hello.encode(Wire::V0_13, &mut bytes);
        assert_eq!(bytes, [16, 2, 1, 1, 2, b'a', b'b']);
        bytes.clear();
        encode_peer_message(3, 1, None, &mut bytes, |out| out.push(7));
        assert_eq!(bytes, [17, 3, 0, 1, 0, 1, 0, 0, 0, 7]);
    }

    #[test]
    fn an_address_query_has_two_layouts() {
        for (wire, transient, expected) in [
            (Wire::V0_12, None, vec![13, 5, 0]),
            (Wire::V0_13, Some(false), vec![13, 5, 0, 0]),
            (Wire::V0_13, Some(true), vec![13, 5, 0, 1]),
        ] {
            let query = ToRti::AddressQuery {
                federate: 5,
                transient,
            };
            let mut bytes = Vec::new();
            query.encode(&mut bytes);
            assert_eq!(bytes, expected);
            for prefix in 0..bytes.len() {
                let decoded = ToRti::decode_limited(&bytes[..prefix], wire, MAX_PAYLOAD);
                assert_eq!(decoded, Ok(None));
            }
            let decoded = ToRti::decode_limited(&bytes, wire, MAX_PAYLOAD);
            assert_eq!(decoded, Ok(Some((query, bytes.len()))));
        }
    }

    #[test]
    fn strange_and_long_messages_are_refused() {
        for byte in [0, 1, 5, 6, 200, 255] {
            let bytes = [byte];
            let decoded = ToPeer::decode(&bytes, Wire::V0_12, MAX_PAYLOAD);
            assert_eq!(decoded, Err(DecodeError::UnknownType(byte)));
        }
        for byte in [1, 16, 17, 18, 23] {
            assert_eq!(
                FromPeer::decode(&[byte]),
                Err(DecodeError::UnknownType(byte))
            );
        }
        for kind in [17, 18] {
            let bytes = [kind, 0, 0, 0, 0, 9, 0, 0, 0];
            let decoded = ToPeer::decode(&bytes, Wire::V0_12, 8);
            let expected = DecodeError::PayloadTooLong {
                length: 9,
                limit: 8,
            };
            assert_eq!(decoded, Err(expected));
        }
    }
}
