//! The simulated executor: synthetic reactions whose every decision follows from what they read.
//!
//! A value is 64 bits; its low byte is how many more reactions it may cause, so that cycles and collisions die out.

use crate::program::{Assembly, Body};
use crate::reference::OutsideEvent;
use crate::seed::mix;
use ictus_coord::{FederateExecutor, PayloadError};
use ictus_core::{
    ActionId, Duration, Effects, Executor, InputId, NodeId, NodeKind, OutputId, PhysicalTime,
    Scheduled, SlotId, Tag, ValueId,
};
use std::collections::BTreeSet;

/// What the simulated world asks of an executor beyond coordination.
pub trait SimulatedExecutor: FederateExecutor {
    /// Learns the start tag.
    fn started(&mut self, start: Tag);

    /// Learns what its host's clock reads.
    fn reads_clock(&mut self, _now: PhysicalTime) {}

    /// Whether a reaction has failed, so that the federate must.
    fn failed(&self) -> bool {
        false
    }

    /// Makes the value of an event from outside, and names the physical action; `None` when there is no such action.
    fn outside(&mut self, draw: u64) -> Option<(ActionId, ValueId)>;

    /// Learns the tag that the last event from outside got.
    fn stamped(&mut self, tag: Tag);

    /// Whether nothing has arrived at the current tag: a tag that is executed only because the RTI wants to know.
    fn quiet(&self) -> bool;

    /// The tag at which the last tardy message is handled.
    fn last_tardy(&self) -> Option<Tag> {
        None
    }

    /// Whether a reaction ran as tardy at `tag`.
    fn ran_tardy(&self, _tag: Tag) -> bool {
        true
    }

    /// Takes note of what `node` reads when it starts; when it runs, later, it must read the same.
    fn observe(&mut self, node: NodeId);
}

/// One record of the logical trace. Ordered by tag, then name.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub struct Record {
    /// Logical time since the start.
    pub time: Duration,
    /// The tag's microstep.
    pub microstep: u32,
    /// The reactor's number in the federation.
    pub reactor: u32,
    /// The reaction's position in its reactor.
    pub reaction: u32,
    /// What was set and scheduled, with values.
    pub effects: u64,
}

/// How many reactions one timer event may cause in a row.
const HOPS: u64 = 6;

/// Delays that synthetic reactions add when they schedule, in nanoseconds.
const DELAYS: [i64; 6] = [0, 0, 500_000, 1_000_000, 2_000_000, 5_000_000];

/// Executes synthetic reactions.
#[derive(Debug)]
pub struct SyntheticExecutor {
    assembly: Assembly,
    start: Tag,
    tag: Tag,
    states: Vec<u64>,
    slots: Vec<Option<u64>>,
    fired: Vec<Option<u64>>,
    touched: Vec<SlotId>,
    fired_now: Vec<ActionId>,
    values: Vec<u64>,
    free: Vec<usize>,
    observed: Vec<Option<u64>>,
    trace: Vec<Record>,
    /// The tags at which reactions ran as tardy.
    tardy: BTreeSet<Tag>,
    last_tardy: Option<Tag>,
    /// The stop tag's records of shutdown reactions are told apart.
    unstable: Option<NodeId>,
    payload: usize,
    arrivals: u32,
    outside: u64,
    stamped: Vec<(usize, u64, Tag)>,
    pending_stamp: Option<(usize, u64)>,
}

impl SyntheticExecutor {
    /// An executor of one program; messages are padded to `payload` bytes.
    #[must_use]
    pub fn new(assembly: Assembly, payload: usize) -> Self {
        let nodes = assembly.program.node_count();
        Self {
            start: Tag::NEVER,
            tag: Tag::NEVER,
            states: vec![0; assembly.reactors],
            slots: vec![None; assembly.program.slot_count()],
            fired: vec![None; assembly.program.actions().len()],
            touched: Vec::new(),
            fired_now: Vec::new(),
            values: Vec::new(),
            free: Vec::new(),
            observed: vec![None; nodes],
            trace: Vec::new(),
            tardy: BTreeSet::new(),
            last_tardy: None,
            unstable: None,
            payload,
            arrivals: 0,
            outside: 0,
            stamped: Vec::new(),
            pending_stamp: None,
            assembly,
        }
    }

    /// The program and what belongs to it.
    #[must_use]
    pub fn assembly(&self) -> &Assembly {
        &self.assembly
    }

