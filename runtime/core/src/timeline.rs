//! The timeline: which nodes may run at which tag. Deciding only; running is an [`Executor`](crate::Executor)'s.
//!
//! The caller's loop, at each tag:
//!
//! ```text
//! next_tag -> begin -> { ready -> run the batch -> finish }* until TagDone -> complete
//! ```
//!
//! `finish` may be called per node, in any order, while others are in flight; `admit`, `settle` and
//! `schedule_physical` at any time.

use crate::graph::BitSet;
use crate::id::{ActionId, InputId, NodeId, OutputId, SlotId, ValueId};
use crate::program::{ActionKind, NetworkInput, NodeKind, Program};
use crate::queue::EventQueue;
use crate::tag::{Delay, Tag};
use crate::time::{Duration, LogicalTime, PhysicalTime};
use std::sync::Arc;

/// What running nodes did.
#[derive(Debug, Default)]
pub struct Effects {
    /// Slots that were set, in order; a slot may stand here twice.
    pub set: Vec<SlotId>,
    /// Events to schedule from the current tag.
    pub scheduled: Vec<Scheduled>,
    /// Whether a reaction asked for the federation to stop.
    pub stop: bool,
}

/// An event scheduled by a reaction or by a forwarder.
#[derive(Clone, Copy, Debug)]
pub struct Scheduled {
    /// The logical action or delayed connection.
    pub action: ActionId,
    /// Added to the action's minimum delay; never negative; ignored for connections.
    pub delay: Duration,
    /// The value, held by the executor.
    pub value: ValueId,
}

/// What to do next at the current tag.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Progress {
    /// Run the nodes in the batch.
    Batch,
    /// Nodes are in flight; only their completion can change anything.
    InFlight,
    /// What is left waits for inputs whose status is unknown.
    Blocked,
    /// Nothing is left at this tag.
    TagDone,
}

/// What became of a message from another federate.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Admission {
    /// It waits for its tag.
    Queued {
        /// The tag at which it is due: its own, or a microstep later after a collision.
        tag: Tag,
    },
    /// It belongs to the tag being executed: hand its value to the executor now.
    IntoCurrentTag,
    /// Its tag is over; it waits for the next microstep after the current tag.
    Tardy {
        /// The tag it should have been handled at.
        intended: Tag,
        /// The tag at which it is due instead.
        actual: Tag,
    },
}

/// The execution state of one program.
#[derive(Debug)]
pub struct Timeline {
    program: Arc<Program>,
    queue: EventQueue,
    start: Tag,
    stop: Tag,
    /// The tag being executed, or the last one completed.
    at: Tag,
    executing: bool,
    ready: ReadyLists,
    in_flight: u32,
    /// Pending and in-flight nodes; kept only when the program has [`Relations`](crate::program::Relations).
    busy: BitSet,
    inputs: Vec<InputStatus>,
    unknown: BitSet,
    unknown_count: u32,
    latest: Vec<Tag>,
    network_inputs_ran: bool,
    overflow: bool,
}

#[derive(Debug)]
struct InputStatus {
    /// Status known up to and including this tag.
    known: Tag,
    /// The tag of the latest message queued or handled.
    last: Tag,
}

impl Timeline {
    /// A timeline that has not started: no event is queued.
    #[must_use]
    pub fn new(program: Arc<Program>) -> Self {
        let inputs = program.inputs.iter();
        let inputs = inputs
            .map(|_| InputStatus {
                known: Tag::NEVER,
                last: Tag::NEVER,
            })
            .collect();
        let nodes = program.nodes.len();
        Self {
            ready: ReadyLists::new(&program),
            busy: BitSet::new(if program.relations.is_some() {
                nodes
            } else {
                0
            }),
            unknown: BitSet::new(program.inputs.len()),
            latest: vec![Tag::NEVER; program.actions.len()],
            queue: EventQueue::default(),
            start: Tag::NEVER,
            stop: Tag::FOREVER,
            at: Tag::NEVER,
            executing: false,
            in_flight: 0,
            inputs,
            unknown_count: 0,
            network_inputs_ran: false,
            overflow: false,
            program,
        }
    }

