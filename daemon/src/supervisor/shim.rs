//! The step between fork and the program: binds its life to the supervisor's, then becomes it.
//!
//! `PR_SET_PDEATHSIG` has to be called in the new process, and without `unsafe` that needs an executable of
//! ours in between. Its standard input is a pipe to the supervisor, which reads why the program could not be
//! executed, or nothing when it was.

use std::ffi::OsString;
use std::fs::File;
use std::io::{self, Write};
use std::os::unix::process::CommandExt;
use std::process::{Command, ExitCode, Stdio};

use super::process;
use rustix::process::{Signal, getppid, set_parent_process_death_signal};

/// The command's name: `ictus supervise-exec SUPERVISOR_PID PROGRAM ARGS...`.
pub const COMMAND: &str = "supervise-exec";

/// Becomes the program. Returns only when it could not.
pub fn exec(mut args: impl Iterator<Item = OsString>) -> ExitCode {
    let supervisor = args
        .next()
        .and_then(|pid| pid.to_str()?.parse::<i32>().ok());
    let (Some(supervisor), Some(program)) = (supervisor, args.next()) else {
        return ExitCode::from(64);
    };
    // Closed by a successful exec, which is how the supervisor learns of it.
    let Ok(report) = rustix::io::fcntl_dupfd_cloexec(io::stdin(), 3) else {
        return ExitCode::FAILURE;
    };
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
        Err(error) => error.into(),
    };
    match write!(File::from(report), "{error}") {
        Ok(()) | Err(_) => ExitCode::FAILURE,
    }
}
