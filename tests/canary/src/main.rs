//! A federation with a race on purpose, and one that breaks: `ictus verify` and `ictus up` must say so.

use ictus::prelude::*;
use secret::Keeper;
use time::{Beat, Ear, Guard, Stamped};

mod secret;
mod time;

/// Sends what no reaction should: a value that depends on physical time.
#[reactor]
pub struct Racer {
    #[timer(period = 10.ms())]
    tick: Timer,
    out: Output<i64>,
}

#[reactions]
impl Racer {
    #[reaction]
    fn tick(&mut self, ctx: &mut Ctx, _tick: &Timer, out: &mut Output<i64>) {
        out.set(ctx.physical_time().as_nanos());
    }
}

/// Counts ticks and panics at one of them.
#[reactor]
pub struct Faulty {
    #[param(default = 5)]
    at: u64,
    #[timer(period = 10.ms())]
    tick: Timer,
    out: Output<u64>,
    ticks: u64,
}

#[reactions]
impl Faulty {
    #[reaction]
    fn tick(&mut self, _tick: &Timer, out: &mut Output<u64>) {
        self.ticks += 1;
        assert!(
            self.ticks != self.at,
            "tick {} was the last straw",
            self.ticks
        );
        out.set(self.ticks);
    }
}

/// Takes readings and does nothing with them.
#[reactor]
pub struct Watcher {
    input: Input<i64>,
    seen: u64,
}

#[reactions]
impl Watcher {
    #[reaction]
    fn watch(&mut self, _input: &Input<i64>) {
        self.seen += 1;
    }
}

/// Takes counts and does nothing with them.
#[reactor]
pub struct Counter {
    input: Input<u64>,
    seen: u64,
}

#[reactions]
impl Counter {
    #[reaction]
    fn count(&mut self, _input: &Input<u64>) {
        self.seen += 1;
    }
}

ictus::program![
    Racer, Faulty, Watcher, Counter, Beat, Ear, Guard, Stamped, Keeper
];
