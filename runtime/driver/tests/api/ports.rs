//! Ports: present and absent, triggers and uses, order within a reactor, multiports.

use crate::harness::{World, d, line};
use ictus::Class;
use ictus::prelude::*;

/// Sets `first` at every tick and `second` at every other.
#[reactor]
struct Source {
    #[timer(period = 10.ms())]
    tick: Timer,
    first: Output<u32>,
    second: Output<u32>,
    count: u32,
}

#[reactions]
impl Source {
    #[reaction]
    fn tick(&mut self, _tick: &Timer, first: &mut Output<u32>, second: &mut Output<u32>) {
        self.count += 1;
        first.set(self.count);
        if self.count.is_multiple_of(2) {
            second.set(10 * self.count);
        }
    }
}

/// Runs for `first` only and adds what it sees.
#[reactor]
struct Adder {
    first: Input<u32>,
    second: Input<u32>,
    sum: Output<u32>,
}

#[reactions]
impl Adder {
    #[reaction]
    fn add(&mut self, first: &Input<u32>, #[uses] second: &Input<u32>, sum: &mut Output<u32>) {
        sum.set(first.get().unwrap() + second.get().unwrap_or(&0));
    }
}

#[test]
fn a_used_input_is_read_and_does_not_trigger() {
    let ran = World::new(&[Class::of::<Source>(), Class::of::<Adder>()])
        .federate("source", "Source", "{}")
        .federate("adder", "Adder", "{}")
        .connect("source.first", "adder.first", None)
        .connect("source.second", "adder.second", None)
        .timeout(20.ms())
        .run();
    let (zero, ten, twenty) = (0.ms(), 10.ms(), 20.ms());
    let source = [
        line((zero, 0), ("source", 0), &[("first", d(1_u32))]),
        line(
            (ten, 0),
            ("source", 0),
            &[("first", d(2_u32)), ("second", d(20_u32))],
        ),
        line((twenty, 0), ("source", 0), &[("first", d(3_u32))]),
    ];
    let adder = [
        line((zero, 0), ("adder", 0), &[("sum", d(1_u32))]),
        line((ten, 0), ("adder", 0), &[("sum", d(22_u32))]),
        line((twenty, 0), ("adder", 0), &[("sum", d(3_u32))]),
    ];
    assert_eq!(ran.traces, [source.concat(), adder.concat()]);
}

/// Reactions of one reactor run in declared order; the last value set wins.
#[reactor]
struct Overwriting {
    out: Output<u32>,
}

#[reactions]
impl Overwriting {
    #[reaction]
    fn twice(&mut self, _: &Startup, out: &mut Output<u32>) {
        out.set(1);
        out.set(2);
    }

    #[reaction]
    fn again(&mut self, _: &Startup, out: &mut Output<u32>) {
        out.set(3);
    }

    #[reaction]
    fn read(&mut self, #[of(out)] value: &Input<u32>) {
        assert_eq!(value.get(), Some(&3));
    }
}

#[test]
fn the_last_value_set_wins() {
    let ran = World::of(Class::of::<Overwriting>()).run();
    assert_eq!(ran.fault, None);
    let expected = [
        line((0.ms(), 0), ("main", 0), &[("out", d(2_u32))]),
        line((0.ms(), 0), ("main", 1), &[("out", d(3_u32))]),
        line((0.ms(), 0), ("main", 2), &[]),
    ];
    assert_eq!(ran.traces, [expected.concat()]);
}

/// Sets the channels whose bit is set in the count.
#[reactor]
struct Scatter {
    #[param]
    width: usize,
    #[timer(period = 1.ms())]
    tick: Timer,
    #[width = width]
    outs: Multi<Output<u32>>,
    count: u32,
}

#[reactions]
impl Scatter {
    #[reaction]
    fn tick(&mut self, _tick: &Timer, outs: &mut Multi<Output<u32>>) {
        for (channel, out) in outs.iter_mut().enumerate() {
            if self.count >> channel & 1 == 1 {
                out.set(self.count);
            }
        }
        self.count += 1;
    }
}

/// Says which channels are present, as bits.
#[reactor]
struct Gather {
    #[param]
    width: usize,
    #[width = width]
    ins: Multi<Input<u32>>,
    bits: Output<u32>,
}

#[reactions]
impl Gather {
    #[reaction]
    fn gather(&mut self, ins: &Multi<Input<u32>>, bits: &mut Output<u32>) {
        let mut present = 0;
        for (channel, value) in ins.present() {
            assert_eq!(ins[channel].get(), Some(value));
            present |= 1 << channel;
        }
        assert_eq!(ins.len(), self.width);
        bits.set(present);
    }
}

#[test]
fn channels_of_a_multiport_are_present_each_by_itself() {
    let ran = World::new(&[Class::of::<Scatter>(), Class::of::<Gather>()])
        .federate("scatter", "Scatter", r#"{ "width": 2 }"#)
        .federate("gather", "Gather", r#"{ "width": 2 }"#)
        .connect("scatter.outs[0]", "gather.ins[1]", None)
        .connect("scatter.outs[1]", "gather.ins[0]", None)
        .timeout(3.ms())
        .run();
    assert_eq!(ran.fault, None);
    let scatter = [
        line((0.ms(), 0), ("scatter", 0), &[]),
        line((1.ms(), 0), ("scatter", 0), &[("outs[0]", d(1_u32))]),
        line((2.ms(), 0), ("scatter", 0), &[("outs[1]", d(2_u32))]),
        line(
            (3.ms(), 0),
            ("scatter", 0),
            &[("outs[0]", d(3_u32)), ("outs[1]", d(3_u32))],
        ),
    ];
    let gather = [
        line((1.ms(), 0), ("gather", 0), &[("bits", d(2_u32))]),
        line((2.ms(), 0), ("gather", 0), &[("bits", d(1_u32))]),
        line((3.ms(), 0), ("gather", 0), &[("bits", d(3_u32))]),
    ];
    assert_eq!(ran.traces, [scatter.concat(), gather.concat()]);
}
