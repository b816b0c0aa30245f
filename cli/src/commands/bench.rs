//! `ictus bench`: builds and runs the bench program of the source tree.

use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::Command;

use crate::error::CliError;

/// The source tree that this executable was built from.
const SOURCE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/..");

pub(crate) fn run(args: &[OsString]) -> Result<(), CliError> {
    let manifest = Path::new(SOURCE).join("Cargo.toml");
    if !manifest.is_file() {
        let error = CliError::failed("the bench program is built from Ictus's source tree");
        return Err(error.hint(format!("{} is not there any more", manifest.display())));
    }
    // Both by name: the bench starts the RTI of this very tree.
    let cargo = |command: &str| {
        let mut cargo = Command::new("cargo");
        cargo
            .arg(command)
            .args(["--release", "--quiet", "--manifest-path"])
            .arg(&manifest);
        cargo
    };
    let built = cargo("build").args(["--package", "ictus-cli"]).status();
    match built {
        Ok(status) if status.success() => {}
        Ok(_) => return Err(CliError::failed("the bench program does not build")),
        Err(error) => return Err(CliError::failed(error).hint("is cargo installed?")),
    }
    Err(CliError::failed(
        cargo("run")
            .args(["--package", "bench", "--"])
            .args(args)
            .exec(),
    ))
}
