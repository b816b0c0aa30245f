//! The diamond: A feeds B and C, which feed D; B and C take a random time, D keeps the order all the same.
//!
//! Source: the running example of "Deterministic Execution of ROS 2 Applications via Lingua Franca",
//! arXiv 2606.09203v1, Section III.

use ictus::prelude::*;
use std::time::Instant;

/// What A measures and everybody passes on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Value)]
#[value(native)]
pub struct Sample {
    /// Counts A's ticks from 1.
    tick: u64,
    /// Logical time of the tick since the start.
    measured: Duration,
}

/// Takes a sample every period and sends it along both branches.
#[reactor]
pub struct A {
    #[param(default = 100.ms())]
    period: Duration,
    #[param(default = 1.ms())]
    work: Duration,
    #[timer(period = period)]
    tick: Timer,
    alpha: Output<Sample>,
    beta: Output<Sample>,
    ticks: u64,
}

#[reactions]
impl A {
    #[reaction]
    fn tick(
        &mut self,
        ctx: &mut Ctx,
        _tick: &Timer,
        alpha: &mut Output<Sample>,
        beta: &mut Output<Sample>,
    ) {
        busy(self.work);
        self.ticks += 1;
        let sample = Sample {
            tick: self.ticks,
            measured: ctx.elapsed(),
        };
        alpha.set(sample);
        beta.set(sample);
    }
}

/// Works for a random time on every sample: B and C.
#[reactor]
pub struct Worker {
    /// Where the random times begin; the same seed gives the same times.
    #[param]
    seed: u64,
    #[param(default = 10.ms())]
    max_work: Duration,
    input: Input<Sample>,
    out: Output<Sample>,
    #[state(init = Random { state: seed })]
    random: Random,
}

#[reactions]
impl Worker {
    #[reaction]
    fn on_input(&mut self, input: &Input<Sample>, out: &mut Output<Sample>) {
        busy(self.random.up_to(self.max_work));
        if let Some(sample) = input.get() {
            out.set(*sample);
        }
    }
}

/// Handles gamma before delta, at the same tag, on every tick.
#[reactor]
pub struct D {
    #[param(default = 1.ms())]
    work: Duration,
    gamma: Input<Sample>,
    delta: Input<Sample>,
    /// Ticks seen on gamma, and how many of them were met by delta at the same tag.
    pairs: u64,
    latest: u64,
}

#[reactions]
impl D {
    #[reaction]
    fn on_gamma(&mut self, gamma: &Input<Sample>) {
        busy(self.work);
        self.latest = gamma.get().map_or(0, |sample| sample.tick);
    }

    #[reaction]
    fn on_delta(&mut self, delta: &Input<Sample>) {
        busy(self.work);
        self.pairs += u64::from(delta.get().is_some_and(|s| s.tick == self.latest));
    }

    #[reaction]
    fn report(&mut self, ctx: &mut Ctx, _: &Shutdown) {
        log!(ctx, "{} of {} ticks in order", self.pairs, self.latest);
    }
}

/// Occupies the processor for a physical time.
fn busy(work: Duration) {
    let start = Instant::now();
    while start.elapsed() < work.to_std() {
        std::hint::spin_loop();
    }
}

/// Random numbers that are the same on every machine.
///
/// Source: Steele, Lea, Flood, "Fast splittable pseudorandom number generators" (`SplitMix64`).
#[derive(Debug)]
struct Random {
    state: u64,
}

impl Random {
    fn next(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut x = self.state;
        x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        x ^ (x >> 31)
    }

    /// Uniform between zero and `most`, to the nanosecond.
    fn up_to(&mut self, most: Duration) -> Duration {
        let range = u128::from(most.as_nanos().max(0).unsigned_abs()) + 1;
        let drawn = (u128::from(self.next()) * range) >> 64;
        Duration::from_nanos(i64::try_from(drawn).unwrap_or(0))
    }
}

ictus::program![A, Worker, D];

#[cfg(test)]
mod tests {
    use super::*;
    use ictus::simulate::Federation;
    use serde_json::json;

    #[test]
    fn every_network_gives_the_trace_of_one_process() {
        for half in [0.ms(), 5.ms()] {
            let work = json!({"work": "0 ms"});
            let worker = |seed: u64| json!({"seed": seed, "max_work": "0 ms"});
            let federation = Federation::new()
                .federate::<A>("a", work.clone())
                .federate::<Worker>("b", worker(1))
                .federate::<Worker>("c", worker(2))
                .federate::<D>("d", work)
                .connect("a.alpha", "b.input", Some(half))
                .connect("a.beta", "c.input", Some(half))
                .connect("b.out", "d.gamma", Some(half))
                .connect("c.out", "d.delta", Some(half))
                .timeout(1.secs());
            let alone = federation.alone().unwrap();
            assert_eq!(alone.of("d").count(), 2 * 10 + 1, "{alone}");
            for seed in 0..30 {
                assert_eq!(federation.simulate(seed).unwrap(), alone, "seed {seed}");
            }
        }
    }

    #[test]
    fn random_times_are_uniform_and_repeat() {
        let draw = || {
            let mut random = Random { state: 1 };
            (0..1_000)
                .map(|_| random.up_to(10.ms()))
                .collect::<Vec<_>>()
        };
        let times = draw();
        assert_eq!(times, draw());
        assert!(times.iter().all(|t| *t >= Duration::ZERO && *t <= 10.ms()));
        let mean = times.iter().map(|t| t.as_nanos()).sum::<i64>() / 1_000;
        assert!((4_500_000..5_500_000).contains(&mean), "{mean}");
    }
}
