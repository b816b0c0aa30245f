//! Nested reactors, banks, connections inside a reactor, parameters of children.

use crate::harness::{World, d, line};
use ictus::Class;
use ictus::prelude::*;

/// Multiplies by its gain.
#[reactor]
struct Stage {
    #[param]
    gain: u32,
    #[param(default = gain + 1)]
    limit: u32,
    input: Input<u32>,
    out: Output<u32>,
}

#[reactions]
impl Stage {
    #[reaction]
    fn scale(&mut self, input: &Input<u32>, out: &mut Output<u32>) {
        out.set((input.get().unwrap() * self.gain).min(self.limit));
    }
}

/// Two stages in a row, inside, with a parameter handed down.
#[reactor]
struct Pipeline {
    #[param(default = 100)]
    limit: u32,
    input: Input<u32>,
    out: Output<u32>,
    #[child(Stage { gain: 2, limit })]
    first: Child<Stage>,
    #[child(Stage { gain: 5, limit: limit * 10 })]
    second: Child<Stage>,
}

#[reactions]
impl Pipeline {
    #[connections]
    fn wire(
        wiring: &mut Wiring,
        input: &Input<u32>,
        out: &Output<u32>,
        first: &Child<Stage>,
        second: &Child<Stage>,
    ) {
        wiring.connect(input, &first.input);
        wiring.connect(&first.out, &second.input).after(3.ms());
        wiring.connect(&second.out, out);
    }
}

/// Writes a child's input, reads a child's output.
#[reactor]
struct Top {
    #[child]
    pipeline: Child<Pipeline>,
    seen: Output<u32>,
}

#[reactions]
impl Top {
    #[reaction]
    fn begin(&mut self, _: &Startup, #[of(pipeline.input)] input: &mut Output<u32>) {
        input.set(7);
    }

    #[reaction]
    fn see(&mut self, #[of(pipeline.out)] value: &Input<u32>, seen: &mut Output<u32>) {
        seen.set(*value.get().unwrap());
    }
}

#[test]
fn values_go_through_children() {
    let ran = World::of(Class::of::<Top>()).run();
    let expected = [
        line((0.ms(), 0), ("main", 0), &[("pipeline.input", d(7_u32))]),
        line(
            (0.ms(), 0),
            ("main.pipeline.first", 0),
            &[("out", d(14_u32))],
        ),
        line(
            (3.ms(), 0),
            ("main.pipeline.second", 0),
            &[("out", d(70_u32))],
        ),
        line((3.ms(), 0), ("main", 1), &[("seen", d(70_u32))]),
    ];
    assert_eq!(ran.traces, [expected.concat()]);
}

/// Says its index, times the factor.
#[reactor]
struct Member {
    #[param]
    factor: usize,
    #[bank_index]
    index: usize,
    go: Input<()>,
    out: Output<u64>,
}

#[reactions]
impl Member {
    #[reaction]
    fn say(&mut self, _go: &Input<()>, out: &mut Output<u64>) {
        out.set((self.index * self.factor) as u64);
    }
}

/// A bank of members, told to go together, read together.
#[reactor]
struct Choir {
    #[param]
    size: usize,
    go: Output<()>,
    #[child(|index| Member { factor: 10 + index })]
    #[width = size]
    members: Bank<Member>,
    #[width = size]
    outs: Multi<Output<u64>>,
    total: Output<u64>,
}

#[reactions]
impl Choir {
    #[connections]
    fn wire(
        &self,
        wiring: &mut Wiring,
        go: &Output<()>,
        members: &Bank<Member>,
        outs: &Multi<Output<u64>>,
    ) {
        assert_eq!(members.len(), self.size);
        wiring.broadcast(go, &members.all(|member| &member.go));
        wiring.connect(&members.all(|member| &member.out), outs);
    }

    #[reaction]
    fn begin(&mut self, _: &Startup, go: &mut Output<()>) {
        go.set(());
    }

    #[reaction]
    fn listen(
        &mut self,
        #[of(members.all(|member| &member.out))] said: &Multi<Input<u64>>,
        #[of(members[1].out)] one: &Input<u64>,
        total: &mut Output<u64>,
    ) {
        assert_eq!(one.get(), Some(&11));
        total.set(said.present().map(|(_, value)| *value).sum());
    }
}

#[test]
fn members_of_a_bank_know_their_index() {
    let ran = World::new(&[Class::of::<Choir>()])
        .federate("choir", "Choir", r#"{ "size": 3 }"#)
        .run();
    assert_eq!(ran.fault, None);
    let say = |index: u64| {
        let path = format!("choir.members[{index}]");
        line((0.ms(), 0), (&path, 0), &[("out", d(index * (10 + index)))])
    };
    let expected = [
        line((0.ms(), 0), ("choir", 0), &[("go", d(()))]),
        say(0),
        say(1),
        say(2),
        line((0.ms(), 0), ("choir", 1), &[("total", d(11_u64 + 24))]),
    ];
    assert_eq!(ran.traces, [expected.concat()]);
}

/// A generic reactor: hands values on at once.
#[reactor]
struct Wire<T: Value> {
    input: Input<T>,
    out: Output<T>,
}

#[reactions]
impl<T: Value> Wire<T> {
    #[reaction]
    fn hand_on(&mut self, input: &Input<T>, out: &mut Output<T>) {
        if let Some(value) = input.get() {
            out.set(value.clone());
        }
    }
}

/// Uses a generic child.
#[reactor]
struct Texts {
    #[child]
    wire: Child<Wire<String>>,
}

#[reactions]
impl Texts {
    #[reaction]
    fn begin(&mut self, _: &Startup, #[of(wire.input)] input: &mut Output<String>) {
        input.set("hello".to_owned());
    }

    #[reaction]
    fn hear(&mut self, #[of(wire.out)] text: &Input<String>) {
        assert_eq!(text.get().map(String::as_str), Some("hello"));
    }
}

#[test]
fn reactors_may_be_generic() {
    let ran = World::of(Class::of::<Texts>()).run();
    assert_eq!(ran.fault, None);
    assert_eq!(ran.traces[0].lines().count(), 3);
}
