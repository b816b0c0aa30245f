//! The step between fork and the program: takes its limits, binds its life to the supervisor's, then becomes it.
//!
//! `PR_SET_PDEATHSIG` has to be called in the new process, and without `unsafe` that needs an executable of
//! ours in between. Its standard input is a pipe to the supervisor, which reads why the program could not be
//! executed, or nothing when it was.

use std::ffi::OsString;
use std::fs::File;
use std::io::{self, Write};
use std::os::fd::OwnedFd;
use std::os::unix::process::CommandExt;
use std::process::{Command, ExitCode, Stdio};

use super::limits::Limits;
use super::process;
use rustix::process::{Signal, getppid, set_parent_process_death_signal};

/// The command's name: `ictus supervise-exec SUPERVISOR_PID LIMITS PROGRAM ARGS...`, where LIMITS are [`Limits`] as JSON.
pub const COMMAND: &str = "supervise-exec";

/// Becomes the program. Returns only when it could not.
pub fn exec(mut args: impl Iterator<Item = OsString>) -> ExitCode {
    let supervisor = args
        .next()
        .and_then(|pid| pid.to_str()?.parse::<i32>().ok());
    let limits = args.next().and_then(|limits| {
        let limits = serde_json::from_str::<Limits>(limits.to_str()?);
        limits.ok()
    });
    let (Some(supervisor), Some(limits), Some(program)) = (supervisor, limits, args.next()) else {
        return ExitCode::from(64);
    };
    // Closed by a successful exec, which is how the supervisor learns of it.
    let Ok(report) = rustix::io::fcntl_dupfd_cloexec(io::stdin(), 3) else {
        return ExitCode::FAILURE;
    };
    // Before the bond, which another user would lose.
    if let Err(why) = limits.apply() {
        return say(report, &why);
    }
    let error = match set_parent_process_death_signal(Some(Signal::KILL)) {
        // A supervisor that died before the call sends no signal any more.
        Ok(()) if getppid().map(|pid| pid.as_raw_nonzero().get()) == Some(supervisor) => {
            let mut command = Command::new(&program);
            if program == process::own_executable() {
                command.arg0("ictus");
            }
            command.args(args).stdin(Stdio::null()).exec()
        }
        Ok(()) => return ExitCode::FAILURE,
        Err(error) => io::Error::from(error),
    };
    say(report, &error.to_string())
}

fn say(report: OwnedFd, why: &str) -> ExitCode {
    match write!(File::from(report), "{why}") {
        Ok(()) | Err(_) => ExitCode::FAILURE,
    }
}
