//! The RTI: joins federates, relays their messages, grants tags, agrees on start and stop. Bytes in, bytes out.
//!
//! The driver reads bytes and hands them to [`Rti::receive`], which relays messages and only *records* the rest. After
//! all sockets of a round have been read it calls [`Rti::drain`], which decides once, over everything that was touched:
//! so a grant always stands behind the messages it vouches for, and what is superseded within a round is never sent.
//! Then it writes what [`Rti::poll_output`] names, takes the events, and waits until [`Rti::poll_timeout`]:
//!
//! ```
//! use ictus_core::PhysicalTime;
//! use ictus_coord::rti::{Rti, RtiConfig};
//! use ictus_coord::wire::{RejectReason, ToFederate, ToRti};
//!
//! let now = PhysicalTime::from_nanos(1_000);
//! let mut rti = Rti::new(RtiConfig::new("federation", 2));
//! let connection = rti.connect(now, "127.0.0.1:40000".to_owned());
//! let mut bytes = Vec::new();
//! ToRti::FederateIds { federate: 2, federation: b"federation" }.encode(&mut bytes);
//! assert_eq!(rti.receive(now, connection, &bytes), bytes.len());
//! rti.drain(now);
//! while let Some(ready) = rti.poll_output() {
//!     let reject = ToFederate::Reject(RejectReason::FederateIdOutOfRange);
//!     assert_eq!(ToFederate::decode(rti.output(ready).chunk()), Ok(Some((reject, 2))));
//! }
//! ```
//!
//! Law `batches_do_not_matter`: any split of the same input into rounds relays the same messages, grants what is equal or
//! later in the end, and never what is unsafe.
//!
//! Source: reactor-c `rti_remote.c`; the wire document. Where LF's RTI has a quirk this one is sane: connections are
//! accepted at once and each has its own deadline; the federation id is compared in full; a federate that vanishes, or
//! says FAILED, starts the stop consensus, its last promise limits those downstream, and nobody is left hanging; a stop
//! reply that is late kills nobody as long as all are alive.

use std::collections::{BTreeSet, VecDeque};
use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use ictus_core::{Duration, PhysicalTime, Tag};

use crate::auth::Nonce;
use crate::clock::{Prober, Transmit};
use crate::mutants::Mutants;
use crate::plan::Wire;
use crate::topology::{FederateId, Topology};
use crate::wire::{MAX_PAYLOAD, NeighborStructure, RejectReason, ToFederate};

mod addresses;
mod authenticate;
mod dnet;
mod flow;
pub mod grant;
mod liveness;
mod output;
mod progress;
mod relay;
mod start;
mod stop;

use grant::{LostRule, Presence, Standing, View};
pub use output::{Closing, Output};
use progress::Touched;
use stop::Stop;

/// What an RTI is told before anything happens.
#[derive(Clone, Debug)]
pub struct RtiConfig {
    /// The federation's id; every federate must name it in full.
    pub federation: String,
    /// The number of federates that must join.
    pub federates: u16,
    /// Clock exchanges with each federate that asks for them while it joins; 0: none.
    pub clock_exchanges: u32,
    /// Whether federates must prove that they know the federation id before they join.
    pub authentication: bool,
    /// The federates whose loss stops nobody: nothing comes from them any more, as if they had resigned. The exit code is 1
    /// all the same, and before the start there is no going on without them.
    pub continue_without: BTreeSet<u16>,
    /// The time between two exchanges over UDP with a federate that has a port for them; absent: none.
    pub clock_period: Option<Duration>,
    /// The layout of ADDRESS_QUERY.
    pub wire: Wire,
    /// Whether DNETs are sent.
    pub dnet: bool,
    /// The start time is rounded up to a multiple of this.
    pub start_multiple: Option<Duration>,
    /// How long a connection may take to say who it is, and then to say each next thing up to the last clock exchange.
    pub handshake_timeout: Duration,
    /// How long a federate that has done its clock exchanges may then be silent before it proposes a start time: it may
    /// be connecting to its peers, for which a C federate gives itself a minute.
    pub setup_timeout: Duration,
    /// How long a connection that is to close may take to take its bytes and close.
    pub closing_timeout: Duration,
    /// How long federates may take to answer a stop request before those that are missing are named; when a federate
    /// was lost they then count as lost too.
    pub stop_reply_timeout: Duration,
    /// After the stop tag is agreed and a federate was lost: how long all may be silent before they are failed.
    pub stop_grace: Duration,
    /// As `stop_grace`, but from the agreement on and whether or not they are silent.
    pub stop_limit: Duration,
    /// The longest payload accepted, in bytes.
    pub max_payload: u32,
    /// The most bytes that may wait for one federate; crossing it ends the federation.
    pub max_output: usize,
    /// Rules that are wrong; none but in tests.
    #[doc(hidden)]
    pub mutants: Mutants,
}

