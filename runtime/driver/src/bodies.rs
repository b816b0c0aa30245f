//! Values and reaction bodies: what the timeline decides about, executed.

use crate::access::Outcome;
use crate::assembly::words;
use crate::carrier::{Carrier, Sender};
use crate::ctx::Ctx;
pub(crate) use crate::observe::Observation;
use crate::observe::{Observer, Run};
use crate::outside::{Outside, OutsideEvent};
use crate::scope::{BodyEntry, Case};
use crate::slot::Epoch;
use crate::watchdog::{Fired, Watchdogs};
use ictus_coord::measure::Histogram;
use ictus_coord::{FederateExecutor, PayloadError};
use ictus_core::{
    ActionId, Duration, Effects, Executor, InputId, NodeId, NodeKind, OutputId, PhysicalTime,
    Program, SlotId, Tag, ValueId,
};
use std::any::Any;
use std::fmt;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

/// All values and bodies of an [`Assembly`](crate::Assembly).
pub struct Bodies {
    pub(crate) program: Arc<Program>,
    pub(crate) ctx: Ctx,
    pub(crate) epoch: Epoch,
    /// By node id; reactions come first.
    pub(crate) bodies: Vec<BodyEntry>,
    /// By action id.
    pub(crate) carriers: Vec<Box<dyn Carrier>>,
    /// By output id.
    pub(crate) senders: Vec<Box<dyn Sender>>,
    /// The type names of network inputs, by input id.
    pub(crate) input_types: Vec<String>,
    /// Paths of the physical actions and of the ports that physical connections feed.
    pub(crate) physical: Vec<(ActionId, String)>,
    pub(crate) watchdogs: Watchdogs,
    pub(crate) outside: Arc<Outside>,
    pub(crate) observer: Option<Observer>,
    pub(crate) counters: Counters,
    /// By how much deadlines were missed.
    pub(crate) lateness: Histogram,
    pub(crate) fault: Option<Fault>,
}

/// A panic in a reaction or a watchdog's handler, or a value that no serializer could write. Fatal: no further body runs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Fault {
    /// The reactor's path.
    pub path: String,
    /// The reaction's or the handler's name, or the output's.
    pub reaction: String,
    /// The tag at which it happened.
    pub tag: Tag,
    /// The panic's words.
    pub message: String,
}

/// What the bodies did so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Reactions run, their handlers included.
    pub reactions: u64,
    /// Deadline handlers run instead of a body.
    pub deadlines_missed: u64,
    /// STP handlers run instead of a body.
    pub stp_handled: u64,
    /// Watchdogs that expired.
    pub watchdogs_fired: u64,
}

impl Bodies {
    /// Says where the start tag is; before [`Executor::begin`].
    pub const fn start(&mut self, start: Tag) {
        self.ctx.start = start;
    }

    /// Opens trace and timing files, one per federate; before [`Bodies::start`] or after.
    ///
    /// # Errors
    ///
    /// When a file cannot be created.
    pub fn observe(&mut self, observation: &Observation) -> std::io::Result<()> {
        self.observer = Observer::open(observation, &self.program)?;
        Ok(())
    }

    /// The first fault.
    #[must_use]
    pub const fn fault(&self) -> Option<&Fault> {
        self.fault.as_ref()
    }

    /// What was done so far.
    #[must_use]
    pub const fn counters(&self) -> Counters {
        self.counters
    }

    /// The queue of physical events.
    #[must_use]
    pub const fn outside(&self) -> &Arc<Outside> {
        &self.outside
    }

    /// By how much deadlines were missed so far.
    #[must_use]
    pub const fn deadline_lateness(&self) -> &Histogram {
        &self.lateness
    }

    /// Moves the queued physical events to `events`, in the order of their arrival.
    pub fn drain_outside(&mut self, events: &mut Vec<OutsideEvent>) {
        let sent = self.outside.take();
        events.extend(sent.into_iter().map(|event| OutsideEvent {
            action: event.action,
            stamp: event.stamp,
            value: self.carriers[event.action.index()].accept(event.value),
        }));
    }

    /// When the next watchdog expires: then [`Bodies::fire_watchdogs`] is due, whatever tag is executed or waited for.
    #[inline]
    #[must_use]
    pub fn next_watchdog(&self) -> Option<PhysicalTime> {
        self.watchdogs.next()
    }

