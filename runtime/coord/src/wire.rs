//! The federated wire protocol: every message between a federate and the RTI, to and from bytes.
//!
//! There is no framing: a message is one type byte and a body whose length follows from the type or from a length
//! field. Integers are little endian; a tag is an `i64` time and a `u32` microstep; a delay is an `i64`, where a
//! negative one is no delay at all and 0 is one microstep. Two layouts differ between LF's releases: [`Wire`]. Times FOREVER and NEVER are made whole when they are
//! decoded: (FOREVER, any microstep) is [`Tag::FOREVER`], likewise NEVER.
//!
//! | Id | Message | Direction | Size | Body |
//! | --- | --- | --- | --- | --- |
//! | 0 | [`ToFederate::Reject`], [`ToRti::Reject`], [`FromPeer::Reject`] | both, P→P | 2 | reason u8 |
//! | 1 | [`ToRti::FederateIds`] | F→R | 4+n | federate u16, n u8, federation id |
//! | 2 | [`ToRti::Timestamp`], [`ToFederate::Timestamp`] | both | 9 | physical time; the start time |
//! | 4 | [`ToRti::Resign`] | F→R | 1 | |
//! | 5 | `TaggedMessage` | both | 21+n | port u16, destination u16, n u32, tag, payload |
//! | 6 | [`ToRti::NextEventTag`] | F→R | 13 | tag |
//! | 7 | [`ToFederate::TagAdvanceGrant`] | R→F | 13 | tag |
//! | 8 | [`ToFederate::ProvisionalTagAdvanceGrant`] | R→F | 13 | tag |
//! | 9 | [`ToRti::LatestTagConfirmed`] | F→R | 13 | tag |
//! | 10 | `StopRequest` | both | 13 | tag |
//! | 11 | [`ToRti::StopRequestReply`] | F→R | 13 | tag |
//! | 12 | [`ToFederate::StopGranted`] | R→F | 13 | tag |
//! | 13 | [`ToRti::AddressQuery`] | F→R | 3 | federate u16; LF 0.13: 4, whether it is transient u8 follows |
//! | 14 | [`ToFederate::AddressQueryReply`] | R→F | 9 | port i32 (-1: unknown), IPv4 in network order |
//! | 15 | [`ToRti::AddressAdvertisement`] | F→R | 5 | port i32 |
//! | 16 | [`ToPeer::Hello`] | P→P | 4+n | federate u16, n u8, federation id; LF 0.13: 5+n, transient u8 before n |
//! | 17 | [`ToPeer::Message`] | P→P | 9+n | port u16, destination u16, n u32, payload |
//! | 18 | [`ToPeer::TaggedMessage`] | P→P | 21+n | as 5 |
//! | 19 | [`ToFederate::ClockSyncT1`] | R→F | 9 | physical time |
//! | 20 | [`ToRti::ClockSyncT3`] | F→R | 3 | federate u16 |
//! | 21 | [`ToFederate::ClockSyncT4`] | R→F | 9 | physical time |
//! | 23 | `PortAbsent` | both, P→P | 17 | port u16, destination u16, tag |
//! | 24 | [`ToRti::NeighborStructure`] | F→R | 9+10u+2d | u i32, d i32, u × (federate u16, delay), d × federate u16 |
//! | 25 | `Failed` | both | 1 | |
//! | 26 | [`ToFederate::DownstreamNextEventTag`] | R→F | 13 | tag |
//! | 100 | [`ToRti::FederateNonce`] | F→R | 11 | federate u16, nonce 8 |
//! | 101 | [`ToFederate::RtiResponse`] | R→F | 41 | nonce 8, HMAC 32 |
//! | 102 | [`ToRti::FederateResponse`] | F→R | 33 | HMAC 32 |
//! | 200 | [`ToRti::Capabilities`] | F→R | 5 | bit set u32: [`capability`] |
//! | 201 | [`ToFederate::DownstreamConfirmed`] | R→F | 13 | tag |
//! | 202 | [`ToFederate::FederateLost`] | R→F | 15 | federate u16, tag |
//! | 203 | [`ToRti::DataAddress`] | F→R | 9 | port i32, IPv4 in network order |
//! | 254 | [`ToRti::UdpPort`] | F→R | 3 | port u16: 65535 no clock sync, 0 at start only, else continuous |
//! | 255 | [`ToFederate::Ack`], [`FromPeer::Ack`] | R→F, P→P | 1 | |
//!
//! 200 to 203 are ours and pass only between our own peers. A federate sends CAPABILITIES once, right after UDP_PORT
//! and only when its plan says that the RTI is ours; the RTI sends 201 only to a federate with
//! [`capability::FLOW_CONTROL`] and 202 only to one with [`capability::FEDERATE_LOST`]. 203 comes after CAPABILITIES.
//!
//! Source: Lingua Franca, reactor-c `net_common.h`; sections 1 to 3 of the wire document.

