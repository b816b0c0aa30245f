//! Joining: who a connection is, clock exchanges, and the start time.

use std::net::SocketAddr;

use ictus_core::{Delay, Duration, LogicalTime, PhysicalTime, Tag};

use super::{ConnectionId, Hello, Link, Member, Phase, Rti, RtiEvent, Stage};
use crate::mutants::Mutant;
use crate::topology::{FederateId, Topology};
use crate::wire::{
    NO_CLOCK_SYNC, NeighborStructure, RejectReason, ToFederate, ToRti, capability, kind,
};

/// The most that the start time lies after the latest proposal; LF's constant.
const LONGEST_DELAY: Duration = Duration::from_secs(1);
/// The start delay of a federation of no federates on a network without latency.
const LEAST_DELAY: Duration = Duration::from_millis(10);
/// What each federate adds to the start delay.
const DELAY_PER_FEDERATE: Duration = Duration::from_millis(1);
/// No proposal may be later (2116-ish): tags after it must have room.
const LATEST_PROPOSAL: PhysicalTime = PhysicalTime::from_nanos(i64::MAX / 2);

impl Rti {
    /// A message of a connection that is nobody yet: FED_IDS, what authenticates it before, or a refusal.
    pub(super) fn receive_hello(&mut self, id: ConnectionId, hello: Hello, bytes: &[u8]) -> usize {
        if let Some((reason, words)) = self.refusal(hello, bytes[0]) {
            self.reject(id, reason, &words);
            return bytes.len();
        }
        let Ok(Some((message, consumed))) = ToRti::decode(bytes) else {
            return 0;
        };
        match (hello, message) {
            (
                Hello::Silent | Hello::Proven { .. },
                ToRti::FederateIds {
                    federate,
                    federation,
                },
            ) => self.identify(id, hello, (federate, federation)),
            (_, message) => self.authenticate(id, hello, &message),
        }
        consumed
    }

    /// Why a message of this type may not be next.
    fn refusal(&self, hello: Hello, first: u8) -> Option<(RejectReason, String)> {
        let (reason, words) = match (hello, first) {
            (_, kind::P2P_FEDERATE_ID | kind::P2P_TAGGED_MESSAGE) => (
                RejectReason::WrongServer,
                "a federate's hello to another federate",
            ),
            (Hello::Proven { .. }, kind::FEDERATE_IDS) => return None,
            (_, kind::FEDERATE_IDS) if self.config.authentication => (
                RejectReason::HmacWrong,
                "it does not authenticate, which this RTI asks for",
            ),
            (_, kind::FEDERATE_IDS) => return None,
            (_, kind::FEDERATE_NONCE) if !self.config.authentication => (
                RejectReason::NotAuthenticating,
                "it wants authentication, which this RTI does not do",
            ),
            (Hello::Silent, kind::FEDERATE_NONCE)
            | (Hello::Challenged { .. }, kind::FEDERATE_RESPONSE | kind::REJECT) => return None,
            (Hello::Silent, byte) => {
                let words = format!("its first message has type {byte}, not FED_IDS");
                return Some((RejectReason::UnexpectedMessage, words));
            }
            (Hello::Challenged { .. } | Hello::Proven { .. }, byte) => {
                let words = format!("a message of type {byte} while it authenticates");
                return Some((RejectReason::UnexpectedMessage, words));
            }
        };
        Some((reason, words.to_owned()))
    }

    fn identify(&mut self, id: ConnectionId, hello: Hello, (federate, federation): (u16, &[u8])) {
        let other = match hello {
            Hello::Proven { federate: proven } => Some(proven).filter(|&proven| proven != federate),
            Hello::Silent | Hello::Challenged { .. } => None,
        };
        let certified = self.connections[id.0].certified;
        let refusal = if let Some(other) = certified.filter(|&other| other != federate) {
            let words = format!(
                "it has the certificate of federate {other}, and says that it is {federate}"
            );
            Some((RejectReason::HmacWrong, words))
        } else if let Some(other) = other {
            let words =
                format!("it authenticated as federate {other}, and says that it is {federate}");
            Some((RejectReason::HmacWrong, words))
        } else if federation != self.config.federation.as_bytes() {
            Some((
                RejectReason::FederationId,
                format!("it names federation `{}`", printable(federation)),
            ))
        } else if federate >= self.config.federates {
            let words = format!("federate {federate} of {}", self.config.federates);
            Some((RejectReason::FederateIdOutOfRange, words))
        } else if self.members[usize::from(federate)].stage != Stage::Absent {
            Some((
                RejectReason::FederateIdInUse,
                format!("federate {federate} has joined already"),
            ))
        } else {
            None
        };
        if let Some((reason, words)) = refusal {
            self.reject(id, reason, &words);
            return;
        }
        let federate = FederateId::new(federate);
        self.connections[id.0].link = Link::Member(federate);
        let member = &mut self.members[federate.index()];
        member.connection = Some(id);
        member.stage = Stage::Identified;
        member.last_word = self.now;
        self.send_to(id, &ToFederate::Ack);
    }