    /// The program.
    #[must_use]
    pub fn program(&self) -> &Arc<Program> {
        &self.program
    }

    /// Queues startup and the first event of every timer.
    pub fn start(&mut self, start: Tag, stop: Tag) {
        self.start = start;
        self.stop = stop;
        self.at = start.latest_earlier();
        for (index, kind) in self.program.actions.iter().enumerate() {
            let action = ActionId::new(index);
            let tag = match kind {
                ActionKind::Startup => start,
                ActionKind::Timer { offset, .. } if *offset == Duration::ZERO => start,
                ActionKind::Timer { offset, .. } => start.delayed(Delay::Time(*offset)),
                ActionKind::Shutdown
                | ActionKind::Logical { .. }
                | ActionKind::Physical { .. }
                | ActionKind::Connection { .. }
                | ActionKind::Network { .. } => continue,
            };
            self.queue.push(tag, action, ValueId::NONE);
        }
    }

    /// The start tag; NEVER before [`Timeline::start`].
    #[must_use]
    pub fn start_tag(&self) -> Tag {
        self.start
    }

    /// The tag at which shutdown reactions run; FOREVER when none is known.
    #[must_use]
    pub fn stop_tag(&self) -> Tag {
        self.stop
    }

    /// Makes the stop tag earlier (a stop was agreed); never later, and never at or before a completed tag.
    pub fn stop_at(&mut self, stop: Tag) {
        let floor = self.at.successor();
        self.stop = self.stop.min(stop.max(floor));
    }

    /// The tag being executed, if one is.
    #[must_use]
    pub fn current(&self) -> Option<Tag> {
        self.executing.then_some(self.at)
    }

    /// The tag being executed or else the last completed one; before the first, the tag before the start tag.
    #[must_use]
    pub fn at(&self) -> Tag {
        self.at
    }

    /// Whether the stop tag is completed.
    #[must_use]
    pub fn finished(&self) -> bool {
        !self.executing && self.at >= self.stop
    }

    /// Whether tag arithmetic has overflowed: the federation must stop.
    #[must_use]
    pub fn overflowed(&self) -> bool {
        self.overflow
    }

    /// The earliest tag with something to do, bounded by the stop tag; FOREVER when there is none.
    #[inline]
    #[must_use]
    pub fn next_tag(&self) -> Tag {
        self.queue.next_tag().unwrap_or(Tag::FOREVER).min(self.stop)
    }

    /// The number of queued events.
    #[must_use]
    pub fn queued(&self) -> usize {
        self.queue.len()
    }

    /// Begins to execute `tag`; `present` receives the actions that fire, for the executor to fetch their values.
    ///
    /// Inputs not known at `tag` block what is downstream of them until they are settled.
    #[inline]
    pub fn begin(&mut self, tag: Tag, present: &mut Vec<(ActionId, ValueId)>) {
        debug_assert!(!self.executing && tag > self.at, "tags only grow");
        self.at = tag;
        self.executing = true;
        self.network_inputs_ran = false;
        let program = Arc::clone(&self.program);
        self.refresh_unknown(&program);
        while let Some((action, value)) = self.queue.pop_through(tag) {
            self.fire(&program, action);
            present.push((action, value));
        }
        if tag == self.stop {
            self.fire(&program, ActionId::SHUTDOWN);
            present.push((ActionId::SHUTDOWN, ValueId::NONE));
        }
    }

    /// Begins the stop tag with nothing but shutdown: events that are due before it are dropped.
    ///
    /// For a federate whose upstream was lost: an ordinary tag past the lost one's last promise could be wrong.
    pub fn begin_shutdown_only(&mut self, present: &mut Vec<(ActionId, ValueId)>) {
        self.queue = EventQueue::default();
        self.settle_all(Tag::FOREVER);
        self.begin(self.stop, present);
    }

