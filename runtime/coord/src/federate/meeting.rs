//! Meeting the other federates, and what they send.

use super::join::Phase;
use super::link::Link;
use super::peers::{Meeting, PeerStream, Role};
use super::{Federate, FederateEvent, Incoming, Outcome, Poll, ProtocolError};
use crate::mutants::Mutant;
use crate::payload::FederateExecutor;
use crate::plan::Wire;
use crate::wire::kind;
use crate::wire::{FromPeer, MAX_PAYLOAD, RejectReason, ToPeer, ToRti};
use ictus_core::{InputId, PhysicalTime, Tag};

impl Federate {
    /// Whether other federates will connect to this one: the driver must listen, and say where, before
    /// [`Federate::connect`].
    #[must_use]
    pub fn expects_peers(&self) -> bool {
        self.link
            .as_ref()
            .is_some_and(|link| link.peers.expects_any())
    }

    /// Whether others are still to connect: if not, the driver stops listening and closes what has not said hello.
    #[must_use]
    pub fn peers_missing(&self) -> bool {
        let missing = |link: &Link| !link.peers.all_here();
        self.link.as_ref().is_some_and(missing)
    }

    /// Whether the other end of `stream` has not said who it is.
    #[must_use]
    pub fn peer_is_stranger(&self, stream: PeerStream) -> bool {
        let role = self.link.as_ref().map(|link| link.peers.role(stream));
        role == Some(Role::Stranger)
    }

    /// The port on which the driver listens for other federates.
    pub fn listening(&mut self, port: u16) {
        if let Some(link) = &mut self.link {
            link.peers.port = Some(port);
        }
    }

    /// The driver has connected to `receiver`, as [`FederateEvent::Connect`] asked.
    ///
    /// # Panics
    ///
    /// When the federate is alone.
    pub fn peer_connected(&mut self, receiver: u16) -> PeerStream {
        let link = self.link.as_mut().expect("only a federate meets others");
        link.peers.connected(receiver)
    }

    /// The driver could not connect to `receiver`: its address will be asked for again.
    pub fn peer_unreachable(&mut self, now: PhysicalTime, receiver: u16) {
        if let Some(link) = &mut self.link {
            link.peers.unreachable(now, receiver);
        }
    }

    /// The driver has accepted a connection on its listener.
    ///
    /// # Panics
    ///
    /// When the federate is alone.
    pub fn peer_accepted(&mut self) -> PeerStream {
        let link = self.link.as_mut().expect("only a federate meets others");
        link.peers.accepted()
    }

    /// The other end of `stream` has shown the certificate of `federate`: it is taken for no other.
    pub fn peer_certified(&mut self, stream: PeerStream, federate: u16) {
        if let Some(link) = &mut self.link {
            link.peers.certify(stream, federate);
        }
    }

    /// Somebody who has connected was refused by the driver before a hello, for this reason.
    pub fn peer_unfit(&mut self, words: String) {
        self.count_refused(words);
    }

    /// Bytes for the other end of `stream`, in order; the driver takes what it has written from the front.
    ///
    /// # Panics
    ///
    /// When the federate is alone, or did not give out `stream`.
    pub fn peer_output(&mut self, stream: PeerStream) -> &mut Vec<u8> {
        let link = self.link.as_mut().expect("only a federate meets others");
        link.peers.output(stream)
    }

    /// Whether nothing more will be read or written on `stream` but what is left of its output: then the driver closes it.
    #[must_use]
    pub fn peer_over(&self, stream: PeerStream) -> bool {
        let role = self.link.as_ref().map(|link| link.peers.role(stream));
        role.is_none_or(|role| role == Role::Over)
    }

    /// Says that everything that had come from anybody when the clock showed `now` has been received: what is decided by
    /// time is decided by this.
    #[inline]
    pub fn looked(&mut self, now: PhysicalTime) {
        self.looked_at = self.looked_at.max(now);
    }

    /// Meets the receivers one by one; then proposes a start time.
    pub(super) fn meet(&mut self, now: PhysicalTime) -> Poll {
        let Some(link) = &mut self.link else {
            return Poll::Wait(None);
        };
        match link.peers.meet(now) {
            Meeting::Ask(peer) => {
                let transient = (link.config.wire == Wire::V0_13).then_some(false);
                let query = ToRti::AddressQuery {
                    federate: peer,
                    transient,
                };
                link.say(&query);
                Poll::Wait(None)
            }
            Meeting::Wait(until) => Poll::Wait(until),
            Meeting::Met => {
                link.say(&ToRti::Timestamp(now));
                self.phase = Phase::AwaitingStart;
                Poll::Wait(None)
            }
        }
    }

    /// Takes the RTI's answer to ADDRESS_QUERY.
    pub(super) fn take_address(&mut self, now: PhysicalTime, port: i32, address: [u8; 4]) {
        if let Some(link) = &mut self.link
            && let Some((peer, port)) = link.peers.answered(now, port)
        {
            self.events.push_back(FederateEvent::Connect {
                peer,
                address,
                port,
            });
        }
    }