    /// Runs the handlers of the watchdogs that have expired; between reactions, not after the stop tag. A panic is a fault.
    pub fn fire_watchdogs(&mut self, now: PhysicalTime) -> Fired {
        let mut fired = Fired::default();
        for index in self.watchdogs.take_expired(now) {
            if self.fault.is_some() {
                break;
            }
            self.fire(index, now);
            fired.count += 1;
        }
        self.counters.watchdogs_fired += fired.count;
        fired.stop = std::mem::take(&mut self.ctx.stop);
        fired
    }

    fn fire(&mut self, index: usize, now: PhysicalTime) {
        let Some((path, handler)) = self.watchdogs.entry(index) else {
            return;
        };
        if let Some(observer) = &mut self.observer {
            observer.watchdog(self.ctx.start, now, path);
        }
        // Its items are physical actions: they go to the queue of outside events.
        let mut effects = Effects::default();
        let mut outcome = Outcome {
            effects: &mut effects,
            trace: None,
        };
        let (ctx, epoch) = (&mut self.ctx, self.epoch);
        ctx.reactor = handler.reactor;
        let run = AssertUnwindSafe(|| handler.body.run(ctx, epoch, Case::Body, &mut outcome));
        if let Err(panic) = catch_unwind(run) {
            self.fault = Some(Fault {
                path: self.program.reactor_path(handler.reactor).to_owned(),
                reaction: handler.name.to_owned(),
                tag: self.ctx.tag,
                message: words(&*panic),
            });
        }
    }

    /// Notes in the trace a stop by request.
    pub fn note_stop(&mut self, tag: Tag) {
        if let Some(observer) = &mut self.observer {
            observer.stop(self.ctx.start, tag);
        }
    }

    /// Lets readers of the trace and timing files see what was written so far.
    pub fn flush_observed(&mut self) {
        if let Some(observer) = &mut self.observer {
            observer.flush();
        }
    }

    /// Ends and flushes trace and timing: the last completed tag and why (one line).
    ///
    /// # Errors
    ///
    /// When a file could not be written, now or earlier.
    pub fn note_end(&mut self, tag: Tag, reason: &str) -> std::io::Result<()> {
        match self.observer.take() {
            Some(observer) => observer.end(self.ctx.start, tag, reason),
            None => Ok(()),
        }
    }

    #[inline]
    fn react(&mut self, node: NodeId, effects: &mut Effects) {
        if self.fault.is_some() {
            return;
        }
        let handlers = self.bodies[node.index()].handlers;
        let late = handlers.deadline.and_then(|deadline| {
            let late = self.ctx.lag().saturating_add(-deadline);
            // As in LF, a deadline of zero is always missed.
            (deadline == Duration::ZERO || late > Duration::ZERO).then_some(late)
        });
        // As in LF, a missed deadline comes before tardiness.
        let case = if let Some(late) = late {
            self.counters.deadlines_missed += 1;
            self.lateness.record(late);
            Case::Deadline
        } else if handlers.stp && self.ctx.intended.is_some() {
            self.counters.stp_handled += 1;
            Case::Stp
        } else {
            Case::Body
        };
        self.react_as(node, case, effects);
    }

    #[inline]
    fn react_as(&mut self, node: NodeId, case: Case, effects: &mut Effects) {
        self.counters.reactions += 1;
        if self.observer.is_some() {
            self.react_observed(node, case, effects);
            return;
        }
        let entry = &mut self.bodies[node.index()];
        self.ctx.reactor = entry.reactor;
        let mut outcome = Outcome {
            effects,
            trace: None,
        };
        let (ctx, epoch) = (&mut self.ctx, self.epoch);
        let run = AssertUnwindSafe(|| entry.body.run(ctx, epoch, case, &mut outcome));
        if let Err(panic) = catch_unwind(run) {
            self.fail(node, &*panic);
        }
        effects.stop |= std::mem::take(&mut self.ctx.stop);
    }

    #[cold]
    fn react_observed(&mut self, node: NodeId, case: Case, effects: &mut Effects) {
        let entry = &mut self.bodies[node.index()];
        self.ctx.reactor = entry.reactor;
        let start = self.ctx.clock.now();
        let mut trace = String::new();
        let mut outcome = Outcome {
            effects,
            trace: Some(&mut trace),
        };
        let (ctx, epoch) = (&mut self.ctx, self.epoch);
        let run = AssertUnwindSafe(|| entry.body.run(ctx, epoch, case, &mut outcome));
        let result = catch_unwind(run);
        let end = self.ctx.clock.now();
        match result {
            Ok(()) => self.record(node, case, &trace, (start, end)),
            Err(panic) => self.fail(node, &*panic),
        }
        effects.stop |= std::mem::take(&mut self.ctx.stop);
    }

