//! One host: a federate, its clock, its connection, driven as a real driver would.

use super::{Conditions, Ended, Event, Member, World};
use crate::clock::HostClock;
use crate::coverage::Feature;
use crate::executor::SimulatedExecutor;
use crate::network::{Arrival, Pipe};
use crate::observer::Position;
use crate::seed::Rng;
use crate::swarm::Ending;
use ictus_coord::federate::{Counters, Federate, FederateEvent, Poll};
use ictus_coord::wire::{ToRti, kind};
use ictus_core::{ActionId, ActionKind, Duration, InputId, NodeId, PhysicalTime, Tag};
use std::collections::BTreeMap;

/// One host with one federate.
#[derive(Debug)]
#[expect(
    clippy::struct_excessive_bools,
    reason = "traits that are independent of each other"
)]
pub(super) struct Host<E> {
    pub(super) federate: Federate,
    pub(super) executor: E,
    pub(super) clock: HostClock,
    /// To the RTI.
    pub(super) up: Pipe,
    /// From the RTI.
    pub(super) down: Pipe,
    rng: Rng,
    state: State,
    received: Vec<u8>,
    /// Bytes of the federate's output that the observer has seen.
    shown: usize,
    /// Polled without looking at what has come.
    unlooked: bool,
    wake_at: Option<i64>,
    busy_until: i64,
    /// Nodes in flight, in the order in which they started.
    in_flight: Vec<NodeId>,
    batches: usize,
    finished_writing: bool,
    /// Ends when nothing is left.
    starves: bool,
    /// Announces progress by LTC alone.
    legacy: bool,
    /// Resigns without a last NET.
    terse: bool,
    /// The last tag whose lateness was looked at.
    timed: Tag,
    /// When which tag was completed, for whoever hears of it by LTC alone.
    completed: Vec<(i64, Tag)>,
    /// The last tag that an event from outside got, per action.
    outside: BTreeMap<ActionId, Tag>,
}

#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum State {
    Waiting,
    Alive,
    Over,
    Dead,
}

impl<E: SimulatedExecutor> Host<E> {
    pub(super) fn new(member: Member<E>, conditions: &Conditions, mut rng: Rng) -> Self {
        let clocks = conditions.swarm.clocks;
        let offset = rng.span(-clocks.offset, clocks.offset);
        let ppm = Duration::from_nanos(clocks.drift);
        let drift = rng.span(-ppm, ppm).as_nanos();
        let network = conditions.swarm.network;
        let mut link = member.link;
        link.mutants = conditions.mutants;
        Self {
            federate: Federate::federated(member.program, conditions.config.clone(), link),
            executor: member.executor,
            clock: HostClock::new(offset, drift),
            up: Pipe::new(rng.fork(1), network),
            down: Pipe::new(rng.fork(2), network),
            state: State::Waiting,
            received: Vec::new(),
            shown: 0,
            unlooked: false,
            wake_at: None,
            busy_until: 0,
            in_flight: Vec::new(),
            batches: 0,
            finished_writing: false,
            starves: conditions.swarm.ending == Ending::Starvation,
            legacy: member.legacy,
            terse: rng.percent(15),
            timed: Tag::NEVER,
            completed: Vec::new(),
            outside: BTreeMap::new(),
            rng,
        }
    }

    pub(super) fn counters(&self) -> Counters {
        self.federate.counters()
    }

    pub(super) fn into_ended(self) -> Ended<E> {
        let timeline = self.federate.timeline();
        Ended {
            stop: timeline.stop_tag(),
            at: timeline.at(),
            tags: self.federate.counters().tags,
            outcome: (self.state == State::Over)
                .then(|| self.federate.into_outcome())
                .flatten(),
            executor: self.executor,
        }
    }

    pub(super) fn is_alive(&self) -> bool {
        self.state == State::Alive
    }

    /// Whether `input` has been decided at `tag`: it was present, absent, or the tag is over. `None` when nothing is
    /// admitted any more.
    pub(super) fn has_decided(&self, input: InputId, tag: Tag) -> Option<bool> {
        let timeline = self.federate.timeline();
        if self.federate.only_shutdown_left() || self.is_over() {
            return None;
        }
        let (at, executing) = (timeline.at(), timeline.current().is_some());
        let tag = timeline.due(input, tag);
        Some(at > tag || (at == tag && (!executing || timeline.known(input) >= tag)))
    }

    /// Whether the tardy message of `input` that was due at `tag` has run its reactions as tardy; `None` when that tag
    /// was not executed, or nothing reads the input.
    pub(super) fn handled_tardy(&self, input: InputId, tag: Tag) -> Option<bool> {
        let timeline = self.federate.timeline();
        let read = timeline.program().triggers_reaction(input);
        let executed =
            timeline.at() > tag || (timeline.at() == tag && timeline.current().is_none());
        let ordinary = tag < timeline.stop_tag();
        (read && executed && ordinary).then(|| self.executor.ran_tardy(tag))
    }

