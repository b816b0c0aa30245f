//! Simulated network, clocks, hosts and faults with checkers; one seed drives all. Pure.

pub mod clock;
pub mod clocks;
pub mod coverage;
pub mod executor;
pub mod network;
pub mod observer;
pub mod offsets;
pub mod plan;
pub mod program;
pub mod reference;
pub mod scenario;
pub mod seed;
pub mod swarm;
pub mod world;