use ictus_core::{Delay, PhysicalTime, Tag};

use crate::plan::Wire;

mod codec;
mod peer;

use codec::{Reader, Writer};
pub use peer::{FromPeer, PeerMessage, ToPeer, encode_peer_message};

/// The largest payload that [`ToRti::decode`] and [`ToFederate::decode`] accept, in bytes (64 MiB).
pub const MAX_PAYLOAD: u32 = 64 << 20;

/// The message types: the first byte of every message.
pub mod kind {
    /// REJECT, RTI to federate; the other way only while they authenticate.
    pub const REJECT: u8 = 0;
    /// FED_IDS, federate to RTI.
    pub const FEDERATE_IDS: u8 = 1;
    /// TIMESTAMP, both ways.
    pub const TIMESTAMP: u8 = 2;
    /// RESIGN, federate to RTI.
    pub const RESIGN: u8 = 4;
    /// TAGGED_MESSAGE, federate to RTI to federate.
    pub const TAGGED_MESSAGE: u8 = 5;
    /// NET, federate to RTI.
    pub const NEXT_EVENT_TAG: u8 = 6;
    /// TAG, RTI to federate.
    pub const TAG_ADVANCE_GRANT: u8 = 7;
    /// PTAG, RTI to federate.
    pub const PROVISIONAL_TAG_ADVANCE_GRANT: u8 = 8;
    /// LTC, federate to RTI.
    pub const LATEST_TAG_CONFIRMED: u8 = 9;
    /// STOP_REQUEST, both ways.
    pub const STOP_REQUEST: u8 = 10;
    /// STOP_REQUEST_REPLY, federate to RTI.
    pub const STOP_REQUEST_REPLY: u8 = 11;
    /// STOP_GRANTED, RTI to federate.
    pub const STOP_GRANTED: u8 = 12;
    /// ADDRESS_QUERY, federate to RTI.
    pub const ADDRESS_QUERY: u8 = 13;
    /// ADDRESS_QUERY_REPLY, RTI to federate.
    pub const ADDRESS_QUERY_REPLY: u8 = 14;
    /// ADDRESS_ADVERTISEMENT, federate to RTI.
    pub const ADDRESS_ADVERTISEMENT: u8 = 15;
    /// P2P_SENDING_FED_ID, between federates: at the RTI it means that the peer has the wrong server.
    pub const P2P_FEDERATE_ID: u8 = 16;
    /// P2P_MESSAGE, between federates: untagged, on a physical connection.
    pub const P2P_MESSAGE: u8 = 17;
    /// P2P_TAGGED_MESSAGE, between federates: at the RTI it means that the peer has the wrong server.
    pub const P2P_TAGGED_MESSAGE: u8 = 18;
    /// CLOCK_SYNC_T1, RTI to federate.
    pub const CLOCK_SYNC_T1: u8 = 19;
    /// CLOCK_SYNC_T3, federate to RTI.
    pub const CLOCK_SYNC_T3: u8 = 20;
    /// CLOCK_SYNC_T4, RTI to federate.
    pub const CLOCK_SYNC_T4: u8 = 21;
    /// CLOCK_SYNC_CODED_PROBE, RTI to federate, over UDP only.
    pub const CLOCK_SYNC_CODED_PROBE: u8 = 22;
    /// PORT_ABSENT, federate to RTI to federate.
    pub const PORT_ABSENT: u8 = 23;
    /// NEIGHBOR_STRUCTURE, federate to RTI.
    pub const NEIGHBOR_STRUCTURE: u8 = 24;
    /// FAILED, both ways.
    pub const FAILED: u8 = 25;
    /// DNET, RTI to federate.
    pub const DOWNSTREAM_NEXT_EVENT_TAG: u8 = 26;
    /// FED_NONCE, federate to RTI.
    pub const FEDERATE_NONCE: u8 = 100;
    /// RTI_RESPONSE, RTI to federate.
    pub const RTI_RESPONSE: u8 = 101;
    /// FED_RESPONSE, federate to RTI.
    pub const FEDERATE_RESPONSE: u8 = 102;
    /// CAPABILITIES, federate to RTI; ours.
    pub const CAPABILITIES: u8 = 200;
    /// DOWNSTREAM_CONFIRMED, RTI to federate; ours.
    pub const DOWNSTREAM_CONFIRMED: u8 = 201;
    /// FEDERATE_LOST, RTI to federate; ours.
    pub const FEDERATE_LOST: u8 = 202;
    /// DATA_ADDRESS, federate to RTI; ours.
    pub const DATA_ADDRESS: u8 = 203;
    /// UDP_PORT, federate to RTI.
    pub const UDP_PORT: u8 = 254;
    /// ACK, RTI to federate.
    pub const ACK: u8 = 255;
}