    pub(super) fn is_over(&self) -> bool {
        matches!(self.state, State::Over | State::Dead)
    }

    pub(super) fn position(&self) -> Position {
        let timeline = self.federate.timeline();
        if timeline.start_tag() == Tag::NEVER {
            return Position::NOWHERE;
        }
        let executing = timeline.current().is_some();
        // What is written at the end of a program that has nothing left stays in the federate.
        let starved = self.starves && timeline.at() >= timeline.stop_tag();
        let over = self.is_over() || timeline.finished() || starved;
        let next = if over {
            Tag::FOREVER
        } else if executing && !self.executor.quiet() {
            timeline.at()
        } else {
            timeline.next_tag()
        };
        Position {
            at: timeline.at(),
            executing,
            next,
            stop: timeline.stop_tag(),
            over,
        }
    }

    /// Whether an event got a later tag than any promise made so far can ask for.
    fn deferred_too_far(&self, action: ActionId, tag: Tag, last: Option<Tag>, now: i64) -> bool {
        let program = self.federate.timeline().program();
        let ActionKind::Physical { min_delay, spacing } = program.actions()[action.index()] else {
            return false;
        };
        let start = self.federate.timeline().start_tag().time;
        let by_now = self
            .clock
            .reading(now)
            .saturating_add(min_delay)
            .as_logical();
        let spaced = last.map_or(start, |tag| tag.time + spacing.min);
        tag.time > by_now.max(spaced).max(start)
    }

    /// When others could know from LTCs alone that nothing up to `tag` comes from here any more.
    fn confirmed_at(&self, tag: Tag) -> i64 {
        let later = |entry: &&(i64, Tag)| entry.1 >= tag;
        match self.completed.iter().find(later) {
            Some((at, _)) if self.legacy => *at,
            None if self.legacy => i64::MAX,
            Some(_) | None => i64::MIN,
        }
    }

    pub(super) fn woken(&mut self, now: i64) -> bool {
        if self.wake_at.is_some_and(|at| at <= now) {
            self.wake_at = None;
        }
        self.state == State::Alive
    }

    pub(super) fn wants_wake(&mut self, at: i64) -> bool {
        let sooner = self.wake_at.is_none_or(|planned| at < planned);
        if sooner {
            self.wake_at = Some(at);
        }
        sooner && self.state == State::Alive
    }

    pub(super) fn die(&mut self, now: i64, lose: bool, wakes: &mut Vec<i64>) {
        self.state = State::Dead;
        self.up.break_off(now, lose, wakes);
    }
}

impl<E: SimulatedExecutor> World<E> {
    pub(super) fn connect(&mut self, federate: usize) {
        if self.rti.is_dead() {
            self.hosts[federate].state = State::Dead;
            return;
        }
        let host = &mut self.hosts[federate];
        if host.state != State::Waiting {
            return;
        }
        host.state = State::Alive;
        if host.federate.expects_peers() {
            host.federate.listening(1);
        }
        host.federate.connect();
        self.rti.accept(self.now, federate);
        self.drive(federate);
    }

    /// Reads, polls, runs, writes, waits.
    pub(super) fn drive(&mut self, federate: usize) {
        if self.hosts[federate].state != State::Alive {
            return;
        }
        let busy = self.hosts[federate].busy_until;
        if busy > self.now {
            self.wake(federate, busy);
            return;
        }
        // A real driver polls several times between two looks at its sockets.
        let host = &mut self.hosts[federate];
        host.unlooked = self.laws.decentralized && !host.unlooked && host.rng.percent(25);
        if host.unlooked {
            self.wake(federate, self.now);
        } else {
            self.read(federate);
            self.read_roads(federate);
        }
        // A correction of the clock comes before the next reading.
        self.take_events(federate);
        self.poll(federate);
        self.show(federate);
        self.take_events(federate);
    }

    fn read(&mut self, federate: usize) {
        let host = &mut self.hosts[federate];
        let now = host.clock.reading(self.now);
        let mut gone = false;
        while let Some(arrival) = host.down.take(self.now) {
            match arrival {
                Arrival::Bytes(bytes) => host.received.extend_from_slice(&bytes),
                Arrival::Eof | Arrival::Reset => gone = true,
            }
        }
        if !host.received.is_empty() {
            let position = host.position();
            let used = host
                .federate
                .receive(now, &host.received, &mut host.executor);
            self.observer
                .federate_read(federate, &host.received[..used], position);
            if used < host.received.len() {
                self.observer.coverage.hit(Feature::SplitMessage);
            }
            host.received.drain(..used);
            let start = host.federate.timeline().start_tag();
            if start != Tag::NEVER {
                host.executor.started(start);
            }
        }
        if gone {
            host.federate.handle_disconnect();
        }
    }

