//! Panics in reactions.

use crate::harness::{World, at, line};
use ictus::prelude::*;
use ictus::{Class, Fault};

#[reactor]
struct Fragile {
    #[child]
    inner: Child<Inner>,
}

#[reactions]
impl Fragile {
    #[reaction]
    fn begin(&mut self, _: &Startup) {}
}

#[reactor]
struct Inner {
    #[timer(offset = 3.ms(), period = 1.ms())]
    tick: Timer,
    ticks: u32,
}

#[reactions]
impl Inner {
    #[reaction]
    fn tick(&mut self, _tick: &Timer) {
        self.ticks += 1;
        assert!(self.ticks < 2, "out of {}", "ticks");
    }

    #[reaction]
    fn after(&mut self, _tick: &Timer) {}
}

#[test]
fn a_panic_is_caught_and_names_reactor_reaction_and_tag() {
    let ran = World::of(Class::of::<Fragile>()).run();
    let fault = Fault {
        path: "main.inner".to_owned(),
        reaction: "tick".to_owned(),
        tag: at(4.ms(), 0),
        message: "out of ticks".to_owned(),
    };
    assert_eq!(ran.fault, Some(fault));
    // The reaction that panicked leaves no record, and nothing runs after it.
    let expected = [
        line((0.ms(), 0), ("main", 0), &[]),
        line((3.ms(), 0), ("main.inner", 0), &[]),
        line((3.ms(), 0), ("main.inner", 1), &[]),
    ];
    assert_eq!(ran.traces, [expected.concat()]);
}
