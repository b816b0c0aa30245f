//! Deadlines: the handler replaces the reaction when it starts too late.

use crate::harness::{TestClock, World, d, late, line};
use ictus::Class;
use ictus::prelude::*;
use std::sync::Arc;

#[reactor]
struct Hasty {
    #[param]
    budget: Duration,
    #[timer(period = 10.ms())]
    tick: Timer,
    out: Output<u32>,
    count: u32,
}

#[reactions]
impl Hasty {
    #[reaction(deadline = self.budget, late = Self::too_late)]
    fn tick(&mut self, ctx: &mut Ctx, _tick: &Timer, out: &mut Output<u32>) {
        self.count += 1;
        assert!(ctx.lag() <= self.budget);
        out.set(self.count);
    }

    fn too_late(&mut self, ctx: &mut Ctx, tick: &Timer, out: &mut Output<u32>) {
        assert!(tick.is_present());
        assert!(ctx.lag() > self.budget);
        out.set(1_000);
    }
}

#[test]
fn a_late_reaction_is_replaced_by_its_handler() {
    let world = World::new(&[Class::of::<Hasty>()])
        .federate("hasty", "Hasty", r#"{ "budget": "2 ms" }"#)
        .timeout(20.ms());
    // The clock stands: the tags 0, 10 and 20 ms start 12 ms late, just in time, and early.
    world.clock.set(12.ms());
    let ran = world.run();
    assert_eq!(ran.fault, None);
    let expected = [
        late((0.ms(), 0), ("hasty", 0), &[("out", d(1_000_u32))]),
        line((10.ms(), 0), ("hasty", 0), &[("out", d(1_u32))]),
        line((20.ms(), 0), ("hasty", 0), &[("out", d(2_u32))]),
    ];
    assert_eq!(ran.traces, [expected.concat()]);
    assert_eq!(ran.deadlines_missed, 1);
}

#[test]
fn a_deadline_of_zero_is_always_missed() {
    let world = World::new(&[Class::of::<Strict>()])
        .federate("strict", "Strict", "{}")
        .timeout(10.ms());
    // Every tag starts early, as in a fast run.
    let ran = world.run();
    assert_eq!((ran.fault, ran.deadlines_missed), (None, 2));
}

/// Its reaction is never in time.
#[reactor]
struct Strict {
    #[timer(period = 10.ms())]
    tick: Timer,
}

#[reactions]
impl Strict {
    #[reaction(deadline = 0.ms(), late = Self::late)]
    fn tick(&mut self, _tick: &Timer) {
        unreachable!("the handler runs instead");
    }

    fn late(&mut self, _tick: &Timer) {}
}

/// Its first reaction takes so long that the second, at the same tag, is late.
#[reactor]
struct Slow {
    out: Output<PhysicalNanos>,
}

/// What a clock said, as a value.
#[derive(Clone, Debug, Value)]
#[value(native)]
struct PhysicalNanos(i64);

std::thread_local! {
    static CLOCK: std::cell::RefCell<Option<Arc<TestClock>>> = const { std::cell::RefCell::new(None) };
}

#[reactions]
impl Slow {
    #[reaction(deadline = 1.ms(), late = Self::late)]
    fn work(&mut self, _: &Startup) {
        CLOCK.with_borrow(|clock| clock.as_ref().unwrap().set(7.ms()));
    }

    fn late(&mut self, _: &Startup) {
        unreachable!("the first reaction is in time");
    }

    #[reaction(deadline = 1.ms(), late = Self::report)]
    fn next(&mut self, _: &mut Ctx, _: &Startup, out: &mut Output<PhysicalNanos>) {
        out.set(PhysicalNanos(0));
    }

    fn report(&mut self, ctx: &mut Ctx, _: &Startup, out: &mut Output<PhysicalNanos>) {
        let time: PhysicalTime = ctx.physical_time();
        out.set(PhysicalNanos(time.as_nanos()));
    }
}

#[test]
fn a_deadline_is_checked_when_its_reaction_starts() {
    let world = World::of(Class::of::<Slow>());
    CLOCK.set(Some(Arc::clone(&world.clock)));
    let ran = world.run();
    assert_eq!(ran.fault, None);
    let seen = PhysicalNanos(1_007_000_000);
    let expected = [
        line((0.ms(), 0), ("main", 0), &[]),
        late((0.ms(), 0), ("main", 1), &[("out", d(seen))]),
    ];
    assert_eq!(ran.traces, [expected.concat()]);
}
