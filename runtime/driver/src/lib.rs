//! Deterministic reactors, alone or federated: what a federate program depends on.
//!
//! A reactor is a struct. `#[reactor]` sorts its fields: parameters and state stay in the struct, ports, timers, actions
//! and children go where only signatures reach. `#[reactions]` turns methods into reactions: **the signature is the
//! declaration**. What a reaction reads by `&` triggers it, what it takes by `&mut` it may set or schedule, and
//! what it does not name it cannot touch.
//!
//! ```
//! use ictus::prelude::*;
//!
//! /// Counts; a `reset` of `true` begins again.
//! #[reactor]
//! pub struct Counter {
//!     #[param(default = 100.ms())]
//!     period: Duration,
//!     #[timer(period = period)]
//!     tick: Timer,
//!     reset: Input<bool>,
//!     out: Output<u64>,
//!     count: u64,
//! }
//!
//! #[reactions]
//! impl Counter {
//!     #[reaction]
//!     fn reset(&mut self, reset: &Input<bool>) {
//!         if reset.get() == Some(&true) {
//!             self.count = 0;
//!         }
//!     }
//!
//!     #[reaction(deadline = 5.ms(), late = Self::too_late)]
//!     fn count(&mut self, _: &mut Ctx, _tick: &Timer, out: &mut Output<u64>) {
//!         self.count += 1;
//!         out.set(self.count);
//!     }
//!
//!     fn too_late(&mut self, ctx: &mut Ctx, _: &Timer, _: &mut Output<u64>) {
//!         log!(ctx, "late by {}", ctx.lag());
//!     }
//! }
//!
//! ictus::program![Counter];
//! ```
//!
//! The last line is the program's `main`: its binary runs any part of a plan in which its classes occur, alone or as a
//! federate, and says what it consists of (`--describe`).
//!
//! Reactions of one reactor run in the order of the block; reactors at one tag run in the order of their
//! connections. So the same inputs give the same outputs at the same tags, in one process or in many.
//!
//! # Nested reactors
//!
//! ```
//! # use ictus::prelude::*;
//! #[reactor]
//! pub struct Stage {
//!     #[param]
//!     gain: f64,
//!     input: Input<f64>,
//!     out: Output<f64>,
//! }
//!
//! #[reactions]
//! impl Stage {
//!     #[reaction]
//!     fn scale(&mut self, input: &Input<f64>, out: &mut Output<f64>) {
//!         if let Some(value) = input.get() {
//!             out.set(self.gain * value);
//!         }
//!     }
//! }
//!
//! #[reactor]
//! pub struct Filter {
//!     input: Input<f64>,
//!     #[child(Stage { gain: 0.5 })]
//!     first: Child<Stage>,
//!     #[child(|i| Stage { gain: 1.0 + i as f64 })]
//!     #[width = 3]
//!     stages: Bank<Stage>,
//!     largest: Output<f64>,
//! }
//!
//! #[reactions]
//! impl Filter {
//!     #[connections]
//!     fn wire(c: &mut Wiring, input: &Input<f64>, first: &Child<Stage>, stages: &Bank<Stage>) {
//!         c.connect(input, &first.input);
//!         c.broadcast(&first.out, &stages.all(|stage| &stage.input)).after(5.ms());
//!     }
//!
//!     #[reaction]
//!     fn pick(
//!         &mut self,
//!         #[of(stages.all(|stage| &stage.out))] values: &Multi<Input<f64>>,
//!         largest: &mut Output<f64>,
//!     ) {
//!         let values = values.present().map(|(_, value)| *value);
//!         largest.set(values.fold(f64::MIN, f64::max));
//!     }
//! }
//! # fn main() {}
//! ```
//!
//! # Events from outside
//!
//! ```
//! # use ictus::prelude::*;
//! #[reactor]
//! pub struct Keyboard {
//!     #[action(min_spacing = 1.ms())]
//!     key: PhysicalAction<u8>,
//!     typed: Output<u8>,
//! }
//!
//! #[reactions]
//! impl Keyboard {
//!     #[reaction]
//!     fn start(&mut self, _: &Startup, #[uses] key: &PhysicalAction<u8>) {
//!         let sender = key.sender();
//!         std::thread::spawn(move || {
//!             // Ends with the program: then `schedule` returns an error.
//!             while sender.schedule(b'x').is_ok() {
//!                 std::thread::park();
//!             }
//!         });
//!     }
//!
//!     #[reaction]
//!     fn on_key(&mut self, key: &PhysicalAction<u8>, typed: &mut Output<u8>) {
//!         if let Some(key) = key.get() {
//!             typed.set(*key);
//!         }
//!     }
//! }
//! # fn main() {}
//! ```
//!
//! # Faults that a reactor can handle
//!
//! A reaction that starts too late runs its deadline handler (`late`), one that a tardy message led to its STP handler (`stp`).
//! A watchdog needs no tag: its handler runs at a physical time, also while the federate waits for others.
//!
//! ```
//! # use ictus::prelude::*;
//! #[reactor]
//! pub struct Brake {
//!     distance: Input<f64>,
//!     #[watchdog(timeout = 200.ms())]
//!     silence: Watchdog,
//!     #[action(min_spacing = 10.ms(), policy = drop)]
//!     alarm: PhysicalAction<()>,
//!     force: Output<f64>,
//! }
//!
//! #[reactions]
//! impl Brake {
//!     #[reaction(deadline = 5.ms(), late = Self::full, stp = Self::tardy)]
//!     fn brake(
//!         &mut self,
//!         _: &mut Ctx,
//!         distance: &Input<f64>,
//!         silence: &mut Watchdog,
//!         force: &mut Output<f64>,
//!     ) {
//!         silence.start(0.ms());
//!         force.set(distance.get().map_or(1.0, |distance| 1.0 / distance));
//!     }
//!
//!     fn full(&mut self, _: &mut Ctx, _: &Input<f64>, _: &mut Watchdog, force: &mut Output<f64>) {
//!         force.set(1.0);
//!     }
//!
//!     fn tardy(&mut self, ctx: &mut Ctx, _: &Input<f64>, _: &mut Watchdog, force: &mut Output<f64>) {
//!         log!(ctx, "due at {}, handled at {}", ctx.intended(), ctx.tag());
//!         force.set(1.0);
//!     }
//!
//!     #[watchdog(silence)]
//!     fn silent(&mut self, alarm: &mut PhysicalAction<()>) {
//!         alarm.schedule(());
//!     }
//!
//!     #[reaction]
//!     fn alarm(&mut self, _alarm: &PhysicalAction<()>, force: &mut Output<f64>) {
//!         force.set(1.0);
//!     }
//! }
//! # fn main() {}
//! ```
//!
//! # What does not compile
//!
//! An output that the signature does not name:
//!
//! ```compile_fail
//! # use ictus::prelude::*;
//! #[reactor]
//! struct Silent { input: Input<u32>, out: Output<u32> }
//!
//! #[reactions]
//! impl Silent {
//!     #[reaction]
//!     fn leak(&mut self, input: &Input<u32>) {
//!         self.out.set(1); // no field `out`
//!     }
//! }
//! # fn main() {}
//! ```
//!
//! A port that does not exist, or has another type:
//!
//! ```compile_fail
//! # use ictus::prelude::*;
//! # #[reactor]
//! # struct Relay { input: Input<u32>, out: Output<u32> }
//! #[reactions]
//! impl Relay {
//!     #[reaction]
//!     fn misspelt(&mut self, inptu: &Input<u32>) {}
//! }
//! # fn main() {}
//! ```
//!
//! ```compile_fail
//! # use ictus::prelude::*;
//! # #[reactor]
//! # struct Relay { input: Input<u32>, out: Output<u32> }
//! #[reactions]
//! impl Relay {
//!     #[reaction]
//!     fn mistyped(&mut self, input: &Input<u64>) {}
//! }
//! # fn main() {}
//! ```
//!
//! A connection between ports of different types, a child without a required parameter, a native value that holds a
//! pointer:
//!
//! ```compile_fail
//! # use ictus::prelude::*;
//! # #[reactor]
//! # struct Source { out: Output<u32> }
//! # #[reactions]
//! # impl Source {}
//! #[reactor]
//! struct Top {
//!     #[child]
//!     source: Child<Source>,
//!     text: Output<String>,
//! }
//!
//! #[reactions]
//! impl Top {
//!     #[connections]
//!     fn wire(c: &mut Wiring, source: &Child<Source>, text: &Output<String>) {
//!         c.connect(&source.out, text);
//!     }
//! }
//! # fn main() {}
//! ```
//!
//! ```compile_fail
//! # use ictus::prelude::*;
//! # #[reactor]
//! # struct Stage { #[param] gain: u32 }
//! # #[reactions]
//! # impl Stage {}
//! #[reactor]
//! struct Top {
//!     #[child(Stage {})]
//!     stage: Child<Stage>,
//! }
//! # #[reactions]
//! # impl Top {}
//! # fn main() {}
//! ```
//!
//! ```compile_fail
//! # use ictus::prelude::*;
//! #[derive(Clone, Value)]
//! #[value(native)]
//! struct Named { name: String }
//! # fn main() {}
//! ```

