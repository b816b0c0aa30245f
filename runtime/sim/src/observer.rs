//! A separate observer of every byte between federates and the RTI. It knows the truth and trusts nobody.

use crate::coverage::{Coverage, Feature};
use ictus_coord::plan::{Coordination, Plan, Wire};
use ictus_coord::topology::{FederateId, Topology, connection_delay};
use ictus_coord::wire::{MAX_PAYLOAD, TaggedMessage, ToFederate, ToPeer, ToRti};
use ictus_core::{Delay, Tag};
use std::collections::BTreeMap;
use thiserror::Error;

/// A law that a run broke.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error("{checker}: {what}")]
pub struct Violation {
    /// Which checker saw it.
    pub checker: &'static str,
    /// What it saw.
    pub what: String,
}

/// Where a federate's timeline is.
#[derive(Clone, Copy, Debug)]
pub struct Position {
    /// The tag being executed, or the last completed one.
    pub at: Tag,
    /// Whether `at` is being executed.
    pub executing: bool,
    /// The earliest tag at which anything local may still happen.
    pub next: Tag,
    /// The stop tag.
    pub stop: Tag,
    /// Whether nothing will ever happen there again.
    pub over: bool,
}

impl Position {
    /// Of a federate that has not started.
    pub const NOWHERE: Self = Self {
        at: Tag::NEVER,
        executing: false,
        next: Tag::NEVER,
        stop: Tag::FOREVER,
        over: false,
    };
}

/// What the observer knows of one federate.
#[derive(Debug, Default)]
struct Seen {
    granted: Option<Tag>,
    provisional: Option<Tag>,
    /// The last NET it sent.
    announced: Option<Tag>,
    /// Messages to it that it has not read, by tag.
    unread: BTreeMap<Tag, u32>,
    /// Messages to it that the RTI has not passed on, by tag and sender.
    unrelayed: BTreeMap<(Tag, u16), u32>,
    /// The last tag per input.
    last_on_port: BTreeMap<u16, Tag>,
    asked_to_stop: bool,
    /// The last tag at which it may run ordinary reactions.
    promise: Option<Tag>,
    /// The tag it had reached when it learnt of a loss.
    entered_before_loss: Option<Tag>,
}

/// Watches a run.
#[derive(Debug)]
#[expect(
    clippy::struct_excessive_bools,
    reason = "facts that are independent of each other"
)]
pub struct Observer {
    topology: Topology,
    /// Per link: sender, receiver, receiver's port, delay.
    delays: BTreeMap<(u16, u16), Delay>,
    seen: Vec<Seen>,
    start: Option<Tag>,
    lost: bool,
    stop_requests: u32,
    stop_granted: bool,
    violation: Option<Violation>,
    /// Every message, in words, when asked for.
    pub log: Option<String>,
    /// True time in nanoseconds, for the log.
    pub now: i64,
    /// Whether clocks and offsets decide, not grants.
    decentralized: bool,
    /// Whether events come from outside.
    pub physical: bool,
    /// Whether federates and RTI use our extensions.
    pub extensions: bool,
    /// What has happened so far.
    pub coverage: Coverage,
}

impl Observer {
    /// An observer of a plan's federation.
    #[must_use]
    pub fn of_plan(plan: &Plan) -> Self {
        let topology = Topology::of_plan(plan);
        let connections = plan.connections.iter();
        let delays = connections
            .map(|c| ((c.to.federate, c.port_id), connection_delay(c)))
            .collect();
        Self {
            seen: std::iter::repeat_with(Seen::default)
                .take(topology.len())
                .collect(),
            topology,
            delays,
            start: None,
            lost: false,
            stop_requests: 0,
            stop_granted: false,
            violation: None,
            log: None,
            now: 0,
            decentralized: plan.coordination == Coordination::Decentralized,
            physical: false,
            extensions: true,
            coverage: Coverage::default(),
        }
    }

    /// The first violation.
    #[must_use]
    pub fn violation(&self) -> Option<&Violation> {
        self.violation.as_ref()
    }

    /// The start tag, once a federate has got it.
    #[must_use]
    pub fn start(&self) -> Option<Tag> {
        self.start
    }

