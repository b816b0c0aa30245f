//! Connections from federate to federate: who connects to whom, hello and answer, and the bytes of each stream.
//!
//! One stream per (sender, receiver): the sender connects, says hello, waits for ACK, and writes; the receiver only
//! answers. Source: sections 3.6, 7 and 8 of the wire document.

use crate::plan::Wire;
use crate::wire::{FromPeer, RejectReason, ToPeer};
use ictus_core::{Duration, PhysicalTime};

/// How long to wait before the RTI is asked again for the address of a peer that has not advertised one.
const ASK_AGAIN: Duration = Duration::from_millis(20);

/// A connection to or from another federate: its number in the order in which they were made.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub struct PeerStream(usize);

impl PeerStream {
    /// The number.
    #[must_use]
    pub const fn index(self) -> usize {
        self.0
    }
}

/// What a stream is for.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Role {
    /// Accepted; its hello is still to come.
    Stranger,
    /// From this sender.
    From(u16),
    /// To this receiver, whose ACK is still to come.
    Greeting(u16),
    /// To this receiver.
    To(u16),
    /// Over: nothing is read or written any more but what is left of the output.
    Over,
}

#[derive(Debug)]
struct Stream {
    role: Role,
    out: Vec<u8>,
    /// Whose certificate the other end has shown, where there are any.
    certified: Option<u16>,
}

/// How far the connection to one receiver is.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Way {
    /// The RTI is to be asked for its address, not before this time.
    Ask(PhysicalTime),
    /// Asked.
    Asked,
    /// The driver was told to connect, or has and waits for the ACK.
    Connecting,
    /// Open.
    Open(PeerStream),
    /// It has ended: what is for it is dropped.
    Gone,
}

/// How far the connection from one sender is.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Sender {
    Missing,
    Here,
    Gone,
}

/// What must be done next to meet the peers.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Meeting {
    /// Ask the RTI for this federate's address.
    Ask(u16),
    /// Wait, at most until this time.
    Wait(Option<PhysicalTime>),
    /// Every receiver has answered.
    Met,
}

/// All connections of one federate with others.
#[derive(Debug, Default)]
pub(super) struct Peers {
    federation: Vec<u8>,
    me: u16,
    wire: Wire,
    receivers: Vec<(u16, Way)>,
    /// Those that will connect.
    senders: Vec<(u16, Sender)>,
    streams: Vec<Stream>,
    /// The port on which this federate listens.
    pub(super) port: Option<u16>,
}

/// Why a hello was refused: the answer, and words for people.
pub(super) type Refusal = (RejectReason, String);

impl Peers {
    pub(super) fn new(me: u16, wire: Wire, senders: Vec<u16>, receivers: Vec<u16>) -> Self {
        let way = |peer| (peer, Way::Ask(PhysicalTime::NEVER));
        Self {
            me,
            wire,
            senders: senders
                .into_iter()
                .map(|peer| (peer, Sender::Missing))
                .collect(),
            receivers: receivers.into_iter().map(way).collect(),
            ..Self::default()
        }
    }

    pub(super) fn name_federation(&mut self, federation: &str) {
        federation.as_bytes().clone_into(&mut self.federation);
    }

    pub(super) const fn wire(&self) -> Wire {
        self.wire
    }

    /// Whether all that will connect have.
    pub(super) fn all_here(&self) -> bool {
        let here = |sender: &(u16, Sender)| sender.1 != Sender::Missing;
        self.senders.iter().all(here)
    }

    /// Whether no sender will send any more.
    pub(super) fn all_gone(&self) -> bool {
        self.senders.iter().all(|sender| sender.1 == Sender::Gone)
    }

    /// Whether others will connect.
    pub(super) fn expects_any(&self) -> bool {
        !self.senders.is_empty()
    }

    pub(super) fn role(&self, stream: PeerStream) -> Role {
        self.streams[stream.0].role
    }

    pub(super) fn output(&mut self, stream: PeerStream) -> &mut Vec<u8> {
        &mut self.streams[stream.0].out
    }

    /// The output of the stream to `receiver`, unless that has ended.
    pub(super) fn to(&mut self, receiver: u16) -> Option<&mut Vec<u8>> {
        let way = self.receivers.iter().find(|(peer, _)| *peer == receiver);
        match way {
            Some((_, Way::Open(stream))) => Some(&mut self.streams[stream.0].out),
            Some(_) | None => None,
        }
    }

    /// What is to be done to meet the next receiver; one address is asked for at a time.
    pub(super) fn meet(&mut self, now: PhysicalTime) -> Meeting {
        let next = self
            .receivers
            .iter_mut()
            .find(|(_, way)| !matches!(way, Way::Open(_) | Way::Gone));
        let Some((peer, way)) = next else {
            return Meeting::Met;
        };
        match *way {
            Way::Ask(at) if at <= now => {
                *way = Way::Asked;
                Meeting::Ask(*peer)
            }
            Way::Ask(at) => Meeting::Wait(Some(at)),
            Way::Asked | Way::Connecting | Way::Open(_) | Way::Gone => Meeting::Wait(None),
        }
    }