    fn refresh_unknown(&mut self, program: &Program) {
        self.unknown_count = 0;
        if program.inputs.is_empty() {
            return;
        }
        self.unknown.clear();
        for (index, status) in self.inputs.iter().enumerate() {
            if status.known < self.at {
                self.unknown.insert(index);
                self.unknown_count += 1;
            }
        }
    }

    #[inline]
    fn fire(&mut self, program: &Program, action: ActionId) {
        match program.actions[action.index()] {
            ActionKind::Timer { period, .. } if period > Duration::ZERO => {
                let next = self.at.delayed(Delay::Time(period));
                if next.time != LogicalTime::FOREVER {
                    self.queue.push(next, action, ValueId::NONE);
                }
            }
            ActionKind::Network { input } => {
                self.network_inputs_ran = true;
                self.learn(input, self.at);
            }
            ActionKind::Timer { .. }
            | ActionKind::Startup
            | ActionKind::Shutdown
            | ActionKind::Logical { .. }
            | ActionKind::Physical { .. }
            | ActionKind::Connection { .. } => {}
        }
        self.trigger(&program.action_triggers[action.index()], program);
    }

    #[inline]
    fn trigger(&mut self, nodes: &[NodeId], program: &Program) {
        for node in nodes {
            if self.ready.insert(*node, program.levels[node.index()]) && program.relations.is_some()
            {
                self.busy.insert(node.index());
            }
        }
    }

    /// Moves every node that may run now into `batch` and counts it as in flight.
    ///
    /// A node may run when no node before it in the graph can still run at this tag, and every network input of its
    /// upstream cone is known. Without unknown inputs that is simply the lowest level.
    #[inline]
    pub fn ready(&mut self, batch: &mut Vec<NodeId>) -> Progress {
        let simple = self.in_flight == 0 && self.unknown_count == 0;
        if simple {
            self.ready.take_lowest(batch);
        } else if self.ready.is_empty() {
            return if self.in_flight > 0 {
                Progress::InFlight
            } else {
                self.rest()
            };
        } else {
            self.take_independent(batch);
        }
        if batch.is_empty() {
            return if self.in_flight > 0 {
                Progress::InFlight
            } else {
                self.rest()
            };
        }
        self.in_flight += u32::try_from(batch.len()).unwrap_or(u32::MAX);
        Progress::Batch
    }

    fn rest(&self) -> Progress {
        if self.ready.is_empty() && self.unknown_count == 0 {
            Progress::TagDone
        } else {
            Progress::Blocked
        }
    }

    fn take_independent(&mut self, batch: &mut Vec<NodeId>) {
        let program = &self.program;
        let Some(relations) = &program.relations else {
            return;
        };
        let (busy, unknown) = (&self.busy, &self.unknown);
        self.ready.take_if(batch, |node| {
            !relations.ancestors[node.index()].intersects(busy)
                && !relations.cone[node.index()].intersects(unknown)
        });
    }

    /// Whether nothing that could still set the network output `output` at the current tag is left, and it was not set.
    ///
    /// Law `absent_is_final`: once true at a tag, the output's sender does not run at that tag.
    #[must_use]
    pub fn settled_without(&self, sender: NodeId) -> bool {
        let Some(relations) = &self.program.relations else {
            return false;
        };
        !self.busy.contains(sender.index())
            && !relations.ancestors[sender.index()].intersects(&self.busy)
            && !relations.cone[sender.index()].intersects(&self.unknown)
    }