    /// Takes what came on `stream` and returns how many bytes were whole messages; the driver keeps the rest and offers it
    /// again: before the start, messages wait.
    pub fn receive_from_peer(
        &mut self,
        now: PhysicalTime,
        stream: PeerStream,
        bytes: &[u8],
        executor: &mut impl FederateExecutor,
    ) -> usize {
        let mut used = 0;
        while !matches!(self.phase, Phase::Ended) && used < bytes.len() {
            let Some(link) = &mut self.link else { break };
            let rest = &bytes[used..];
            let taken = match link.peers.role(stream) {
                Role::Stranger => self.take_hello(stream, rest),
                Role::Greeting(peer) => self.take_greeting(stream, peer, rest),
                Role::From(peer) => self.take_from_sender(now, peer, rest, executor),
                // A receiver has nothing to say, and what is over is not read.
                Role::To(_) | Role::Over => Ok(rest.len()),
            };
            match taken {
                Ok(0) => break,
                Ok(length) => used += length,
                Err(outcome) => self.end_with(outcome),
            }
        }
        used
    }

    fn take_hello(&mut self, stream: PeerStream, bytes: &[u8]) -> Result<usize, Outcome> {
        let Some(link) = &mut self.link else {
            return Ok(bytes.len());
        };
        // Nothing is kept of who does not begin with a hello.
        let refusal = match ToPeer::decode(bytes, link.peers.wire(), 0) {
            Ok(None) if bytes[0] == kind::P2P_FEDERATE_ID => return Ok(0),
            Ok(Some((
                ToPeer::Hello {
                    federate,
                    federation,
                    ..
                },
                length,
            ))) => match link.peers.hello(stream, federate, federation) {
                Ok(_) => return Ok(length),
                Err(refusal) => refusal,
            },
            Ok(None | Some(_)) | Err(_) => {
                let words = "somebody's first bytes are no hello of a federate".to_owned();
                (RejectReason::WrongServer, words)
            }
        };
        link.peers.refuse(stream, refusal.0);
        self.count_refused(refusal.1);
        Ok(bytes.len())
    }

    /// Counts a stranger, and says why it was refused.
    fn count_refused(&mut self, words: String) {
        self.counters.refused += 1;
        // They may come without end.
        let count = self.counters.refused;
        if count <= 10 || 10_u64.pow(count.ilog10()) == count {
            self.events.push_back(FederateEvent::PeerRefused(words));
        }
    }

    fn take_greeting(
        &mut self,
        stream: PeerStream,
        peer: u16,
        bytes: &[u8],
    ) -> Result<usize, Outcome> {
        match FromPeer::decode(bytes) {
            Ok(None) => Ok(0),
            Ok(Some((FromPeer::Ack, length))) => {
                if let Some(link) = &mut self.link {
                    link.peers.greeted(stream);
                }
                Ok(length)
            }
            Ok(Some((FromPeer::Reject(reason), _))) => {
                Err(Outcome::RejectedByPeer { peer, reason })
            }
            Err(error) => Err(Outcome::PeerProtocol {
                peer,
                error: error.into(),
            }),
        }
    }

    fn take_from_sender(
        &mut self,
        now: PhysicalTime,
        peer: u16,
        bytes: &[u8],
        executor: &mut impl FederateExecutor,
    ) -> Result<usize, Outcome> {
        match self.phase {
            Phase::Running | Phase::Draining { .. } => {}
            Phase::Ended => return Ok(bytes.len()),
            // It has heard of the start before this federate has.
            Phase::Idle
            | Phase::Authenticating(_)
            | Phase::AwaitingAck
            | Phase::Synchronizing(_)
            | Phase::Meeting
            | Phase::AwaitingStart => return Ok(0),
        }
        let Some(link) = &self.link else {
            return Ok(bytes.len());
        };
        let broke = |error: ProtocolError| Outcome::PeerProtocol { peer, error };
        match ToPeer::decode(bytes, link.peers.wire(), MAX_PAYLOAD) {
            Ok(None) => Ok(0),
            Ok(Some((message, length))) => {
                let taken = self.take_peer_message(now, peer, &message, executor);
                if let Err(Outcome::Protocol(error)) = taken {
                    return Err(broke(error));
                }
                taken?;
                Ok(length)
            }
            Err(error) => Err(broke(error.into())),
        }
    }

