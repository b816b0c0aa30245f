//! Federated coordination as state machines: wire codec, RTI, federate. Pure.

pub mod describe;
pub mod plan;
pub mod report;
pub mod wire;
