//! Two reactor classes. `federation.yaml` says which federates are made of them and how they are connected.

use ictus::prelude::*;

/// Counts and sends the count every period.
#[reactor]
pub struct Counter {
    #[param(default = 100.ms())]
    period: Duration,
    #[timer(period = period)]
    tick: Timer,
    out: Output<u64>,
    count: u64,
}

#[reactions]
impl Counter {
    #[reaction]
    fn tick(&mut self, _tick: &Timer, out: &mut Output<u64>) {
        self.count += 1;
        out.set(self.count);
    }
}

/// Logs what it receives.
#[reactor]
pub struct Display {
    value: Input<u64>,
}

#[reactions]
impl Display {
    #[reaction]
    fn on_value(&mut self, ctx: &mut Ctx, value: &Input<u64>) {
        if let Some(count) = value.get() {
            log!(ctx, "received {count}");
        }
    }
}

ictus::program![Counter, Display];