    fn take_peer_message(
        &mut self,
        now: PhysicalTime,
        peer: u16,
        message: &ToPeer<'_>,
        executor: &mut impl FederateExecutor,
    ) -> Result<(), Outcome> {
        match message {
            ToPeer::Hello { .. } => {
                let (message, phase) = ("a second hello", "running");
                Err(ProtocolError::Unexpected { message, phase }.into())
            }
            ToPeer::Message(message) => {
                let input = self.input_from(peer, message.port, message.federate, true)?;
                self.admit_physical(now, input, message.payload, executor)
            }
            // What is never due is no message.
            ToPeer::TaggedMessage(message) if message.tag == Tag::FOREVER => {
                let (message, phase) = ("a message at the end of time", "running");
                Err(ProtocolError::Unexpected { message, phase }.into())
            }
            ToPeer::TaggedMessage(message) => {
                let input = self.input_from(peer, message.port, message.federate, false)?;
                let incoming = Incoming {
                    input,
                    tag: message.tag,
                    payload: message.payload,
                };
                self.admit_by_time(now, &incoming, executor)
            }
            ToPeer::PortAbsent(absent) => {
                let input = self.input_from(peer, absent.port, absent.federate, false)?;
                self.timeline.settle(input, absent.tag);
                Ok(())
            }
        }
    }

    /// The input that `peer` may write to through port `port`.
    fn input_from(
        &self,
        peer: u16,
        port: u16,
        federate: u16,
        physical: bool,
    ) -> Result<InputId, ProtocolError> {
        let Some(link) = &self.link else {
            return Err(ProtocolError::UnknownPort(port));
        };
        if federate != link.config.id {
            return Err(ProtocolError::WrongFederate(federate));
        }
        let input = link.input(port).ok_or(ProtocolError::UnknownPort(port))?;
        let known = &link.config.inputs[input.index()];
        if known.federate == peer && known.physical == physical {
            Ok(input)
        } else {
            Err(ProtocolError::NotItsPort { port, peer })
        }
    }

    fn admit_physical(
        &mut self,
        now: PhysicalTime,
        input: InputId,
        payload: &[u8],
        executor: &mut impl FederateExecutor,
    ) -> Result<(), Outcome> {
        self.counters.received += 1;
        if let Some(link) = &self.link {
            let sender = link.config.inputs[input.index()].federate;
            self.measures.arrived(sender, payload.len());
        }
        if self.stop.over(self.timeline.at()) {
            return Ok(());
        }
        let value = executor.decode(input, payload)?;
        let action = self.timeline.program().network_inputs()[input.index()].action;
        let tag = self.schedule_physical(now, action, value);
        executor.note_physical(action, tag);
        Ok(())
    }

    /// The other end of `stream` has closed it, after everything that it sent was offered.
    ///
    /// A sender that did not say goodbye is lost: its inputs stay unknown until the RTI says what to do; from LF federates,
    /// which say none, and from those that the others may outlive, nothing comes any more. `cut`: the last message is not
    /// whole, so that this was no regular end.
    pub fn peer_closed(&mut self, now: PhysicalTime, stream: PeerStream, cut: bool) {
        let Some(link) = &mut self.link else { return };
        match link.peers.close(stream) {
            Role::From(peer) => self.sender_closed(now, peer, cut),
            Role::Greeting(peer) => link.peers.unreachable(now, peer),
            Role::Stranger | Role::To(_) | Role::Over => {}
        }
        self.end_if_all_gone();
    }

    /// After the last words: the end, once the RTI has closed and no sender can bring anything late.
    pub(super) fn end_if_all_gone(&mut self) {
        let gone = |link: &Link| link.peers.all_gone() || !link.config.decentralized;
        if let Phase::Draining {
            rti_closed: true, ..
        } = self.phase
            && self.link.as_ref().is_none_or(gone)
        {
            self.phase = Phase::Ended;
        }
    }

    /// The receiver at the other end of `stream` has taken nothing for too long.
    ///
    /// One that the others may outlive is left behind: what is for it is dropped. Without any other this federate cannot go on.
    pub fn peer_stuck(&mut self, stream: PeerStream) {
        let Some(link) = &mut self.link else { return };
        let Role::To(peer) = link.peers.role(stream) else {
            return;
        };
        let mut outputs = link.config.outputs.iter();
        if outputs.any(|output| output.federate == peer && output.outlived) {
            link.peers.close(stream);
            let words = format!("federate {peer} takes nothing any more: nothing is sent to it");
            self.events.push_back(FederateEvent::PeerLeft(words));
        } else {
            self.end_with(Outcome::PeerStuck(peer));
        }
    }

    fn sender_closed(&mut self, now: PhysicalTime, peer: u16, cut: bool) {
        let Some(link) = &mut self.link else { return };
        let mut lost = false;
        for (index, input) in link.config.inputs.iter().enumerate() {
            if input.federate != peer {
                continue;
            }
            lost |= cut && !input.outlived;
            if input.physical {
                continue;
            }
            let input_id = InputId::new(index);
            let as_end = link.config.mutants.has(Mutant::LossAsEnd);
            if !input.says_goodbye || input.outlived || as_end {
                self.timeline.settle(input_id, Tag::FOREVER);
            } else {
                lost |= self.timeline.known(input_id) < Tag::FOREVER;
            }
        }
        // The RTI may have said so already.
        if lost && !self.stop.has_lost(peer) {
            let within = super::LOSS_EXPLAINED_WITHIN + link.config.found_later;
            let until = now.saturating_add(within);
            self.unexplained.get_or_insert((peer, until));
        }
    }
}