    fn poll(&mut self, federate: usize) {
        loop {
            let host = &mut self.hosts[federate];
            let now = host.clock.reading(self.now);
            host.executor.reads_clock(now);
            match host.federate.poll(now, &mut host.executor) {
                Poll::Run => {
                    if !self.start_batch(federate) {
                        break;
                    }
                }
                Poll::Wait(until) => {
                    self.write(federate);
                    self.wait(federate, until);
                    let position = self.hosts[federate].position();
                    self.check_prompt(federate, position);
                    break;
                }
                Poll::Ended => {
                    self.write(federate);
                    self.write_roads(federate);
                    let host = &mut self.hosts[federate];
                    host.up.close(self.now, &mut self.wakes);
                    host.state = State::Over;
                    self.wake_rti_for_arrivals();
                    break;
                }
            }
        }
        let position = self.hosts[federate].position();
        self.observer.federate_ran(federate, position);
        self.check_entry(federate, position);
        if self.conditions.swarm.mode.calm && !self.observer.has_zero_delay_cycle() {
            self.check_lateness(federate, position);
        }
    }

    /// In a calm run a tag is begun when it is due, but for what messages need on their way.
    fn check_lateness(&mut self, federate: usize, position: Position) {
        let host = &mut self.hosts[federate];
        let start = host.federate.timeline().start_tag();
        if !position.executing {
            host.completed.push((self.now, position.at));
        }
        let known = std::mem::replace(&mut host.timed, position.at) == position.at;
        if known || start == Tag::NEVER || position.at < start {
            return;
        }
        let due = host
            .clock
            .when(position.at.time.as_physical())
            .unwrap_or(self.now);
        let upstream = self.observer.upstream(federate);
        let told = upstream.map(|u| self.hosts[u].confirmed_at(position.at));
        let due = told.max().unwrap_or(due).max(due);
        let late = self.now - due;
        let count = i64::try_from(self.hosts.len()).unwrap_or(i64::MAX);
        let bound = 6 * (count + 1) * self.conditions.swarm.network.delay_max.as_nanos() + 50_000;
        if late > bound {
            let what = format!(
                "federate {federate} began {} late by {late} ns",
                position.at
            );
            self.observer.blame("promptness", what);
        }
    }

    /// Starts what is ready; says whether to go on polling at once.
    fn start_batch(&mut self, federate: usize) -> bool {
        let mode = self.conditions.swarm.mode;
        let host = &mut self.hosts[federate];
        host.batches += 1;
        let batch = host.federate.batch().to_vec();
        for node in &batch {
            host.executor.observe(*node);
        }
        if mode.parallel {
            for node in batch {
                let host = &mut self.hosts[federate];
                host.in_flight.push(node);
                let takes = host.rng.span(Duration::ZERO, mode.reaction).as_nanos();
                self.at(self.now + takes, Event::Done(federate, node));
            }
            return true;
        }
        host.federate.run_batch(&mut host.executor);
        if host.executor.failed() {
            host.federate.fail();
        }
        let takes = host.rng.span(Duration::ZERO, mode.reaction).as_nanos();
        if takes > 0 {
            host.busy_until = self.now + takes;
            let until = host.busy_until;
            self.wake(federate, until);
            return false;
        }
        if host.batches.is_multiple_of(mode.slice) {
            self.write(federate);
            self.wake(federate, self.now + 1_000);
            return false;
        }
        true
    }

    /// A reaction in flight is done.
    pub(super) fn node_done(&mut self, federate: usize, node: NodeId) {
        let host = &mut self.hosts[federate];
        if host.state != State::Alive {
            return;
        }
        let place = host.in_flight.iter().position(|n| *n == node);
        match place {
            Some(0) => {}
            Some(_) => self.observer.coverage.hit(Feature::OutOfOrder),
            None => return,
        }
        host.in_flight.retain(|n| *n != node);
        let tag = host.federate.timeline().at();
        host.federate.run_node(node, tag, &mut host.executor);
        host.federate.finish(&[node], &mut host.executor);
        self.drive(federate);
    }

    fn write(&mut self, federate: usize) {
        self.hosts[federate].federate.flush();
        self.show(federate);
        let host = &mut self.hosts[federate];
        let timeline = host.federate.timeline();
        let done = (timeline.at() >= timeline.start_tag()).then(|| timeline.at());
        if let Some(output) = host.federate.output() {
            if host.legacy || host.terse {
                let rewritten = rewrite(output, host.legacy, done);
                host.up.write(self.now, &rewritten, &mut self.wakes);
            } else {
                host.up.write(self.now, output, &mut self.wakes);
            }
            output.clear();
            host.shown = 0;
        }
        if host.federate.resigned() && !host.finished_writing {
            host.finished_writing = true;
            host.up.close(self.now, &mut self.wakes);
        }
        self.wake_rti_for_arrivals();
        self.write_roads(federate);
    }

