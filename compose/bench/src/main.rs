//! Throughput and latency of federations and programs, each beside its floor of the same run.
//!
//! `ictus bench` builds and runs this. Called with `--plan` it is an ordinary federate program.

mod classes;
mod clock;
mod floor;
mod harness;
mod rti;
mod table;

use classes::{Fan, FanSink, Flood, LatencySink, Merge, Paced, Ping, Pong, Relay, Sink};
use ictus::Class;
use std::process::ExitCode;

fn main() -> ExitCode {
    let federate = std::env::args().any(|arg| arg == "--plan" || arg == "--describe");
    if federate {
        return ictus::main_with(&[
            Class::of::<Flood>(),
            Class::of::<Relay>(),
            Class::of::<Sink>(),
            Class::of::<Merge>(),
            Class::of::<Paced>(),
            Class::of::<LatencySink>(),
            Class::of::<Ping>(),
            Class::of::<Pong>(),
            Class::of::<Fan>(),
            Class::of::<FanSink>(),
            Class::of::<clock::Watcher>(),
        ]);
    }
    let mut args = std::env::args().skip(1).peekable();
    if args.next_if(|arg| arg == "clock").is_some() {
        return clock::main(args);
    }
    table::main()
}
