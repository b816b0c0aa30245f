//! The reactors that are measured.

use ictus::prelude::*;
use serde_json::json;
use std::io::Write;

/// Says a result to the harness, one line of JSON on standard output.
fn report(result: &serde_json::Value) {
    // The harness reads to the end of the stream; without a reader there is nobody to tell.
    drop(writeln!(std::io::stdout(), "{result}"));
}

/// Resident memory at its peak, in KiB.
fn peak_kib() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find(|line| line.starts_with("VmHWM:"));
    line.and_then(|l| l.split_whitespace().nth(1))
        .and_then(|n| n.parse().ok())
        .unwrap_or(0)
}

/// How many things happened between two readings of the clock.
#[derive(Default)]
struct Meter {
    first: Option<PhysicalTime>,
    last: Option<PhysicalTime>,
    count: u64,
}

impl Meter {
    fn begin(&mut self, ctx: &Ctx) {
        self.first.get_or_insert_with(|| ctx.physical_time());
    }

    fn end(&mut self, ctx: &Ctx) {
        self.last = Some(ctx.physical_time());
    }

    fn rate(&self) -> f64 {
        let (Some(first), Some(last)) = (self.first, self.last) else {
            return 0.0;
        };
        crate::floor::rate(self.count, last.since(first).to_std())
    }
}

/// Sends `count` numbers, one a tag, tags `gap` apart, as fast as it may.
#[reactor]
pub(crate) struct Flood {
    #[param(default = 1)]
    count: u32,
    #[param(default = 1.us())]
    gap: Duration,
    out: Output<u32>,
    #[action(min_delay = gap)]
    next: LogicalAction<()>,
    sent: u32,
}

#[reactions]
impl Flood {
    #[reaction]
    fn begin(&mut self, _: &Startup, next: &mut LogicalAction<()>) {
        next.schedule(Duration::ZERO, ());
    }

    #[reaction]
    fn send(&mut self, #[trigger] next: &mut LogicalAction<()>, out: &mut Output<u32>) {
        out.set(self.sent);
        self.sent += 1;
        if self.sent < self.count {
            next.schedule(Duration::ZERO, ());
        }
    }

    #[reaction]
    fn end(&mut self, _: &Shutdown) {
        report(&json!({"sent": self.sent, "peak_kib": peak_kib()}));
    }
}

/// Passes numbers on at their own tag.
#[reactor]
pub(crate) struct Relay {
    input: Input<u32>,
    out: Output<u32>,
}

#[reactions]
impl Relay {
    #[reaction]
    fn relay(&mut self, input: &Input<u32>, out: &mut Output<u32>) {
        if let Some(number) = input.get() {
            out.set(*number);
        }
    }
}

/// Checks that `count` numbers come in sequence.
#[reactor]
pub(crate) struct Sink {
    #[param(default = 1)]
    count: u64,
    input: Input<u32>,
    meter: Meter,
}

#[reactions]
impl Sink {
    #[reaction]
    fn take(&mut self, ctx: &mut Ctx, input: &Input<u32>) {
        self.meter.begin(ctx);
        assert_eq!(
            input.get().copied().map(u64::from),
            Some(self.meter.count),
            "in sequence"
        );
        self.meter.count += 1;
        if self.meter.count == self.count {
            self.meter.end(ctx);
        }
    }

    #[reaction]
    fn end(&mut self, _: &Shutdown) {
        assert_eq!(self.meter.count, self.count, "nothing is lost");
        report(&json!({"rate": self.meter.rate(), "peak_kib": peak_kib()}));
    }
}

/// Checks that two sequences of `count` numbers arrive aligned: one of each at every tag.
#[reactor]
pub(crate) struct Merge {
    #[param(default = 1)]
    count: u64,
    first: Input<u32>,
    second: Input<u32>,
    meter: Meter,
}

#[reactions]
impl Merge {
    #[reaction]
    fn take(&mut self, ctx: &mut Ctx, first: &Input<u32>, second: &Input<u32>) {
        self.meter.begin(ctx);
        assert_eq!(first.get(), second.get(), "aligned");
        assert_eq!(
            first.get().copied().map(u64::from),
            Some(self.meter.count / 2),
            "in sequence"
        );
        self.meter.count += 2;
        if self.meter.count == 2 * self.count {
            self.meter.end(ctx);
        }
    }

    #[reaction]
    fn end(&mut self, _: &Shutdown) {
        assert_eq!(self.meter.count, 2 * self.count, "nothing is lost");
        report(&json!({"rate": self.meter.rate(), "peak_kib": peak_kib()}));
    }
}

