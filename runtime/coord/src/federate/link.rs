//! The link to the RTI under centralized coordination: what is announced (NET, LTC), granted (TAG, PTAG) and sent.

use super::peers::Peers;
use crate::auth::Nonce;
use crate::measure::Measures;
use crate::mutants::{Mutant, Mutants};
use crate::plan::{ClockSync, ConnectionPlan, Coordination, OnFailure, Plan, Wire};
use crate::topology::{FederateId, Topology, connection_delay, zero_delay_cycle_inputs};
use crate::wire::{self, NeighborStructure, PortAbsent, ToPeer, ToRti};
use ictus_core::{
    Delay, Duration, InputId, LogicalTime, NodeId, OutputId, PhysicalTime, Program, Tag, Timeline,
};
use std::collections::{BTreeSet, VecDeque};
use std::sync::Arc;

/// How often a federate with physical actions renews its promise when it is not known what downstreams wait for.
const ADVANCE_INTERVAL: Duration = Duration::from_millis(10);

/// Promises that nobody is known to wait for are at least this far apart: in a zero-delay cycle each is answered.
const PROMISE_SPACING: Duration = Duration::from_millis(1);

/// What a federate knows of its place in the federation.
#[derive(Clone, Debug, Default)]
#[expect(
    clippy::struct_excessive_bools,
    reason = "switches that are independent of each other"
)]
pub struct LinkConfig {
    /// The federate's id.
    pub id: u16,
    /// The federation id, at most 255 bytes.
    pub federation: String,
    /// When set, federate and RTI prove to each other that they know the federation id before it joins; random bytes, never
    /// used before.
    pub authentication: Option<Nonce>,
    /// Immediate upstreams with the least delay from each.
    pub upstream: Vec<(u16, Delay)>,
    /// Immediate downstreams.
    pub downstream: Vec<u16>,
    /// Per network input, in the order of [`InputId`].
    pub inputs: Vec<InputLink>,
    /// Per network output, in the order of [`OutputId`].
    pub outputs: Vec<OutputLink>,
    /// Whether this federate is on a cycle of connections without delay.
    pub in_cycle: bool,
    /// Whether the clock is compared with the RTI's while joining, and with how many exchanges.
    pub clock_exchanges: Option<u32>,
    /// The UDP port at which probes are answered; 0: none are wanted.
    pub clock_port: u16,
    /// Whether the RTI is ours.
    pub extensions: bool,
    /// How far a federate without upstreams may run ahead of what its downstreams have confirmed.
    pub max_lead: Option<Duration>,
    /// Whether the program runs ahead of physical time.
    pub fast: bool,
    /// Whether time and STP offsets decide, and messages go from federate to federate.
    pub decentralized: bool,
    /// Where others reach this federate (IPv4), when it is not the address that the RTI sees.
    pub data_address: Option<[u8; 4]>,
    /// The layout of the messages that differ between LF's releases.
    pub wire: Wire,
    /// This federate's STP offset S: its launch lag is measured from there.
    pub stp_offset: Duration,
    /// The STP violation of this number makes the federate stop the federation.
    pub max_stp_violations: Option<u64>,
    /// The federates that a federate's loss concerns: those that it reaches over other federates.
    pub indirect_upstream: Vec<u16>,
    /// How much later than this federate the RTI may find out that a host is gone.
    pub found_later: Duration,
    /// Rules that are wrong; none but in tests.
    #[doc(hidden)]
    pub mutants: Mutants,
}

