//! Connections from federate to federate, and the laws of decentralized coordination.
//!
//! *Exact*: a message is counted as an STP violation iff its input had been decided at its tag when it was ingested.
//! *In time*: a message that has come by its tag's time plus its connection's offset, by the receiver's clock, is never
//! counted. *Sufficient*: when launch lag, latency and clock error of every message are within the bounds of which the
//! offsets were solved, none is counted.

use super::World;
use crate::coverage::Feature;
use crate::executor::SimulatedExecutor;
use crate::network::{Arrival, Pipe};
use crate::observer::Position;
use crate::swarm::Ending;
use ictus_coord::federate::PeerStream;
use ictus_coord::plan::{Bounds, Coordination, Plan, Wire};
use ictus_coord::topology::connection_delay;
use ictus_coord::wire::{MAX_PAYLOAD, TaggedMessage, ToPeer};
use ictus_core::{Delay, Duration, InputId, PhysicalTime, Tag};
use std::collections::{BTreeMap, VecDeque};

/// One connection between two federates.
#[derive(Debug)]
pub(super) struct Road {
    sender: usize,
    receiver: usize,
    at_sender: PeerStream,
    at_receiver: PeerStream,
    forward: Pipe,
    back: Pipe,
    /// Bytes that have come to the receiver and are not taken yet.
    arrived: Vec<u8>,
    /// Which of them came when: how many bytes, in true time.
    pieces: VecDeque<(usize, i64)>,
    /// When the messages that are on their way were written, and their tags.
    written: VecDeque<(i64, Tag)>,
    answers: Vec<u8>,
    ended: bool,
    told: bool,
}

/// What is known of one connection of the plan.
#[derive(Clone, Copy, Debug)]
struct Lane {
    input: InputId,
    delay: Delay,
    offset: Duration,
    sender_offset: Duration,
    bounds: Option<Bounds>,
    absent_after: Duration,
    /// Up to which tag messages and absences have told the status.
    known: Tag,
    /// The largest tag of a message or absence.
    told: Tag,
    /// The last tag whose beginning, and whose end, were looked at.
    begun: Tag,
    ended: Tag,
}

/// What the laws need to know.
#[derive(Debug, Default)]
pub(super) struct Laws {
    /// Per receiver and port id.
    lanes: BTreeMap<(usize, u16), Lane>,
    pub(super) decentralized: bool,
    /// Whether every message so far was within the bounds.
    within_bounds: bool,
    /// Whether the offsets are solved from bounds.
    solved: bool,
    messages: u64,
    violations: u64,
    /// Up to here, tags excluded, nothing can differ from the program alone.
    pub(super) faithful: Option<Tag>,
    /// Tardy messages: receiver, port, the tag of their handling.
    tardy: Vec<(usize, u16, Tag)>,
}

impl Laws {
    pub(super) fn of_plan(plan: &Plan) -> Self {
        let mut next_input = vec![0; plan.federates.len()];
        let mut lanes = BTreeMap::new();
        for c in &plan.connections {
            if c.from.federate == c.to.federate {
                continue;
            }
            let receiver = usize::from(c.to.federate);
            let own = plan.federates[receiver].stp_offset_ns;
            let lane = Lane {
                input: InputId::new(next_input[receiver]),
                delay: connection_delay(c),
                offset: Duration::from_nanos(c.stp_offset_ns.unwrap_or(own).max(0)),
                sender_offset: Duration::from_nanos(
                    plan.federates[usize::from(c.from.federate)].stp_offset_ns,
                ),
                bounds: c.bounds,
                absent_after: Duration::from_nanos(c.absent_after_ns),
                known: Tag::NEVER,
                told: Tag::NEVER,
                begun: Tag::NEVER,
                ended: Tag::NEVER,
            };
            next_input[receiver] += 1;
            lanes.insert((receiver, c.port_id), lane);
        }
        Self {
            solved: plan.connections.iter().all(|c| c.bounds.is_some()),
            decentralized: plan.coordination == Coordination::Decentralized,
            within_bounds: true,
            lanes,
            ..Self::default()
        }
    }