impl RtiConfig {
    /// The defaults for a federation of `federates` federates: no clock exchanges, DNET on, handshakes of 30 s, 180 s
    /// to set up, 64 MiB payloads, 256 MiB per output.
    #[must_use]
    pub fn new(federation: &str, federates: u16) -> Self {
        Self {
            federation: federation.to_owned(),
            federates,
            clock_exchanges: 0,
            authentication: false,
            continue_without: BTreeSet::new(),
            clock_period: None,
            wire: Wire::V0_12,
            dnet: true,
            start_multiple: None,
            handshake_timeout: Duration::from_secs(30),
            setup_timeout: Duration::from_secs(180),
            closing_timeout: Duration::from_secs(5),
            stop_reply_timeout: Duration::from_secs(30),
            stop_grace: Duration::from_secs(10),
            stop_limit: Duration::from_secs(60),
            max_payload: MAX_PAYLOAD,
            max_output: 256 << 20,
            mutants: Mutants::NONE,
        }
    }
}

/// Names a connection of one [`Rti`]; reused after [`Rti::disconnect`].
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub struct ConnectionId(usize);

impl ConnectionId {
    /// The position in a table of connections; small, because ids are reused.
    #[must_use]
    pub const fn index(self) -> usize {
        self.0
    }

    /// The id that a driver kept as a position.
    #[must_use]
    pub const fn from_index(index: usize) -> Self {
        Self(index)
    }
}

/// A peer that has connected.
#[derive(Clone, Debug)]
pub struct Newcomer {
    /// Its address, for people; where others reach the federate, when it is a socket address.
    pub peer: String,
    /// The RTI's address as the peer sees it, if known: told to it as the address of federates on the RTI's host.
    pub local: Option<IpAddr>,
    /// Random bytes of its own; without them it cannot authenticate.
    pub nonce: Option<Nonce>,
}

impl From<String> for Newcomer {
    fn from(peer: String) -> Self {
        Self {
            peer,
            local: None,
            nonce: None,
        }
    }
}

/// How a connection ended.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Disconnect {
    /// The peer closed its writing half.
    #[error("the connection was closed")]
    Eof,
    /// The peer reset the connection.
    #[error("the connection was reset")]
    Reset,
    /// It ended, and the peer had not said that it would; only where connections are protected.
    #[error("the connection was cut")]
    Cut,
    /// The peer is not who it should be, or its bytes are not its own; in words.
    #[error("{0}")]
    Unfit(String),
    /// The driver closed it to make room: [`Rti::least_needed`].
    #[error("its place was given to another")]
    Evicted,
    /// The peer's host answers nothing any more, whatever its programs do.
    #[error("no answer from {host} for {:.1} s", .lasting.to_std().as_secs_f64())]
    Silent {
        /// The host.
        host: IpAddr,
        /// For how long.
        lasting: Duration,
    },
    /// The socket failed.
    #[error("the connection failed: {0}")]
    Error(String),
}