//!
//! An output in the handler of a watchdog, which runs at no tag:
//!
//! ```compile_fail
//! # use ictus::prelude::*;
//! #[reactor]
//! struct Guarded {
//!     #[watchdog(timeout = 1.ms())]
//!     guard: Watchdog,
//!     out: Output<u32>,
//! }
//!
//! #[reactions]
//! impl Guarded {
//!     #[watchdog(guard)]
//!     fn silent(&mut self, out: &mut Output<u32>) {}
//! }
//! # fn main() {}
//! ```
//!
//! An STP handler with other arguments than its reaction; a policy for events that are never too soon:
//!
//! ```compile_fail
//! # use ictus::prelude::*;
//! # #[reactor]
//! # struct Sink { input: Input<u32> }
//! #[reactions]
//! impl Sink {
//!     #[reaction(stp = Self::tardy)]
//!     fn take(&mut self, input: &Input<u32>) {}
//!
//!     fn tardy(&mut self) {}
//! }
//! # fn main() {}
//! ```
//!
//! ```compile_fail
//! # use ictus::prelude::*;
//! #[reactor]
//! struct Keyboard {
//!     #[action(policy = drop)]
//!     key: PhysicalAction<u8>,
//! }
//!
//! #[reactions]
//! impl Keyboard {}
//! # fn main() {}
//! ```

