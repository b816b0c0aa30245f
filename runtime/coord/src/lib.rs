//! Federated coordination as state machines: wire codec, RTI, federate. Pure.

pub mod describe;
mod payload;
pub mod plan;
pub mod report;
pub mod wire;

pub use payload::{FederateExecutor, PayloadError};