    /// From `tag` on, what runs may differ from the program alone.
    pub(super) fn differs_from(&mut self, tag: Tag) {
        self.faithful = Some(self.faithful.map_or(tag, |earlier| earlier.min(tag)));
    }

    /// Whether no message may have been counted as a violation.
    pub(super) fn must_be_clean(&self) -> bool {
        self.solved && self.within_bounds && self.messages > 0
    }

    /// Looks at one message: when it was written and came, by true time and by both clocks.
    fn weigh(&mut self, receiver: usize, message: &TaggedMessage<'_>, trip: Trip) {
        let Some(lane) = self.lanes.get(&(receiver, message.port)) else {
            return;
        };
        self.messages += 1;
        let Some(bounds) = lane.bounds else { return };
        let origin = message
            .tag
            .time
            .as_physical()
            .saturating_add(-lane.delay.span());
        let lag = trip.written_there.since(origin) - lane.sender_offset;
        let latency = trip.arrived - trip.written;
        let clocks = trip.arrived_here.since(trip.arrived_there).as_nanos();
        self.within_bounds &= lag.as_nanos() <= bounds.launch_lag_ns
            && latency <= bounds.latency_ns
            && clocks <= bounds.clock_error_ns;
    }
}

/// When a message was written and came.
#[derive(Clone, Copy, Debug)]
struct Trip {
    written: i64,
    arrived: i64,
    /// The sender's clock when it was written.
    written_there: PhysicalTime,
    /// The sender's clock when it came.
    arrived_there: PhysicalTime,
    /// The receiver's clock when it came.
    arrived_here: PhysicalTime,
}

impl<E: SimulatedExecutor> World<E> {
    /// A federate wants to connect to another one.
    pub(super) fn meet(&mut self, sender: usize, receiver: u16) {
        let there = usize::from(receiver);
        let now = self.hosts[sender].clock.reading(self.now);
        if !self.hosts[there].is_alive() || self.rng.percent(10) {
            self.hosts[sender].federate.peer_unreachable(now, receiver);
            return;
        }
        let network = self.conditions.swarm.network;
        let salt = (sender * 64 + there) as u64;
        let (forward, back) = (self.rng.fork(salt), self.rng.fork(salt + 4_096));
        let mut road = Road {
            sender,
            receiver: there,
            at_sender: self.hosts[sender].federate.peer_connected(receiver),
            at_receiver: self.hosts[there].federate.peer_accepted(),
            forward: Pipe::new(forward, network),
            back: Pipe::new(back, network),
            arrived: Vec::new(),
            pieces: VecDeque::new(),
            written: VecDeque::new(),
            answers: Vec::new(),
            ended: false,
            told: false,
        };
        if network.partitions > 0 && self.rng.percent(30) {
            let from = self.now
                + self
                    .rng
                    .span(Duration::ZERO, Duration::from_millis(300))
                    .as_nanos();
            road.forward
                .partition(from, from + network.partition.as_nanos());
        }
        self.roads.push(road);
    }

    /// A federate takes what has come from others.
    pub(super) fn read_roads(&mut self, federate: usize) {
        for index in 0..self.roads.len() {
            if self.roads[index].receiver == federate {
                self.read_forward(index);
            } else if self.roads[index].sender == federate {
                self.read_back(index);
            }
        }
        if self.laws.decentralized {
            let host = &mut self.hosts[federate];
            let now = host.clock.reading(self.now);
            host.federate.looked(now);
        }
    }

    fn read_back(&mut self, index: usize) {
        let road = &mut self.roads[index];
        while let Some(arrival) = road.back.take(self.now) {
            if let Arrival::Bytes(bytes) = arrival {
                road.answers.extend_from_slice(&bytes);
            }
        }
        let host = &mut self.hosts[road.sender];
        let now = host.clock.reading(self.now);
        let (federate, executor) = (&mut host.federate, &mut host.executor);
        let used = federate.receive_from_peer(now, road.at_sender, &road.answers, executor);
        road.answers.drain(..used);
    }