    /// Takes what `batch` did: triggers what its outputs trigger, queues what it scheduled. Drains `effects` but for
    /// `stop`, which the caller reads.
    #[inline]
    pub fn finish(&mut self, batch: &[NodeId], effects: &mut Effects) {
        self.in_flight -= u32::try_from(batch.len()).unwrap_or(u32::MAX);
        let program = Arc::clone(&self.program);
        if program.relations.is_some() {
            for node in batch {
                self.busy.remove(node.index());
            }
        }
        for slot in effects.set.drain(..) {
            self.trigger(&program.slot_triggers[slot.index()], &program);
        }
        for event in effects.scheduled.drain(..) {
            self.schedule(&program, event);
        }
    }

    #[inline]
    fn schedule(&mut self, program: &Program, event: Scheduled) {
        let delay = match program.actions[event.action.index()] {
            ActionKind::Logical { min_delay } => {
                Delay::after(min_delay.saturating_add(event.delay.max(Duration::ZERO)))
            }
            ActionKind::Connection { delay } => delay,
            ActionKind::Startup
            | ActionKind::Shutdown
            | ActionKind::Timer { .. }
            | ActionKind::Physical { .. }
            | ActionKind::Network { .. } => {
                debug_assert!(false, "reactions schedule logical actions only");
                return;
            }
        };
        self.enqueue(self.at.delayed(delay), event.action, event.value);
    }

    /// Queues an event; a second one of the same action at the same tag goes one microstep later.
    #[inline]
    fn enqueue(&mut self, tag: Tag, action: ActionId, value: ValueId) -> Tag {
        let latest = &mut self.latest[action.index()];
        let mut tag = tag;
        if tag > *latest {
            *latest = tag;
        } else {
            while self.queue.contains(tag, action) {
                let Some(next) = tag.next_microstep() else {
                    break;
                };
                tag = next;
            }
            *latest = tag.max(*latest);
        }
        self.overflow |= tag == Tag::FOREVER;
        self.queue.push(tag, action, value);
        tag
    }

    /// Queues an event from outside and returns its tag: the stamp plus the action's minimum delay, but after the
    /// current tag, not before `floor` (what was promised to others), and spaced from the action's last event.
    ///
    /// # Panics
    ///
    /// When `action` is not a physical action.
    pub fn schedule_physical(
        &mut self,
        stamp: PhysicalTime,
        action: ActionId,
        value: ValueId,
        floor: Tag,
    ) -> Tag {
        let ActionKind::Physical {
            min_delay,
            min_spacing,
        } = self.program.actions[action.index()]
        else {
            unreachable!("only physical actions are scheduled from outside")
        };
        let wanted = Tag::new(stamp.saturating_add(min_delay).as_logical(), 0);
        let after_current = self.at.successor();
        let last = self.latest[action.index()];
        let spaced = match min_spacing {
            Duration::ZERO => last.next_microstep().unwrap_or(Tag::NEVER),
            _ if last == Tag::NEVER => Tag::NEVER,
            _ => last.delayed(Delay::Time(min_spacing)),
        };
        let tag = wanted
            .max(after_current)
            .max(floor)
            .max(spaced)
            .max(self.start);
        self.enqueue(tag, action, value)
    }

    /// Takes a message from another federate for `input` with the tag it carries.
    ///
    /// Over a delayed connection the n-th message for one tag goes n-1 microsteps later, in the order of the connection.
    pub fn admit(&mut self, input: InputId, tag: Tag, value: ValueId) -> Admission {
        let NetworkInput {
            action, delayed, ..
        } = self.program.inputs[input.index()];
        let status = &mut self.inputs[input.index()];
        let mut due = tag;
        if delayed && due <= status.last {
            due = status.last.next_microstep().unwrap_or(Tag::FOREVER);
        }
        status.last = status.last.max(due);
        if due > self.at {
            return Admission::Queued {
                tag: self.enqueue(due, action, value),
            };
        }
        if self.executing && due == self.at && self.unknown.contains(input.index()) {
            let program = Arc::clone(&self.program);
            self.fire(&program, action);
            return Admission::IntoCurrentTag;
        }
        let next = self.at.successor();
        let actual = self.enqueue(next, action, value);
        Admission::Tardy {
            intended: tag,
            actual,
        }
    }

