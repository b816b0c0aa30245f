//! What a program says of itself.

use crate::class::Class;
use std::path::Path;
use std::process::ExitCode;

/// Answers `--describe [FILE]` on standard output.
pub(crate) fn describe_main(classes: &[Class], file: Option<&Path>) -> ExitCode {
    let _ = (classes, file);
    ExitCode::FAILURE
}