/// The bits of [`ToRti::Capabilities`].
pub mod capability {
    /// The federate limits its lead by [`super::ToFederate::DownstreamConfirmed`].
    pub const FLOW_CONTROL: u32 = 1;
    /// The federate understands [`super::ToFederate::FederateLost`].
    pub const FEDERATE_LOST: u32 = 2;
    /// The federate begins a tag as soon as nothing can come before it, and runs there what has all its inputs: it wants a
    /// TAG just before its NET when messages may still come at its NET.
    pub const RUNS_AHEAD: u32 = 4;
    /// The federate needs no grants: it knows itself what a lost federate's messages may be missing from
    /// ([`super::ToFederate::FederateLost`] promises nothing).
    pub const DECENTRALIZED: u32 = 8;
}

/// The value of [`ToRti::UdpPort`] that asks for no clock synchronization at all.
pub const NO_CLOCK_SYNC: u16 = u16::MAX;

/// A message on a connection between two federates, relayed whole.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TaggedMessage<'a> {
    /// The destination's port id.
    pub port: u16,
    /// The destination.
    pub federate: u16,
    /// The tag at the destination, the connection's delay included.
    pub tag: Tag,
    /// The serialized value, opaque here.
    pub payload: &'a [u8],
}

/// An output that stays absent up to a tag, relayed whole.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PortAbsent {
    /// The destination's port id.
    pub port: u16,
    /// The destination.
    pub federate: u16,
    /// The port's status is known up to and including this tag.
    pub tag: Tag,
}

/// A federate's immediate neighbours over logical connections, as it tells the RTI.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct NeighborStructure {
    /// The federates it receives from, each with the least delay of all connections from it.
    pub upstream: Vec<(u16, Delay)>,
    /// The federates it sends to.
    pub downstream: Vec<u16>,
}

/// Why a join was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RejectReason {
    /// 1: the federation id differs, or the federation has started already.
    FederationId,
    /// 2: the federate id is in use.
    FederateIdInUse,
    /// 3: the federate id is not below the number of federates.
    FederateIdOutOfRange,
    /// 4: the message type was not expected here.
    UnexpectedMessage,
    /// 5: the peer took this server for another: a federate's hello at the RTI, or the reverse.
    WrongServer,
    /// 6: the HMAC is wrong.
    HmacWrong,
    /// 7: the RTI runs without authentication.
    NotAuthenticating,
    /// 8: joining too late (LF 0.13).
    TooLate,
    /// A reason that this version does not know.
    Unknown(u8),
}

