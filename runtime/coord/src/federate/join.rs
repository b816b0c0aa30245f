//! Joining, and what each message of the RTI means in each phase.

use super::link::Link;
use super::{Federate, FederateEvent, Incoming, Outcome, Poll, ProtocolError};
use crate::auth::{Nonce, Proof};
use crate::clock::{Exchange, Interval};
use crate::payload::FederateExecutor;
use crate::wire::{NO_CLOCK_SYNC, RejectReason, TaggedMessage, ToFederate, ToRti, capability};
use ictus_core::{Duration, PhysicalTime, Tag};

/// A step of joining that takes longer is not answered at all: joins are answered one by one, clocks compared at once.
pub(super) const ANSWER_MAX: Duration = Duration::from_secs(60);

/// Where a federate is in its life.
#[derive(Debug)]
pub(super) enum Phase {
    /// Made, not connected.
    Idle,
    /// FED_NONCE sent.
    Authenticating(Nonce),
    /// FED_IDS sent.
    AwaitingAck,
    /// Comparing clocks.
    Synchronizing(Exchanges),
    /// Connecting with the other federates.
    Meeting,
    /// Own time proposed.
    AwaitingStart,
    /// Executing tags.
    Running,
    /// Resigned; waiting for the RTI and for senders to close, but not for ever.
    Draining {
        /// Whether the RTI has.
        rti_closed: bool,
        /// When waiting began.
        since: PhysicalTime,
    },
    /// Done.
    Ended,
}

impl Phase {
    fn name(&self) -> &'static str {
        match self {
            Self::Idle => "not connected",
            Self::Authenticating(_) => "waiting for the RTI to authenticate",
            Self::AwaitingAck => "waiting for the RTI to accept the join",
            Self::Synchronizing(_) => "comparing clocks",
            Self::Meeting => "connecting with other federates",
            Self::AwaitingStart => "waiting for the start time",
            Self::Running => "running",
            Self::Draining { .. } => "leaving",
            Self::Ended => "ended",
        }
    }
}

/// Clock exchanges over TCP: T1 from the RTI, T3 to it, T4 from it.
#[derive(Debug, Default)]
pub(super) struct Exchanges {
    wanted: u32,
    sent_at: Option<(PhysicalTime, PhysicalTime)>,
    done: Vec<Exchange>,
}

impl Federate {
    /// Begins to join: the first bytes for the RTI. A federate alone has nothing to say.
    pub fn connect(&mut self) {
        if let Some(link) = &mut self.link {
            let federate = link.config.id;
            if let Some(nonce) = link.config.authentication {
                link.say(&ToRti::FederateNonce { federate, nonce });
                self.phase = Phase::Authenticating(nonce);
            } else {
                self.identify();
            }
        }
    }

    fn identify(&mut self) {
        if let Some(link) = &mut self.link {
            let federation = link.config.federation.clone();
            link.say(&ToRti::FederateIds {
                federate: link.config.id,
                federation: federation.as_bytes(),
            });
            self.phase = Phase::AwaitingAck;
        }
    }

    /// RTI_RESPONSE: checks that the RTI knows the federation id, and proves that we do.
    fn authenticate(&mut self, own: Nonce, nonce: Nonce, hmac: &[u8; 32]) {
        let Some(link) = &mut self.link else { return };
        let key = link.config.federation.as_bytes();
        let rti = Proof::Rti {
            federate: link.config.id,
            nonce: own,
        };
        if rti.verify(key, hmac) {
            let hmac = Proof::Federate { nonce }.sign(key);
            link.say(&ToRti::FederateResponse { hmac });
            self.identify();
        } else {
            link.say(&ToRti::Reject(RejectReason::HmacWrong));
            self.outcome = Some(Outcome::RtiUnproven);
            self.phase = Phase::Ended;
        }
    }

    /// Ends before the start, because the clock is too uncertain.
    pub fn refuse_clock(&mut self, why: String) {
        self.end_with(Outcome::Clock(why));
    }

    /// Waits for the next step of joining, but not for ever.
    pub(super) fn await_answer(&mut self, now: PhysicalTime) -> Poll {
        let by = *self.answer_by.get_or_insert(now.saturating_add(ANSWER_MAX));
        if now < by {
            return Poll::Wait(Some(by));
        }
        let hint = match self.phase {
            Phase::Authenticating(_) | Phase::AwaitingAck => ": is an RTI listening there?",
            Phase::Synchronizing(_) => ": an RTI with `-c off` compares no clocks",
            Phase::Idle
            | Phase::Meeting
            | Phase::AwaitingStart
            | Phase::Running
            | Phase::Draining { .. }
            | Phase::Ended => "",
        };
        let phase = self.phase.name();
        self.end_with(Outcome::NotJoined { phase, hint });
        Poll::Ended
    }

