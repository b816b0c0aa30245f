//! The `ictus` command: a skin over ictus-deploy and the daemon's API. By the names `ictusd` and `ictus-rti` it is
//! the daemon and the RTI.

use std::process::ExitCode;

mod args;
mod commands;
mod error;
mod files;
mod history;
mod hosts;
mod interrupts;
mod rollout;
mod runs;
mod secrets;
mod session;
mod stack;
mod ui;

fn main() -> ExitCode {
    args::dispatch(std::env::args_os().collect())
}