    /// Learns that the status of `input` is known up to and including `through`.
    pub fn settle(&mut self, input: InputId, through: Tag) {
        self.learn(input, through);
    }

    /// Learns that the status of every input is known up to and including `through`.
    pub fn settle_all(&mut self, through: Tag) {
        for status in &mut self.inputs {
            status.known = status.known.max(through);
        }
        if self.executing && through >= self.at {
            self.unknown.clear();
            self.unknown_count = 0;
        }
    }

    fn learn(&mut self, input: InputId, through: Tag) {
        let status = &mut self.inputs[input.index()];
        status.known = status.known.max(through);
        if self.executing && through >= self.at && self.unknown.contains(input.index()) {
            self.unknown.remove(input.index());
            self.unknown_count -= 1;
        }
    }

    /// Drops what is blocked at the current tag: the status it waits for will never come.
    pub fn abandon(&mut self) {
        self.ready.clear();
        self.busy.clear();
        self.unknown.clear();
        self.unknown_count = 0;
    }

    /// Ends the current tag and says whether a network input was present at it.
    #[inline]
    pub fn complete(&mut self) -> bool {
        debug_assert!(
            self.executing && self.in_flight == 0 && self.ready.is_empty(),
            "tag done"
        );
        self.executing = false;
        self.network_inputs_ran
    }

    /// The sender nodes, with their outputs.
    pub fn senders(&self) -> impl Iterator<Item = (NodeId, OutputId)> + '_ {
        self.program
            .nodes
            .iter()
            .enumerate()
            .filter_map(|(index, kind)| match kind {
                NodeKind::Send { output } => Some((NodeId::new(index), *output)),
                NodeKind::Reaction | NodeKind::Forward { .. } => None,
            })
    }
}

/// Triggered nodes by level.
#[derive(Debug)]
struct ReadyLists {
    levels: Vec<Vec<NodeId>>,
    lowest: usize,
    count: usize,
    marked: Vec<bool>,
}

impl ReadyLists {
    fn new(program: &Program) -> Self {
        let levels = program
            .levels
            .iter()
            .map(|l| *l as usize + 1)
            .max()
            .unwrap_or(0);
        Self {
            levels: vec![Vec::new(); levels],
            lowest: 0,
            count: 0,
            marked: vec![false; program.nodes.len()],
        }
    }

    fn is_empty(&self) -> bool {
        self.count == 0
    }

    fn clear(&mut self) {
        self.levels.iter_mut().for_each(Vec::clear);
        self.marked.fill(false);
        self.count = 0;
    }

    /// Adds a node once; says whether it was not there yet.
    #[inline]
    fn insert(&mut self, node: NodeId, level: u32) -> bool {
        if std::mem::replace(&mut self.marked[node.index()], true) {
            return false;
        }
        let level = level as usize;
        self.levels[level].push(node);
        self.lowest = if self.count == 0 {
            level
        } else {
            self.lowest.min(level)
        };
        self.count += 1;
        true
    }

    #[inline]
    fn take_lowest(&mut self, batch: &mut Vec<NodeId>) {
        if self.count == 0 {
            return;
        }
        while self.levels[self.lowest].is_empty() {
            self.lowest += 1;
        }
        let list = &mut self.levels[self.lowest];
        self.count -= list.len();
        for node in list.iter() {
            self.marked[node.index()] = false;
        }
        batch.append(list);
    }

    fn take_if(&mut self, batch: &mut Vec<NodeId>, free: impl Fn(NodeId) -> bool) {
        let (marked, count) = (&mut self.marked, &mut self.count);
        for list in &mut self.levels[self.lowest..] {
            list.retain(|node| {
                let take = free(*node);
                if take {
                    marked[node.index()] = false;
                    *count -= 1;
                    batch.push(*node);
                }
                !take
            });
        }
    }
}