    /// Takes what the RTI sent and returns how many bytes were whole messages; the driver keeps the rest.
    pub fn receive(
        &mut self,
        now: PhysicalTime,
        bytes: &[u8],
        executor: &mut impl FederateExecutor,
    ) -> usize {
        let mut used = 0;
        while !matches!(self.phase, Phase::Ended) {
            let handled = match ToFederate::decode(&bytes[used..]) {
                Ok(None) => break,
                Ok(Some((message, length))) => {
                    used += length;
                    self.handle(now, &message, executor)
                }
                Err(error) => Err(ProtocolError::from(error).into()),
            };
            if let Err(outcome) = handled {
                self.end_with(outcome);
            }
        }
        used
    }

    fn handle(
        &mut self,
        now: PhysicalTime,
        message: &ToFederate<'_>,
        executor: &mut impl FederateExecutor,
    ) -> Result<(), Outcome> {
        self.answer_by = None;
        match (&mut self.phase, message) {
            (Phase::Draining { .. } | Phase::Ended, _) => Ok(()),
            (_, ToFederate::Reject(reason)) => Err(Outcome::Rejected(*reason)),
            (Phase::Running, _) => self.handle_running(now, message, executor),
            (Phase::Authenticating(own), ToFederate::RtiResponse { nonce, hmac }) => {
                let own = *own;
                self.authenticate(own, *nonce, hmac);
                Ok(())
            }
            (Phase::AwaitingAck, ToFederate::Ack) => {
                self.introduce();
                Ok(())
            }
            (Phase::Synchronizing(exchanges), ToFederate::ClockSyncT1(t1)) => {
                exchanges.sent_at = Some((*t1, now));
                if let Some(link) = &mut self.link {
                    let federate = link.config.id;
                    link.say(&ToRti::ClockSyncT3 { federate });
                }
                Ok(())
            }
            (Phase::Synchronizing(_), ToFederate::ClockSyncT4(t4)) => {
                self.take_exchange(*t4);
                Ok(())
            }
            (Phase::Meeting, ToFederate::AddressQueryReply { port, address }) => {
                self.take_address(now, *port, *address);
                Ok(())
            }
            (Phase::AwaitingStart, ToFederate::Timestamp(start)) => {
                self.start(Tag::new(start.as_logical(), 0));
                Ok(())
            }
            (_, ToFederate::Failed) => Err(Outcome::RtiFailed),
            (phase, message) => Err(ProtocolError::Unexpected {
                message: name(message),
                phase: phase.name(),
            }
            .into()),
        }
    }

    /// After the ACK: structure, clock port, what we can do; then clocks or the own time.
    fn introduce(&mut self) {
        let Some(link) = &mut self.link else { return };
        self.events.push_back(FederateEvent::Joined);
        link.say(&ToRti::NeighborStructure(link.neighbors()));
        let exchanges = link.config.clock_exchanges;
        link.say(&ToRti::UdpPort(if exchanges.is_some() {
            link.config.clock_port
        } else {
            NO_CLOCK_SYNC
        }));
        if link.config.extensions {
            let always =
                capability::FLOW_CONTROL | capability::FEDERATE_LOST | capability::RUNS_AHEAD;
            let more = if link.config.decentralized {
                capability::DECENTRALIZED
            } else {
                0
            };
            link.say(&ToRti::Capabilities(always | more));
        }
        match exchanges {
            Some(wanted) if wanted > 0 => {
                self.phase = Phase::Synchronizing(Exchanges {
                    wanted,
                    ..Exchanges::default()
                });
            }
            Some(_) | None => self.advertise(),
        }
    }

    /// After the clocks: says where others can connect; then this federate meets those that it sends to.
    fn advertise(&mut self) {
        let Some(link) = &mut self.link else { return };
        if let Some(port) = link.peers.port {
            let port = i32::from(port);
            // LF's RTI tells others the address that it sees itself.
            let own = link.config.data_address.filter(|_| link.config.extensions);
            link.say(&match own {
                Some(address) => ToRti::DataAddress { port, address },
                None => ToRti::AddressAdvertisement { port },
            });
        }
        self.phase = Phase::Meeting;
    }

    fn take_exchange(&mut self, t4: PhysicalTime) {
        let Phase::Synchronizing(exchanges) = &mut self.phase else {
            return;
        };
        let Some((t1, t2)) = exchanges.sent_at.take() else {
            return;
        };
        // T3 is written later than this, and only that matters: LF takes the mean of the errors, this one what is certain.
        let t3 = t2;
        exchanges.done.push(Exchange { t1, t2, t3, t4 });
        if exchanges.done.len() < exchanges.wanted as usize {
            return;
        }
        // Its own time is proposed at the next poll, when the driver has corrected the clock.
        if let Some(interval) = Interval::of_all(&exchanges.done) {
            self.events.push_back(FederateEvent::ClockOffset(interval));
        }
        self.advertise();
    }

