//! Logical time: timers, logical actions, delays, collisions, startup, shutdown, stopping.

use crate::harness::{World, at, d, line};
use ictus::Class;
use ictus::prelude::*;

#[reactor]
struct Timers {
    #[param(default = 4.ms())]
    period: Duration,
    #[timer(offset = 1.ms(), period = period)]
    often: Timer,
    #[timer(offset = 5.ms())]
    once: Timer,
    which: Output<u32>,
}

#[reactions]
impl Timers {
    #[reaction]
    fn tick(&mut self, often: &Timer, once: &Timer, which: &mut Output<u32>) {
        which.set(u32::from(often.is_present()) + 2 * u32::from(once.is_present()));
    }
}

#[test]
fn timers_fire_at_offset_and_every_period() {
    let ran = World::of(Class::of::<Timers>()).timeout(10.ms()).run();
    let expected = [
        line((1.ms(), 0), ("main", 0), &[("which", d(1_u32))]),
        line((5.ms(), 0), ("main", 0), &[("which", d(3_u32))]),
        line((9.ms(), 0), ("main", 0), &[("which", d(1_u32))]),
    ];
    assert_eq!(ran.traces, [expected.concat()]);
    assert_eq!(ran.end, at(10.ms(), 0));
}

#[reactor]
struct Actor {
    #[action]
    now: LogicalAction<u32>,
    #[action(min_delay = 2.ms())]
    later: LogicalAction<u32>,
    seen: Output<u32>,
}

#[reactions]
impl Actor {
    #[reaction]
    fn begin(&mut self, _: &Startup, now: &mut LogicalAction<u32>, later: &mut LogicalAction<u32>) {
        now.schedule(Duration::ZERO, 1);
        now.schedule(Duration::ZERO, 2);
        later.schedule(3.ms(), 3);
        now.schedule(Duration::ZERO, 4);
    }

    #[reaction]
    fn act(&mut self, #[trigger] now: &mut LogicalAction<u32>, seen: &mut Output<u32>) {
        let value = *now.get().unwrap();
        seen.set(value);
        if value == 4 {
            now.schedule(1.ms(), 5);
        }
    }

    #[reaction]
    fn act_later(&mut self, later: &LogicalAction<u32>, #[uses] now: &LogicalAction<u32>) {
        assert_eq!(later.get(), Some(&3));
        assert!(!now.is_present());
    }

    #[reaction]
    fn end(&mut self, ctx: &mut Ctx, _: &Shutdown, seen: &mut Output<u32>) {
        assert_eq!(ctx.elapsed(), 5.ms());
        seen.set(99);
    }
}

#[test]
fn the_nth_event_for_one_tag_is_handled_n_microsteps_later() {
    let ran = World::of(Class::of::<Actor>()).run();
    assert_eq!(ran.fault, None);
    let scheduled = [
        ("now", d(1_u32)),
        ("now", d(2_u32)),
        ("now", d(4_u32)),
        ("later", d(3_u32)),
    ];
    let expected = [
        line((0.ms(), 0), ("main", 0), &scheduled),
        line((0.ms(), 1), ("main", 1), &[("seen", d(1_u32))]),
        line((0.ms(), 2), ("main", 1), &[("seen", d(2_u32))]),
        line(
            (0.ms(), 3),
            ("main", 1),
            &[("now", d(5_u32)), ("seen", d(4_u32))],
        ),
        line((1.ms(), 0), ("main", 1), &[("seen", d(5_u32))]),
        line((5.ms(), 0), ("main", 2), &[]),
        line((5.ms(), 1), ("main", 3), &[("seen", d(99_u32))]),
    ];
    assert_eq!(ran.traces, [expected.concat()]);
}

/// Sets its output twice in one time, at two microsteps.
#[reactor]
struct Stutter {
    #[action]
    again: LogicalAction<()>,
    out: Output<u32>,
}

#[reactions]
impl Stutter {
    #[reaction]
    fn begin(&mut self, _: &Startup, out: &mut Output<u32>, again: &mut LogicalAction<()>) {
        out.set(1);
        again.schedule(Duration::ZERO, ());
    }

    #[reaction]
    fn repeat(&mut self, _again: &LogicalAction<()>, out: &mut Output<u32>) {
        out.set(2);
    }
}

#[reactor]
struct Listener {
    input: Input<u32>,
    heard: Output<u32>,
}

#[reactions]
impl Listener {
    #[reaction]
    fn hear(&mut self, input: &Input<u32>, heard: &mut Output<u32>) {
        heard.set(*input.get().unwrap());
    }
}

fn heard(after: Option<Duration>) -> String {
    let ran = World::new(&[Class::of::<Stutter>(), Class::of::<Listener>()])
        .federate("stutter", "Stutter", "{}")
        .federate("listener", "Listener", "{}")
        .connect("stutter.out", "listener.input", after)
        .run();
    assert_eq!(ran.fault, None);
    ran.traces[1].clone()
}

#[test]
fn a_delay_of_zero_is_one_microstep_and_none_is_none() {
    let line = |when, value: u32| line(when, ("listener", 0), &[("heard", d(value))]);
    let none = [line((0.ms(), 0), 1), line((0.ms(), 1), 2)];
    assert_eq!(heard(None), none.concat());
    let zero = [line((0.ms(), 1), 1), line((0.ms(), 2), 2)];
    assert_eq!(heard(Some(Duration::ZERO)), zero.concat());
    // Both microsteps reach the same time; the second collides with the first.
    let five = [line((5.ms(), 0), 1), line((5.ms(), 1), 2)];
    assert_eq!(heard(Some(5.ms())), five.concat());
}

#[reactor]
struct Stopper {
    #[timer(period = 1.ms())]
    tick: Timer,
    ticks: u32,
    count: Output<u32>,
}

#[reactions]
impl Stopper {
    #[reaction]
    fn tick(&mut self, ctx: &mut Ctx, _tick: &Timer) {
        self.ticks += 1;
        if self.ticks == 3 {
            ctx.request_stop();
        }
    }

    #[reaction]
    fn end(&mut self, _: &Shutdown, count: &mut Output<u32>) {
        count.set(self.ticks);
    }
}

#[test]
fn a_requested_stop_runs_shutdown_one_microstep_later() {
    let ran = World::of(Class::of::<Stopper>()).timeout(100.ms()).run();
    let expected = [
        line((0.ms(), 0), ("main", 0), &[]),
        line((1.ms(), 0), ("main", 0), &[]),
        line((2.ms(), 0), ("main", 0), &[]),
        line((2.ms(), 1), ("main", 1), &[("count", d(3_u32))]),
    ];
    assert_eq!(ran.traces, [expected.concat()]);
}
