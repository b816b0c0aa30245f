//! The Autoware reference system: 24 nodes of six kinds that exchange messages of 4096 bytes.
//!
//! Source: ros-realtime/reference-system at de8f3bc. Time stamps are logical, so that two runs send the same bytes.

mod message;

use ictus::prelude::*;
use message::{History, Message4kb};
use std::time::Instant;

/// Publishes on its timer.
#[reactor]
struct Sensor {
    #[param]
    period: Duration,
    #[timer(period = period)]
    tick: Timer,
    out: Output<Message4kb>,
    history: History,
}

#[reactions]
impl Sensor {
    #[reaction]
    fn tick(&mut self, ctx: &mut Ctx, _tick: &Timer, out: &mut Output<Message4kb>) {
        let mut message = Message4kb::default();
        self.history.sign(&mut message, ctx);
        out.set(message);
    }
}

/// Works on every input and publishes the result.
#[reactor]
struct Transform {
    #[param(default = 200.us())]
    work: Duration,
    input: Input<Message4kb>,
    out: Output<Message4kb>,
    history: History,
}

#[reactions]
impl Transform {
    #[reaction]
    fn on_input(&mut self, ctx: &mut Ctx, input: &Input<Message4kb>, out: &mut Output<Message4kb>) {
        busy(self.work);
        if let Some(message) = input.get() {
            out.set(self.history.pass_on(message, ctx));
        }
    }
}

/// Keeps each input; when it has both, works, publishes them merged, and begins again.
#[reactor]
struct Fusion {
    #[param(default = 200.us())]
    work: Duration,
    first: Input<Message4kb>,
    second: Input<Message4kb>,
    out: Output<Message4kb>,
    kept: [Option<Box<Message4kb>>; 2],
    history: History,
}

#[reactions]
impl Fusion {
    #[reaction]
    fn on_first(&mut self, ctx: &mut Ctx, first: &Input<Message4kb>, out: &mut Output<Message4kb>) {
        self.keep(0, first, ctx, out);
    }

    #[reaction]
    fn on_second(
        &mut self,
        ctx: &mut Ctx,
        second: &Input<Message4kb>,
        out: &mut Output<Message4kb>,
    ) {
        self.keep(1, second, ctx, out);
    }

    fn keep(
        &mut self,
        place: usize,
        input: &Input<Message4kb>,
        ctx: &Ctx,
        out: &mut Output<Message4kb>,
    ) {
        self.kept[place] = input.get().copied().map(Box::new);
        if let [Some(first), Some(second)] = &self.kept {
            busy(self.work);
            let mut message = **first;
            message.merge(second);
            self.history.sign(&mut message, ctx);
            out.set(message);
            self.kept = [None, None];
        }
    }
}

/// Keeps the latest of each input; on its timer works, publishes what it has, merged, and begins again.
///
/// The timer's reaction stands first: at a tag that has both, the timer does not see the inputs of that tag.
#[reactor]
struct Cyclic {
    #[param(default = 100.ms())]
    period: Duration,
    #[param(default = 200.us())]
    work: Duration,
    #[timer(period = period)]
    tick: Timer,
    #[width = 6]
    inputs: Multi<Input<Message4kb>>,
    out: Output<Message4kb>,
    kept: [Option<Box<Message4kb>>; 6],
    history: History,
}

#[reactions]
impl Cyclic {
    #[reaction]
    fn tick(&mut self, ctx: &mut Ctx, _tick: &Timer, out: &mut Output<Message4kb>) {
        busy(self.work);
        let mut message = Message4kb::default();
        for kept in &mut self.kept {
            if let Some(kept) = kept.take() {
                message.merge(&kept);
            }
        }
        self.history.sign(&mut message, ctx);
        out.set(message);
    }

    #[reaction]
    fn on_0(&mut self, #[of(inputs[0])] input: &Input<Message4kb>) {
        self.keep(0, input);
    }

    #[reaction]
    fn on_1(&mut self, #[of(inputs[1])] input: &Input<Message4kb>) {
        self.keep(1, input);
    }

    #[reaction]
    fn on_2(&mut self, #[of(inputs[2])] input: &Input<Message4kb>) {
        self.keep(2, input);
    }

    #[reaction]
    fn on_3(&mut self, #[of(inputs[3])] input: &Input<Message4kb>) {
        self.keep(3, input);
    }

    #[reaction]
    fn on_4(&mut self, #[of(inputs[4])] input: &Input<Message4kb>) {
        self.keep(4, input);
    }

    #[reaction]
    fn on_5(&mut self, #[of(inputs[5])] input: &Input<Message4kb>) {
        self.keep(5, input);
    }

    fn keep(&mut self, place: usize, input: &Input<Message4kb>) {
        self.kept[place] = input.get().copied().map(Box::new);
    }
}

/// Two transforms in one node.
#[reactor]
struct Intersection {
    #[param(default = 200.us())]
    work: Duration,
    first: Input<Message4kb>,
    second: Input<Message4kb>,
    first_out: Output<Message4kb>,
    second_out: Output<Message4kb>,
    histories: [History; 2],
}

#[reactions]
impl Intersection {
    #[reaction]
    fn on_first(
        &mut self,
        ctx: &mut Ctx,
        first: &Input<Message4kb>,
        first_out: &mut Output<Message4kb>,
    ) {
        busy(self.work);
        if let Some(message) = first.get() {
            first_out.set(self.histories[0].pass_on(message, ctx));
        }
    }

    #[reaction]
    fn on_second(
        &mut self,
        ctx: &mut Ctx,
        second: &Input<Message4kb>,
        second_out: &mut Output<Message4kb>,
    ) {
        busy(self.work);
        if let Some(message) = second.get() {
            second_out.set(self.histories[1].pass_on(message, ctx));
        }
    }
}

/// Records what arrives.
#[reactor]
struct Command {
    input: Input<Message4kb>,
    received: u64,
    history: History,
}

#[reactions]
impl Command {
    #[reaction]
    fn on_input(&mut self, input: &Input<Message4kb>) {
        self.received += 1;
        if let Some(message) = input.get() {
            self.history.missed(message);
        }
    }

    #[reaction]
    fn report(&mut self, ctx: &mut Ctx, _: &Shutdown) {
        let dropped = self.history.dropped();
        log!(ctx, "{} messages, {dropped} dropped", self.received);
    }
}

/// Occupies the processor for a physical time.
fn busy(work: Duration) {
    let start = Instant::now();
    while start.elapsed() < work.to_std() {
        std::hint::spin_loop();
    }
}

ictus::program![Sensor, Transform, Fusion, Cyclic, Intersection, Command];
