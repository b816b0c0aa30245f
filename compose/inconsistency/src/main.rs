//! In which order messages of one source arrive that go over two ways.
//!
//! The federation is in `federation.yaml`; `sweep` runs it in every coordination over periods and STP offsets, and the same
//! over MQTT (feature `mqtt`). Called with `--plan` this is an ordinary federate program.
//!
//! Source: Xronos, arXiv 2207.09555, Section III (node-to-node inconsistency) and Figure 8.

mod chart;
mod classes;
#[cfg(feature = "mqtt")]
mod contrast;
mod harness;
mod order;
mod part;
mod sweep;

use clap::{Parser, Subcommand};
use classes::{Node, Planner, Source};
use ictus::Class;
use std::ffi::OsString;
use std::io::Write;
use std::process::ExitCode;

/// In which order do messages of one source arrive that go over two ways?
#[derive(Debug, Parser)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Sweep(sweep::Sweep),
    /// A program of the contrast over MQTT
    #[cfg(feature = "mqtt")]
    #[command(hide = true)]
    Mqtt(contrast::Program),
}

fn main() -> ExitCode {
    let args: Vec<OsString> = std::env::args_os().skip(1).collect();
    if args
        .iter()
        .any(|arg| arg == "--plan" || arg == "--describe")
    {
        return ictus::main_with(&[
            Class::of::<Source>(),
            Class::of::<Node>(),
            Class::of::<Planner>(),
        ]);
    }
    if args.first().is_some_and(|arg| arg == harness::RTI) {
        return ictus_rti::run(args.into_iter().skip(1));
    }
    let said = match Cli::parse().command {
        Command::Sweep(sweep) => sweep.run().map_err(|error| error.to_string()),
        #[cfg(feature = "mqtt")]
        Command::Mqtt(program) => program.run().map_err(|error| error.to_string()),
    };
    let Err(error) = said else {
        return ExitCode::SUCCESS;
    };
    // Nobody reads standard error: the exit code still tells.
    drop(writeln!(std::io::stderr(), "inconsistency: {error}"));
    ExitCode::FAILURE
}
