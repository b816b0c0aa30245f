//! `ictus timing`: what the manifest's `timing` asks of a run, and declared bounds beside measured ones.

use std::fs;
use std::path::Path;

use clap::Args;
use ictus_coord::plan::{Coordination, Plan};
use ictus_coord::report::FederationMeasures;
use ictus_deploy::TimingSpec;
use ictus_deploy::timing::{
    BoundsReport, Suggestion, TimingReport, bounds_report, report, report_runs, suggest,
};
use ictusd::store::Directory;
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::args::ManifestArgs;
use crate::error::CliError;
use crate::runs::Runs;
use crate::session::{Session, checked};
use crate::ui::Ui;

/// Show order and latency of a run, or of several new ones
///
/// Without `--runs`: of the last run of a federation, also while it runs; under decentralized coordination with every
/// federate's declared bounds beside the measured ones. With `--runs N MANIFEST`: runs the federation N times to its
/// timeout, one after the other, and compares them.
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
    /// Print bounds made of the measured ones, as a section of the manifest
    #[arg(long, conflicts_with = "runs")]
    suggest: bool,
    /// What `--suggest` adds to the largest measured values, in percent
    #[arg(
        long,
        value_name = "PERCENT",
        default_value_t = 20,
        requires = "suggest"
    )]
    margin: u16,
}

/// The answer for programs.
#[derive(Debug, Serialize)]
struct Answer {
    #[serde(flatten)]
    timing: TimingReport,
    /// Absent under centralized coordination.
    #[serde(skip_serializing_if = "Option::is_none")]
    bounds: Option<BoundsReport>,
}

impl Timing {
    pub(crate) fn run(&self, ui: &mut Ui) -> Result<(), CliError> {
        let session = Session::new()?;
        if self.suggest {
            let found = self.suggestion(&session)?;
            return ui.result(&found, || found.to_string());
        }
        let answer = match self.runs {
            Some(runs) => Answer {
                timing: self.over_runs(ui, &session, runs)?,
                bounds: None,
            },
            None => of_last_run(&session, self.name.as_deref())?,
        };
        ui.result(&answer, || answer.text())
    }

    fn suggestion(&self, session: &Session) -> Result<Suggestion, CliError> {
        let name = session.name(self.name.as_deref())?;
        let directory = Directory::of(&session.paths.federations(), &name);
        let plan: Plan = read(&directory.plan())?;
        if plan.coordination == Coordination::Centralized {
            let message =
                format!("federation `{name}` is coordinated centrally: nobody waits an offset");
            return Err(CliError::failed(message)
                .hint("run it with `coordination: decentralized` and generous offsets first"));
        }
        let found = suggest(&plan, &measured(session, &name)?, u32::from(self.margin));
        if found.is_empty() {
            let error = CliError::failed(format!("no message of `{name}` was measured"));
            return Err(error.hint("federates tell what they measured once a second"));
        }
        Ok(found)
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
                match runs.federated(&checked.plan, false).await {
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

impl Answer {
    fn text(&self) -> String {
        let timing = self.timing.to_string();
        let bounds = self.bounds.as_ref().map(ToString::to_string);
        let parts = bounds.into_iter().chain([timing]);
        let parts: Vec<String> = parts.filter(|part| !part.is_empty()).collect();
        parts.join("\n\n")
    }
}

fn of_last_run(session: &Session, name: Option<&str>) -> Result<Answer, CliError> {
    let name = session.name(name)?;
    let directory = Directory::of(&session.paths.federations(), &name);
    let spec: TimingSpec = read(&directory.timing_spec())?;
    let plan: Plan = read(&directory.plan())?;
    let bounds = match plan.coordination {
        Coordination::Centralized => None,
        Coordination::Decentralized => bounds_report(&plan, &measured(session, &name)?),
    };
    let timing = if spec.is_empty() && bounds.is_some() {
        TimingReport::default()
    } else {
        report(&directory.timing(), &spec, &plan).map_err(CliError::failed)?
    };
    Ok(Answer { timing, bounds })
}

/// What the federates have measured, from the daemon.
fn measured(session: &Session, name: &str) -> Result<FederationMeasures, CliError> {
    session.block_on(async { Ok(session.daemon().await?.measures(name).await?) })
}

fn read<T: DeserializeOwned>(path: &Path) -> Result<T, CliError> {
    let unreadable = |error: &dyn std::fmt::Display| {
        CliError::failed(format!("cannot read {}: {error}", path.display()))
    };
    let text = fs::read(path).map_err(|error| unreadable(&error))?;
    serde_json::from_slice(&text).map_err(|error| unreadable(&error))
}
