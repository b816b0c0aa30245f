//! Federated coordination as state machines: wire codec, RTI, federate. Pure.

pub mod auth;
pub mod clock;
pub mod describe;
pub mod federate;
pub mod measure;
#[doc(hidden)]
pub mod mutants;
mod payload;
pub mod plan;
pub mod report;
pub mod rti;
pub mod silence;
pub mod stp;
pub mod topology;
pub mod wire;

pub use payload::{FederateExecutor, PayloadError};