    /// Takes the RTI's answer; returns the peer when its address is known. `None` too when nothing was asked.
    pub(super) fn answered(&mut self, now: PhysicalTime, port: i32) -> Option<(u16, u16)> {
        let asked = self.receivers.iter_mut().find(|r| r.1 == Way::Asked);
        let (peer, way) = asked?;
        match u16::try_from(port) {
            Ok(port) if port > 0 => {
                *way = Way::Connecting;
                Some((*peer, port))
            }
            Ok(_) | Err(_) => {
                *way = Way::Ask(now.saturating_add(ASK_AGAIN));
                None
            }
        }
    }

    /// Nobody answers there: its address is asked for again.
    pub(super) fn unreachable(&mut self, now: PhysicalTime, receiver: u16) {
        self.set(receiver, Way::Ask(now.saturating_add(ASK_AGAIN)));
    }

    fn set(&mut self, receiver: u16, to: Way) {
        if let Some((_, way)) = self.receivers.iter_mut().find(|r| r.0 == receiver) {
            *way = to;
        }
    }

    /// A connection to `receiver` stands: the hello goes out.
    pub(super) fn connected(&mut self, receiver: u16) -> PeerStream {
        let mut out = Vec::new();
        let hello = ToPeer::Hello {
            federate: self.me,
            federation: &self.federation,
            transient: false,
        };
        hello.encode(self.wire, &mut out);
        self.add(Role::Greeting(receiver), out)
    }

    /// Somebody has connected.
    pub(super) fn accepted(&mut self) -> PeerStream {
        self.add(Role::Stranger, Vec::new())
    }

    /// The other end of `stream` has the certificate of this federate.
    pub(super) fn certify(&mut self, stream: PeerStream, federate: u16) {
        self.streams[stream.0].certified = Some(federate);
    }

    fn add(&mut self, role: Role, out: Vec<u8>) -> PeerStream {
        let certified = None;
        self.streams.push(Stream {
            role,
            out,
            certified,
        });
        PeerStream(self.streams.len() - 1)
    }

    /// The receiver at the other end of `stream` has answered the hello.
    pub(super) fn greeted(&mut self, stream: PeerStream) {
        if let Role::Greeting(peer) = self.streams[stream.0].role {
            self.streams[stream.0].role = Role::To(peer);
            self.set(peer, Way::Open(stream));
        }
    }

    /// The hello of whoever has connected on `stream`: accepted, or refused with the reason.
    pub(super) fn hello(
        &mut self,
        stream: PeerStream,
        federate: u16,
        federation: &[u8],
    ) -> Result<u16, Refusal> {
        if federation != self.federation {
            let words = format!("federate {federate} of another federation wants to send here");
            return Err((RejectReason::FederationId, words));
        }
        if let Some(other) = self.streams[stream.0].certified
            && other != federate
        {
            let words = format!(
                "federate {other}, by its certificate, says that it is federate {federate}"
            );
            return Err((RejectReason::HmacWrong, words));
        }
        match self.senders.iter_mut().find(|(peer, _)| *peer == federate) {
            None => {
                let words =
                    format!("federate {federate} wants to send here, which the plan does not say");
                Err((RejectReason::FederateIdOutOfRange, words))
            }
            Some((_, Sender::Here | Sender::Gone)) => {
                let words = format!("federate {federate} connects a second time");
                Err((RejectReason::FederateIdInUse, words))
            }
            Some((_, sender)) => {
                *sender = Sender::Here;
                self.streams[stream.0].role = Role::From(federate);
                FromPeer::Ack.encode(&mut self.streams[stream.0].out);
                Ok(federate)
            }
        }
    }

    /// Answers with a refusal and ends the stream.
    pub(super) fn refuse(&mut self, stream: PeerStream, reason: RejectReason) {
        FromPeer::Reject(reason).encode(&mut self.streams[stream.0].out);
        self.streams[stream.0].role = Role::Over;
    }

    /// The stream is over; returns what it was for.
    pub(super) fn close(&mut self, stream: PeerStream) -> Role {
        let role = std::mem::replace(&mut self.streams[stream.0].role, Role::Over);
        match role {
            Role::To(peer) => {
                self.set(peer, Way::Gone);
                self.streams[stream.0].out.clear();
            }
            Role::From(peer) => {
                let sender = self.senders.iter_mut().find(|sender| sender.0 == peer);
                if let Some(sender) = sender {
                    sender.1 = Sender::Gone;
                }
            }
            Role::Stranger | Role::Greeting(_) | Role::Over => {}
        }
        role
    }

    /// Ends all streams to others once what they hold is written.
    pub(super) fn leave(&mut self) {
        for stream in &mut self.streams {
            if !matches!(stream.role, Role::From(_)) {
                stream.role = Role::Over;
            }
        }
    }
}
