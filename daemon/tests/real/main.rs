//! The daemon and its supervisors as real processes. Waits are on streams and pidfds, with a bound each.
#![allow(
    clippy::unwrap_used,
    clippy::panic,
    clippy::wildcard_enum_match_arm,
    clippy::print_stderr,
    clippy::too_many_lines,
    missing_docs,
    reason = "tests"
)]

mod daemon;
mod docker;
mod metrics;
mod needs;
mod parts;
mod supervisor;
mod world;