/// What happened, for people and supervisors.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum RtiEvent {
    /// A federate joined.
    Joined {
        /// Its id.
        federate: FederateId,
    },
    /// All have joined; the start time is agreed.
    Started {
        /// The start time.
        start: PhysicalTime,
    },
    /// A stop was asked for.
    StopRequested {
        /// By this federate; by the RTI itself when absent.
        federate: Option<FederateId>,
    },
    /// Some have not answered a stop request for [`RtiConfig::stop_reply_timeout`].
    StopUnanswered {
        /// Those that have not.
        federates: Vec<FederateId>,
    },
    /// The stop tag is agreed.
    StopAgreed {
        /// The stop tag's time, since the start time.
        elapsed: Duration,
        /// Its microstep.
        microstep: u32,
    },
    /// A federate left in order.
    Resigned {
        /// Its id.
        federate: FederateId,
    },
    /// A federate was lost.
    Lost {
        /// Its id.
        federate: FederateId,
        /// How, in words.
        reason: String,
    },
    /// A connection was refused or did not say who it is.
    Rejected {
        /// The peer's address.
        peer: String,
        /// Why, in words.
        reason: String,
    },
    /// All federates are gone.
    Ended {
        /// The exit code.
        code: u8,
    },
}

/// The RTI's state machine.
///
/// `now` is the RTI's physical clock in every call; a reading below an earlier one counts as the earlier one.
#[derive(Debug)]
pub struct Rti {
    config: RtiConfig,
    now: PhysicalTime,
    phase: Phase,
    connections: Vec<Connection>,
    free: Vec<ConnectionId>,
    members: Vec<Member>,
    /// By federate, beside `members` so that grants can borrow it alone.
    standings: Vec<Standing>,
    topology: Topology,
    touched: Touched,
    stop: Stop,
    /// Whether a federate was lost, so that the exit code is 1.
    failed: bool,
    /// Whether one was lost that the others do not go on without, so that silence is bounded.
    lost: bool,
    /// Whether nobody needs grants, as far as it shows: no federate has told a neighbour, and some listen for peers.
    ungranted: bool,
    /// The last time a running federate said anything.
    last_word: PhysicalTime,
    /// The largest round trip measured while joining.
    round_trip: Duration,
    /// Outputs that changed since they were last polled.
    outputs: VecDeque<ConnectionId>,
    events: VecDeque<RtiEvent>,
    prober: Option<Prober>,
    /// Messages that a mutant writes after the grants.
    held: Vec<(FederateId, Vec<u8>)>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// Waiting for all federates to propose a start time.
    Joining,
    /// The start tag is agreed.
    Running { start: Tag },
    /// All federates are gone.
    Ended { code: u8 },
}

#[derive(Debug)]
struct Connection {
    link: Link,
    peer: String,
    local: Option<IpAddr>,
    nonce: Option<Nonce>,
    /// The federate whose certificate it has shown, where there are any.
    certified: Option<u16>,
    output: Output,
    /// Whether it stands in [`Rti::outputs`].
    queued: bool,
}

/// What a connection is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Link {
    /// The slot is unused.
    Free,
    /// Nobody yet; closed at the deadline.
    Unknown {
        deadline: PhysicalTime,
        hello: Hello,
    },
    /// This federate.
    Member(FederateId),
    /// To be closed: what it sends is thrown away; closed by us at the deadline. A stranger never was a federate: the
    /// end does not wait for it.
    Closing {
        deadline: PhysicalTime,
        stranger: bool,
    },
}

/// How far a newcomer's authentication is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Hello {
    /// It has said nothing.
    Silent,
    /// This federate, as it says, was sent RTI_RESPONSE.
    Challenged { federate: u16 },
    /// It has proved that it knows the federation id.
    Proven { federate: u16 },
}

