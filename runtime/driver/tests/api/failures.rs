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

#[reactor]
struct Delicate {
    #[param(default = 1)]
    divisor: i64,
    #[param(default = 0.ms())]
    offset: Duration,
    #[timer(offset = offset)]
    tick: Timer,
    #[state(init = 100 / divisor)]
    share: i64,
}

#[reactions]
impl Delicate {
    #[reaction]
    fn tick(&mut self, _tick: &Timer) {
        self.share += 1;
    }
}

#[test]
fn what_cannot_be_built_is_said_with_its_federate() {
    let build = |parameters: &str| {
        let world = World::new(&[Class::of::<Delicate>()]).federate("f", "Delicate", parameters);
        world.assemble().unwrap_err().to_string()
    };
    let panicked = build(r#"{"divisor": 0}"#);
    assert!(
        panicked.contains("federate f (class Delicate)"),
        "{panicked}"
    );
    assert!(panicked.contains("divide by zero"), "{panicked}");
    let negative = build(r#"{"offset": "-5 ms"}"#);
    assert_eq!(negative, "f: the offset of a timer is negative: -5 ms");
}

#[test]
fn names_of_federates_are_checked() {
    for (name, why) in [
        ("a\tb", "only letters"),
        ("../a", "begin with a letter"),
        ("", "begin with"),
    ] {
        let world = World::new(&[Class::of::<Delicate>()]).federate(name, "Delicate", "{}");
        let error = world.assemble().unwrap_err().to_string();
        assert!(error.contains(why), "{error}");
    }
    let world = World::new(&[Class::of::<Delicate>()]).federate("a", "Delicate", "{}");
    let error = world
        .federate("a", "Delicate", "{}")
        .assemble()
        .unwrap_err();
    assert!(
        error.to_string().contains("another federate has it"),
        "{error}"
    );
}
