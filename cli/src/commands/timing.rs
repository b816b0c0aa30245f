//! `ictus timing`: what the manifest's `timing` asks of a run.

use std::fs;
use std::path::Path;

use clap::Args;
use ictus_deploy::TimingSpec;
use ictus_deploy::timing::{TimingReport, report, report_runs};
use ictusd::store::Directory;
use serde::de::DeserializeOwned;

use crate::args::ManifestArgs;
use crate::error::CliError;
use crate::runs::Runs;
use crate::session::{Session, checked};
use crate::ui::Ui;

/// Show order and latency of a run, or of several new ones
///
/// Without `--runs`: of the last run of a federation, also while it runs. With `--runs N MANIFEST`: runs the federation
/// N times to its timeout, one after the other, and compares them.
#[derive(Debug, Args)]
pub(crate) struct Timing {
    /// The federation: its name or manifest; may be left out when there is one
    name: Option<String>,
    /// Run the manifest so many times and compare the runs
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1000))]
    runs: Option<u32>,
    /// Give a name of the manifest's `let` another value, with `--runs`
    #[arg(long = "set", value_name = "NAME=VALUE", requires = "runs", value_parser = crate::args::assignment)]
    set: Vec<(String, String)>,
}

impl Timing {
    pub(crate) fn run(&self, ui: &mut Ui) -> Result<(), CliError> {
        let session = Session::new()?;
        let report = match self.runs {
            Some(runs) => self.over_runs(ui, &session, runs)?,
            None => of_last_run(&session, self.name.as_deref())?,
        };
        ui.result(&report, || report.to_string())
    }

    fn over_runs(
        &self,
        ui: &mut Ui,
        session: &Session,
        number: u32,
    ) -> Result<TimingReport, CliError> {
        let manifest = self.name.as_deref().unwrap_or("federation.yaml").into();
        let manifest = ManifestArgs {
            manifest,
            set: self.set.clone(),
        };
        let checked = checked(ui, &manifest, true)?;
        session.block_on(async {
            let mut runs = Runs::new(session, &checked).await?;
            let mut directories = Vec::new();
            let mut result = Ok(());
            for run in 1..=number {
                ui.progress("running", &format!("{run} of {number}"));
                match runs.federated(false).await {
                    Ok(directory) => directories.push(directory.timing()),
                    Err(error) => {
                        result = Err(error);
                        break;
                    }
                }
            }
            let report = result.and_then(|()| {
                report_runs(&directories, &checked.timing, &checked.plan).map_err(CliError::failed)
            });
            runs.remove(ui).await;
            report
        })
    }
}

fn of_last_run(session: &Session, name: Option<&str>) -> Result<TimingReport, CliError> {
    let name = session.name(name)?;
    let directory = Directory::of(&session.paths.federations(), &name);
    let spec: TimingSpec = read(&directory.timing_spec())?;
    report(&directory.timing(), &spec, &read(&directory.plan())?).map_err(CliError::failed)
}

fn read<T: DeserializeOwned>(path: &Path) -> Result<T, CliError> {
    let unreadable = |error: &dyn std::fmt::Display| {
        CliError::failed(format!("cannot read {}: {error}", path.display()))
    };
    let text = fs::read(path).map_err(|error| unreadable(&error))?;
    serde_json::from_slice(&text).map_err(|error| unreadable(&error))
}