/// One federate's connection and how far its join is.
#[derive(Debug)]
struct Member {
    stage: Stage,
    connection: Option<ConnectionId>,
    /// When it last said something while joining.
    last_word: PhysicalTime,
    /// CAPABILITIES, once it has sent them.
    capabilities: Option<u32>,
    /// Where it answers probes.
    probed_at: Option<SocketAddr>,
    neighbors: NeighborStructure,
    /// Whether its last message was ADDRESS_QUERY.
    queried: bool,
    /// The port at which it listens for peers, as it advertised.
    listener: Option<u16>,
    /// Where peers reach it, when it has said so.
    data_address: Option<Ipv4Addr>,
    /// Tags of messages on their way to it and not covered by its LTC: ascending, distinct.
    in_transit: VecDeque<Tag>,
    /// The last DNET sent to it.
    sent_dnet: Tag,
    /// As far as it follows that DNET: it lowers it itself when it sends a message with an earlier tag.
    known_dnet: Tag,
    /// Up to here its downstreams have handled what it sent, as it was last found.
    downstream_confirmed: Tag,
    /// The largest tag of a message from it.
    last_relayed: Tag,
}

/// How far a federate is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stage {
    /// It has not said that it is there.
    Absent,
    /// FED_IDS is accepted.
    Identified,
    /// NEIGHBOR_STRUCTURE is known.
    Structured,
    /// T1 was sent; `left` exchanges follow this one.
    Exchanging { sent: PhysicalTime, left: u32 },
    /// UDP_PORT, and all clock exchanges, are done.
    Synchronized { exchanged: bool },
    /// It has proposed a start time.
    Proposed { time: PhysicalTime, exchanged: bool },
    /// It has the start time.
    Running,
    /// It has resigned, or is lost.
    Gone,
}

impl Rti {
    /// An RTI that waits for its federates.
    #[must_use]
    pub fn new(config: RtiConfig) -> Self {
        let federates = usize::from(config.federates);
        Self {
            now: PhysicalTime::NEVER,
            phase: Phase::Joining,
            connections: Vec::new(),
            free: Vec::new(),
            members: std::iter::repeat_with(Member::new)
                .take(federates)
                .collect(),
            standings: vec![Standing::NEW; federates],
            topology: Topology::default(),
            touched: Touched::new(federates),
            stop: Stop::None,
            failed: false,
            lost: false,
            ungranted: false,
            last_word: PhysicalTime::NEVER,
            round_trip: Duration::ZERO,
            outputs: VecDeque::new(),
            events: VecDeque::new(),
            prober: config
                .clock_period
                .map(|period| Prober::new(config.federates, period)),
            held: Vec::new(),
            config,
        }
    }

    /// A peer has connected. It is refused at once when the federation has started.
    #[must_use]
    pub fn connect(&mut self, now: PhysicalTime, newcomer: impl Into<Newcomer>) -> ConnectionId {
        self.advance_to(now);
        let Newcomer { peer, local, nonce } = newcomer.into();
        let deadline = self.now + self.config.handshake_timeout;
        let hello = Hello::Silent;
        let connection = Connection {
            link: Link::Unknown { deadline, hello },
            peer,
            local,
            nonce,
            certified: None,
            output: Output::new(),
            queued: false,
        };
        let id = if let Some(id) = self.free.pop() {
            self.connections[id.0] = connection;
            id
        } else {
            self.connections.push(connection);
            ConnectionId(self.connections.len() - 1)
        };
        if self.phase != Phase::Joining {
            self.reject(
                id,
                RejectReason::FederationId,
                "the federation has started already",
            );
        }
        id
    }

    /// The peer has shown the certificate of this federate: it is taken for no other.
    pub fn certify(&mut self, id: ConnectionId, federate: u16) {
        self.connections[id.0].certified = Some(federate);
    }