    fn handle_running(
        &mut self,
        now: PhysicalTime,
        message: &ToFederate<'_>,
        executor: &mut impl FederateExecutor,
    ) -> Result<(), Outcome> {
        let Some(link) = &mut self.link else {
            return Ok(());
        };
        let limit = self.stop.limit();
        match message {
            ToFederate::TaggedMessage(message) => self.take_message(message, executor)?,
            ToFederate::PortAbsent(absent) => {
                let input = link
                    .input(absent.port)
                    .ok_or(ProtocolError::UnknownPort(absent.port))?;
                self.timeline.settle(input, absent.tag);
            }
            ToFederate::TagAdvanceGrant(tag) => link.grant(*tag, limit, &mut self.timeline),
            ToFederate::ProvisionalTagAdvanceGrant(tag) => {
                self.counters.provisional += 1;
                link.grant_provisionally(*tag, limit, &mut self.timeline);
            }
            ToFederate::DownstreamNextEventTag(tag) => link.announcements_not_needed(*tag),
            ToFederate::DownstreamConfirmed(tag) => link.downstream_confirmed(*tag),
            ToFederate::StopRequest(tag) => self.answer_stop_request(*tag),
            ToFederate::StopGranted(tag) => self.take_stop_tag(*tag),
            ToFederate::FederateLost { federate, promise } => self.peer_lost(*federate, *promise),
            ToFederate::Failed => self.abandon(Outcome::RtiFailed),
            ToFederate::Ack
            | ToFederate::Reject(_)
            | ToFederate::Timestamp(_)
            | ToFederate::ClockSyncT1(_)
            | ToFederate::ClockSyncT4(_)
            | ToFederate::AddressQueryReply { .. }
            | ToFederate::RtiResponse { .. } => {
                let phase = "running";
                return Err(ProtocolError::Unexpected {
                    message: name(message),
                    phase,
                }
                .into());
            }
        }
        let _ = now;
        Ok(())
    }

    #[inline]
    fn take_message(
        &mut self,
        message: &TaggedMessage<'_>,
        executor: &mut impl FederateExecutor,
    ) -> Result<(), Outcome> {
        let Some(link) = &mut self.link else {
            return Ok(());
        };
        if message.federate != link.config.id {
            return Err(ProtocolError::WrongFederate(message.federate).into());
        }
        let input = link
            .input(message.port)
            .ok_or(ProtocolError::UnknownPort(message.port))?;
        link.message_arrived(message.tag);
        self.admit(
            &Incoming {
                input,
                tag: message.tag,
                payload: message.payload,
            },
            executor,
        )
    }

    /// The connection ended. Expected after RESIGN; before the start it ends the federate at once; while running the
    /// current tag is finished and shutdown reactions run.
    pub fn handle_disconnect(&mut self) {
        match self.phase {
            Phase::Draining {
                ref mut rti_closed, ..
            } => {
                *rti_closed = true;
                self.end_if_all_gone();
            }
            Phase::Running => self.abandon(Outcome::RtiLost),
            Phase::Ended => {}
            Phase::Idle
            | Phase::Authenticating(_)
            | Phase::AwaitingAck
            | Phase::Synchronizing(_)
            | Phase::Meeting
            | Phase::AwaitingStart => {
                self.link.as_mut().map(Link::output).map(Vec::clear);
                self.end_with(Outcome::RtiLost);
            }
        }
    }
}

fn name(message: &ToFederate<'_>) -> &'static str {
    match message {
        ToFederate::Ack => "ACK",
        ToFederate::Reject(_) => "REJECT",
        ToFederate::Timestamp(_) => "TIMESTAMP",
        ToFederate::TaggedMessage(_) => "TAGGED_MESSAGE",
        ToFederate::PortAbsent(_) => "PORT_ABSENT",
        ToFederate::TagAdvanceGrant(_) => "TAG",
        ToFederate::ProvisionalTagAdvanceGrant(_) => "PTAG",
        ToFederate::DownstreamNextEventTag(_) => "DNET",
        ToFederate::StopRequest(_) => "STOP_REQUEST",
        ToFederate::StopGranted(_) => "STOP_GRANTED",
        ToFederate::ClockSyncT1(_) => "T1",
        ToFederate::ClockSyncT4(_) => "T4",
        ToFederate::AddressQueryReply { .. } => "ADDRESS_QUERY_REPLY",
        ToFederate::RtiResponse { .. } => "RTI_RESPONSE",
        ToFederate::Failed => "FAILED",
        ToFederate::DownstreamConfirmed(_) => "DOWNSTREAM_CONFIRMED",
        ToFederate::FederateLost { .. } => "FEDERATE_LOST",
    }
}
