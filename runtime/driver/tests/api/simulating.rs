//! The simulated world around real reactors.

use ictus::prelude::*;
use ictus::simulate::{Federation, FederationError, SimulateError};
use serde_json::json;

/// Asks, and answers at the tag at which the answer comes.
#[reactor]
struct Asker {
    #[timer(period = 10.ms())]
    tick: Timer,
    ask: Output<u64>,
    answer: Input<u64>,
    heard: Output<u64>,
    asked: u64,
}

#[reactions]
impl Asker {
    #[reaction]
    fn ask(&mut self, _tick: &Timer, ask: &mut Output<u64>) {
        self.asked += 1;
        ask.set(self.asked);
    }

    #[reaction]
    fn hear(&mut self, answer: &Input<u64>, heard: &mut Output<u64>) {
        assert_eq!(answer.get(), Some(&(2 * self.asked)));
        heard.set(self.asked);
    }
}

#[reactor]
struct Doubler {
    input: Input<u64>,
    out: Output<u64>,
}

#[reactions]
impl Doubler {
    #[reaction]
    fn double(&mut self, input: &Input<u64>, out: &mut Output<u64>) {
        out.set(2 * input.get().copied().unwrap_or_default());
    }
}

/// Stops the federation at the third value; panics at `panic_at`.
#[reactor]
struct Judge {
    #[param(default = 0)]
    panic_at: u64,
    input: Input<u64>,
    seen: u64,
}

#[reactions]
impl Judge {
    #[reaction]
    fn judge(&mut self, ctx: &mut Ctx, input: &Input<u64>) {
        self.seen += u64::from(input.is_present());
        assert!(self.seen != self.panic_at, "the last straw");
        if self.seen == 3 {
            ctx.request_stop();
        }
    }
}

fn asking(panic_at: u64) -> Federation {
    Federation::new()
        .federate::<Asker>("asker", json!({}))
        .federate::<Doubler>("doubler", json!({}))
        .federate::<Judge>("judge", json!({"panic_at": panic_at}))
        .connect("asker.ask", "doubler.input", None)
        .connect("doubler.out", "asker.answer", None)
        .connect("asker.heard", "judge.input", Some(Duration::ZERO))
}

#[test]
fn a_cycle_without_delay_gives_the_same_trace_whatever_the_network() {
    let federation = asking(0).timeout(15.ms());
    let alone = federation.alone().unwrap();
    assert_eq!(alone.of("judge").count(), 2, "{alone}");
    for seed in 0..40 {
        assert_eq!(federation.simulate(seed).unwrap(), alone, "seed {seed}");
    }
}

#[test]
fn equal_seeds_give_equal_runs_and_a_stop_ends_them() {
    let federation = asking(0).timeout(10.secs());
    for seed in [1, 2, 3] {
        let first = federation.simulate(seed).unwrap();
        assert_eq!(first, federation.simulate(seed).unwrap());
        assert!(first.of("judge").count() >= 3, "{first}");
        assert!(
            first.records().len() < 1_000,
            "stopped long before the time-out"
        );
    }
}

#[test]
fn a_panic_names_the_reaction() {
    let federation = asking(2).timeout(1.secs());
    for result in [federation.alone(), federation.simulate(7)] {
        let Err(SimulateError::Reaction(fault)) = result else {
            panic!("{result:?}");
        };
        assert_eq!(
            (fault.path.as_str(), fault.reaction.as_str()),
            ("judge", "judge")
        );
        assert!(
            fault.message.contains("the last straw"),
            "{}",
            fault.message
        );
    }
}

#[test]
fn mistakes_are_named() {
    let federation = asking(0).connect("asker.ask", "nobody.input", None);
    let error = federation.simulate(0).unwrap_err();
    assert!(
        matches!(&error, SimulateError::Federation(FederationError::End { end, .. }) if end == "nobody.input"),
        "{error}"
    );
    let error = asking(0).simulate(0).unwrap_err();
    assert!(error.to_string().contains("no time-out"), "{error}");
    let federation = asking(0).timeout(1.secs());
    let loops = federation.connect("doubler.out", "doubler.input", None);
    let words = |result: Result<_, SimulateError>| result.unwrap_err().to_string();
    let (alone, simulated) = (
        words(loops.alone().map(|_| ())),
        words(loops.simulate(1).map(|_| ())),
    );
    assert_eq!(alone, simulated);
    let federation = Federation::new().federate::<Judge>("judge", json!(3));
    assert!(
        federation
            .alone()
            .unwrap_err()
            .to_string()
            .contains("judge: parameters")
    );
    let federation = asking(0)
        .timeout(1.secs())
        .connect("asker.asked", "judge.input", None);
    assert!(
        federation
            .alone()
            .unwrap_err()
            .to_string()
            .contains("no output `asked`")
    );
}