impl LinkConfig {
    /// The link of federate `id` of a plan; `inputs` and `outputs` are the indices into the plan's connections of its
    /// network inputs and outputs, in the order of their ids. The federation id is the caller's to set, and the nonce when
    /// the plan asks for authentication.
    ///
    /// # Panics
    ///
    /// When an index is not of the plan.
    #[must_use]
    pub fn from_plan(plan: &Plan, id: u16, inputs: &[usize], outputs: &[usize]) -> Self {
        let topology = Topology::of_plan(plan);
        let me = FederateId::new(id);
        let decentralized = plan.coordination == Coordination::Decentralized;
        let neighbors = if decentralized {
            NeighborStructure::default()
        } else {
            topology.neighbor_structure(me)
        };
        let in_cycle = zero_delay_cycle_inputs(plan, &topology, me);
        let input = |index: &usize| {
            let in_cycle = in_cycle.contains(index);
            InputLink::of_plan(plan, &plan.connections[*index], in_cycle)
        };
        let output = |index: &usize| OutputLink {
            federate: plan.connections[*index].to.federate,
            port_id: plan.connections[*index].port_id,
            delay: connection_delay(&plan.connections[*index]),
            physical: plan.connections[*index].physical,
            outlived: plan.federates[usize::from(plan.connections[*index].to.federate)].on_failure
                == OnFailure::Continue,
        };
        let direct = |f: &u16| topology.upstream(me).iter().any(|(u, _)| u.get() == *f);
        let over_others = |f: &u16| {
            let via = topology.upstream(me).iter().map(|(u, _)| *u);
            let reaches = |u: FederateId| topology.sources(u).iter().any(|(s, _)| s.get() == *f);
            via.into_iter()
                .any(|u| u.get() != *f && u != me && reaches(u))
        };
        let sources = topology.sources(me).iter().map(|(f, _)| f.get());
        let indirect_upstream = sources.filter(|f| !direct(f) || over_others(f)).collect();
        Self {
            id,
            federation: String::new(),
            authentication: None,
            upstream: neighbors.upstream,
            downstream: neighbors.downstream,
            inputs: inputs.iter().map(input).collect(),
            outputs: outputs.iter().map(output).collect(),
            in_cycle: topology.in_zero_delay_cycle(me),
            clock_exchanges: matches!(plan.clock.sync, ClockSync::Init | ClockSync::On)
                .then_some(plan.clock.trials),
            clock_port: 0,
            extensions: plan.extensions,
            max_lead: plan.max_lead_ns.map(Duration::from_nanos),
            fast: plan.fast,
            decentralized,
            data_address: None,
            wire: plan.wire,
            stp_offset: Duration::from_nanos(plan.federates[usize::from(id)].stp_offset_ns),
            max_stp_violations: plan.federates[usize::from(id)].max_stp_violations,
            indirect_upstream,
            found_later: Duration::ZERO,
            mutants: Mutants::NONE,
        }
    }
}

/// A network input on the wire.
#[derive(Clone, Copy, Debug)]
#[expect(
    clippy::struct_excessive_bools,
    reason = "switches that are independent of each other"
)]
pub struct InputLink {
    /// The sending federate.
    pub federate: u16,
    /// The port id that senders use.
    pub port_id: u16,
    /// Whether it comes without delay from a member of this federate's zero-delay cycle: a provisional grant leaves
    /// its status unknown.
    pub in_cycle: bool,
    /// Whether messages come without tag, straight from the sender.
    pub physical: bool,
    /// The connection's delay.
    pub delay: Delay,
    /// How long after a tag's time its status may stay unknown before it counts as absent; never negative.
    pub stp_offset: Duration,
    /// How much longer at a tag that was begun.
    pub absent_after: Duration,
    /// The sender's own STP offset.
    pub sender_offset: Duration,
    /// Whether the sender is ours, and says goodbye before it closes.
    pub says_goodbye: bool,
    /// Whether the others go on when the sender is lost.
    pub outlived: bool,
}

impl InputLink {
    fn of_plan(plan: &Plan, connection: &ConnectionPlan, in_cycle: bool) -> Self {
        let sender = &plan.federates[usize::from(connection.from.federate)];
        let receiver = &plan.federates[usize::from(connection.to.federate)];
        let offset = connection.stp_offset_ns.unwrap_or(receiver.stp_offset_ns);
        Self {
            federate: connection.from.federate,
            port_id: connection.port_id,
            in_cycle,
            physical: connection.physical,
            delay: connection_delay(connection),
            stp_offset: Duration::from_nanos(offset.max(0)),
            absent_after: Duration::from_nanos(connection.absent_after_ns.max(0)),
            sender_offset: Duration::from_nanos(sender.stp_offset_ns),
            says_goodbye: sender.class.is_some(),
            outlived: sender.on_failure == OnFailure::Continue,
        }
    }
}