/// A message from a federate to the RTI.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ToRti<'a> {
    /// Who the federate is; its first message (but for authentication).
    FederateIds {
        /// The federate's id.
        federate: u16,
        /// The federation id, at most 255 bytes (a longer one is cut when it is encoded).
        federation: &'a [u8],
    },
    /// The federate's proposal for the start: its physical clock, corrected.
    Timestamp(PhysicalTime),
    /// A message for another federate.
    TaggedMessage(TaggedMessage<'a>),
    /// An absent output of a federate in a zero-delay cycle.
    PortAbsent(PortAbsent),
    /// Promise: unless a message arrives, the federate sends nothing with an earlier tag (NET).
    NextEventTag(Tag),
    /// The federate has completed this tag (LTC).
    LatestTagConfirmed(Tag),
    /// The federate asks to stop at this tag.
    StopRequest(Tag),
    /// The least tag at which the federate can stop.
    StopRequestReply(Tag),
    /// The federate leaves in order; its last message.
    Resign,
    /// The federate leaves because of an error; its last message.
    Failed,
    /// The federate's neighbours.
    NeighborStructure(NeighborStructure),
    /// Whether, and where, the federate synchronizes its clock: [`NO_CLOCK_SYNC`], 0 for at start only, or a UDP port.
    UdpPort(u16),
    /// Answers T1.
    ClockSyncT3 {
        /// The sender.
        federate: u16,
    },
    /// Asks where a federate listens for peers.
    AddressQuery {
        /// The federate asked about.
        federate: u16,
        /// Whether it is transient, where the layout says so (LF 0.13).
        transient: Option<bool>,
    },
    /// Says where this federate listens for peers.
    AddressAdvertisement {
        /// Its TCP port.
        port: i32,
    },
    /// Starts authentication.
    FederateNonce {
        /// The sender.
        federate: u16,
        /// Random bytes.
        nonce: [u8; 8],
    },
    /// Ends authentication.
    FederateResponse {
        /// Over (102, the RTI's nonce).
        hmac: [u8; 32],
    },
    /// What the federate understands beyond LF's protocol: [`capability`].
    Capabilities(u32),
    /// Where this federate's peers reach it, when that is not the address it joins from.
    DataAddress {
        /// Its TCP port.
        port: i32,
        /// Its IPv4 address, in network order; 0.0.0.0: as the RTI sees it.
        address: [u8; 4],
    },
    /// The federate refuses this RTI, which has not proved that it knows the federation id; its last message.
    Reject(RejectReason),
}

/// A message from the RTI to a federate.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ToFederate<'a> {
    /// The join is accepted so far.
    Ack,
    /// The join is refused; the connection closes.
    Reject(RejectReason),
    /// The start time.
    Timestamp(PhysicalTime),
    /// A message from another federate.
    TaggedMessage(TaggedMessage<'a>),
    /// An absent input.
    PortAbsent(PortAbsent),
    /// All inputs are known up to and including this tag (TAG).
    TagAdvanceGrant(Tag),
    /// All inputs are known before this tag, and those outside the zero-delay cycle at it (PTAG).
    ProvisionalTagAdvanceGrant(Tag),
    /// No NET at or before this tag is needed for others' sake (DNET).
    DownstreamNextEventTag(Tag),
    /// Another federate, or the RTI, asks to stop at this tag.
    StopRequest(Tag),
    /// The agreed stop tag.
    StopGranted(Tag),
    /// The RTI's clock when it sends this.
    ClockSyncT1(PhysicalTime),
    /// The RTI's clock when it sends this, after T3.
    ClockSyncT4(PhysicalTime),
    /// Where a federate listens for peers.
    AddressQueryReply {
        /// Its TCP port, -1 when unknown.
        port: i32,
        /// Its IPv4 address, in network order.
        address: [u8; 4],
    },
    /// Answers the federate's nonce.
    RtiResponse {
        /// Random bytes.
        nonce: [u8; 8],
        /// Over (101, federate id, the federate's nonce).
        hmac: [u8; 32],
    },
    /// The RTI gives up; the federate exits with an error.
    Failed,
    /// Every message for an immediate downstream with a tag up to this one is handled. Not monotone; a later one
    /// replaces an earlier one.
    DownstreamConfirmed(Tag),
    /// A federate was lost without resigning; sent before the stop request that follows from it.
    FederateLost {
        /// The lost one.
        federate: u16,
        /// The last tag at which the *receiver* may still run ordinary reactions: at any later tag a message of the
        /// lost one could be missing. [`Tag::FOREVER`] when the lost one cannot reach the receiver. Grants may
        /// pass it afterwards so that the stop tag is reached; only `shutdown` runs there. [`Tag::NEVER`], which says
        /// nothing, to a receiver with [`capability::DECENTRALIZED`].
        promise: Tag,
    },
}