    /// The records so far, in order of execution.
    #[must_use]
    pub fn trace(&self) -> &[Record] {
        &self.trace
    }

    /// The events from outside with the tags they got, `start` being the first tag.
    pub fn outside_events(&self, federate: usize, start: Tag) -> Vec<OutsideEvent> {
        let event = |(action, value, tag): &(usize, u64, Tag)| OutsideEvent {
            federate,
            action: *action,
            tag: (tag.time - start.time, tag.microstep),
            value: *value,
        };
        self.stamped.iter().map(event).collect()
    }

    /// A reaction that read something else when it ran than when it started, if there was one.
    #[must_use]
    pub fn unstable(&self) -> Option<NodeId> {
        self.unstable
    }

    /// Holds a value and returns its handle.
    pub fn hold(&mut self, value: u64) -> ValueId {
        let index = self.free.pop().unwrap_or_else(|| {
            self.values.push(0);
            self.values.len() - 1
        });
        self.values[index] = value;
        ValueId::new(index)
    }

    fn take(&mut self, value: ValueId) -> u64 {
        if value == ValueId::NONE {
            return mix(7, 7) & !0xff | HOPS;
        }
        self.free.push(value.index());
        self.values[value.index()]
    }

    fn set(&mut self, slot: SlotId, value: u64) {
        if self.slots[slot.index()].replace(value).is_none() {
            self.touched.push(slot);
        }
    }

    /// What a reaction reads, as one number, and how far it may reach.
    fn read(&self, body: &Body) -> (u64, u64) {
        let fired = |a: &(ActionId, u64)| self.fired[a.0.index()].map(|value| (a.1, value));
        let present = |s: &(SlotId, u64)| self.slots[s.0.index()].map(|value| (s.1, value));
        let actions = body.actions.iter().filter_map(fired);
        let inputs = body.reads.iter().filter_map(present);
        let mut hash = 0;
        let mut hops = 0;
        for (salt, value) in actions.chain(inputs) {
            hash = mix(hash, mix(salt, value));
            hops = hops.max(value & 0xff);
        }
        (hash, hops)
    }

    fn react(&mut self, node: NodeId, effects: &mut Effects) {
        let body = &self.assembly.bodies[node.index()];
        let (read, hops) = self.read(body);
        let time = self.tag.time - self.start.time;
        let at = mix(
            time.as_nanos().cast_unsigned(),
            u64::from(self.tag.microstep),
        );
        let state = mix(
            self.states[body.state],
            mix(at, mix(read, u64::from(body.name.1))),
        );
        let mut digest = 0;
        let mut set = Vec::new();
        if hops > 0 {
            for (slot, salt) in &body.effects {
                let value = mix(state, *salt);
                if value >> 8 & 0xffff < body.eagerness * 65_536 / 100 {
                    let value = value & !0xff | (hops - 1);
                    digest = mix(digest, mix(*salt, value));
                    set.push((*slot, value));
                }
            }
        }
        let mut scheduled = Vec::new();
        if hops > 0 {
            for (action, salt) in &body.schedules {
                let value = mix(state, mix(*salt, 1));
                if value >> 8 & 0xff < 100 {
                    let delay = DELAYS[usize::from(value.to_le_bytes()[2]) % DELAYS.len()];
                    let value = value & !0xff | (hops - 1);
                    digest = mix(digest, mix(*salt, value));
                    scheduled.push((*action, Duration::from_nanos(delay), value));
                }
            }
        }
        effects.stop |= body.stops_after.is_some_and(|after| time >= after);
        self.trace.push(Record {
            time,
            microstep: self.tag.microstep,
            reactor: body.name.0,
            reaction: body.name.1,
            effects: digest,
        });
        let index = body.state;
        self.states[index] = state;
        for (slot, value) in set {
            self.set(slot, value);
            effects.set.push(slot);
        }
        for (action, delay, value) in scheduled {
            let value = self.hold(value);
            effects.scheduled.push(Scheduled {
                action,
                delay,
                value,
            });
        }
    }

    fn forward(&mut self, action: ActionId, effects: &mut Effects) {
        let slot = self.assembly.forwards[action.index()].expect("every forwarder has a source");
        if let Some(value) = self.slots[slot.index()] {
            let value = self.hold(value);
            effects.forward(&self.assembly.program, action, value);
        }
    }

