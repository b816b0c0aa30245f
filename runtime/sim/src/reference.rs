//! The same federation in one program, without RTI and network: the trace that every run must repeat.

use crate::executor::{Record, SimulatedExecutor as _, SyntheticExecutor};
use crate::program::Federation;
use ictus_core::{
    ActionId, Delay, Duration, Effects, Executor as _, NodeKind, PhysicalTime, Progress, Tag,
    Timeline, ValueId,
};
use std::sync::Arc;

/// An event from outside as a run recorded it.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct OutsideEvent {
    /// The federate.
    pub federate: usize,
    /// The number of the physical action among the federate's.
    pub action: usize,
    /// The tag it got, since the start tag.
    pub tag: (Duration, u32),
    /// Its value.
    pub value: u64,
}

/// Where everything starts when nothing else says so.
const START: Tag = Tag::at(1_000_000_000_000_000_000);

/// Runs the federation in one program up to `stop` (time since the start, microstep), with recorded events.
///
/// # Panics
///
/// When the federation cannot be built as one program.
#[must_use]
pub fn reference(
    federation: &Federation,
    events: &[OutsideEvent],
    stop: Option<(Duration, u32)>,
) -> Vec<Record> {
    let assembly = federation
        .alone()
        .expect("generated federations have no loop");
    let program = Arc::clone(&assembly.program);
    let physical = assembly.physical.clone();
    let mut executor = SyntheticExecutor::new(assembly, 0);
    let mut timeline = Timeline::new(program);
    let end = stop.map_or(Tag::FOREVER, after_start);
    timeline.start(START, end);
    executor.started(START);
    let mut ordered = events.to_vec();
    ordered.sort_by_key(|e| e.tag);
    for event in &ordered {
        let action = physical
            .iter()
            .find(|p| (p.0, p.1) == (event.federate, event.action))
            .map(|p| p.2)
            .expect("recorded events name actions of the federation");
        let value = executor.hold(event.value);
        inject(&mut timeline, action, value, after_start(event.tag));
    }
    run(&mut timeline, &mut executor);
    executor.trace().to_vec()
}

fn after_start((time, microstep): (Duration, u32)) -> Tag {
    let time = if time == Duration::ZERO {
        START.time
    } else {
        START.delayed(Delay::Time(time)).time
    };
    Tag::new(time, microstep)
}

fn inject(timeline: &mut Timeline, action: ActionId, value: ValueId, tag: Tag) {
    let actual = timeline.schedule_physical(PhysicalTime::NEVER, action, value, tag);
    debug_assert_eq!(actual, tag, "recorded tags are spaced already");
}

fn run(timeline: &mut Timeline, executor: &mut SyntheticExecutor) {
    let program = Arc::clone(timeline.program());
    let mut present = Vec::new();
    let mut batch = Vec::new();
    let mut effects = Effects::default();
    while !timeline.finished() && timeline.next_tag() != Tag::FOREVER {
        let tag = timeline.next_tag();
        timeline.begin(tag, &mut present);
        executor.begin(tag);
        for (action, value) in present.drain(..) {
            executor.arrive(action, program.action_slot(action), value);
        }
        while timeline.ready(&mut batch) == Progress::Batch {
            for node in &batch {
                debug_assert!(!matches!(program.node(*node), NodeKind::Send { .. }));
                executor.run(*node, tag, &mut effects);
            }
            timeline.finish(&batch, &mut effects);
            effects.stop = false;
            batch.clear();
        }
        timeline.complete();
    }
}
