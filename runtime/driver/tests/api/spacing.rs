//! Events that come too soon: put off, dropped, or giving their value to the one before.

use crate::harness::{START, World, at, d, line, run_tag, take_outside};
use ictus::Class;
use ictus::prelude::*;
use ictus::value::{Digest, Layout};
use ictus_core::Timeline;
use std::sync::{Arc, Mutex};

#[reactor]
struct Spaced {
    #[action(min_spacing = 5.ms())]
    put_off: LogicalAction<u32>,
    #[action(min_delay = 1.ms(), min_spacing = 5.ms(), policy = drop)]
    lost: LogicalAction<u32>,
    #[action(min_delay = 1.ms(), min_spacing = 5.ms(), policy = replace)]
    newest: LogicalAction<u32>,
    #[timer(offset = 3.ms())]
    tick: Timer,
    out: Output<u32>,
}

#[reactions]
impl Spaced {
    #[reaction]
    fn schedule(
        &mut self,
        start: &Startup,
        _tick: &Timer,
        put_off: &mut LogicalAction<u32>,
        lost: &mut LogicalAction<u32>,
        newest: &mut LogicalAction<u32>,
    ) {
        let values: &[u32] = if start.is_present() { &[1, 2] } else { &[3] };
        for value in values {
            put_off.schedule(0.ms(), *value);
            lost.schedule(0.ms(), 10 + value);
            newest.schedule(0.ms(), 20 + value);
        }
    }

    #[reaction]
    fn put_off(&mut self, put_off: &LogicalAction<u32>, out: &mut Output<u32>) {
        out.set(*put_off.get().unwrap());
    }

    #[reaction]
    fn lost(&mut self, lost: &LogicalAction<u32>, out: &mut Output<u32>) {
        out.set(*lost.get().unwrap());
    }

    #[reaction]
    fn newest(&mut self, newest: &LogicalAction<u32>, out: &mut Output<u32>) {
        out.set(*newest.get().unwrap());
    }
}

#[test]
fn an_event_that_comes_too_soon_goes_by_its_actions_policy() {
    let ran = World::of(Class::of::<Spaced>()).timeout(20.ms()).run();
    assert_eq!(ran.fault, None);
    let handled: Vec<_> = ran.traces[0]
        .lines()
        .filter(|line| line.contains("out="))
        .map(|line| format!("{line}\n"))
        .collect();
    let out = |time, microstep, index, value: u32| {
        line((time, microstep), ("main", index), &[("out", d(value))])
    };
    let expected = [
        out(0.ms(), 1, 1, 1),
        out(1.ms(), 0, 2, 11),
        out(1.ms(), 0, 3, 22),
        out(5.ms(), 0, 1, 2),
        // The event before is handled: there is nothing to replace.
        out(6.ms(), 0, 3, 23),
        out(10.ms(), 0, 1, 3),
    ];
    assert_eq!(handled, expected);
}

/// Tells how many of its kind are alive.
#[derive(Clone, Debug)]
struct Counted(#[expect(dead_code, reason = "held to be counted")] Arc<()>);

impl Value for Counted {
    fn type_name() -> String {
        "Counted".to_owned()
    }

    fn layout(_: &mut Layout) {}

    fn digest(&self, digest: &mut Digest) {
        digest.refuse();
    }
}

type Senders = [PhysicalSender<Counted>; 2];

static SENDERS: Mutex<Option<Senders>> = Mutex::new(None);

#[reactor]
struct Bouncing {
    #[action(min_spacing = 5.ms(), policy = drop)]
    first: PhysicalAction<Counted>,
    #[action(min_spacing = 5.ms(), policy = replace)]
    last: PhysicalAction<Counted>,
}

#[reactions]
impl Bouncing {
    #[reaction]
    fn begin(
        &mut self,
        _: &Startup,
        #[uses] first: &PhysicalAction<Counted>,
        #[uses] last: &PhysicalAction<Counted>,
    ) {
        *SENDERS.lock().unwrap() = Some([first.sender(), last.sender()]);
    }
}

#[test]
fn a_value_that_no_event_carries_is_released() {
    let world = World::of(Class::of::<Bouncing>());
    let mut assembly = world.assemble().unwrap();
    let bodies = &mut assembly.bodies;
    bodies.start(START);
    let mut timeline = Timeline::new(Arc::clone(&assembly.program));
    timeline.start(START, Tag::FOREVER);
    run_tag(&mut timeline, bodies, &world.clock);
    let senders = SENDERS.lock().unwrap().take().unwrap();
    let token = Arc::new(());
    for time in [10.ms(), 11.ms(), 12.ms()] {
        world.clock.set(time);
        for sender in &senders {
            sender.schedule(Counted(Arc::clone(&token))).unwrap();
        }
        take_outside(&mut timeline, bodies);
    }
    // One event each is left, with one value.
    assert_eq!((timeline.queued(), Arc::strong_count(&token)), (2, 3));
    assert_eq!(timeline.next_tag(), at(10.ms(), 0));
    world.clock.set(16.ms());
    for sender in &senders {
        sender.schedule(Counted(Arc::clone(&token))).unwrap();
    }
    take_outside(&mut timeline, bodies);
    assert_eq!((timeline.queued(), Arc::strong_count(&token)), (4, 5));
}