extern crate self as ictus;

mod access;
mod action;
mod args;
mod assembly;
mod bodies;
mod carrier;
mod class;
mod clock;
mod clock_sync;
mod ctx;
pub mod describe;
mod linker;
mod observe;
mod outside;
mod parameters;
mod peers;
mod port;
mod reactor;
mod run;
mod scope;
#[cfg(feature = "simulate")]
pub mod simulate;
mod slot;
mod status;
mod transport;
pub mod value;
mod watchdog;
mod wiring;

pub use action::{LogicalAction, PhysicalAction, PhysicalSender, Shutdown, Startup, Timer};
pub use assembly::{Assembly, AssemblyError};
pub use bodies::{Bodies, Counters, Fault};
pub use class::Class;
pub use clock::{Clock, SystemClock};
pub use clock_sync::ClockRefusal;
pub use ctx::Ctx;
pub use ictus_core::{Duration, DurationExt, LogicalTime, PhysicalTime, Tag};
pub use ictus_macros::{Value, reactions, reactor};
pub use observe::Observation;
pub use outside::{Outside, OutsideEvent, SendError};
pub use port::{Input, Multi, Output};
pub use reactor::{Bank, Child};
pub use run::{RunError, main_with};
pub use value::Value;
pub use watchdog::{Fired, Watchdog};
pub use wiring::{End, Link, Wiring};

/// The `main` of a program whose manifests may name these classes: `ictus::program![Camera, Planner];`.
#[macro_export]
macro_rules! program {
    ($($class:ty),+ $(,)?) => {
        fn main() -> ::std::process::ExitCode {
            $crate::main_with(&[$($crate::Class::of::<$class>()),+])
        }
    };
}

/// What the macros use, for writing reactors by hand.
pub mod build {
    pub use crate::access::{
        Access, Args, Declaration, Item, Outcome, Readable, Role, Writable, effect, trigger,
        trigger_and_effect, uses,
    };
    pub use crate::linker::Linker;
    pub use crate::parameters::{Complete, Missing, ParameterError, ParameterSource, parameter};
    pub use crate::reactor::{Reactions, Reactor};
    pub use crate::scope::{Case, Handlers, ReactionScope, Scope, WiringError};
    pub use crate::slot::Epoch;
    #[doc(hidden)]
    pub use crate::value::{put_front, take_front};
    pub use ictus_coord::describe::ParameterDescription;
    pub use ictus_core::{Spacing, SpacingPolicy};
}

/// Everything that a file with reactors needs.
pub mod prelude {
    pub use crate::{
        Bank, Child, Ctx, Duration, DurationExt, Input, LogicalAction, LogicalTime, Multi, Output,
        PhysicalAction, PhysicalSender, PhysicalTime, Shutdown, Startup, Tag, Timer, Value,
        Watchdog, Wiring, log, reactions, reactor,
    };
}
