//! What reactors mean: one module a subject.
#![allow(
    clippy::unwrap_used,
    clippy::panic,
    missing_docs,
    missing_debug_implementations,
    unreachable_pub,
    reason = "tests may fail loudly and are not documented item by item"
)]

mod assembling;
mod deadlines;
mod failures;
mod harness;
mod hierarchy;
mod observing;
mod physical;
mod ports;
#[cfg(feature = "simulate")]
mod simulating;
mod spacing;
mod stp;
mod time;
mod values;
mod watchdogs;