/// Why bytes are no message. Always fatal for the connection: the next message cannot be found.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DecodeError {
    /// The first byte is no type that may come from this side.
    #[error("unknown message type {0}")]
    UnknownType(u8),
    /// A TAGGED_MESSAGE announces more bytes than are accepted.
    #[error("payload of {length} bytes exceeds the limit of {limit}")]
    PayloadTooLong {
        /// The announced length.
        length: u32,
        /// The limit.
        limit: u32,
    },
    /// A NEIGHBOR_STRUCTURE announces an impossible number of neighbours.
    #[error("neighbour count {0} is out of range")]
    NeighborCount(i32),
}

/// Appends a TAGGED_MESSAGE whose payload is written in place: one copy, straight from the value.
///
/// # Panics
///
/// When the payload is longer than `u32::MAX` bytes.
#[inline]
pub fn encode_tagged_message(
    port: u16,
    federate: u16,
    tag: Tag,
    out: &mut Vec<u8>,
    payload: impl FnOnce(&mut Vec<u8>),
) {
    let start = out.len();
    ToRti::TaggedMessage(TaggedMessage {
        port,
        federate,
        tag,
        payload: &[],
    })
    .encode(out);
    write_payload(start, out, payload);
}

/// Appends the payload to the head of a message that begins at `start`, and puts its length there.
#[inline]
fn write_payload(start: usize, out: &mut Vec<u8>, payload: impl FnOnce(&mut Vec<u8>)) {
    let body = out.len();
    payload(out);
    let length = u32::try_from(out.len() - body).expect("payloads are shorter than 4 GiB");
    out[start + 5..start + 9].copy_from_slice(&length.to_le_bytes());
}

impl<'a> TaggedMessage<'a> {
    /// Decodes the TAGGED_MESSAGE at the start of `bytes` and says how many bytes it takes; `None` when more are needed,
    /// or when it is another message.
    ///
    /// # Errors
    ///
    /// When the payload is longer than `max_payload` bytes.
    #[inline]
    pub fn decode_limited(
        bytes: &'a [u8],
        max_payload: u32,
    ) -> Result<Option<(Self, usize)>, DecodeError> {
        let mut r = Reader::new(bytes);
        if r.u8() != Some(kind::TAGGED_MESSAGE) {
            return Ok(None);
        }
        Ok(r.message(max_payload)?
            .map(|message| (message, r.consumed())))
    }
}