    /// One message of a federate that has not got the start time.
    pub(super) fn receive_joining(&mut self, federate: FederateId, bytes: &[u8]) -> usize {
        match ToRti::decode_limited(bytes, self.config.wire, self.config.max_payload) {
            Ok(None) => 0,
            Ok(Some((message, consumed))) => {
                self.handle_joining(federate, message);
                consumed
            }
            Err(error) => {
                self.fail(federate, error.to_string());
                bytes.len()
            }
        }
    }

    fn handle_joining(&mut self, federate: FederateId, message: ToRti<'_>) {
        let member = &mut self.members[federate.index()];
        member.last_word = self.now;
        let query = matches!(message, ToRti::AddressQuery { .. });
        let queried = std::mem::replace(&mut member.queried, query);
        match (self.members[federate.index()].stage, message) {
            (Stage::Identified, ToRti::NeighborStructure(neighbors)) => {
                self.take_structure(federate, neighbors);
            }
            (Stage::Structured, ToRti::UdpPort(port)) => self.take_udp_port(federate, port),
            (
                Stage::Exchanging { .. } | Stage::Synchronized { .. },
                ToRti::Capabilities(capabilities),
            ) => self.take_capabilities(federate, capabilities),
            (Stage::Exchanging { sent, left }, ToRti::ClockSyncT3 { .. }) => {
                self.finish_exchange(federate, sent, left);
            }
            (Stage::Synchronized { exchanged }, ToRti::Timestamp(time)) => {
                self.take_proposal(federate, time, exchanged);
            }
            (_, ToRti::AddressAdvertisement { port }) => self.take_listener(federate, port),
            (_, ToRti::DataAddress { port, address }) => {
                self.take_data_address(federate, port, address.into());
            }
            (
                _,
                ToRti::AddressQuery {
                    federate: asked, ..
                },
            ) => self.answer_query(federate, asked),
            (_, ToRti::Failed) => self.fail(federate, "it reported a failure".to_owned()),
            (_, ToRti::Resign) => self.fail(federate, "it resigned before the start".to_owned()),
            (_, message) => {
                let name = message.name();
                let hint = self.layout_hint(queried, &message);
                self.fail(
                    federate,
                    format!("{name} was not expected while joining{hint}"),
                );
            }
        }
    }

    fn take_structure(&mut self, federate: FederateId, neighbors: NeighborStructure) {
        let federates = self.config.federates;
        let upstream = neighbors.upstream.iter().map(|&(id, _)| id);
        let stranger = upstream
            .chain(neighbors.downstream.iter().copied())
            .find(|&id| id >= federates);
        if let Some(id) = stranger {
            self.fail(
                federate,
                format!("its neighbour {id} is not one of {federates} federates"),
            );
            return;
        }
        let member = &mut self.members[federate.index()];
        member.neighbors = neighbors;
        member.stage = Stage::Structured;
    }

    fn take_udp_port(&mut self, federate: FederateId, port: u16) {
        self.events.push_back(RtiEvent::Joined { federate });
        self.members[federate.index()].probed_at = self.probe_address(federate, port);
        if self.config.clock_exchanges == 0 || port == NO_CLOCK_SYNC {
            self.members[federate.index()].stage = Stage::Synchronized { exchanged: false };
        } else {
            self.begin_exchange(federate, self.config.clock_exchanges - 1);
        }
    }

    /// Where a federate with this UDP_PORT answers probes.
    fn probe_address(&self, federate: FederateId, port: u16) -> Option<SocketAddr> {
        let connection = self.members[federate.index()].connection?;
        let peer: SocketAddr = self.connections[connection.0].peer.parse().ok()?;
        (port != 0 && port != NO_CLOCK_SYNC).then(|| SocketAddr::new(peer.ip(), port))
    }

    /// From `first` on compares clocks with a federate that wants that.
    fn begin_probing(&mut self, first: PhysicalTime, federate: FederateId) {
        let member = &mut self.members[federate.index()];
        if let (Some(prober), Some(address)) = (&mut self.prober, member.probed_at.take()) {
            prober.begin(first, federate, address);
        }
    }

    fn begin_exchange(&mut self, federate: FederateId, left: u32) {
        self.send(federate, &ToFederate::ClockSyncT1(self.now));
        self.members[federate.index()].stage = Stage::Exchanging {
            sent: self.now,
            left,
        };
    }

    fn finish_exchange(&mut self, federate: FederateId, sent: PhysicalTime, left: u32) {
        self.send(federate, &ToFederate::ClockSyncT4(self.now));
        self.round_trip = self.round_trip.max(self.now.since(sent));
        match left.checked_sub(1) {
            Some(left) => self.begin_exchange(federate, left),
            None => {
                self.members[federate.index()].stage = Stage::Synchronized { exchanged: true };
                // LF's federates listen for probes from the start time on.
                if self.members[federate.index()].capabilities.is_some() {
                    self.begin_probing(self.now, federate);
                }
            }
        }
    }

