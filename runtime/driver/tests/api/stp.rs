//! STP handlers: they replace what a tardy message leads to.

use crate::harness::{START, World, at, d, late, line, run_tag, stp};
use ictus::prelude::*;
use ictus::{Class, Observation};
use ictus_coord::FederateExecutor;
use ictus_core::{Admission, InputId, Timeline};
use std::sync::Arc;

#[reactor]
struct Source {
    out: Output<u32>,
}

#[reactions]
impl Source {}

/// Handles what is tardy, and what is late.
#[reactor]
struct Careful {
    input: Input<u32>,
    out: Output<i64>,
}

#[reactions]
impl Careful {
    #[reaction(deadline = 1.ms(), late = Self::late, stp = Self::tardy)]
    fn take(&mut self, ctx: &mut Ctx, _input: &Input<u32>, _out: &mut Output<i64>) {
        unreachable!("{} is late or tardy", ctx.tag());
    }

    fn late(&mut self, ctx: &mut Ctx, input: &Input<u32>, out: &mut Output<i64>) {
        assert_eq!(ctx.intended(), ctx.tag());
        out.set(i64::from(*input.get().unwrap()));
    }

    fn tardy(&mut self, ctx: &mut Ctx, input: &Input<u32>, out: &mut Output<i64>) {
        let behind = ctx.tag().time - ctx.intended().time;
        out.set(behind.as_nanos() + i64::from(*input.get().unwrap()));
    }
}

/// Has no handler; what it reads from `Careful` is tardy too.
#[reactor]
struct Careless {
    input: Input<i64>,
    #[timer(offset = 10.ms())]
    tick: Timer,
}

#[reactions]
impl Careless {
    #[reaction]
    fn tick(&mut self, _tick: &Timer) {}

    #[reaction]
    fn take(&mut self, ctx: &mut Ctx, input: &Input<i64>) {
        let tardy = ctx.intended() < ctx.tag();
        assert_eq!(tardy, *input.get().unwrap() > 1_000_000);
    }
}

#[test]
fn a_tardy_message_runs_the_handler_with_intended_and_actual_tag() {
    let world = World::new(&[
        Class::of::<Source>(),
        Class::of::<Careful>(),
        Class::of::<Careless>(),
    ])
    .federate("source", "Source", "{}")
    .federate("careful", "Careful", "{}")
    .federate("careless", "Careless", "{}")
    .connect("source.out", "careful.input", None)
    .connect("careful.out", "careless.input", None);
    // In time for the deadline at 10 ms; a missed one comes first.
    world.clock.set(11.ms());
    let mut assembly = world.assemble_some(&[1, 2]).unwrap();
    let bodies = &mut assembly.bodies;
    let dir = tempfile::tempdir().unwrap();
    let trace = Some(dir.path().to_owned());
    bodies
        .observe(&Observation {
            trace,
            timing: None,
        })
        .unwrap();
    bodies.start(START);
    let mut timeline = Timeline::new(Arc::clone(&assembly.program));
    timeline.start(START, at(100.ms(), 0));
    timeline.settle_all(at(50.ms(), 0));
    run_tag(&mut timeline, bodies, &world.clock);
    run_tag(&mut timeline, bodies, &world.clock);
    let input = InputId::new(0);
    for (intended, value) in [(at(3.ms(), 0), 7_u32), (at(20.ms(), 0), 8)] {
        let value = bodies.decode(input, &value.to_le_bytes()).unwrap();
        let admission = timeline.admit(input, intended, value);
        if let Admission::Tardy { intended, actual } = admission {
            bodies.note_tardy(input, intended, actual);
        }
    }
    run_tag(&mut timeline, bodies, &world.clock);
    world.clock.set(1_000.ms());
    run_tag(&mut timeline, bodies, &world.clock);
    assert_eq!(bodies.fault(), None);
    let counters = bodies.counters();
    assert_eq!((counters.stp_handled, counters.deadlines_missed), (1, 1));
    bodies.note_end(timeline.at(), "test").unwrap();
    let read = |name: &str| std::fs::read_to_string(dir.path().join(name)).unwrap();
    let behind = 7_000_007_i64;
    let expected = [
        "# tardy 10000000 1 careful.input 3000000 0\n".to_owned(),
        stp((10.ms(), 1), ("careful", 0), &[("out", d(behind))]),
        late((20.ms(), 0), ("careful", 0), &[("out", d(8_i64))]),
        "# end 20000000 0 test\n".to_owned(),
    ];
    assert_eq!(read("careful.trace"), expected.concat());
    let expected = [
        line((10.ms(), 0), ("careless", 0), &[]),
        line((10.ms(), 1), ("careless", 1), &[]),
        line((20.ms(), 0), ("careless", 1), &[]),
        "# end 20000000 0 test\n".to_owned(),
    ];
    assert_eq!(read("careless.trace"), expected.concat());
}
