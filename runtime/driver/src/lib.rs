//! Deterministic reactors, alone or federated: what a federate program depends on.

mod assembly;
mod bodies;
mod class;
mod clock;
mod outside;

pub use assembly::{Assembly, AssemblyError};
pub use bodies::{Bodies, Counters, Fault, Observation};
pub use class::Class;
pub use clock::Clock;
pub use outside::{Outside, OutsideEvent};