    fn read_forward(&mut self, index: usize) {
        let road = &mut self.roads[index];
        while let Some(at) = road.forward.next_at().filter(|at| *at <= self.now) {
            match road.forward.take(self.now) {
                Some(Arrival::Bytes(bytes)) => {
                    road.arrived.extend_from_slice(&bytes);
                    road.pieces.push_back((bytes.len(), at));
                }
                Some(Arrival::Eof | Arrival::Reset) => road.ended = true,
                None => break,
            }
        }
        while self.take_one(index) {}
        let road = &mut self.roads[index];
        let host = &mut self.hosts[road.receiver];
        let started = host.federate.timeline().start_tag() != Tag::NEVER;
        if road.ended && !road.told && (started || road.arrived.is_empty()) {
            road.told = true;
            let now = host.clock.reading(self.now);
            let cut = !road.arrived.is_empty();
            host.federate.peer_closed(now, road.at_receiver, cut);
        }
    }

    /// Offers one whole message to its receiver; says whether it was taken.
    fn take_one(&mut self, index: usize) -> bool {
        let road = &mut self.roads[index];
        let Ok(Some((message, length))) = ToPeer::decode(&road.arrived, Wire::V0_12, MAX_PAYLOAD)
        else {
            return false;
        };
        let tagged = match message {
            ToPeer::TaggedMessage(message) => Some(message),
            ToPeer::Hello { .. } | ToPeer::Message(_) | ToPeer::PortAbsent(_) => None,
        };
        let (receiver, arrived) = (road.receiver, arrival_time(&road.pieces, length));
        let host = &mut self.hosts[receiver];
        let now = host.clock.reading(self.now);
        let decided = tagged.and_then(|message| {
            let lane = self.laws.lanes.get(&(receiver, message.port))?;
            host.has_decided(lane.input, message.tag)
        });
        let told = match message {
            ToPeer::TaggedMessage(message) => Some((message.port, message.tag)),
            ToPeer::PortAbsent(absent) => Some((absent.port, absent.tag)),
            ToPeer::Hello { .. } | ToPeer::Message(_) => None,
        };
        let before = host.federate.measures().stp_violations();
        let (federate, executor) = (&mut host.federate, &mut host.executor);
        let used =
            federate.receive_from_peer(now, road.at_receiver, &road.arrived[..length], executor);
        if used == 0 {
            return false;
        }
        let counted = host.federate.measures().stp_violations() > before;
        if let Some((port, tag)) = told
            && let Some(lane) = self.laws.lanes.get_mut(&(receiver, port))
        {
            lane.told = lane.told.max(tag);
            // After collisions a message decides a later microstep than its own.
            let known = host.federate.timeline().known(lane.input);
            let by_message = tagged.map_or(Tag::NEVER, |_| known);
            lane.known = lane.known.max(tag).max(by_message);
        }
        let actual = host.executor.last_tardy();
        if let Some(message) = tagged {
            let trip = Trip {
                written: road.written.pop_front().map_or(arrived, |w| w.0),
                arrived,
                written_there: PhysicalTime::NEVER,
                arrived_there: self.hosts[road.sender].clock.reading(arrived),
                arrived_here: self.hosts[receiver].clock.reading(arrived),
            };
            let there = &self.hosts[road.sender].clock;
            let trip = Trip {
                written_there: there.reading(trip.written),
                ..trip
            };
            let (port, tag) = (message.port, message.tag);
            self.laws.weigh(receiver, &message, trip);
            self.judge((receiver, port), tag, (decided, counted), trip);
            if counted && let Some(actual) = actual {
                self.laws.tardy.push((receiver, port, actual));
            }
        }
        let road = &mut self.roads[index];
        road.arrived.drain(..length);
        forget(&mut road.pieces, length);
        true
    }