    /// Whether tags are granted provisionally somewhere, which takes round trips per tag.
    #[must_use]
    pub fn has_zero_delay_cycle(&self) -> bool {
        let mut federates = self.topology.federates();
        federates.any(|f| self.topology.in_zero_delay_cycle(f))
    }

    /// The immediate upstreams of a federate.
    pub fn upstream(&self, federate: usize) -> impl Iterator<Item = usize> {
        let upstream = self.topology.upstream(FederateId::from_index(federate));
        upstream.iter().map(|(upstream, _)| upstream.index())
    }

    /// The last tag at which a federate may run ordinary reactions, if another was lost.
    #[must_use]
    pub fn promise(&self, federate: usize) -> Option<Tag> {
        self.seen[federate].promise
    }

    /// The tag that a federate had reached when it learnt of a loss.
    #[must_use]
    pub fn entered_before_loss(&self, federate: usize) -> Option<Tag> {
        self.seen[federate].entered_before_loss
    }

    /// Whether anybody was lost: promises to the dead are void.
    pub fn lose(&mut self) {
        self.lost = true;
    }

    /// Notes a broken law; the first one counts.
    pub fn blame(&mut self, checker: &'static str, what: String) {
        self.violation.get_or_insert(Violation { checker, what });
    }

    /// A federate has written these whole messages.
    pub fn federate_wrote(&mut self, from: usize, mut bytes: &[u8]) {
        while !bytes.is_empty() {
            match ToRti::decode(bytes) {
                Ok(Some((message, length))) => {
                    bytes = &bytes[length..];
                    self.note(from, "->", &message);
                    self.heard_from_federate(from, &message);
                }
                Ok(None) | Err(_) => {
                    let what = format!("federate {from} wrote what is no message");
                    self.blame("safety", what);
                    return;
                }
            }
        }
    }

    fn note(&mut self, federate: usize, direction: &str, message: &dyn std::fmt::Debug) {
        let (now, start) = (self.now, self.start);
        if let Some(log) = &mut self.log {
            let words = relative(&format!("{message:?}"), start);
            log.push_str(&format!("{now:>12} {federate} {direction} {words}\n"));
        }
    }

    fn heard_from_federate(&mut self, from: usize, message: &ToRti<'_>) {
        match message {
            ToRti::TaggedMessage(message) => self.message_sent(from, message),
            ToRti::PortAbsent(_) => self.coverage.hit(Feature::Absent),
            ToRti::NextEventTag(tag) => {
                let seen = &mut self.seen[from];
                seen.announced = Some(*tag);
                if seen.unread.keys().next().is_some_and(|first| first < tag) {
                    self.coverage.hit(Feature::InTransitLowersNext);
                }
            }
            ToRti::StopRequest(_) => {
                self.seen[from].asked_to_stop = true;
                self.stop_requests += 1;
                if self.stop_requests == 2 && !self.stop_granted {
                    self.coverage.hit(Feature::StopRace);
                }
            }
            ToRti::Timestamp(_)
            | ToRti::FederateIds { .. }
            | ToRti::LatestTagConfirmed(_)
            | ToRti::StopRequestReply(_)
            | ToRti::Resign
            | ToRti::Failed
            | ToRti::NeighborStructure(_)
            | ToRti::UdpPort(_)
            | ToRti::ClockSyncT3 { .. }
            | ToRti::AddressQuery { .. }
            | ToRti::AddressAdvertisement { .. }
            | ToRti::FederateNonce { .. }
            | ToRti::FederateResponse { .. }
            | ToRti::Capabilities(_)
            | ToRti::DataAddress { .. }
            | ToRti::Reject(_) => {}
        }
    }