impl<'a> ToRti<'a> {
    /// The message's name in LF's terms, for people.
    #[must_use]
    pub const fn name(&self) -> &'static str {
        match self {
            Self::FederateIds { .. } => "FED_IDS",
            Self::Timestamp(_) => "TIMESTAMP",
            Self::TaggedMessage(_) => "TAGGED_MESSAGE",
            Self::PortAbsent(_) => "PORT_ABSENT",
            Self::NextEventTag(_) => "NET",
            Self::LatestTagConfirmed(_) => "LTC",
            Self::StopRequest(_) => "STOP_REQUEST",
            Self::StopRequestReply(_) => "STOP_REQUEST_REPLY",
            Self::Resign => "RESIGN",
            Self::Failed => "FAILED",
            Self::NeighborStructure(_) => "NEIGHBOR_STRUCTURE",
            Self::UdpPort(_) => "UDP_PORT",
            Self::ClockSyncT3 { .. } => "CLOCK_SYNC_T3",
            Self::AddressQuery { .. } => "ADDRESS_QUERY",
            Self::AddressAdvertisement { .. } => "ADDRESS_ADVERTISEMENT",
            Self::FederateNonce { .. } => "FED_NONCE",
            Self::FederateResponse { .. } => "FED_RESPONSE",
            Self::Capabilities(_) => "CAPABILITIES",
            Self::DataAddress { .. } => "DATA_ADDRESS",
            Self::Reject(_) => "REJECT",
        }
    }

    /// Appends the message's bytes to `out`.
    ///
    /// Law `to_rti_round_trip`: decoding gives the message back.
    pub fn encode(&self, out: &mut Vec<u8>) {
        let mut w = Writer(out);
        match self {
            Self::FederateIds {
                federate,
                federation,
            } => {
                w.u8(kind::FEDERATE_IDS)
                    .u16(*federate)
                    .short_bytes(federation);
            }
            Self::Timestamp(time) => w.time(kind::TIMESTAMP, *time),
            Self::TaggedMessage(message) => w.message(kind::TAGGED_MESSAGE, message),
            Self::PortAbsent(absent) => w.absent(absent),
            Self::NextEventTag(tag) => w.tag_only(kind::NEXT_EVENT_TAG, *tag),
            Self::LatestTagConfirmed(tag) => w.tag_only(kind::LATEST_TAG_CONFIRMED, *tag),
            Self::StopRequest(tag) => w.tag_only(kind::STOP_REQUEST, *tag),
            Self::StopRequestReply(tag) => w.tag_only(kind::STOP_REQUEST_REPLY, *tag),
            Self::Resign => {
                w.u8(kind::RESIGN);
            }
            Self::Failed => {
                w.u8(kind::FAILED);
            }
            Self::NeighborStructure(neighbors) => w.neighbors(neighbors),
            Self::UdpPort(port) => {
                w.u8(kind::UDP_PORT).u16(*port);
            }
            Self::ClockSyncT3 { federate } => {
                w.u8(kind::CLOCK_SYNC_T3).u16(*federate);
            }
            Self::AddressQuery {
                federate,
                transient,
            } => {
                w.u8(kind::ADDRESS_QUERY).u16(*federate);
                if let Some(transient) = transient {
                    w.u8(u8::from(*transient));
                }
            }
            Self::AddressAdvertisement { port } => {
                w.u8(kind::ADDRESS_ADVERTISEMENT).i32(*port);
            }
            Self::FederateNonce { federate, nonce } => {
                w.u8(kind::FEDERATE_NONCE).u16(*federate).bytes(nonce);
            }
            Self::FederateResponse { hmac } => {
                w.u8(kind::FEDERATE_RESPONSE).bytes(hmac);
            }
            Self::Capabilities(bits) => {
                w.u8(kind::CAPABILITIES).u32(*bits);
            }
            Self::DataAddress { port, address } => {
                w.u8(kind::DATA_ADDRESS).i32(*port).bytes(address);
            }
            Self::Reject(reason) => {
                w.u8(kind::REJECT).u8(reason.code());
            }
        }
    }

    /// Decodes the message at the start of `bytes`, in LF 0.12's layout, and says how many bytes it takes; `None` when
    /// more are needed.
    ///
    /// Laws `decode_never_panics` and `every_prefix_is_incomplete`. Nothing but the neighbour lists is copied.
    ///
    /// # Errors
    ///
    /// When the type is unknown or a length is out of range; the stream cannot be read any further.
    pub fn decode(bytes: &'a [u8]) -> Result<Option<(Self, usize)>, DecodeError> {
        Self::decode_limited(bytes, Wire::V0_12, MAX_PAYLOAD)
    }

    /// As [`ToRti::decode`], in the layout of `wire` and with a limit of `max_payload` bytes for a payload.
    ///
    /// # Errors
    ///
    /// As [`ToRti::decode`].
    pub fn decode_limited(
        bytes: &'a [u8],
        wire: Wire,
        max_payload: u32,
    ) -> Result<Option<(Self, usize)>, DecodeError> {
        let mut r = Reader::new(bytes);
        let Some(kind) = r.u8() else { return Ok(None) };
        let message = match kind {
            kind::TAGGED_MESSAGE => r.message(max_payload)?.map(Self::TaggedMessage),
            kind::NEXT_EVENT_TAG => r.tag().map(Self::NextEventTag),
            kind::LATEST_TAG_CONFIRMED => r.tag().map(Self::LatestTagConfirmed),
            kind::PORT_ABSENT => r.absent().map(Self::PortAbsent),
            kind::ADDRESS_QUERY => r.address_query(wire),
            kind::NEIGHBOR_STRUCTURE => r.neighbors()?.map(Self::NeighborStructure),
            _ => match Self::decode_rare(kind, &mut r) {
                Some(message) => message,
                None => return Err(DecodeError::UnknownType(kind)),
            },
        };
        Ok(message.map(|message| (message, r.consumed())))
    }

    /// `None`: no such type; `Some(None)`: incomplete.
    fn decode_rare(kind: u8, r: &mut Reader<'a>) -> Option<Option<Self>> {
        Some(match kind {
            kind::FEDERATE_IDS => r.u16().and_then(|federate| {
                let federation = r.short_bytes()?;
                Some(Self::FederateIds {
                    federate,
                    federation,
                })
            }),
            kind::TIMESTAMP => r.time().map(Self::Timestamp),
            kind::RESIGN => Some(Self::Resign),
            kind::FAILED => Some(Self::Failed),
            kind::STOP_REQUEST => r.tag().map(Self::StopRequest),
            kind::STOP_REQUEST_REPLY => r.tag().map(Self::StopRequestReply),
            kind::UDP_PORT => r.u16().map(Self::UdpPort),
            kind::CLOCK_SYNC_T3 => r.u16().map(|federate| Self::ClockSyncT3 { federate }),
            kind::ADDRESS_ADVERTISEMENT => r.i32().map(|port| Self::AddressAdvertisement { port }),
            kind::FEDERATE_NONCE => r.u16().and_then(|federate| {
                let nonce = r.array()?;
                Some(Self::FederateNonce { federate, nonce })
            }),
            kind::FEDERATE_RESPONSE => r.array().map(|hmac| Self::FederateResponse { hmac }),
            kind::CAPABILITIES => r.u32().map(Self::Capabilities),
            kind::DATA_ADDRESS => r.i32().and_then(|port| {
                let address = r.array()?;
                Some(Self::DataAddress { port, address })
            }),
            kind::REJECT => r
                .u8()
                .map(|code| Self::Reject(RejectReason::from_code(code))),
            _ => return None,
        })
    }
}

