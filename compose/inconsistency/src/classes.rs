//! The federation: a source with two outputs, a node on each of their ways, and a planner where they meet.

use crate::order::{Orders, Step};
use ictus::prelude::*;
use std::io::Write;
use std::time::Instant;

/// A state report or a kinematic state of the vehicle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Value)]
#[value(native)]
pub(crate) struct Message {
    /// Counts sequences from 0.
    pub(crate) sequence: u32,
    /// The number of its [`Step`].
    pub(crate) step: u8,
}

/// Sends drive, +v, reverse, -v, one `period` after the other, and again after a pause.
#[reactor]
pub(crate) struct Source {
    #[param(default = 1.ms())]
    period: Duration,
    /// From the last message of a sequence to the first of the next.
    #[param(default = 500.us())]
    pause: Duration,
    #[param]
    sequences: u32,
    #[action]
    next: LogicalAction<()>,
    report: Output<Message>,
    kinematic: Output<Message>,
    sequence: u32,
    #[state(init = Step::Drive)]
    step: Step,
}

#[reactions]
impl Source {
    #[reaction]
    fn begin(&mut self, _: &Startup, next: &mut LogicalAction<()>) {
        if self.sequences > 0 {
            next.schedule(self.pause, ());
        }
    }

    #[reaction]
    fn send(
        &mut self,
        #[trigger] next: &mut LogicalAction<()>,
        report: &mut Output<Message>,
        kinematic: &mut Output<Message>,
    ) {
        let message = Message {
            sequence: self.sequence,
            step: self.step.number(),
        };
        if self.step.is_report() {
            report.set(message);
        } else {
            kinematic.set(message);
        }
        if let Some(step) = Step::from_number(message.step + 1) {
            self.step = step;
            next.schedule(self.period, ());
        } else {
            self.step = Step::Drive;
            self.sequence += 1;
            if self.sequence < self.sequences {
                next.schedule(self.pause, ());
            }
        }
    }
}

/// Works for a random time on every message, then passes it on at the same tag.
#[reactor]
pub(crate) struct Node {
    /// Where the random times begin; the same seed gives the same times.
    #[param]
    seed: u64,
    #[param(default = 100.us())]
    max_work: Duration,
    input: Input<Message>,
    out: Output<Message>,
    #[state(init = Random::new(seed))]
    random: Random,
}

#[reactions]
impl Node {
    #[reaction]
    fn relay(&mut self, input: &Input<Message>, out: &mut Output<Message>) {
        busy(self.random.up_to(self.max_work));
        if let Some(message) = input.get() {
            out.set(*message);
        }
    }
}

/// A sequence of which all messages have come.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Value)]
#[value(native)]
pub(crate) struct Verdict {
    /// The rank of the order in which they came; 0 is right.
    order: u8,
    /// Whether the planner was told that one was tardy.
    told: bool,
}

/// Reads both, and counts in which order the messages of a sequence come.
#[reactor]
pub(crate) struct Planner {
    report: Input<Message>,
    kinematic: Input<Message>,
    verdict: Output<Verdict>,
    orders: Orders,
}

#[reactions]
impl Planner {
    #[reaction(stp = Self::on_tardy_report)]
    fn on_report(&mut self, report: &Input<Message>, verdict: &mut Output<Verdict>) {
        self.note(report, verdict, false);
    }

    #[reaction(stp = Self::on_tardy_kinematic)]
    fn on_kinematic(&mut self, kinematic: &Input<Message>, verdict: &mut Output<Verdict>) {
        self.note(kinematic, verdict, false);
    }

    fn on_tardy_report(&mut self, report: &Input<Message>, verdict: &mut Output<Verdict>) {
        self.note(report, verdict, true);
    }

    fn on_tardy_kinematic(&mut self, kinematic: &Input<Message>, verdict: &mut Output<Verdict>) {
        self.note(kinematic, verdict, true);
    }

    #[reaction]
    fn end(&mut self, _: &Shutdown) {
        say(&self.orders);
    }
}

impl Planner {
    fn note(&mut self, input: &Input<Message>, verdict: &mut Output<Verdict>, tardy: bool) {
        let Some(message) = input.get() else { return };
        let Some(step) = Step::from_number(message.step) else {
            return;
        };
        if let Some((order, told)) = self.orders.note(message.sequence, step, tardy) {
            verdict.set(Verdict {
                order: order.rank(),
                told,
            });
        }
    }
}