    fn message_sent(&mut self, from: usize, message: &TaggedMessage<'_>) {
        let key = (message.federate, message.port);
        match self.delays.get(&key) {
            Some(Delay::Microstep) => self.coverage.hit(Feature::MicrostepDelay),
            Some(Delay::Time(_)) => self.coverage.hit(Feature::TimeDelay),
            Some(Delay::None) => {}
            None => {
                let what = format!("federate {from} wrote to a port that does not exist");
                self.blame("safety", what);
                return;
            }
        }
        let to = &mut self.seen[usize::from(message.federate)];
        *to.unread.entry(message.tag).or_default() += 1;
        let id = u16::try_from(from).unwrap_or(u16::MAX);
        *to.unrelayed.entry((message.tag, id)).or_default() += 1;
        if to.last_on_port.insert(message.port, message.tag) == Some(message.tag) {
            self.coverage.hit(Feature::Collision);
        }
    }

    /// A federate has written these whole messages to another one.
    pub fn peer_wrote(&mut self, from: usize, to: usize, mut bytes: &[u8]) {
        while !bytes.is_empty() {
            let Ok(Some((message, length))) = ToPeer::decode(bytes, Wire::V0_12, MAX_PAYLOAD)
            else {
                let what = format!("federate {from} wrote to {to} what is no message");
                self.blame("safety", what);
                return;
            };
            bytes = &bytes[length..];
            self.note(from, &format!("=> {to}"), &message);
            match message {
                ToPeer::TaggedMessage(message) => self.message_sent(from, &message),
                ToPeer::PortAbsent(_) => self.coverage.hit(Feature::Absent),
                ToPeer::Hello { .. } | ToPeer::Message(_) => {}
            }
        }
    }

    /// The RTI has written these whole messages; `truth` is where every federate is.
    pub fn rti_wrote(&mut self, to: usize, mut bytes: &[u8], truth: &[Position]) {
        while !bytes.is_empty() {
            match ToFederate::decode(bytes) {
                Ok(Some((message, length))) => {
                    bytes = &bytes[length..];
                    self.note(to, "<-", &message);
                    self.heard_from_rti(to, &message, truth);
                }
                Ok(None) | Err(_) => {
                    self.blame("safety", "the RTI wrote what is no message".to_owned());
                    return;
                }
            }
        }
    }

    fn heard_from_rti(&mut self, to: usize, message: &ToFederate<'_>, truth: &[Position]) {
        match message {
            ToFederate::TaggedMessage(message) => {
                let seen = &mut self.seen[to];
                // Senders of one tag are interchangeable here: what counts is that none is left.
                let key = seen
                    .unrelayed
                    .keys()
                    .find(|key| key.0 == message.tag)
                    .copied();
                match key {
                    Some(key) => decrement(&mut seen.unrelayed, key),
                    None => self.blame("safety", format!("the RTI made up a message to {to}")),
                }
            }
            ToFederate::TagAdvanceGrant(tag) => self.full_grant(to, *tag, truth),
            ToFederate::ProvisionalTagAdvanceGrant(tag) => self.provisional_grant(to, *tag, truth),
            ToFederate::DownstreamNextEventTag(tag) => {
                self.coverage.hit(Feature::DownstreamNextEvent);
                self.needless_announcements(to, *tag, truth);
            }
            ToFederate::StopGranted(tag) => {
                self.stop_granted = true;
                if self.extensions {
                    let seen = &mut self.seen[to];
                    let before = tag.latest_earlier();
                    seen.granted = seen.granted.map(|g| g.min(before));
                    seen.provisional = seen.provisional.map(|g| g.min(before));
                }
            }
            ToFederate::FederateLost { promise, .. } => {
                if *promise != Tag::FOREVER {
                    self.coverage.hit(Feature::PromiseLimit);
                }
                let seen = &mut self.seen[to];
                seen.promise = Some(seen.promise.map_or(*promise, |p| p.min(*promise)));
            }
            ToFederate::Timestamp(start) => {
                self.start.get_or_insert(Tag::new(start.as_logical(), 0));
            }
            ToFederate::Ack
            | ToFederate::Reject(_)
            | ToFederate::PortAbsent(_)
            | ToFederate::StopRequest(_)
            | ToFederate::ClockSyncT1(_)
            | ToFederate::ClockSyncT4(_)
            | ToFederate::AddressQueryReply { .. }
            | ToFederate::RtiResponse { .. }
            | ToFederate::Failed
            | ToFederate::DownstreamConfirmed(_) => {}
        }
    }