    /// Takes the complete messages at the start of `bytes` and returns how many bytes they are; the driver keeps the rest
    /// and offers it again with what follows.
    ///
    /// Messages for other federates are copied to their outputs; the rest is recorded until [`Rti::drain`].
    #[must_use]
    pub fn receive(&mut self, now: PhysicalTime, id: ConnectionId, bytes: &[u8]) -> usize {
        self.advance_to(now);
        let mut at = 0;
        while at < bytes.len() {
            let rest = &bytes[at..];
            let consumed = match self.connections[id.0].link {
                Link::Free | Link::Closing { .. } => rest.len(),
                Link::Unknown { hello, .. } => self.receive_hello(id, hello, rest),
                Link::Member(federate) => match self.members[federate.index()].stage {
                    Stage::Running => self.receive_running(federate, rest),
                    Stage::Absent
                    | Stage::Identified
                    | Stage::Structured
                    | Stage::Exchanging { .. }
                    | Stage::Synchronized { .. }
                    | Stage::Proposed { .. }
                    | Stage::Gone => self.receive_joining(federate, rest),
                },
            };
            if consumed == 0 {
                break;
            }
            at += consumed;
        }
        at
    }

    /// The connection is gone, in both directions; its id may be reused from now on.
    pub fn disconnect(&mut self, now: PhysicalTime, id: ConnectionId, why: &Disconnect) {
        self.advance_to(now);
        let link = std::mem::replace(&mut self.connections[id.0].link, Link::Free);
        self.connections[id.0].output = Output::new();
        match link {
            Link::Free => return,
            Link::Unknown { .. } => {
                let peer = self.connections[id.0].peer.clone();
                let reason = match why {
                    Disconnect::Unfit(words) => words.clone(),
                    Disconnect::Eof
                    | Disconnect::Reset
                    | Disconnect::Cut
                    | Disconnect::Evicted
                    | Disconnect::Silent { .. }
                    | Disconnect::Error(_) => format!("{why} before it said who it is"),
                };
                self.events.push_back(RtiEvent::Rejected { peer, reason });
            }
            Link::Member(federate) => {
                self.members[federate.index()].connection = None;
                self.lose(federate, why.to_string());
            }
            Link::Closing { .. } => {}
        }
        self.free.push(id);
    }

    /// Acts on everything received since the last call: start, grants, DNETs, stop. Call it once per round.
    pub fn drain(&mut self, now: PhysicalTime) {
        self.advance_to(now);
        self.check_outputs();
        match self.phase {
            Phase::Joining => self.start_if_complete(),
            Phase::Running { .. } => {
                self.advance_stop();
                self.grant_touched();
                self.fail_unreachable();
                self.release_held();
                // A federate that cannot reach the stop tag was lost just now: others may go on.
                self.grant_touched();
            }
            Phase::Ended { .. } => {}
        }
        self.end_if_alone();
    }

    /// Whether newcomers need a nonce.
    #[must_use]
    pub const fn authenticates(&self) -> bool {
        self.config.authentication
    }

    /// The next connection whose output has changed; its chunks are to be written, its [`Closing`] obeyed.
    #[must_use]
    pub fn poll_output(&mut self) -> Option<ConnectionId> {
        let id = self.outputs.pop_front()?;
        self.connections[id.0].queued = false;
        Some(id)
    }

    /// What waits for a connection.
    #[must_use]
    pub fn output(&mut self, id: ConnectionId) -> &mut Output {
        &mut self.connections[id.0].output
    }

    /// The next event.
    #[must_use]
    pub fn poll_event(&mut self) -> Option<RtiEvent> {
        self.events.pop_front()
    }

    /// The exit code, once all federates and their connections are gone; then nothing is left to do.
    #[must_use]
    pub fn finished(&self) -> Option<u8> {
        match self.phase {
            Phase::Ended { code } if self.connections.iter().all(|c| c.link == Link::Free) => {
                Some(code)
            }
            Phase::Ended { .. } | Phase::Joining | Phase::Running { .. } => None,
        }
    }

