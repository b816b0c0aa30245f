//! The RTI as a server: sockets around [`ictus_coord::rti`].
//!
//! One thread reads every ready socket at line rate, lets the state machine decide once per round, and writes what it has
//! put together: nothing here decides anything. `ictus rti` is [`run`]; [`Server`] serves tests and benches.

use std::ffi::OsString;
use std::io::Write;
use std::process::ExitCode;

use ictus_coord::report::exit;

pub mod options;
mod outlet;
mod probing;
mod server;
mod socket;
pub mod status;

pub use options::{Command, Options, UsageError};
pub use server::{BindError, Server};
pub use status::Status;

/// Runs the RTI with LF's command line (without the program's name) until its federation has ended.
///
/// SIGTERM and SIGINT ask for an ordered stop; a second one fails the federation. Messages for people go to standard
/// error, status lines to the descriptor of `--status-fd`. Exit codes: [`exit`].
pub fn run(arguments: impl IntoIterator<Item = OsString>) -> ExitCode {
    let mut stderr = std::io::stderr();
    let options = match Options::parse(arguments) {
        Ok(Command::Run(options)) => *options,
        Ok(Command::Print(text)) => {
            let printed = writeln!(std::io::stdout(), "{text}");
            return ExitCode::from(if printed.is_ok() {
                exit::OK
            } else {
                exit::FAILED
            });
        }
        Err(error) => return fail(&mut stderr, &error, exit::USAGE),
    };
    let status = match Status::open(options.status_fd) {
        Ok(status) => status,
        Err(error) => return fail(&mut stderr, &error, exit::USAGE),
    };
    let server = Server::bind(&options, status).and_then(Server::with_signals);
    match server.and_then(Server::run) {
        Ok(code) => ExitCode::from(code),
        Err(error) => fail(&mut stderr, &error, exit::FAILED),
    }
}

fn fail(out: &mut impl Write, error: &dyn std::error::Error, code: u8) -> ExitCode {
    // Nobody is left to tell when standard error is gone.
    let _unwritten = writeln!(out, "ictus rti: {error}");
    ExitCode::from(code)
}
