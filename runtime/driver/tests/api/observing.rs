//! Trace and timing files: one of each a federate, lines as ARCHITECTURE.md has them.

use crate::harness::{START, World, at, d, line};
use ictus::prelude::*;
use ictus::{Class, Observation};
use ictus_core::{Effects, Executor, Timeline};
use std::sync::Arc;

#[reactor]
struct Node {
    #[child]
    inner: Child<Inner>,
    out: Output<u32>,
}

#[reactions]
impl Node {
    #[connections]
    fn wire(c: &mut Wiring, inner: &Child<Inner>, out: &Output<u32>) {
        c.connect(&inner.out, out);
    }
}

#[reactor]
struct Inner {
    out: Output<u32>,
    opaque: Output<Opaque>,
}

#[reactions]
impl Inner {
    #[reaction]
    fn begin(&mut self, _: &Startup, opaque: &mut Output<Opaque>, out: &mut Output<u32>) {
        out.set(7);
        opaque.set(Opaque);
    }
}

/// A value that no digest can be made of.
#[derive(Clone)]
struct Opaque;

impl Value for Opaque {
    fn type_name() -> String {
        "Opaque".to_owned()
    }

    fn layout(layout: &mut ictus::value::Layout) {
        layout.primitive("Opaque");
    }

    fn digest(&self, digest: &mut ictus::value::Digest) {
        digest.refuse();
    }
}

#[test]
fn each_federate_has_its_own_files() {
    let world = World::new(&[Class::of::<Node>()])
        .federate("a", "Node", "{}")
        .federate("b", "Node", "{}");
    world.clock.set(3.ms());
    let mut assembly = world.assemble().unwrap();
    let dir = tempfile::tempdir().unwrap();
    let bodies = &mut assembly.bodies;
    bodies
        .observe(&Observation {
            trace: Some(dir.path().to_owned()),
            timing: Some(dir.path().to_owned()),
        })
        .unwrap();
    bodies.start(START);
    let mut timeline = Timeline::new(Arc::clone(&assembly.program));
    timeline.start(START, Tag::FOREVER);
    let (mut present, mut batch, mut effects) = (Vec::new(), Vec::new(), Effects::default());
    bodies.begin(START);
    timeline.begin(START, &mut present);
    for (action, value) in present {
        bodies.arrive(action, None, value);
    }
    timeline.ready(&mut batch);
    for node in &batch {
        bodies.run(*node, START, &mut effects);
    }
    bodies.note_stop(at(5.ms(), 0));
    bodies.note_end(at(5.ms(), 1), "stopped\nby hand").unwrap();
    for name in ["a", "b"] {
        let read = |extension| {
            std::fs::read_to_string(dir.path().join(format!("{name}.{extension}"))).unwrap()
        };
        let path = format!("{name}.inner");
        // Effects stand in the order of the signature; a type without a digest shows a question mark.
        let run = line((0.ms(), 0), (&path, 0), &[("out", d(7_u32))]);
        let run = run.replace("out=", "opaque=?,out=");
        let expected = format!("{run}# stop 5000000 0\n# end 5000000 1 stopped by hand\n");
        assert_eq!(read("trace"), expected);
        assert_eq!(
            read("timing"),
            format!("0\t0\t{path}\t0\t3000000\t3000000\n")
        );
    }
}