impl<'a> ToFederate<'a> {
    /// Appends the message's bytes to `out`.
    ///
    /// Law `to_federate_round_trip`: decoding gives the message back.
    pub fn encode(&self, out: &mut Vec<u8>) {
        let mut w = Writer(out);
        match self {
            Self::Ack => {
                w.u8(kind::ACK);
            }
            Self::Reject(reason) => {
                w.u8(kind::REJECT).u8(reason.code());
            }
            Self::Timestamp(time) => w.time(kind::TIMESTAMP, *time),
            Self::TaggedMessage(message) => w.message(kind::TAGGED_MESSAGE, message),
            Self::PortAbsent(absent) => w.absent(absent),
            Self::TagAdvanceGrant(tag) => w.tag_only(kind::TAG_ADVANCE_GRANT, *tag),
            Self::ProvisionalTagAdvanceGrant(tag) => {
                w.tag_only(kind::PROVISIONAL_TAG_ADVANCE_GRANT, *tag);
            }
            Self::DownstreamNextEventTag(tag) => w.tag_only(kind::DOWNSTREAM_NEXT_EVENT_TAG, *tag),
            Self::StopRequest(tag) => w.tag_only(kind::STOP_REQUEST, *tag),
            Self::StopGranted(tag) => w.tag_only(kind::STOP_GRANTED, *tag),
            Self::ClockSyncT1(time) => w.time(kind::CLOCK_SYNC_T1, *time),
            Self::ClockSyncT4(time) => w.time(kind::CLOCK_SYNC_T4, *time),
            Self::AddressQueryReply { port, address } => {
                w.u8(kind::ADDRESS_QUERY_REPLY).i32(*port).bytes(address);
            }
            Self::RtiResponse { nonce, hmac } => {
                w.u8(kind::RTI_RESPONSE).bytes(nonce).bytes(hmac);
            }
            Self::Failed => {
                w.u8(kind::FAILED);
            }
            Self::DownstreamConfirmed(tag) => w.tag_only(kind::DOWNSTREAM_CONFIRMED, *tag),
            Self::FederateLost { federate, promise } => {
                w.u8(kind::FEDERATE_LOST).u16(*federate).tag(*promise);
            }
        }
    }

    /// Decodes the message at the start of `bytes` and says how many bytes it takes; `None` when more are needed.
    ///
    /// Laws as [`ToRti::decode`].
    ///
    /// # Errors
    ///
    /// When the type is unknown or a length is out of range; the stream cannot be read any further.
    pub fn decode(bytes: &'a [u8]) -> Result<Option<(Self, usize)>, DecodeError> {
        Self::decode_limited(bytes, MAX_PAYLOAD)
    }