    /// Takes a datagram that came at `arrived` or before.
    pub fn receive_probe(&mut self, from: SocketAddr, bytes: &[u8], arrived: PhysicalTime) {
        if let Some(prober) = &mut self.prober {
            prober.receive(from, bytes, arrived);
        }
    }

    /// The next datagram to send, at once; `now` is a reading of the clock just before.
    #[must_use]
    pub fn poll_probe(&mut self, now: PhysicalTime) -> Option<Transmit> {
        self.prober.as_mut()?.poll_transmit(now)
    }

    /// T1 to a federate left when the clock showed `when` or later.
    pub fn probe_left(&mut self, federate: FederateId, when: PhysicalTime) {
        if let Some(prober) = &mut self.prober {
            prober.left(federate, when);
        }
    }

    /// The prober, while clocks are compared continuously.
    #[must_use]
    pub const fn prober(&self) -> Option<&Prober> {
        self.prober.as_ref()
    }

    fn advance_to(&mut self, now: PhysicalTime) {
        self.now = self.now.max(now);
    }

    fn view(&self, lost: LostRule, start: Tag) -> View<'_> {
        View {
            topology: &self.topology,
            start,
            standings: &self.standings,
            lost,
            mutants: self.config.mutants,
        }
    }

    fn is_present(&self, federate: FederateId) -> bool {
        self.members[federate.index()].stage == Stage::Running
            && self.standings[federate.index()].presence == Presence::Present
    }

    fn federates(&self) -> impl Iterator<Item = FederateId> + use<> {
        (0..self.members.len()).map(FederateId::from_index)
    }

    fn has_capability(&self, federate: FederateId, bit: u32) -> bool {
        self.members[federate.index()]
            .capabilities
            .is_some_and(|bits| bits & bit != 0)
    }

    /// Writes to a federate, if it is connected.
    fn send(&mut self, federate: FederateId, message: &ToFederate<'_>) {
        if let Some(id) = self.members[federate.index()].connection {
            self.send_to(id, message);
        }
    }

    fn send_to(&mut self, id: ConnectionId, message: &ToFederate<'_>) {
        self.connections[id.0].output.send(message);
        self.queue_output(id);
    }

    #[inline]
    fn queue_output(&mut self, id: ConnectionId) {
        let connection = &mut self.connections[id.0];
        if !connection.queued {
            connection.queued = true;
            self.outputs.push_back(id);
        }
    }

    /// Lets what is pending go out, then closes; whatever the peer still sends is thrown away.
    fn close(&mut self, id: ConnectionId, closing: Closing) {
        let deadline = self.now + self.config.closing_timeout;
        let connection = &mut self.connections[id.0];
        let stranger = matches!(connection.link, Link::Unknown { .. });
        connection.link = Link::Closing { deadline, stranger };
        connection.output.close(closing);
        self.queue_output(id);
    }

    fn reject(&mut self, id: ConnectionId, reason: RejectReason, words: &str) {
        self.send_to(id, &ToFederate::Reject(reason));
        self.close(id, Closing::AfterFlush);
        let peer = self.connections[id.0].peer.clone();
        self.events.push_back(RtiEvent::Rejected {
            peer,
            reason: words.to_owned(),
        });
    }
}

impl Member {
    const fn new() -> Self {
        Self {
            stage: Stage::Absent,
            connection: None,
            last_word: PhysicalTime::NEVER,
            capabilities: None,
            probed_at: None,
            neighbors: NeighborStructure {
                upstream: Vec::new(),
                downstream: Vec::new(),
            },
            queried: false,
            listener: None,
            data_address: None,
            in_transit: VecDeque::new(),
            sent_dnet: Tag::NEVER,
            known_dnet: Tag::NEVER,
            downstream_confirmed: Tag::NEVER,
            last_relayed: Tag::NEVER,
        }
    }
}