    fn judge(
        &mut self,
        (receiver, port): (usize, u16),
        tag: Tag,
        (decided, counted): (Option<bool>, bool),
        trip: Trip,
    ) {
        let Some(lane) = self.laws.lanes.get(&(receiver, port)) else {
            return;
        };
        let by = tag.time.as_physical().saturating_add(lane.offset);
        let coverage = &mut self.observer.coverage;
        if counted {
            self.laws.violations += 1;
            self.laws.differs_from(tag);
            coverage.hit(Feature::StpViolation);
        }
        if let Some(decided) = decided
            && decided != counted
        {
            let what =
                format!("message with {tag} for {receiver}: decided {decided}, counted {counted}");
            self.observer.blame("stp exact", what);
        }
        if counted && trip.arrived_here <= by {
            let what = format!(
                "message with {tag} for {receiver} was there at {:?}, by {by:?}, and counted",
                trip.arrived_here
            );
            self.observer.blame("stp in time", what);
        }
    }

    /// A federate writes to others.
    pub(super) fn write_roads(&mut self, federate: usize) {
        let mut wakes = std::mem::take(&mut self.wakes);
        for index in 0..self.roads.len() {
            let road = &mut self.roads[index];
            if road.sender == federate {
                let host = &mut self.hosts[federate];
                let out = host.federate.peer_output(road.at_sender);
                let written = tags(out).into_iter().map(|tag| (self.now, tag));
                road.written.extend(written);
                self.observer.peer_wrote(federate, road.receiver, out);
                road.forward.write(self.now, out, &mut wakes);
                out.clear();
                if host.federate.peer_over(road.at_sender) {
                    road.forward.close(self.now, &mut wakes);
                }
                let receiver = road.receiver;
                for at in wakes.drain(..) {
                    self.at(at, super::Event::Wake(receiver));
                }
            } else if road.receiver == federate {
                let host = &mut self.hosts[federate];
                let out = host.federate.peer_output(road.at_receiver);
                road.back.write(self.now, out, &mut wakes);
                out.clear();
                let sender = road.sender;
                for at in wakes.drain(..) {
                    self.at(at, super::Event::Wake(sender));
                }
            }
        }
        self.wakes = wakes;
    }

    /// A federate's process died: what it had not sent, and part of what is on its way, is lost.
    pub(super) fn break_roads(&mut self, federate: usize, lose: bool) {
        let mut wakes = std::mem::take(&mut self.wakes);
        for index in 0..self.roads.len() {
            let road = &mut self.roads[index];
            if road.sender != federate {
                continue;
            }
            road.forward.break_off(self.now, lose, &mut wakes);
            let receiver = road.receiver;
            for at in wakes.drain(..) {
                self.at(at, super::Event::Wake(receiver));
            }
        }
        self.wakes = wakes;
    }

    /// A tag is begun when everything before it is known or was waited for, and ended when it is itself.
    pub(super) fn check_entry(&mut self, federate: usize, position: Position) {
        let host = &self.hosts[federate];
        let clock = host.clock.reading(self.now);
        let start = host.federate.timeline().start_tag();
        // Who has lost the RTI or a peer leaves the stop tag half done.
        let hurried = position.over && self.crashed.is_some();
        let started = start != Tag::NEVER && position.at >= start && !hurried;
        if !self.laws.decentralized || !started || host.federate.only_shutdown_left() {
            return;
        }
        let mut wrong = None;
        let (at, time) = (position.at, position.at.time.as_physical());
        for ((_, port), lane) in self
            .laws
            .lanes
            .range_mut((federate, 0)..=(federate, u16::MAX))
        {
            let begins = std::mem::replace(&mut lane.begun, at) != at;
            let by = time.saturating_add(lane.offset);
            if begins && lane.known < at.latest_earlier() && clock < by {
                wrong = Some(format!(
                    "{federate} began {at} at {clock:?}, port {port} until {by:?}"
                ));
            }
            let ends = !position.executing && std::mem::replace(&mut lane.ended, at) != at;
            // A tardy message decides its input where it is handled.
            let ends = ends && !self.laws.tardy.contains(&(federate, *port, at));
            let by = by.saturating_add(lane.absent_after);
            if ends && lane.known < at && clock < by {
                wrong = Some(format!(
                    "{federate} ended {at} at {clock:?}, port {port} until {by:?}"
                ));
            }
        }
        if let Some(what) = wrong {
            self.observer.blame("stp entry", what);
        }
    }