/// A network output on the wire.
#[derive(Clone, Copy, Debug)]
pub struct OutputLink {
    /// The receiving federate.
    pub federate: u16,
    /// The receiver's port id.
    pub port_id: u16,
    /// The connection's delay.
    pub delay: Delay,
    /// Whether messages go without tag, straight to the receiver.
    pub physical: bool,
    /// Whether the others go on when the receiver is lost.
    pub outlived: bool,
}

/// Whether a tag may be entered as far as the RTI is concerned.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Permission {
    Enter,
    Wait(Option<PhysicalTime>),
}

#[derive(Debug)]
pub(super) struct Link {
    pub(super) config: LinkConfig,
    out: Vec<u8>,
    granted: Tag,
    /// Tags granted provisionally, ascending; others wait for what happens here at each of them, so each is executed, also
    /// when a later grant has come.
    provisional: VecDeque<Tag>,
    /// What the RTI takes for the next event here: the last NET, sent or pending, or the tag of a message since.
    announced: Tag,
    /// What downstreams count on: the largest NET, unless a message has lowered it.
    promised: Tag,
    /// The last NET that was found needless, until one is sent.
    skipped: Option<Tag>,
    skipped_count: u64,
    /// When the last promise was made.
    promised_at: PhysicalTime,
    not_needed_through: Option<Tag>,
    pending_announcement: Option<Tag>,
    pending_confirmation: Option<Tag>,
    last_confirmed: Tag,
    /// Per sender node: the tag at which its output was last sent or said to be absent.
    told_at: Vec<Tag>,
    senders: Vec<(NodeId, OutputId)>,
    unconfirmed: VecDeque<Sent>,
    /// The last tag that had to wait for downstreams, and how many had to.
    held_back: Tag,
    held_back_count: u64,
    /// Nothing more may be sent: it was promised.
    silent: bool,
    /// An agreed stop tag that comes before what was promised.
    silent_at: Option<Tag>,
    /// Lost federates, with the tags up to which they had sent all they would.
    lost: Vec<(u16, Tag)>,
    pub(super) peers: Peers,
}

/// A run of messages that downstreams have not confirmed, by the tags they have there.
#[derive(Debug)]
struct Sent {
    first: Tag,
    last: Tag,
}

/// The connections with other federates: all under decentralized coordination, else the physical ones.
fn peers(config: &LinkConfig) -> Peers {
    let distinct = |peers: &mut Vec<u16>| {
        peers.sort_unstable();
        peers.dedup();
    };
    let direct = |physical: bool| physical || config.decentralized;
    let inputs = config.inputs.iter().filter(|i| direct(i.physical));
    let outputs = config.outputs.iter().filter(|o| direct(o.physical));
    let mut senders = inputs.map(|i| i.federate).collect();
    let mut receivers = outputs.map(|o| o.federate).collect();
    distinct(&mut senders);
    distinct(&mut receivers);
    let mut peers = Peers::new(config.id, config.wire, senders, receivers);
    peers.name_federation(&config.federation);
    peers
}

impl Link {
    pub(super) fn new(config: LinkConfig, program: &Arc<Program>) -> Self {
        let senders: Vec<_> = Timeline::new(Arc::clone(program)).senders().collect();
        let nodes = senders
            .iter()
            .map(|(node, _)| node.index() + 1)
            .max()
            .unwrap_or(0);
        Self {
            out: Vec::new(),
            granted: Tag::NEVER,
            provisional: VecDeque::new(),
            announced: Tag::NEVER,
            promised: Tag::NEVER,
            skipped: None,
            skipped_count: 0,
            promised_at: PhysicalTime::NEVER,
            not_needed_through: None,
            pending_announcement: None,
            pending_confirmation: None,
            last_confirmed: Tag::NEVER,
            told_at: vec![Tag::NEVER; nodes],
            senders,
            unconfirmed: VecDeque::new(),
            held_back: Tag::NEVER,
            held_back_count: 0,
            silent: false,
            silent_at: None,
            lost: Vec::new(),
            peers: peers(&config),
            config,
        }
    }

