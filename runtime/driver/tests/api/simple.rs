//! One reactor: timers, state, ports, actions.

use crate::harness::World;
use ictus::Class;
use ictus::prelude::*;

#[reactor]
pub struct Counter {
    #[param(default = 100.ms())]
    period: Duration,
    #[timer(period = period)]
    tick: Timer,
    reset: Input<bool>,
    out: Output<u64>,
    #[action(min_delay = 5.ms())]
    later: LogicalAction<u32>,
    count: u64,
}

#[reactions]
impl Counter {
    #[reaction]
    fn clear(&mut self, reset: &Input<bool>) {
        if reset.get() == Some(&true) {
            self.count = 0;
        }
    }

    #[reaction(deadline = 5.ms(), late = Self::too_late)]
    fn count(
        &mut self,
        ctx: &mut Ctx,
        _tick: &Timer,
        #[uses] reset: &Input<bool>,
        out: &mut Output<u64>,
        later: &mut LogicalAction<u32>,
    ) {
        self.count += 1;
        assert!(!reset.is_present());
        assert_eq!(ctx.path(), "main");
        out.set(self.count);
        later.schedule(1.ms(), 7);
    }

    fn too_late(
        &mut self,
        _: &mut Ctx,
        _: &Timer,
        _: &Input<bool>,
        out: &mut Output<u64>,
        _: &mut LogicalAction<u32>,
    ) {
        out.set(0);
    }

    #[reaction]
    fn begin(&mut self, _: &Startup) {}

    #[reaction]
    fn act(&mut self, ctx: &mut Ctx, later: &LogicalAction<u32>) {
        assert_eq!(later.get(), Some(&7));
        log!(ctx, "later at {}", ctx.elapsed());
    }

    #[reaction]
    fn end(&mut self, _: &Shutdown) {}
}

#[test]
fn a_counter_counts() {
    let ran = World::of(Class::of::<Counter>()).timeout(200.ms()).run();
    assert_eq!(ran.fault, None);
    assert_eq!(ran.traces[0], "");
}
