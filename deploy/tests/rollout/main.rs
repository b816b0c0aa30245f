//! Plan and apply over several hosts: what is planned and refused, what failures mean, and both in a world of simulated
//! hosts that lose messages, restart and are changed by others.

#![expect(
    clippy::unwrap_used,
    clippy::panic,
    clippy::too_many_lines,
    clippy::semicolon_if_nothing_returned,
    reason = "a test stops at the first surprise; tables are as long as what they list"
)]

mod applying;
mod desired;
mod outcomes;
mod planning;
mod simulation;
