//! The timeline: which nodes may run at which tag. Deciding only; running is an [`Executor`](crate::Executor)'s.
//!
//! The caller's loop, at each tag:
//!
//! ```text
//! next_tag -> begin -> { ready -> run the batch -> finish }* until TagDone -> complete
//! ```
//!
//! `finish` may be called per node, in any order, while others are in flight; `admit`, `settle` and
//! `schedule_physical` at any time. What a node set over physical connections stays in [`Effects::physical`] after `finish`:
//! the caller drains it into `schedule_physical`.
//!
//! A message whose tag is over is *tardy*: it is due at the next free microstep after the current tag. The nodes that it
//! triggers there are tardy, and so are those that they trigger at that tag by setting slots: `finish` passes it on
//! from its whole batch, so while [`Timeline::any_tardy`] the caller runs and finishes node by node.

mod ready;
mod tardiness;

use crate::graph::BitSet;
use crate::id::{ActionId, InputId, NodeId, OutputId, SlotId, ValueId};
use crate::program::{ActionKind, NodeKind, Program, Spacing, SpacingPolicy};
use crate::queue::EventQueue;
use crate::tag::{Delay, Tag};
use crate::time::{Duration, LogicalTime, PhysicalTime};
use ready::ReadyLists;
use std::sync::Arc;
use tardiness::Tardiness;

/// What running nodes did.
#[derive(Debug, Default)]
pub struct Effects {
    /// Slots that were set, in order; a slot may stand here twice.
    pub set: Vec<SlotId>,
    /// Events to schedule from the current tag.
    pub scheduled: Vec<Scheduled>,
    /// Values that were set over physical connections: the caller's to schedule by physical time.
    pub physical: Vec<(ActionId, ValueId)>,
    /// Whether a reaction asked for the federation to stop.
    pub stop: bool,
}

impl Effects {
    /// Adds what a forwarder did: `value` goes over the connection of `action`, delayed or physical.
    #[inline]
    pub fn forward(&mut self, program: &Program, action: ActionId, value: ValueId) {
        match program.actions[action.index()] {
            ActionKind::PhysicalConnection { .. } => self.physical.push((action, value)),
            ActionKind::Connection { .. }
            | ActionKind::Startup
            | ActionKind::Shutdown
            | ActionKind::Timer { .. }
            | ActionKind::Logical { .. }
            | ActionKind::Physical { .. }
            | ActionKind::Network { .. } => self.scheduled.push(Scheduled {
                action,
                delay: Duration::ZERO,
                value,
            }),
        }
    }
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
    state: State,
}

/// Everything that changes, apart from the program, so that both can be borrowed at once.
#[derive(Debug)]
struct State {
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
    tardiness: Tardiness,
    /// Values whose events were dropped or replaced.
    released: Vec<(ActionId, ValueId)>,
    network_inputs_ran: bool,
    overflow: bool,
}

#[derive(Debug)]
struct InputStatus {
    /// Status known up to and including this tag.
    known: Tag,
    /// The tag of the latest message queued or handled.
    last: Tag,
    /// The tag at which the latest tardy message is handled.
    tardy: Tag,
}

impl Timeline {
    /// A timeline that has not started: no event is queued.
    #[must_use]
    pub fn new(program: Arc<Program>) -> Self {
        let inputs = program.inputs.iter();
        let inputs = inputs
            .map(|input| InputStatus {
                known: if input.physical {
                    Tag::FOREVER
                } else {
                    Tag::NEVER
                },
                last: Tag::NEVER,
                tardy: Tag::NEVER,
            })
            .collect();
        let nodes = program.nodes.len();
        let state = State {
            ready: ReadyLists::new(&program),
            busy: BitSet::new(if program.relations.is_some() {
                nodes
            } else {
                0
            }),
            unknown: BitSet::new(program.inputs.len()),
            latest: vec![Tag::NEVER; program.actions.len()],
            tardiness: Tardiness::new(nodes),
            released: Vec::new(),
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
        };
        Self { program, state }
    }

    /// The program.
    #[must_use]
    pub fn program(&self) -> &Arc<Program> {
        &self.program
    }