/// Sends the clock's reading every millisecond, `count` times.
#[reactor]
pub(crate) struct Paced {
    #[param(default = 1)]
    count: u64,
    #[timer(offset = 50.ms(), period = 1.ms())]
    tick: Timer,
    out: Output<i64>,
    sent: u64,
}

#[reactions]
impl Paced {
    #[reaction]
    fn send(&mut self, ctx: &mut Ctx, _tick: &Timer, out: &mut Output<i64>) {
        out.set(ctx.physical_time().as_nanos());
        self.sent += 1;
        if self.sent == self.count {
            ctx.request_stop();
        }
    }
}

/// Measures how old the readings are when they arrive.
#[reactor]
pub(crate) struct LatencySink {
    input: Input<i64>,
    ages: Vec<i64>,
}

#[reactions]
impl LatencySink {
    #[reaction]
    fn take(&mut self, ctx: &mut Ctx, input: &Input<i64>) {
        let now = ctx.physical_time().as_nanos();
        self.ages.extend(input.get().map(|sent| now - sent));
    }

    #[reaction]
    fn end(&mut self, _: &Shutdown) {
        self.ages.sort_unstable();
        let at = |index: usize| self.ages.get(index).copied();
        let count = self.ages.len();
        report(&json!({"p50_ns": at(count / 2), "p99_ns": at(count * 99 / 100), "count": count}));
    }
}

/// Serves `count` balls, each at a tag of its own, and takes them back.
#[reactor]
pub(crate) struct Ping {
    #[param(default = 1)]
    count: u64,
    input: Input<u32>,
    out: Output<u32>,
    #[action]
    serve: LogicalAction<()>,
    meter: Meter,
}

#[reactions]
impl Ping {
    #[reaction]
    fn begin(&mut self, ctx: &mut Ctx, _: &Startup, serve: &mut LogicalAction<()>) {
        self.meter.begin(ctx);
        serve.schedule(Duration::ZERO, ());
    }

    #[reaction]
    fn serve(&mut self, _serve: &LogicalAction<()>, out: &mut Output<u32>) {
        out.set(7);
    }

    #[reaction]
    fn back(&mut self, ctx: &mut Ctx, _input: &Input<u32>, serve: &mut LogicalAction<()>) {
        self.meter.count += 1;
        if self.meter.count < self.count {
            serve.schedule(Duration::ZERO, ());
        } else {
            self.meter.end(ctx);
        }
    }

    #[reaction]
    fn end(&mut self, _: &Shutdown) {
        report(&json!({"rate": self.meter.rate(), "peak_kib": peak_kib()}));
    }
}

/// Returns balls at once.
#[reactor]
pub(crate) struct Pong {
    input: Input<u32>,
    out: Output<u32>,
}

#[reactions]
impl Pong {
    #[reaction]
    fn back(&mut self, input: &Input<u32>, out: &mut Output<u32>) {
        if let Some(ball) = input.get() {
            out.set(*ball);
        }
    }
}

/// Sets its output at `count` tags.
#[reactor]
pub(crate) struct Fan {
    #[param(default = 1)]
    count: u64,
    out: Output<u32>,
    #[action]
    next: LogicalAction<()>,
    meter: Meter,
    sent: u64,
}

#[reactions]
impl Fan {
    #[reaction]
    fn begin(&mut self, ctx: &mut Ctx, _: &Startup, next: &mut LogicalAction<()>) {
        self.meter.begin(ctx);
        next.schedule(Duration::ZERO, ());
    }

    #[reaction]
    fn send(
        &mut self,
        ctx: &mut Ctx,
        #[trigger] next: &mut LogicalAction<()>,
        out: &mut Output<u32>,
    ) {
        out.set(3);
        self.sent += 1;
        if self.sent < self.count {
            next.schedule(Duration::ZERO, ());
        } else {
            self.meter.end(ctx);
        }
    }

    #[reaction]
    fn end(&mut self, _: &Shutdown) {
        // Ten sinks and the source itself run at each tag.
        self.meter.count = self.sent * 11;
        report(&json!({"rate": self.meter.rate(), "peak_kib": peak_kib()}));
    }
}

/// One of the ten.
#[reactor]
pub(crate) struct FanSink {
    input: Input<u32>,
    sum: u64,
}

#[reactions]
impl FanSink {
    #[reaction]
    fn take(&mut self, input: &Input<u32>) {
        self.sum += input.get().copied().map_or(0, u64::from);
    }
}