    fn full_grant(&mut self, to: usize, tag: Tag, truth: &[Position]) {
        self.coverage.hit(Feature::FullGrant);
        let seen = &self.seen[to];
        if seen.granted.is_some_and(|g| tag <= g) || seen.provisional.is_some_and(|p| tag < p) {
            let what = format!(
                "TAG{tag} to {to} after TAG{:?}, PTAG{:?}",
                seen.granted, seen.provisional
            );
            self.blame("safety", what);
        }
        self.seen[to].granted = Some(tag);
        if self.lost {
            return;
        }
        let earliest = self.earliest_incoming(to, truth);
        let unrelayed = self.first_unrelayed(to);
        if tag >= earliest.min(unrelayed) && tag < truth[to].stop {
            let what = format!(
                "TAG{tag} to {to}, but a message may still come with {}",
                earliest.min(unrelayed)
            );
            self.blame("grant oracle", what);
        }
    }

    fn provisional_grant(&mut self, to: usize, tag: Tag, truth: &[Position]) {
        self.coverage.hit(Feature::ProvisionalGrant);
        let seen = &self.seen[to];
        if seen.granted.max(seen.provisional).is_some_and(|g| tag <= g) {
            let what = format!(
                "PTAG{tag} to {to} after TAG{:?}, PTAG{:?}",
                seen.granted, seen.provisional
            );
            self.blame("safety", what);
        }
        self.seen[to].provisional = Some(tag);
        if self.lost {
            return;
        }
        let outside = self.earliest_from_outside(to, truth);
        let earliest = self
            .earliest_incoming(to, truth)
            .min(self.first_unrelayed(to));
        if tag > earliest || tag >= outside {
            let what = format!(
                "PTAG{tag} to {to}, but a message may come with {earliest}, from outside its cycle with {outside}"
            );
            self.blame("grant oracle", what);
        }
    }

    /// A NET at `tag` must not be what anybody downstream waits for.
    fn needless_announcements(&mut self, to: usize, tag: Tag, truth: &[Position]) {
        // A physical event comes to be known to its federate first.
        if self.lost || self.physical || tag == Tag::NEVER {
            return;
        }
        let sinks = self.topology.sinks(FederateId::from_index(to));
        // The last microstep stands for "all of them": no path may overflow it.
        let tag = Tag::new(tag.time, tag.microstep.min(1 << 20));
        let waits = sinks.iter().find(|(sink, path)| {
            sink.index() != to && tag.plus_path(*path) > truth[sink.index()].next
        });
        if let Some((sink, _)) = waits {
            let what = format!(
                "DNET{tag} to {to}, but {sink} waits to reach {}",
                truth[sink.index()].next
            );
            self.blame("grant oracle", what);
        }
    }

    fn first_unrelayed(&self, to: usize) -> Tag {
        let first = self.seen[to].unrelayed.keys().next();
        first.map_or(Tag::FOREVER, |key| key.0)
    }

    /// By brute force over what is true: the earliest tag at which each federate may still do anything.
    ///
    /// A federate does something at its next event, or when a message comes, but never again at a completed tag.
    fn activities(&self, truth: &[Position]) -> Vec<Tag> {
        let start = self.start.unwrap_or(Tag::NEVER);
        let floor = |position: &Position| {
            let floor = if position.over {
                Tag::FOREVER
            } else if position.executing {
                position.at
            } else {
                position.at.successor()
            };
            floor.max(start)
        };
        let local = |(position, seen): (&Position, &Seen)| {
            let unread = seen.unread.keys().next().copied();
            let next = unread.map_or(position.next, |tag| position.next.min(tag));
            next.max(floor(position))
        };
        let mut activities: Vec<Tag> = truth.iter().zip(&self.seen).map(local).collect();
        for _ in 0..truth.len() {
            for federate in self.topology.federates() {
                let index = federate.index();
                let incoming = self.incoming(federate, &activities, |_| true);
                let activity = incoming.max(floor(&truth[index]));
                activities[index] = activities[index].min(activity);
            }
        }
        activities
    }