    /// Queues startup and the first event of every timer.
    pub fn start(&mut self, start: Tag, stop: Tag) {
        self.state.start = start;
        self.state.stop = stop;
        self.state.at = start.latest_earlier();
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
                | ActionKind::PhysicalConnection { .. }
                | ActionKind::Network { .. } => continue,
            };
            self.state.queue.push(tag, action, ValueId::NONE);
        }
    }

    /// The start tag; NEVER before [`Timeline::start`].
    #[must_use]
    pub fn start_tag(&self) -> Tag {
        self.state.start
    }

    /// The tag at which shutdown reactions run; FOREVER when none is known.
    #[must_use]
    pub fn stop_tag(&self) -> Tag {
        self.state.stop
    }

    /// Makes the stop tag earlier (a stop was agreed); never later, and never at or before a completed tag.
    pub fn stop_at(&mut self, stop: Tag) {
        let floor = self.state.at.successor();
        self.state.stop = self.state.stop.min(stop.max(floor));
    }

    /// The tag being executed, if one is.
    #[must_use]
    pub fn current(&self) -> Option<Tag> {
        self.state.executing.then_some(self.state.at)
    }

    /// The tag being executed or else the last completed one; before the first, the tag before the start tag.
    #[must_use]
    pub fn at(&self) -> Tag {
        self.state.at
    }

    /// Whether the stop tag is completed.
    #[must_use]
    pub fn finished(&self) -> bool {
        !self.state.executing && self.state.at >= self.state.stop
    }

    /// Whether tag arithmetic has overflowed: the federation must stop.
    #[must_use]
    pub fn overflowed(&self) -> bool {
        self.state.overflow
    }

    /// The earliest tag with something to do, bounded by the stop tag; FOREVER when there is none.
    #[inline]
    #[must_use]
    pub fn next_tag(&self) -> Tag {
        self.state
            .queue
            .next_tag()
            .unwrap_or(Tag::FOREVER)
            .min(self.state.stop)
    }

    /// The number of queued events.
    #[must_use]
    pub fn queued(&self) -> usize {
        self.state.queue.len()
    }

    /// Begins to execute `tag`; `present` receives the actions that fire, for the executor to fetch their values.
    ///
    /// Inputs not known at `tag` block what is downstream of them until they are settled.
    #[inline]
    pub fn begin(&mut self, tag: Tag, present: &mut Vec<(ActionId, ValueId)>) {
        debug_assert!(
            !self.state.executing && tag > self.state.at,
            "tags only grow"
        );
        self.state.at = tag;
        self.state.executing = true;
        self.state.network_inputs_ran = false;
        let Self { program, state } = self;
        state.refresh_unknown(program);
        while let Some((action, value)) = state.queue.pop_through(tag) {
            state.fire(program, action);
            present.push((action, value));
        }
        if tag == state.stop {
            state.fire(program, ActionId::SHUTDOWN);
            present.push((ActionId::SHUTDOWN, ValueId::NONE));
        }
        if state.tardiness.any_queued() {
            state.tardiness.fire(tag, program);
        }
    }

    /// Begins the stop tag with nothing but shutdown: events that are due before it are dropped.
    ///
    /// For a federate whose upstream was lost: an ordinary tag past the lost one's last promise could be wrong.
    pub fn begin_shutdown_only(&mut self, present: &mut Vec<(ActionId, ValueId)>) {
        self.state.queue = EventQueue::default();
        self.state.tardiness.drop_queued();
        self.settle_all(Tag::FOREVER);
        self.begin(self.state.stop, present);
    }

    /// Moves every node that may run now into `batch` and counts it as in flight.
    ///
    /// A node may run when no node before it in the graph can still run at this tag, and every network input of its
    /// upstream cone is known. Without unknown inputs that is simply the lowest level.
    #[inline]
    pub fn ready(&mut self, batch: &mut Vec<NodeId>) -> Progress {
        let simple = self.state.in_flight == 0 && self.state.unknown_count == 0;
        if simple {
            self.state.ready.take_lowest(batch);
        } else if self.state.ready.is_empty() {
            return if self.state.in_flight > 0 {
                Progress::InFlight
            } else {
                self.state.rest()
            };
        } else {
            self.take_independent(batch);
        }
        if batch.is_empty() {
            return if self.state.in_flight > 0 {
                Progress::InFlight
            } else {
                self.state.rest()
            };
        }
        self.state.in_flight += u32::try_from(batch.len()).unwrap_or(u32::MAX);
        Progress::Batch
    }

    fn take_independent(&mut self, batch: &mut Vec<NodeId>) {
        let program = &self.program;
        let Some(relations) = &program.relations else {
            return;
        };
        let (busy, unknown) = (&self.state.busy, &self.state.unknown);
        self.state.ready.take_if(batch, |node| {
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
        !self.state.busy.contains(sender.index())
            && !relations.ancestors[sender.index()].intersects(&self.state.busy)
            && !relations.cone[sender.index()].intersects(&self.state.unknown)
    }

    /// Takes what `batch` did: triggers what its outputs trigger, queues what it scheduled. Drains `effects` but for
    /// `stop`, which the caller reads, and `physical`, which the caller schedules by physical time.
    #[inline]
    pub fn finish(&mut self, batch: &[NodeId], effects: &mut Effects) {
        self.state.in_flight -= u32::try_from(batch.len()).unwrap_or(u32::MAX);
        let Self { program, state } = self;
        if program.relations.is_some() {
            for node in batch {
                state.busy.remove(node.index());
            }
        }
        if state.tardiness.any() {
            state.tardiness.pass_on(batch, &effects.set, program);
        }
        for slot in &effects.set {
            state.trigger(&program.slot_triggers[slot.index()], program);
        }
        effects.set.clear();
        for event in &effects.scheduled {
            state.schedule(program, *event);
        }
        effects.scheduled.clear();
    }

    /// Queues an event from outside and returns its tag: the stamp plus the action's minimum delay, but after the
    /// current tag, not before `floor` (what was promised to others), and spaced from the action's last event.
    ///
    /// When the policy of the spacing drops the event, or gives its value to the last one, the tag is that of the last one.
    ///
    /// # Panics
    ///
    /// When `action` is neither a physical action nor that of a physical connection.
    pub fn schedule_physical(
        &mut self,
        stamp: PhysicalTime,
        action: ActionId,
        value: ValueId,
        floor: Tag,
    ) -> Tag {
        let (min_delay, spacing) = match self.program.actions[action.index()] {
            ActionKind::Physical { min_delay, spacing } => (min_delay, spacing),
            ActionKind::PhysicalConnection { min_delay } => (min_delay, Spacing::NONE),
            ActionKind::Startup
            | ActionKind::Shutdown
            | ActionKind::Timer { .. }
            | ActionKind::Logical { .. }
            | ActionKind::Connection { .. }
            | ActionKind::Network { .. } => {
                unreachable!("only physical actions are scheduled from outside")
            }
        };
        let wanted = Tag::new(stamp.saturating_add(min_delay).as_logical(), 0);
        let after_current = self.state.at.successor();
        let last = self.state.latest[action.index()];
        let after_last = last.next_microstep().unwrap_or(Tag::NEVER);
        let tag = wanted.max(after_current).max(floor).max(self.state.start);
        if spacing.min > Duration::ZERO {
            self.state.enqueue_spaced(tag, spacing, action, value)
        } else {
            self.state.enqueue(tag.max(after_last), action, value)
        }
    }

    /// A value that no event will carry, because the policy of a spacing dropped or replaced it, with its action. The caller
    /// hands them to [`Executor::release`](crate::Executor::release), before it schedules many.
    #[inline]
    pub fn pop_released(&mut self) -> Option<(ActionId, ValueId)> {
        self.state.released.pop()
    }

    /// The tag at which a message for `input` with `tag` is due: its own, or a microstep after the last one's when they
    /// collide (over a delayed connection; over any other only a wrong peer sends two for one tag).
    #[inline]
    #[must_use]
    pub fn due(&self, input: InputId, tag: Tag) -> Tag {
        let last = self.state.inputs[input.index()].last;
        let delayed = self.program.inputs[input.index()].delayed;
        let twice = tag.time == last.time && tag > self.state.at;
        if tag <= last && (delayed || twice) {
            last.next_microstep().unwrap_or(Tag::FOREVER)
        } else {
            tag
        }
    }

    /// Takes a message from another federate for `input` with the tag it carries.
    ///
    /// Over a delayed connection the n-th message for one tag goes n-1 microsteps later, in the order of the connection.
    /// Tardy ones go to the next free microsteps after the current tag.
    pub fn admit(&mut self, input: InputId, tag: Tag, value: ValueId) -> Admission {
        let due = self.due(input, tag);
        let action = self.program.inputs[input.index()].action;
        let status = &mut self.state.inputs[input.index()];
        status.last = status.last.max(due);
        if due > self.state.at {
            return Admission::Queued {
                tag: self.state.enqueue(due, action, value),
            };
        }
        if self.state.executing
            && due == self.state.at
            && self.state.unknown.contains(input.index())
        {
            let Self { program, state } = self;
            state.fire(program, action);
            return Admission::IntoCurrentTag;
        }
        // After the last tardy one of this input, so that a burst of them need not look for a free microstep.
        let last = self.state.inputs[input.index()].tardy;
        let after_last = last.next_microstep().unwrap_or(Tag::NEVER);
        let next = self.state.at.successor().max(after_last);
        let actual = self.state.enqueue(next, action, value);
        self.state.inputs[input.index()].tardy = actual;
        self.state.tardiness.queue(actual, action, tag);
        Admission::Tardy {
            intended: tag,
            actual,
        }
    }

    /// Unlearns the status of all inputs after `through`: a stop was agreed, at which others may write what they had not
    /// announced. `through` is at or after the current tag.
    pub fn unsettle_after(&mut self, through: Tag) {
        for (status, input) in self.state.inputs.iter_mut().zip(&self.program.inputs) {
            if !input.physical {
                status.known = status.known.min(through);
            }
        }
    }

    /// The tag up to and including which the status of `input` is known; FOREVER for a physical connection.
    #[must_use]
    pub fn known(&self, input: InputId) -> Tag {
        self.state.inputs[input.index()].known
    }

    /// The inputs whose status is unknown at the current tag, in order; none between tags.
    pub fn unknown_inputs(&self) -> impl Iterator<Item = InputId> + '_ {
        let State {
            executing,
            unknown,
            unknown_count,
            ..
        } = &self.state;
        let count = if *executing && *unknown_count > 0 {
            self.program.inputs.len()
        } else {
            0
        };
        (0..count)
            .filter(|index| unknown.contains(*index))
            .map(InputId::new)
    }

    /// The tag at which `node` should have run, when a tardy message led to it; while it is ready or in flight.
    ///
    /// Law `tardiness_is_passed_on`: it is the least intended tag over the tardy messages that led to the node at the
    /// current tag.
    #[must_use]
    pub fn tardy(&self, node: NodeId) -> Option<Tag> {
        self.state.tardiness.of(node)
    }

    /// Whether a node that is ready or in flight is tardy.
    #[inline]
    #[must_use]
    pub fn any_tardy(&self) -> bool {
        self.state.tardiness.any()
    }

    /// Learns that the status of `input` is known up to and including `through`.
    pub fn settle(&mut self, input: InputId, through: Tag) {
        self.state.learn(input, through);
    }

    /// Learns that the status of every input is known up to and including `through`.
    pub fn settle_all(&mut self, through: Tag) {
        for status in &mut self.state.inputs {
            status.known = status.known.max(through);
        }
        if self.state.executing && through >= self.state.at {
            self.state.unknown.clear();
            self.state.unknown_count = 0;
        }
    }

    /// Drops what is blocked at the current tag: the status it waits for will never come.
    pub fn abandon(&mut self) {
        self.state.ready.clear();
        self.state.busy.clear();
        self.state.unknown.clear();
        self.state.unknown_count = 0;
        self.state.tardiness.clear();
    }

    /// Ends the current tag and says whether a network input was present at it.
    #[inline]
    pub fn complete(&mut self) -> bool {
        debug_assert!(
            self.state.executing && self.state.in_flight == 0 && self.state.ready.is_empty(),
            "tag done"
        );
        self.state.executing = false;
        self.state.network_inputs_ran
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

impl State {
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
            | ActionKind::PhysicalConnection { .. }
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

    #[inline]
    fn schedule(&mut self, program: &Program, event: Scheduled) {
        let delay = match program.actions[event.action.index()] {
            ActionKind::Logical { min_delay, spacing } => {
                let delay = min_delay.saturating_add(event.delay.max(Duration::ZERO));
                if spacing.min > Duration::ZERO {
                    let tag = self.at.delayed(Delay::after(delay));
                    self.enqueue_spaced(tag, spacing, event.action, event.value);
                    return;
                }
                Delay::after(delay)
            }
            ActionKind::Connection { delay } => delay,
            ActionKind::Startup
            | ActionKind::Shutdown
            | ActionKind::Timer { .. }
            | ActionKind::Physical { .. }
            | ActionKind::PhysicalConnection { .. }
            | ActionKind::Network { .. } => {
                debug_assert!(false, "reactions schedule logical actions only");
                return;
            }
        };
        self.enqueue(self.at.delayed(delay), event.action, event.value);
    }

    /// Queues an event that may be too soon after the action's last one, and returns the tag of the event that stands for it.
    fn enqueue_spaced(
        &mut self,
        tag: Tag,
        spacing: Spacing,
        action: ActionId,
        value: ValueId,
    ) -> Tag {
        let last = self.latest[action.index()];
        let earliest = last.delayed(Delay::Time(spacing.min));
        if last == Tag::NEVER || tag >= earliest {
            return self.enqueue(tag, action, value);
        }
        let released = match spacing.policy {
            SpacingPolicy::Defer => None,
            SpacingPolicy::Drop => Some(value),
            SpacingPolicy::Replace => self.queue.replace(last, action, value),
        };
        match released {
            Some(released) => {
                self.released.push((action, released));
                last
            }
            None => self.enqueue(earliest, action, value),
        }
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

    fn learn(&mut self, input: InputId, through: Tag) {
        let status = &mut self.inputs[input.index()];
        status.known = status.known.max(through);
        if self.executing && through >= self.at && self.unknown.contains(input.index()) {
            self.unknown.remove(input.index());
            self.unknown_count -= 1;
        }
    }

    fn rest(&self) -> Progress {
        if self.ready.is_empty() && self.unknown_count == 0 {
            Progress::TagDone
        } else {
            Progress::Blocked
        }
    }
}