    pub(super) fn output(&mut self) -> &mut Vec<u8> {
        &mut self.out
    }

    pub(super) fn in_cycle(&self) -> bool {
        self.config.in_cycle
    }

    pub(super) fn skipped(&self) -> u64 {
        self.skipped_count
    }

    pub(super) fn held_back(&self) -> u64 {
        self.held_back_count
    }

    /// What was promised to downstreams: no event from outside may get an earlier tag.
    pub(super) fn announced(&self) -> Tag {
        if self.config.downstream.is_empty() {
            return Tag::NEVER;
        }
        self.promised
    }

    /// The first provisionally granted tag that is still to be executed, FOREVER when there is none.
    pub(super) fn provisional_tag(&self, at: Tag) -> Tag {
        let ahead = |tag: &&Tag| **tag > at;
        self.provisional
            .iter()
            .find(ahead)
            .map_or(Tag::FOREVER, |tag| *tag)
    }

    pub(super) fn neighbors(&self) -> NeighborStructure {
        NeighborStructure {
            upstream: self.config.upstream.clone(),
            downstream: self.config.downstream.clone(),
        }
    }

    pub(super) fn input(&self, port_id: u16) -> Option<InputId> {
        // Port ids are dense in practice: the id is the index.
        let guess = usize::from(port_id);
        let index = match self.config.inputs.get(guess) {
            Some(input) if input.port_id == port_id => guess,
            Some(_) | None => self
                .config
                .inputs
                .iter()
                .position(|i| i.port_id == port_id)?,
        };
        Some(InputId::new(index))
    }

    /// Whether `next` may be entered; announces it first, because others may wait for that.
    ///
    /// `promise` is the earliest time at which an event from outside may still happen (FOREVER: never): nothing later
    /// is announced. Source: section 5 of the wire document; the interval is replaced by the time a downstream waits
    /// for, when DNET says it.
    #[inline]
    pub(super) fn permit(
        &mut self,
        now: PhysicalTime,
        next: Tag,
        promise: PhysicalTime,
    ) -> Permission {
        if self.config.upstream.is_empty() && self.config.downstream.is_empty() {
            return Permission::Enter;
        }
        if !self.config.downstream.is_empty() && promise < next.time.as_physical() {
            return self.promise(now, next, promise);
        }
        self.announce(next);
        if !self.config.upstream.is_empty() && self.granted < self.enough(next) {
            return Permission::Wait(None);
        }
        if self.too_far_ahead(next) {
            self.held_back_count += u64::from(std::mem::replace(&mut self.held_back, next) != next);
            Permission::Wait(None)
        } else {
            Permission::Enter
        }
    }

    /// The grant that `next` needs to be begun. What has its inputs at it, because they are there or because it has none, runs
    /// as soon as nothing can come before it; the rest, and its end, wait for its own grant.
    fn enough(&self, next: Tag) -> Tag {
        if self.config.extensions && next != Tag::FOREVER {
            next.latest_earlier()
        } else {
            next
        }
    }

    /// Whether `at` is executed without having been granted.
    pub(super) fn is_ahead(&self, at: Tag) -> bool {
        self.config.extensions
            && !self.config.upstream.is_empty()
            && self.granted < at
            && !self.config.mutants.has(Mutant::AheadCompletes)
    }

    fn promise(&mut self, now: PhysicalTime, next: Tag, promise: PhysicalTime) -> Permission {
        let tag = Tag::new(promise.as_logical(), 0);
        let waited_for = self
            .not_needed_through
            .is_some_and(|through| (self.announced..tag).contains(&through));
        if waited_for || now >= self.promised_at.saturating_add(PROMISE_SPACING) {
            self.promised_at = now;
            self.announce(tag);
        }
        let delay = promise.since(now);
        let renew = match self.not_needed_through {
            Some(Tag::FOREVER) => None,
            Some(through) if through.time.as_physical() >= promise => Some(
                through
                    .time
                    .as_physical()
                    .saturating_add(Duration::NANOSECOND - delay),
            ),
            Some(_) | None => Some(self.promised_at.saturating_add(ADVANCE_INTERVAL)),
        };
        let due = (next.time != LogicalTime::FOREVER)
            .then(|| next.time.as_physical().saturating_add(-delay));
        Permission::Wait([renew, due].into_iter().flatten().min())
    }