    /// The earliest tag of a message to `to` that is not written yet, from the upstreams that are `chosen`.
    fn incoming(
        &self,
        to: FederateId,
        activities: &[Tag],
        chosen: impl Fn(FederateId) -> bool,
    ) -> Tag {
        self.topology
            .upstream(to)
            .iter()
            .filter(|(upstream, _)| chosen(*upstream))
            .map(|(upstream, delay)| activities[upstream.index()].delayed(*delay))
            .min()
            .unwrap_or(Tag::FOREVER)
    }

    fn earliest_incoming(&self, to: usize, truth: &[Position]) -> Tag {
        self.incoming(FederateId::from_index(to), &self.activities(truth), |_| {
            true
        })
    }

    fn earliest_from_outside(&self, to: usize, truth: &[Position]) -> Tag {
        let me = FederateId::from_index(to);
        let outside = |upstream| !self.topology.share_zero_delay_cycle(upstream, me);
        self.incoming(me, &self.activities(truth), outside)
    }

    /// A federate, standing at `position`, has taken these whole messages.
    pub fn federate_read(&mut self, federate: usize, mut bytes: &[u8], position: Position) {
        while let Ok(Some((message, length))) = ToFederate::decode(bytes) {
            bytes = &bytes[length..];
            self.note(federate, "reads", &message);
            if matches!(message, ToFederate::FederateLost { .. }) {
                let entered = &mut self.seen[federate].entered_before_loss;
                entered.get_or_insert(position.at);
            }
            let ToFederate::TaggedMessage(message) = message else {
                continue;
            };
            decrement(&mut self.seen[federate].unread, message.tag);
            let current = position.executing && message.tag == position.at;
            if current {
                self.coverage.hit(Feature::IntoCurrentTag);
            }
            let over = message.tag <= position.at && !current;
            if over && !self.lost && position.at < position.stop {
                let what = format!(
                    "message with {} reached {federate}, which has completed {}",
                    message.tag, position.at
                );
                self.blame("safety", what);
            }
        }
    }

    /// A federate has got as far as `position`.
    pub fn federate_ran(&mut self, federate: usize, position: Position) {
        if self.log.is_some() {
            self.note(federate, "is at", &position);
        }
        if self.decentralized {
            return;
        }
        let upstream = self.topology.upstream(FederateId::from_index(federate));
        if upstream.is_empty() || self.start.is_none_or(|start| position.at < start) {
            return;
        }
        let seen = &self.seen[federate];
        let granted = seen.granted.max(seen.provisional).unwrap_or(Tag::NEVER);
        let shutdown_only = self.lost && position.at >= position.stop;
        // What needs no input runs once nothing can come before the tag; completing it takes the grant.
        let ahead = self.extensions
            && position.executing
            && position.at > granted
            && position.at.latest_earlier() <= granted;
        if ahead {
            self.coverage.hit(Feature::RunsAhead);
        }
        // What it waits for there may be lost: it ends the tag it is at as far as it can.
        let abandoned = seen.entered_before_loss == Some(position.at);
        if position.at > granted && !shutdown_only && !ahead && !abandoned {
            let what = format!(
                "federate {federate} ran {} but was granted {granted}",
                position.at
            );
            self.blame("safety", what);
        }
    }
}

fn decrement<K: Ord>(counts: &mut BTreeMap<K, u32>, key: K) {
    if let Some(count) = counts.get_mut(&key) {
        *count -= 1;
        if *count == 0 {
            counts.remove(&key);
        }
    }
}

/// Tags in words, made relative to the start tag.
fn relative(words: &str, start: Option<Tag>) -> String {
    let Some(start) = start else {
        return words.to_owned();
    };
    let mut out = String::new();
    let mut digits = String::new();
    for c in words.chars().chain([' ']) {
        if c.is_ascii_digit() {
            digits.push(c);
            continue;
        }
        match digits.parse::<i64>() {
            Ok(time) if digits.len() == 19 => {
                out.push_str(&(time - start.time.as_nanos()).to_string());
            }
            Ok(_) | Err(_) => out.push_str(&digits),
        }
        digits.clear();
        out.push(c);
    }
    out
}
