//! Deterministic reactors, alone or federated: what a federate program depends on.

extern crate self as ictus;

mod access;
mod action;
mod args;
mod assembly;
mod bodies;
mod carrier;
mod class;
mod clock;
mod ctx;
pub mod describe;
mod linker;
mod observe;
mod outside;
mod parameters;
mod port;
mod reactor;
mod run;
mod scope;
mod slot;
mod status;
mod transport;
pub mod value;
mod wiring;

pub use action::{LogicalAction, PhysicalAction, PhysicalSender, Shutdown, Startup, Timer};
pub use assembly::{Assembly, AssemblyError};
pub use bodies::{Bodies, Counters, Fault};
pub use class::Class;
pub use clock::{Clock, SystemClock};
pub use ctx::Ctx;
pub use ictus_core::{Duration, DurationExt, LogicalTime, PhysicalTime, Tag};
pub use ictus_macros::{Value, reactions, reactor};
pub use observe::Observation;
pub use outside::{Outside, OutsideEvent, SendError};
pub use port::{Input, Multi, Output};
pub use reactor::{Bank, Child};
pub use run::{RunError, main_with};
pub use value::Value;
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
    pub use crate::parameters::{Missing, ParameterError, ParameterSource, parameter};
    pub use crate::reactor::{Reactions, Reactor};
    pub use crate::scope::{ReactionScope, Scope, WiringError};
    pub use crate::slot::Epoch;
    #[doc(hidden)]
    pub use crate::value::{put_front, take_front};
    pub use ictus_coord::describe::ParameterDescription;
}

/// Everything that a file with reactors needs.
pub mod prelude {
    pub use crate::{
        Bank, Child, Ctx, Duration, DurationExt, Input, LogicalAction, LogicalTime, Multi, Output,
        PhysicalAction, PhysicalSender, PhysicalTime, Shutdown, Startup, Tag, Timer, Value, Wiring,
        log, reactions, reactor,
    };
}