    #[inline]
    fn announce(&mut self, next: Tag) {
        if next == self.announced {
            self.skipped = None;
            return;
        }
        if self.forgets_skipped() && self.skipped == Some(next) {
            return;
        }
        let needed = self.not_needed_through.is_none_or(|through| through < next)
            || (!self.config.upstream.is_empty() && self.granted < next);
        if needed {
            self.announced = next;
            self.promised = self.promised.max(next);
            self.pending_announcement = Some(next);
            self.skipped = None;
        } else if self.skipped != Some(next) {
            self.skipped = Some(next);
            self.skipped_count += 1;
        }
    }

    const fn forgets_skipped(&self) -> bool {
        self.config.mutants.has(Mutant::SkippedNextForgotten)
    }

    /// A message has come, or a stop was agreed: the RTI counts its tag as announced if it is earlier than what was, and
    /// nothing downstream was granted past it.
    #[inline]
    pub(super) fn message_arrived(&mut self, tag: Tag) {
        self.silent_at = self.silent_at.filter(|stop| tag > *stop);
        self.promised = self.promised.min(tag);
        self.lower_announced(tag);
    }

    #[inline]
    fn lower_announced(&mut self, tag: Tag) {
        self.skipped = self.skipped.filter(|skipped| *skipped <= tag);
        if tag < self.announced {
            self.announced = tag;
            self.pending_announcement = self.pending_announcement.map(|pending| pending.min(tag));
        }
    }

    /// Takes a DNET: announcements up to `through` are needless; one that was skipped after it is made good.
    pub(super) fn announcements_not_needed(&mut self, through: Tag) {
        self.not_needed_through = Some(through);
        if self.forgets_skipped() {
            return;
        }
        if let Some(skipped) = self.skipped
            && through < skipped
        {
            self.skipped = None;
            self.promised = self.promised.max(skipped);
            self.announced = skipped;
            self.pending_announcement = Some(skipped);
        }
    }

    /// Takes a TAG. A grant that goes back is ignored. Inputs are known up to it, but not past `limit`: there, a lost
    /// federate's silence says nothing.
    pub(super) fn grant(&mut self, tag: Tag, limit: Tag, timeline: &mut Timeline) {
        if tag < self.granted {
            return;
        }
        self.granted = tag;
        self.forget_provisional(timeline.at());
        timeline.settle_all(tag.min(limit));
    }

    /// Takes back what was granted at `stop` and after, as our RTI does when a stop is agreed. LF's does not: there, what
    /// this federate writes at the stop tag stays here if it comes before what was announced.
    pub(super) fn revoke_from(&mut self, stop: Tag, timeline: &mut Timeline) {
        if self.config.decentralized {
            return;
        }
        if !self.config.extensions {
            self.silent_at = (self.announced > stop).then_some(stop);
            return;
        }
        let before = stop.latest_earlier();
        self.granted = self.granted.min(before);
        self.provisional.retain(|tag| *tag < stop);
        timeline.unsettle_after(before);
        self.settle_all_lost(timeline);
        self.message_arrived(stop);
    }

    fn forget_provisional(&mut self, at: Tag) {
        while self.provisional.front().is_some_and(|tag| *tag <= at) {
            self.provisional.pop_front();
        }
    }