    fn record(
        &mut self,
        node: NodeId,
        case: Case,
        effects: &str,
        (start, end): (PhysicalTime, PhysicalTime),
    ) {
        let reaction = &self.program.reactions()[node.index()];
        if let Some(observer) = &mut self.observer {
            observer.run(&Run {
                origin: self.ctx.start,
                tag: self.ctx.tag,
                reactor: reaction.spec.reactor,
                path: self.program.reactor_path(reaction.spec.reactor),
                index: reaction.index,
                case,
                effects,
                start,
                end,
            });
        }
    }

    #[cold]
    fn fail(&mut self, node: NodeId, panic: &(dyn Any + Send)) {
        let spec = &self.program.reactions()[node.index()].spec;
        self.fault = Some(Fault {
            path: self.program.reactor_path(spec.reactor).to_owned(),
            reaction: spec.name.clone(),
            tag: self.ctx.tag,
            message: words(panic),
        });
    }
}

impl Executor for Bodies {
    #[inline]
    fn begin(&mut self, tag: Tag) {
        self.ctx.tag = tag;
        self.epoch.advance();
        if !self.watchdogs.is_empty() {
            self.watchdogs.begin(tag.time);
        }
    }

    #[inline]
    fn arrive(&mut self, action: ActionId, _: Option<SlotId>, value: ValueId) {
        self.carriers[action.index()].arrive(value, self.epoch);
    }

    #[inline]
    fn run(&mut self, node: NodeId, _: Tag, effects: &mut Effects) {
        match self.program.node(node) {
            NodeKind::Reaction => self.react(node, effects),
            NodeKind::Forward { action } => {
                let value = self.carriers[action.index()].forward();
                effects.forward(&self.program, action, value);
            }
            // The value stays in its slot; the federate asks for its bytes with `encode`.
            NodeKind::Send { .. } => {}
        }
    }

    #[cold]
    fn run_tardy(&mut self, node: NodeId, tag: Tag, intended: Tag, effects: &mut Effects) {
        self.ctx.intended = Some(intended);
        self.run(node, tag, effects);
        self.ctx.intended = None;
    }

    fn release(&mut self, action: ActionId, value: ValueId) {
        self.carriers[action.index()].release(value);
    }
}

impl FederateExecutor for Bodies {
    fn encode(&mut self, output: OutputId, out: &mut Vec<u8>) {
        if let Err(error) = self.senders[output.index()].encode(out) {
            let port = self.program.network_outputs()[output.index()];
            self.fault.get_or_insert_with(|| Fault {
                path: self.program.port_path(port),
                reaction: "output".to_owned(),
                tag: self.ctx.tag,
                message: error.to_string(),
            });
        }
    }

    fn decode(&mut self, input: InputId, payload: &[u8]) -> Result<ValueId, PayloadError> {
        let network = self.program.network_inputs()[input.index()];
        let carrier = &mut self.carriers[network.action.index()];
        carrier.decode(payload).map_err(|error| PayloadError {
            input: self.program.port_path(network.port),
            type_name: self.input_types[input.index()].clone(),
            length: payload.len(),
            reason: error.to_string(),
        })
    }

    fn note_physical(&mut self, action: ActionId, tag: Tag) {
        if let Some(observer) = &mut self.observer
            && let Some((_, path)) = self.physical.iter().find(|(a, _)| *a == action)
        {
            observer.physical(self.ctx.start, tag, path);
        }
    }

    fn note_tardy(&mut self, input: InputId, intended: Tag, actual: Tag) {
        if let Some(observer) = &mut self.observer {
            let port = self.program.network_inputs()[input.index()].port;
            let path = self.program.port_path(port);
            observer.tardy(self.ctx.start, (intended, actual), &path);
        }
    }
}

impl fmt::Debug for Bodies {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Bodies")
            .field("bodies", &self.bodies.len())
            .field("fault", &self.fault)
            .finish_non_exhaustive()
    }
}
