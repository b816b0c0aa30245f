//! Watchdogs: handlers at a physical time, although no tag advances.

use crate::harness::{START, World, at, d, line, run_tag, take_outside};
use ictus::prelude::*;
use ictus::{Class, Fault, Fired};
use ictus_core::Timeline;
use std::sync::Arc;

/// Starts its watchdog at 0 ms and stops it, or starts it again, at 10 ms.
#[reactor]
struct Guarded {
    #[param(default = 0.ms())]
    extra: Duration,
    #[param(default = false)]
    again: bool,
    #[timer(period = 10.ms())]
    tick: Timer,
    #[watchdog(timeout = 15.ms())]
    guard: Watchdog,
    #[action(min_delay = 1.ms())]
    alarm: PhysicalAction<u32>,
    out: Output<u32>,
    fired: u32,
}

#[reactions]
impl Guarded {
    #[reaction]
    fn tick(&mut self, ctx: &mut Ctx, _tick: &Timer, guard: &mut Watchdog) {
        if self.again || ctx.elapsed() == 0.ms() {
            guard.start(self.extra);
        } else {
            guard.stop();
        }
    }

    #[watchdog(guard)]
    fn silent(&mut self, ctx: &mut Ctx, alarm: &mut PhysicalAction<u32>) {
        assert_eq!(ctx.path(), "main");
        self.fired += 1;
        alarm.schedule(self.fired);
    }

    #[reaction]
    fn alarm(&mut self, alarm: &PhysicalAction<u32>, out: &mut Output<u32>) {
        out.set(*alarm.get().unwrap());
    }
}

fn guarded(parameters: &str) -> World {
    World::new(&[Class::of::<Guarded>()]).federate("main", "Guarded", parameters)
}

/// Physical time so long after the start.
fn physical(after_start: Duration) -> PhysicalTime {
    at(after_start, 0).time.as_physical()
}

#[test]
fn a_watchdog_fires_between_two_tags_and_its_alarm_is_a_physical_event() {
    let world = guarded("{}").timeout(30.ms());
    world.clock.set(16.ms());
    let ran = world.run();
    assert_eq!(ran.fault, None);
    let expected = [
        line((0.ms(), 0), ("main", 0), &[]),
        "# watchdog 16000000 main.guard\n".to_owned(),
        "# physical 17000000 0 main.alarm\n".to_owned(),
        line((10.ms(), 0), ("main", 0), &[]),
        line((17.ms(), 0), ("main", 1), &[("out", d(1_u32))]),
        line((20.ms(), 0), ("main", 0), &[]),
        line((30.ms(), 0), ("main", 0), &[]),
    ];
    assert_eq!(ran.traces, [expected.concat()]);
    assert_eq!(ran.counters.watchdogs_fired, 1);
}

#[test]
fn a_watchdog_expires_at_the_tags_time_plus_timeout_plus_extra_and_once() {
    for (parameters, extra) in [("{}", 0.ms()), (r#"{ "extra": "3 ms" }"#, 3.ms())] {
        let world = guarded(parameters);
        world.clock.set(5.ms());
        let mut assembly = world.assemble().unwrap();
        let bodies = &mut assembly.bodies;
        bodies.start(START);
        let mut timeline = Timeline::new(Arc::clone(&assembly.program));
        timeline.start(START, at(100.ms(), 0));
        assert_eq!(bodies.next_watchdog(), None);
        run_tag(&mut timeline, bodies, &world.clock);
        let due = 15.ms() + extra;
        assert_eq!(bodies.next_watchdog(), Some(physical(due)));
        let early = bodies.fire_watchdogs(physical(due - 1.ns()));
        assert_eq!(early, Fired::default());
        let fired = bodies.fire_watchdogs(physical(due));
        assert_eq!(
            fired,
            Fired {
                count: 1,
                stop: false
            }
        );
        assert_eq!(bodies.next_watchdog(), None);
        take_outside(&mut timeline, bodies);
        assert_eq!(timeline.next_tag(), at(6.ms(), 0), "the alarm");
    }
}

#[test]
fn a_stopped_watchdog_does_not_fire_and_one_started_again_fires_later() {
    for (parameters, next) in [("{}", None), (r#"{ "again": true }"#, Some(25.ms()))] {
        let world = guarded(parameters);
        let mut assembly = world.assemble().unwrap();
        let bodies = &mut assembly.bodies;
        bodies.start(START);
        let mut timeline = Timeline::new(Arc::clone(&assembly.program));
        timeline.start(START, at(100.ms(), 0));
        run_tag(&mut timeline, bodies, &world.clock);
        run_tag(&mut timeline, bodies, &world.clock);
        assert_eq!(bodies.next_watchdog(), next.map(physical));
    }
}

#[reactor]
struct Impatient {
    #[watchdog(timeout = 1.ms())]
    guard: Watchdog,
    #[param(default = false)]
    panics: bool,
}

#[reactions]
impl Impatient {
    #[reaction]
    fn begin(&mut self, _: &Startup, guard: &mut Watchdog) {
        guard.start(0.ms());
    }

    #[watchdog(guard)]
    fn give_up(&mut self, ctx: &mut Ctx) {
        assert!(!self.panics, "no answer");
        ctx.request_stop();
    }
}

/// Runs the first tag of an `Impatient` and lets its watchdog expire.
fn expire(parameters: &str) -> (Fired, Option<Fault>) {
    let world = World::new(&[Class::of::<Impatient>()]).federate("main", "Impatient", parameters);
    let mut assembly = world.assemble().unwrap();
    let bodies = &mut assembly.bodies;
    bodies.start(START);
    let mut timeline = Timeline::new(Arc::clone(&assembly.program));
    timeline.start(START, at(50.ms(), 0));
    run_tag(&mut timeline, bodies, &world.clock);
    let fired = bodies.fire_watchdogs(physical(1.ms()));
    (fired, bodies.fault().cloned())
}

#[test]
fn a_handler_may_ask_for_a_stop() {
    let stop = Fired {
        count: 1,
        stop: true,
    };
    assert_eq!(expire("{}"), (stop, None));
}

#[test]
fn a_panic_in_a_handler_is_a_fault_with_its_name() {
    let (fired, fault) = expire(r#"{ "panics": true }"#);
    assert!(!fired.stop);
    let fault = fault.unwrap();
    let words = [&fault.path, &fault.reaction, &fault.message].map(String::as_str);
    assert_eq!(words, ["main", "give_up", "no answer"]);
}

#[reactor]
struct Unguarded {
    #[watchdog(timeout = 1.ms())]
    guard: Watchdog,
}

#[reactions]
impl Unguarded {}

#[reactor]
struct Twice {
    #[watchdog(timeout = 0.ms() - 1.ms())]
    guard: Watchdog,
}

#[reactions]
impl Twice {
    #[watchdog(guard)]
    fn one(&mut self) {}

    #[watchdog(guard)]
    fn other(&mut self) {}
}

#[test]
fn a_watchdog_has_one_handler_a_timeout_and_no_fast_program() {
    let error = |class| World::of(class).assemble().unwrap_err().to_string();
    assert_eq!(
        error(Class::of::<Unguarded>()),
        "main.guard: the watchdog has 0 handlers instead of one: write one method `#[watchdog(guard)]`"
    );
    assert_eq!(
        error(Class::of::<Twice>()),
        "main: the timeout of a watchdog is negative: -1 ms"
    );
    let fast = World::of(Class::of::<Impatient>()).fast();
    assert_eq!(
        fast.assemble().unwrap_err().to_string(),
        "`fast`, but the watchdog `main.guard` goes by the physical clock"
    );
}