    /// A federate that waits does so for something that may still come before its next tag.
    pub(super) fn check_prompt(&mut self, federate: usize, position: Position) {
        let undisturbed = self.conditions.swarm.ending == Ending::Timeout;
        if !self.laws.decentralized || !undisturbed || position.executing || position.over {
            return;
        }
        let host = &self.hosts[federate];
        let clock = host.clock.reading(self.now);
        let next = position.next;
        if position.at == Tag::NEVER || next == Tag::FOREVER || clock < next.time.as_physical() {
            return;
        }
        let mut lanes = self.laws.lanes.range((federate, 0)..=(federate, u16::MAX));
        if lanes.all(|(_, lane)| lane.told >= next.latest_earlier()) {
            let what = format!("{federate} waits before {next} at {clock:?}, though all is known");
            self.observer.blame("stp prompt", what);
        }
    }

    /// What is on its way to anybody may never be handled, and everybody stops somewhere: from now on runs may differ.
    pub(super) fn end_of_faith(&mut self) {
        for host in &self.hosts {
            self.laws.differs_from(host.federate.timeline().at());
        }
        for index in 0..self.roads.len() {
            let road = &mut self.roads[index];
            let unsent = tags(self.hosts[road.sender].federate.peer_output(road.at_sender));
            let lost = road.written.iter().map(|w| w.1).chain(unsent).min();
            lost.into_iter().for_each(|tag| self.laws.differs_from(tag));
        }
    }

    /// The laws that can be told at the end only.
    pub(super) fn check_laws(&mut self) {
        if !self.laws.decentralized {
            return;
        }
        if self.laws.must_be_clean() {
            self.observer.coverage.hit(Feature::WithinBounds);
            if self.laws.violations > 0 {
                let what = format!("{} violations within all bounds", self.laws.violations);
                self.observer.blame("stp sufficient", what);
            }
        }
        let tardy = std::mem::take(&mut self.laws.tardy);
        // What is due after a loss may not run at all.
        let all_ran = self.crashed.is_none();
        for (receiver, port, actual) in tardy.into_iter().filter(|_| all_ran) {
            let Some(lane) = self.laws.lanes.get(&(receiver, port)) else {
                continue;
            };
            let host = &self.hosts[receiver];
            if host.handled_tardy(lane.input, actual) == Some(false) {
                let what =
                    format!("federate {receiver} did not handle a tardy message at {actual}");
                self.observer.blame("stp handled", what);
            }
        }
    }
}

/// When the last of `length` bytes came.
fn arrival_time(pieces: &VecDeque<(usize, i64)>, length: usize) -> i64 {
    let mut sum = 0;
    let end = pieces.iter().find(|(count, _)| {
        sum += count;
        sum >= length
    });
    end.map_or(0, |(_, at)| *at)
}

fn forget(pieces: &mut VecDeque<(usize, i64)>, mut length: usize) {
    while let Some((count, _)) = pieces.front_mut() {
        if *count > length {
            *count -= length;
            return;
        }
        length -= *count;
        pieces.pop_front();
    }
}

/// The tags of the messages in these bytes.
fn tags(mut bytes: &[u8]) -> Vec<Tag> {
    let mut tags = Vec::new();
    while let Ok(Some((message, length))) = ToPeer::decode(bytes, Wire::V0_12, MAX_PAYLOAD) {
        if let ToPeer::TaggedMessage(message) = message {
            tags.push(message.tag);
        }
        bytes = &bytes[length..];
    }
    tags
}