    fn take_capabilities(&mut self, federate: FederateId, capabilities: u32) {
        let member = &mut self.members[federate.index()];
        member.capabilities = Some(capabilities);
        self.standings[federate.index()].runs_ahead = capabilities & capability::RUNS_AHEAD != 0;
        if let Some(id) = member.connection {
            self.connections[id.0].output.allow_large_chunks();
        }
    }

    fn take_proposal(&mut self, federate: FederateId, time: PhysicalTime, exchanged: bool) {
        if time < PhysicalTime::from_nanos(0) || time > LATEST_PROPOSAL {
            self.fail(federate, format!("it proposes to start at {time:?} ns"));
            return;
        }
        self.members[federate.index()].stage = Stage::Proposed { time, exchanged };
    }

    /// When all have proposed a start time: agrees on one and tells it.
    pub(super) fn start_if_complete(&mut self) {
        let Some(latest) = self.latest_proposal() else {
            return;
        };
        let start = round_up(latest + self.start_delay(), self.config.start_multiple);
        self.topology = self.told_topology();
        let told = |member: &Member| member.neighbors != NeighborStructure::default();
        self.ungranted = !self.members.iter().any(told)
            && self.members.iter().any(|member| member.listener.is_some());
        self.phase = Phase::Running {
            start: Tag::new(start.as_logical(), 0),
        };
        self.last_word = self.now;
        self.events.push_back(RtiEvent::Started { start });
        for federate in self.federates() {
            self.members[federate.index()].stage = Stage::Running;
            self.send(federate, &ToFederate::Timestamp(start));
            self.begin_probing(start, federate);
        }
        self.refuse_strangers();
    }

    pub(super) fn told_topology(&self) -> Topology {
        let mut neighbors: Vec<_> = self
            .members
            .iter()
            .map(|member| member.neighbors.clone())
            .collect();
        if self.config.mutants.has(Mutant::AfterZeroAsNone) {
            for (_, delay) in neighbors.iter_mut().flat_map(|told| &mut told.upstream) {
                *delay = if *delay == Delay::Microstep {
                    Delay::None
                } else {
                    *delay
                };
            }
        }
        Topology::from_neighbors(&neighbors)
    }

    fn latest_proposal(&self) -> Option<PhysicalTime> {
        self.members
            .iter()
            .try_fold(PhysicalTime::NEVER, |latest, member| match member.stage {
                Stage::Proposed { time, .. } => Some(latest.max(time)),
                Stage::Absent
                | Stage::Identified
                | Stage::Structured
                | Stage::Exchanging { .. }
                | Stage::Synchronized { .. }
                | Stage::Running
                | Stage::Gone => None,
            })
    }

    /// How long after the latest proposal the federation starts: long enough for the start time to reach everybody.
    fn start_delay(&self) -> Duration {
        let unmeasured = self.members.iter().any(|member| {
            member.capabilities.is_none()
                && matches!(
                    member.stage,
                    Stage::Proposed {
                        exchanged: false,
                        ..
                    }
                )
        });
        if unmeasured {
            return LONGEST_DELAY;
        }
        let network = self.round_trip.as_nanos().saturating_mul(4);
        let size = DELAY_PER_FEDERATE.as_nanos() * i64::from(self.config.federates);
        LEAST_DELAY
            .saturating_add(Duration::from_nanos(network))
            .saturating_add(Duration::from_nanos(size))
            .min(LONGEST_DELAY)
    }

    /// Connections that have not said who they are come too late now.
    fn refuse_strangers(&mut self) {
        for index in 0..self.connections.len() {
            if matches!(self.connections[index].link, Link::Unknown { .. }) {
                let words = "the federation has started already";
                self.reject(ConnectionId(index), RejectReason::FederationId, words);
            }
        }
    }
}

/// A peer's text for people: no control characters, and not longer than a line has room for.
fn printable(text: &[u8]) -> String {
    const MOST: usize = 64;
    let text = String::from_utf8_lossy(text);
    let mut shown: String = text
        .chars()
        .take(MOST)
        .flat_map(char::escape_debug)
        .collect();
    if text.chars().nth(MOST).is_some() {
        shown.push('…');
    }
    shown
}

/// The next multiple of `multiple` at or after `time`.
fn round_up(time: PhysicalTime, multiple: Option<Duration>) -> PhysicalTime {
    let Some(multiple) = multiple.filter(|&multiple| multiple > Duration::ZERO) else {
        return time;
    };
    let past = time.as_nanos().rem_euclid(multiple.as_nanos());
    if past == 0 {
        time
    } else {
        time + (multiple - Duration::from_nanos(past))
    }
}

/// The time that has passed between two logical times, for events.
pub(super) const fn elapsed(from: Tag, to: LogicalTime) -> Duration {
    to.since(from.time)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn start_times_are_rounded_up() {
        let at = PhysicalTime::from_nanos;
        let multiple = Some(Duration::from_nanos(100));
        assert_eq!(round_up(at(150), None), at(150));
        assert_eq!(round_up(at(150), multiple), at(200));
        assert_eq!(round_up(at(200), multiple), at(200));
        assert_eq!(round_up(at(200), Some(Duration::ZERO)), at(200));
    }
}
