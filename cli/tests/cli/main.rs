//! The command line as people meet it: a cleared environment, a private state directory, real processes.
#![allow(
    clippy::unwrap_used,
    clippy::panic,
    missing_docs,
    reason = "tests stop at the first surprise"
)]

mod environment;
mod golden;
mod life;
mod metrics;
