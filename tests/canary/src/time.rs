//! Federates whose timing is wrong on purpose: what comes too late, and what never comes.

use ictus::prelude::*;
use std::time::Instant;

/// Sends a count every period, after working for a while: so long is its message on the way at least.
#[reactor]
pub struct Beat {
    #[param(default = 20.ms())]
    period: Duration,
    #[param(default = 0.ms())]
    work: Duration,
    #[timer(period = period)]
    tick: Timer,
    out: Output<u64>,
    ticks: u64,
}

#[reactions]
impl Beat {
    #[reaction]
    fn tick(&mut self, _tick: &Timer, out: &mut Output<u64>) {
        let start = Instant::now();
        while start.elapsed() < self.work.to_std() {
            std::hint::spin_loop();
        }
        self.ticks += 1;
        out.set(self.ticks);
    }
}

/// Hears counts at its own pace: the tags of its timer are those of the sender's.
#[reactor]
pub struct Ear {
    #[param(default = 20.ms())]
    period: Duration,
    #[timer(period = period)]
    tick: Timer,
    input: Input<u64>,
    heard: u64,
    tardy: u64,
}

#[reactions]
impl Ear {
    #[reaction]
    fn tick(&mut self, _tick: &Timer) {}

    #[reaction(stp = Self::late)]
    fn hear(&mut self, _ctx: &mut Ctx, input: &Input<u64>) {
        self.heard += u64::from(input.is_present());
    }

    fn late(&mut self, ctx: &mut Ctx, input: &Input<u64>) {
        assert!(ctx.intended() < ctx.tag(), "it should have come earlier");
        self.tardy += u64::from(input.is_present());
    }

    #[reaction]
    fn report(&mut self, ctx: &mut Ctx, _: &Shutdown) {
        log!(ctx, "heard {} in time and {} tardy", self.heard, self.tardy);
    }
}

/// Says when it has heard nothing for a while, by its clock, although no tag may have advanced.
#[reactor]
pub struct Guard {
    #[param(default = 200.ms())]
    patience: Duration,
    input: Input<u64>,
    #[watchdog(timeout = patience)]
    silence: Watchdog,
    #[action]
    alarm: PhysicalAction<()>,
    silences: u64,
}

#[reactions]
impl Guard {
    #[reaction]
    fn hear(&mut self, _input: &Input<u64>, silence: &mut Watchdog) {
        silence.start(Duration::ZERO);
    }

    #[watchdog(silence)]
    fn silent(&mut self, ctx: &mut Ctx, alarm: &mut PhysicalAction<()>) {
        self.silences += 1;
        log!(ctx, "silence {}", self.silences);
        alarm.schedule(());
    }

    #[reaction]
    fn raise(&mut self, ctx: &mut Ctx, #[trigger] _alarm: &PhysicalAction<()>) {
        log!(ctx, "alarm {}", self.silences);
    }
}

/// Takes counts over a physical connection: their tags come from its own clock.
#[reactor]
pub struct Stamped {
    input: Input<u64>,
    heard: u64,
    early: u64,
}

#[reactions]
impl Stamped {
    #[reaction]
    fn hear(&mut self, ctx: &mut Ctx, input: &Input<u64>) {
        self.heard += u64::from(input.is_present());
        // A tag of the receiver's clock is not ahead of it.
        self.early += u64::from(ctx.lag() < Duration::ZERO);
    }

    #[reaction]
    fn report(&mut self, ctx: &mut Ctx, _: &Shutdown) {
        log!(ctx, "heard {}, {} early", self.heard, self.early);
    }
}