    fn seen(&self, node: NodeId) -> u64 {
        match self.assembly.program.node(node) {
            NodeKind::Reaction => {
                let body = &self.assembly.bodies[node.index()];
                mix(self.read(body).0, self.states[body.state])
            }
            NodeKind::Forward { action } => {
                let slot = self.assembly.forwards[action.index()];
                slot.and_then(|s| self.slots[s.index()]).unwrap_or(1)
            }
            NodeKind::Send { output } => {
                let port = self.assembly.program.network_outputs()[output.index()];
                let slot = self.assembly.program.slot(port);
                self.slots[slot.index()].unwrap_or(1)
            }
        }
    }

    fn check_stable(&mut self, node: NodeId) {
        if let Some(before) = self.observed[node.index()].take()
            && before != self.seen(node)
        {
            self.unstable.get_or_insert(node);
        }
    }
}

impl Executor for SyntheticExecutor {
    fn begin(&mut self, tag: Tag) {
        self.tag = tag;
        self.arrivals = 0;
        for slot in self.touched.drain(..) {
            self.slots[slot.index()] = None;
        }
        for action in self.fired_now.drain(..) {
            self.fired[action.index()] = None;
        }
    }

    fn arrive(&mut self, action: ActionId, slot: Option<SlotId>, value: ValueId) {
        self.arrivals += 1;
        let value = self.take(value);
        match slot {
            Some(slot) => self.set(slot, value),
            None => {
                self.fired[action.index()] = Some(value);
                self.fired_now.push(action);
            }
        }
    }

    fn run_tardy(&mut self, node: NodeId, tag: Tag, _intended: Tag, effects: &mut Effects) {
        self.tardy.insert(tag);
        self.run(node, tag, effects);
    }

    fn run(&mut self, node: NodeId, _tag: Tag, effects: &mut Effects) {
        self.check_stable(node);
        match self.assembly.program.node(node) {
            NodeKind::Reaction => self.react(node, effects),
            NodeKind::Forward { action } => self.forward(action, effects),
            NodeKind::Send { .. } => {}
        }
    }
}

impl FederateExecutor for SyntheticExecutor {
    fn encode(&mut self, output: OutputId, out: &mut Vec<u8>) {
        let port = self.assembly.program.network_outputs()[output.index()];
        let slot = self.assembly.program.slot(port);
        let value = self.slots[slot.index()].unwrap_or(u64::MAX);
        out.extend_from_slice(&value.to_le_bytes());
        out.resize(out.len() + self.payload, 0);
    }

    fn decode(&mut self, input: InputId, payload: &[u8]) -> Result<ValueId, PayloadError> {
        let bytes = payload
            .first_chunk()
            .filter(|_| payload.len() == 8 + self.payload);
        let Some(bytes) = bytes else {
            let program = &self.assembly.program;
            return Err(PayloadError {
                input: program.port_path(program.network_inputs()[input.index()].port),
                type_name: "u64".to_owned(),
                length: payload.len(),
                reason: "wrong length".to_owned(),
            });
        };
        Ok(self.hold(u64::from_le_bytes(*bytes)))
    }

    fn note_tardy(&mut self, _input: InputId, _intended: Tag, actual: Tag) {
        self.last_tardy = Some(actual);
    }
}

impl SimulatedExecutor for SyntheticExecutor {
    fn started(&mut self, start: Tag) {
        self.start = start;
    }

    fn outside(&mut self, draw: u64) -> Option<(ActionId, ValueId)> {
        let count = self.assembly.physical.len();
        if count == 0 {
            return None;
        }
        let which = usize::try_from(draw % count as u64).unwrap_or(0);
        let action = self.assembly.physical[which].2;
        self.outside += 1;
        let value = mix(draw, self.outside) & !0xff | (HOPS - 1);
        self.pending_stamp = Some((self.assembly.physical[which].1, value));
        Some((action, self.hold(value)))
    }

    fn stamped(&mut self, tag: Tag) {
        if let Some((action, value)) = self.pending_stamp.take() {
            self.stamped.push((action, value, tag));
        }
    }

    fn quiet(&self) -> bool {
        self.arrivals == 0
    }

    fn last_tardy(&self) -> Option<Tag> {
        self.last_tardy
    }

    fn ran_tardy(&self, tag: Tag) -> bool {
        self.tardy.contains(&tag)
    }

    fn observe(&mut self, node: NodeId) {
        self.observed[node.index()] = Some(self.seen(node));
    }
}
