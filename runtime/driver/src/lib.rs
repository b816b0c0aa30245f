//! Deterministic reactors, alone or federated: what a federate program depends on.

mod args;
mod assembly;
mod bodies;
mod class;
mod clock;
mod describe;
mod outside;
mod run;
mod status;
mod transport;

pub use assembly::{Assembly, AssemblyError};
pub use bodies::{Bodies, Counters, Fault, Observation};
pub use class::Class;
pub use clock::{Clock, SystemClock};
pub use outside::{Outside, OutsideEvent};
pub use run::{RunError, main_with};