    fn wait(&mut self, federate: usize, until: Option<PhysicalTime>) {
        let host = &self.hosts[federate];
        if let Some(at) = until.and_then(|until| host.clock.when(until)) {
            self.wake(federate, at);
        }
    }

    /// Lets the observer see what the federate has written, flushed or not.
    fn show(&mut self, federate: usize) {
        let host = &mut self.hosts[federate];
        let shown = host.shown;
        if let Some(output) = host.federate.output() {
            host.shown = output.len();
            self.observer.federate_wrote(federate, &output[shown..]);
        }
    }

    fn take_events(&mut self, federate: usize) {
        while let Some(event) = self.hosts[federate].federate.poll_event() {
            match event {
                FederateEvent::ClockOffset(interval) => {
                    let base = self.hosts[federate].clock.reading(self.now);
                    let offset = interval.middle(base);
                    self.hosts[federate].clock.correct(offset);
                    if offset != Duration::ZERO {
                        self.observer.coverage.hit(Feature::ClockOffset);
                    }
                }
                FederateEvent::Started(start) => {
                    let clock = self.hosts[federate].clock;
                    let at = clock.when(start.time.as_physical()).unwrap_or(self.now);
                    self.plan_run(at.max(self.now));
                }
                FederateEvent::Connect { peer, .. } => self.meet(federate, peer),
                FederateEvent::PeerRefused(words) | FederateEvent::PeerLeft(words) => {
                    self.observer.blame("safety", words);
                }
                FederateEvent::Lag(_)
                | FederateEvent::StpViolation { .. }
                | FederateEvent::Joined
                | FederateEvent::Running
                | FederateEvent::StopRequested
                | FederateEvent::StopGranted(_)
                | FederateEvent::PeerLost(_) => {}
            }
        }
    }

    /// Something happens outside: a physical action, stamped by a thread that is a little ahead of the federate.
    pub(super) fn outside(&mut self, federate: usize) {
        let now = self.now;
        let host = &mut self.hosts[federate];
        if host.state != State::Alive || host.federate.resigned() {
            return;
        }
        let next = host
            .rng
            .span(Duration::from_micros(200), Duration::from_millis(15));
        let late = host.rng.span(Duration::ZERO, Duration::from_micros(400));
        let draw = host.rng.bits();
        let started = host.federate.timeline().start_tag() != Tag::NEVER;
        if started && let Some((action, value)) = host.executor.outside(draw) {
            let stamp = host.clock.reading(now - late.as_nanos());
            let tag = host.federate.schedule_physical(stamp, action, value);
            host.executor.stamped(tag);
            let last = host.outside.insert(action, tag);
            let late = host.deferred_too_far(action, tag, last, now);
            if late {
                let what =
                    format!("event from outside at {stamp:?} got {tag} in federate {federate}");
                self.observer.blame("promptness", what);
            }
            self.observer.coverage.hit(Feature::PhysicalAction);
            if tag.time > stamp.as_logical() && tag.microstep == 0 {
                self.observer.coverage.hit(Feature::PhysicalDeferred);
            }
            self.drive(federate);
        }
        self.at(now + next.as_nanos(), Event::Outside(federate));
    }

    pub(super) fn ask_stop(&mut self, federate: usize) {
        let host = &mut self.hosts[federate];
        if host.state == State::Alive {
            let now = host.clock.reading(self.now);
            host.federate.request_stop(now);
            self.observer.coverage.hit(Feature::StopFromOutside);
            self.drive(federate);
        }
    }
}

/// What other implementations write in place of what ours does: no NET before RESIGN, and, if `legacy`, LTCs in place of
/// NETs; `done` is the last tag completed.
fn rewrite(mut bytes: &[u8], legacy: bool, done: Option<Tag>) -> Vec<u8> {
    let mut rewritten = Vec::new();
    while let Ok(Some((message, length))) = ToRti::decode(bytes) {
        bytes = &bytes[length..];
        let ToRti::NextEventTag(next) = message else {
            message.encode(&mut rewritten);
            continue;
        };
        let resigns = next == Tag::FOREVER && bytes.first() == Some(&kind::RESIGN);
        if resigns {
            continue;
        }
        if !legacy || next == Tag::FOREVER {
            message.encode(&mut rewritten);
        } else if let Some(done) = done.filter(|done| *done < next) {
            ToRti::LatestTagConfirmed(done).encode(&mut rewritten);
        }
    }
    rewritten
}
