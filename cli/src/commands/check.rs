//! `ictus check`: every mistake at once.

use clap::Args;
use ictus_deploy::{CheckOptions, check};
use serde_json::json;

use crate::args::ManifestArgs;
use crate::error::{CliError, Kind};
use crate::session::checked;
use crate::ui::Ui;

/// Find every mistake of a manifest before anything runs: file, line, column, and the fix
#[derive(Debug, Args)]
pub(crate) struct Check {
    #[command(flatten)]
    manifest: ManifestArgs,
    /// Run nothing the manifest names, neither build scripts nor programs; ports, types and loops are then not checked
    #[arg(long)]
    no_build: bool,
}

impl Check {
    pub(crate) fn run(&self, ui: &mut Ui) -> Result<(), CliError> {
        if !ui.json() {
            return checked(ui, &self.manifest, !self.no_build).map(|_| ());
        }
        let path = self.manifest.path()?;
        let overrides = self.manifest.set.iter().cloned().collect();
        let options = CheckOptions {
            build: !self.no_build,
            overrides,
            ..CheckOptions::default()
        };
        let (problems, warnings) = match check(&path, &options, &mut |_| {}) {
            Ok(checked) => (Vec::new(), checked.warnings),
            Err(problems) => (problems.0, Vec::new()),
        };
        let valid = problems.is_empty();
        let answer = json!({ "valid": valid, "problems": problems, "warnings": warnings });
        ui.result(&answer, String::new)?;
        if valid {
            return Ok(());
        }
        let message = format!("{} has mistakes: {}", path.display(), problems.len());
        Err(CliError::new(Kind::Manifest, message))
    }
}