    /// As [`ToFederate::decode`], with a limit of `max_payload` bytes for a payload.
    ///
    /// # Errors
    ///
    /// As [`ToFederate::decode`].
    pub fn decode_limited(
        bytes: &'a [u8],
        max_payload: u32,
    ) -> Result<Option<(Self, usize)>, DecodeError> {
        let mut r = Reader::new(bytes);
        let Some(kind) = r.u8() else { return Ok(None) };
        let message = match kind {
            kind::TAGGED_MESSAGE => r.message(max_payload)?.map(Self::TaggedMessage),
            kind::TAG_ADVANCE_GRANT => r.tag().map(Self::TagAdvanceGrant),
            kind::PROVISIONAL_TAG_ADVANCE_GRANT => r.tag().map(Self::ProvisionalTagAdvanceGrant),
            kind::PORT_ABSENT => r.absent().map(Self::PortAbsent),
            kind::DOWNSTREAM_NEXT_EVENT_TAG => r.tag().map(Self::DownstreamNextEventTag),
            _ => match Self::decode_rare(kind, &mut r) {
                Some(message) => message,
                None => return Err(DecodeError::UnknownType(kind)),
            },
        };
        Ok(message.map(|message| (message, r.consumed())))
    }

    /// `None`: no such type; `Some(None)`: incomplete.
    fn decode_rare(kind: u8, r: &mut Reader<'a>) -> Option<Option<Self>> {
        Some(match kind {
            kind::ACK => Some(Self::Ack),
            kind::REJECT => r
                .u8()
                .map(|code| Self::Reject(RejectReason::from_code(code))),
            kind::TIMESTAMP => r.time().map(Self::Timestamp),
            kind::STOP_REQUEST => r.tag().map(Self::StopRequest),
            kind::STOP_GRANTED => r.tag().map(Self::StopGranted),
            kind::CLOCK_SYNC_T1 => r.time().map(Self::ClockSyncT1),
            kind::CLOCK_SYNC_T4 => r.time().map(Self::ClockSyncT4),
            kind::ADDRESS_QUERY_REPLY => r.i32().and_then(|port| {
                let address = r.array()?;
                Some(Self::AddressQueryReply { port, address })
            }),
            kind::RTI_RESPONSE => r.array().and_then(|nonce| {
                let hmac = r.array()?;
                Some(Self::RtiResponse { nonce, hmac })
            }),
            kind::FAILED => Some(Self::Failed),
            kind::DOWNSTREAM_CONFIRMED => r.tag().map(Self::DownstreamConfirmed),
            kind::FEDERATE_LOST => r.u16().and_then(|federate| {
                let promise = r.tag()?;
                Some(Self::FederateLost { federate, promise })
            }),
            _ => return None,
        })
    }
}

impl RejectReason {
    /// The reason's byte on the wire.
    #[must_use]
    pub const fn code(self) -> u8 {
        match self {
            Self::FederationId => 1,
            Self::FederateIdInUse => 2,
            Self::FederateIdOutOfRange => 3,
            Self::UnexpectedMessage => 4,
            Self::WrongServer => 5,
            Self::HmacWrong => 6,
            Self::NotAuthenticating => 7,
            Self::TooLate => 8,
            Self::Unknown(code) => code,
        }
    }

    /// The reason that a byte on the wire stands for.
    #[must_use]
    pub const fn from_code(code: u8) -> Self {
        match code {
            1 => Self::FederationId,
            2 => Self::FederateIdInUse,
            3 => Self::FederateIdOutOfRange,
            4 => Self::UnexpectedMessage,
            5 => Self::WrongServer,
            6 => Self::HmacWrong,
            7 => Self::NotAuthenticating,
            8 => Self::TooLate,
            code => Self::Unknown(code),
        }
    }
}

impl std::fmt::Display for RejectReason {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::FederationId => {
                "the federation id differs, or the federation has started already"
            }
            Self::FederateIdInUse => "the federate id is in use",
            Self::FederateIdOutOfRange => "the federate id is out of range",
            Self::UnexpectedMessage => "the message was not expected here",
            Self::WrongServer => "the peer took this server for another",
            Self::HmacWrong => "authentication failed",
            Self::NotAuthenticating => "the RTI runs without authentication",
            Self::TooLate => "joining too late",
            Self::Unknown(code) => return write!(f, "reason {code}"),
        })
    }
}

#[cfg(test)]
mod tests;