    /// Takes a PTAG: `tag` may be entered, but what comes over the cycle is unknown at it.
    pub(super) fn grant_provisionally(&mut self, tag: Tag, limit: Tag, timeline: &mut Timeline) {
        if self.config.mutants.has(Mutant::ProvisionalAsFull) {
            self.grant(tag, limit, timeline);
            return;
        }
        if tag < self.granted {
            return;
        }
        self.granted = tag;
        for (index, input) in self.config.inputs.iter().enumerate() {
            let through = if input.in_cycle {
                tag.latest_earlier()
            } else {
                tag
            };
            timeline.settle(InputId::new(index), through.min(limit));
        }
        self.forget_provisional(timeline.at());
        if timeline.at() < tag {
            self.provisional.push_back(tag);
            if self.config.extensions {
                // Our RTI takes it for the next event here, without being told.
                self.lower_announced(tag);
            }
        } else if timeline.current() != Some(tag) {
            // It is over: what was not sent at it never will be.
            for index in 0..self.senders.len() {
                self.say_absent(self.senders[index].1, tag);
            }
            self.confirm(tag);
        }
    }

    /// Takes FEDERATE_LOST: what `federate` has not sent up to `promise` it never will.
    pub(super) fn settle_lost(&mut self, federate: u16, promise: Tag, timeline: &mut Timeline) {
        self.lost.push((federate, promise));
        self.settle_all_lost(timeline);
    }

    fn settle_all_lost(&self, timeline: &mut Timeline) {
        for (federate, promise) in &self.lost {
            for (index, input) in self.config.inputs.iter().enumerate() {
                if input.federate == *federate {
                    timeline.settle(InputId::new(index), *promise);
                }
            }
        }
    }

    /// Ends a tag: downstreams may count on it when a network input was handled or the cycle waits for it.
    #[inline]
    pub(super) fn completed(&mut self, tag: Tag, network_inputs_ran: bool) {
        if self.config.decentralized {
            return;
        }
        if network_inputs_ran || self.config.in_cycle {
            self.confirm(tag);
        }
    }

    /// What a wrong federate does: LTC when a tag is begun.
    pub(super) fn confirm_too_early(&mut self, tag: Tag) {
        if self.config.mutants.has(Mutant::ConfirmedBeforeMessages) {
            ToRti::LatestTagConfirmed(tag).encode(&mut self.out);
        }
    }

    fn confirm(&mut self, tag: Tag) {
        if tag > self.last_confirmed {
            self.last_confirmed = tag;
            self.pending_confirmation = Some(tag);
        }
    }

    /// Nothing measured yet, of all peers.
    pub(super) fn measures(&self) -> Measures {
        let upstreams: BTreeSet<u16> = self.config.inputs.iter().map(|i| i.federate).collect();
        let downstreams: BTreeSet<u16> = self.config.outputs.iter().map(|o| o.federate).collect();
        let list = |set: BTreeSet<u16>| set.into_iter().collect::<Vec<_>>();
        Measures::new(&list(upstreams), &list(downstreams))
    }

    /// Sends the value of `output` and says how many payload bytes that took; not after the stop tag, nor past the end of time.
    #[inline]
    pub(super) fn send(
        &mut self,
        node: NodeId,
        output: OutputId,
        timeline: &Timeline,
        payload: impl FnOnce(&mut Vec<u8>),
    ) -> Option<usize> {
        let mut bytes = 0;
        let payload = |out: &mut Vec<u8>| {
            let before = out.len();
            payload(out);
            bytes = out.len() - before;
        };
        let at = timeline.at();
        self.told_at[node.index()] = at;
        let link = self.config.outputs[output.index()];
        let tag = at.delayed(link.delay);
        if link.physical {
            let out = self.peers.to(link.federate)?;
            wire::encode_peer_message(link.port_id, link.federate, None, out, payload);
            return Some(bytes);
        }
        if self.silent || self.silent_at == Some(at) {
            if self.config.in_cycle {
                self.say_absent(output, at);
            }
            return None;
        }
        if tag > timeline.stop_tag() || tag == Tag::FOREVER {
            return None;
        }
        if self.config.decentralized {
            let out = self.peers.to(link.federate)?;
            wire::encode_peer_message(link.port_id, link.federate, Some(tag), out, payload);
            return Some(bytes);
        }
        wire::encode_tagged_message(link.port_id, link.federate, tag, &mut self.out, payload);
        if let Some(through) = &mut self.not_needed_through {
            *through = (*through).min(tag);
        }
        if self.flow_controlled() {
            let grain = self.grain();
            match self.unconfirmed.back_mut() {
                Some(run) if tag.time < run.first.time + grain => run.last = run.last.max(tag),
                Some(_) | None => self.unconfirmed.push_back(Sent {
                    first: tag,
                    last: tag,
                }),
            }
        }
        Some(bytes)
    }