/// Says what was counted, as one line of JSON on standard output.
pub(crate) fn say(orders: &Orders) {
    if let Ok(line) = serde_json::to_string(&orders.tally()) {
        // Without a reader there is nobody to tell.
        drop(writeln!(std::io::stdout(), "{line}"));
    }
}

/// Occupies the processor for a physical time.
pub(crate) fn busy(work: Duration) {
    let start = Instant::now();
    while start.elapsed() < work.to_std() {
        std::hint::spin_loop();
    }
}

/// Random numbers that are the same on every machine.
///
/// Source: Steele, Lea, Flood, "Fast splittable pseudorandom number generators" (`SplitMix64`).
#[derive(Debug)]
pub(crate) struct Random {
    state: u64,
}

impl Random {
    /// The numbers of a seed.
    pub(crate) const fn new(seed: u64) -> Self {
        Self { state: seed }
    }

    fn next(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut x = self.state;
        x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        x ^ (x >> 31)
    }

    /// Uniform between zero and `most`, to the nanosecond.
    pub(crate) fn up_to(&mut self, most: Duration) -> Duration {
        let range = u128::from(most.as_nanos().max(0).unsigned_abs()) + 1;
        let drawn = (u128::from(self.next()) * range) >> 64;
        Duration::from_nanos(i64::try_from(drawn).unwrap_or(0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ictus::simulate::Federation;
    use serde_json::json;

    /// Stops the test at the first sequence in a wrong order of which the planner was not told.
    #[reactor]
    struct Judge {
        verdict: Input<Verdict>,
    }

    #[reactions]
    impl Judge {
        #[reaction]
        fn judge(&mut self, verdict: &Input<Verdict>) {
            let Verdict { order, told } = verdict.get().unwrap();
            assert!(*order == 0 || *told, "nobody was told of order {order}");
        }
    }

    fn federation(period: &str) -> Federation {
        let node = |seed: u64| json!({"seed": seed, "max_work": "0 ms"});
        let source = json!({"period": period, "pause": "500 us", "sequences": 20});
        Federation::new()
            .federate::<Source>("source", source)
            .federate::<Node>("vehicle", node(1))
            .federate::<Node>("localizer", node(2))
            .federate::<Planner>("planner", json!({}))
            .federate::<Judge>("judge", json!({}))
            .connect("source.report", "vehicle.input", None)
            .connect("source.kinematic", "localizer.input", None)
            .connect("vehicle.out", "planner.report", None)
            .connect("localizer.out", "planner.kinematic", None)
            .connect("planner.verdict", "judge.verdict", None)
            .timeout(3.secs())
    }

    #[test]
    fn every_network_keeps_the_order_of_every_sequence() {
        for period in ["1 ns", "10 us", "10 ms"] {
            let federation = federation(period);
            let alone = federation.alone().unwrap();
            assert_eq!(alone.of("judge").count(), 20, "{alone}");
            assert_eq!(alone.of("planner").count(), 4 * 20 + 1, "{alone}");
            for seed in 0..20 {
                assert_eq!(federation.simulate(seed).unwrap(), alone, "seed {seed}");
            }
        }
    }

    #[test]
    fn no_error_without_a_tardy_message() {
        let (mut tardy, mut judged) = (0, 0);
        for (offset, seeds) in [(0.ms(), 0..30), (5.ms(), 30..40)] {
            let federation = federation("10 us").decentralized(offset);
            for seed in seeds {
                let trace = federation.simulate(seed).unwrap();
                let handled = |record: &&str| record.contains("\tstp\t");
                tardy += trace.of("planner").filter(handled).count();
                judged += trace.of("judge").count();
            }
        }
        assert!(
            tardy > 100 && judged > 100,
            "{tardy} were tardy, {judged} judged"
        );
    }

    #[test]
    fn long_offsets_keep_the_order() {
        let federation = federation("10 us").decentralized(60.secs());
        let alone = federation.alone().unwrap();
        for seed in 0..5 {
            assert_eq!(federation.simulate(seed).unwrap(), alone, "seed {seed}");
        }
    }
}