    /// Unconfirmed tags closer than this are counted as one run.
    fn grain(&self) -> Duration {
        let lead = self.config.max_lead.map_or(i64::MAX, Duration::as_nanos);
        Duration::from_nanos(lead / 8)
    }

    fn flow_controlled(&self) -> bool {
        self.config.extensions
            && self.config.max_lead.is_some()
            && (self.config.upstream.is_empty() || self.config.fast)
    }

    #[inline]
    fn too_far_ahead(&self, next: Tag) -> bool {
        match (self.unconfirmed.front(), self.config.max_lead) {
            (Some(oldest), Some(lead)) => next.time > oldest.first.time + lead,
            (Some(_) | None, _) => false,
        }
    }

    /// Takes DOWNSTREAM_CONFIRMED: every message for a tag up to `through` was handled.
    pub(super) fn downstream_confirmed(&mut self, through: Tag) {
        while self
            .unconfirmed
            .front()
            .is_some_and(|run| run.last <= through)
        {
            self.unconfirmed.pop_front();
        }
    }

    /// PORT_ABSENT for every output that can no longer be set at the current tag.
    pub(super) fn send_absents(&mut self, timeline: &Timeline) {
        let Some(at) = timeline.current() else { return };
        for index in 0..self.senders.len() {
            let (node, output) = self.senders[index];
            if self.told_at[node.index()] != at && timeline.settled_without(node) {
                self.told_at[node.index()] = at;
                self.say_absent(output, at);
            }
        }
    }

    fn say_absent(&mut self, output: OutputId, at: Tag) {
        if self.config.mutants.has(Mutant::AbsentsDropped) {
            return;
        }
        let link = self.config.outputs[output.index()];
        if link.physical {
            return;
        }
        let absent = PortAbsent {
            port: link.port_id,
            federate: link.federate,
            tag: at.delayed_strict(link.delay),
        };
        if !self.config.decentralized {
            ToRti::PortAbsent(absent).encode(&mut self.out);
        } else if let Some(out) = self.peers.to(link.federate) {
            ToPeer::PortAbsent(absent).encode(self.config.wire, out);
        }
    }

    /// Tells the receivers that nothing will come any more, and ends the streams.
    fn say_goodbye(&mut self) {
        for link in &self.config.outputs {
            if self.config.decentralized
                && !link.physical
                && let Some(out) = self.peers.to(link.federate)
            {
                let absent = PortAbsent {
                    port: link.port_id,
                    federate: link.federate,
                    tag: Tag::FOREVER,
                };
                ToPeer::PortAbsent(absent).encode(self.config.wire, out);
            }
        }
        self.peers.leave();
    }

    /// From now on nothing is sent to other federates: they have been told that nothing will come.
    pub(super) fn fall_silent(&mut self) {
        self.silent = true;
    }

    /// Appends a message that nothing can supersede.
    pub(super) fn say(&mut self, message: &ToRti<'_>) {
        message.encode(&mut self.out);
    }

    /// Moves pending LTC and NET behind the messages they vouch for.
    pub(super) fn flush(&mut self) {
        if let Some(tag) = self.pending_confirmation.take() {
            ToRti::LatestTagConfirmed(tag).encode(&mut self.out);
        }
        if let Some(tag) = self.pending_announcement.take() {
            ToRti::NextEventTag(tag).encode(&mut self.out);
        }
    }

    /// The last words at the stop tag.
    pub(super) fn resign(&mut self) {
        self.say_goodbye();
        // Under decentralized coordination nobody asks for it.
        self.pending_announcement = (!self.config.decentralized).then_some(Tag::FOREVER);
        self.flush();
        ToRti::Resign.encode(&mut self.out);
    }

    /// The last word of a federate that cannot go on.
    pub(super) fn fail(&mut self) {
        self.peers.leave();
        self.pending_announcement = None;
        ToRti::Failed.encode(&mut self.out);
    }
}
