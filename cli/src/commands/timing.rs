//! `ictus timing`: what the manifest's `timing` asks of a run, and declared bounds beside measured ones.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::time::Duration;

use clap::Args;
use ictus_coord::plan::{Coordination, Plan};
use ictus_coord::report::FederationMeasures;
use ictus_deploy::TimingSpec;
use ictus_deploy::timing::{
    BoundsReport, Suggestion, TimingReport, bounds_report, report, report_runs, suggest,
};
use ictusd::api::recorded::FileKind;
use ictusd::store::Directory;
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::args::ManifestArgs;
use crate::error::CliError;
use crate::hosts::Clients;
use crate::hosts::clocks::ClockBounds;
use crate::hosts::copied::Copied;
use crate::runs::Runs;
use crate::session::{Abroad, Session, Whereabouts, checked};
use crate::ui::Ui;

/// How often `--watch` looks.
const PERIOD: Duration = Duration::from_secs(1);

/// Show order and latency of a run, or of several new ones
///
/// Without `--runs`: of the last run of a federation, also while it runs; under decentralized coordination with every
/// federate's declared bounds beside the measured ones. With `--runs N MANIFEST`: runs the federation N times to its
/// timeout, one after the other, and compares them.
#[derive(Debug, Args)]
pub(crate) struct Timing {
    /// The federation: its name or manifest; may be left out when there is one
    name: Option<String>,
    #[command(flatten)]
    at: Whereabouts,
    /// Show it again every second, until Ctrl-C
    #[arg(short, long, conflicts_with_all = ["runs", "suggest"])]
    watch: bool,
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
    /// Absent on one host.
    #[serde(skip_serializing_if = "Option::is_none")]
    clocks: Option<ClockBounds>,
}

impl Timing {
    pub(crate) fn run(&self, ui: &mut Ui) -> Result<(), CliError> {
        let session = Session::new()?;
        if let Some(runs) = self.runs {
            let answer = Answer {
                timing: self.over_runs(ui, &session, runs)?,
                bounds: None,
                clocks: None,
            };
            return ui.result(&answer, || answer.text());
        }
        let given = self.name.as_deref();
        if let Some(abroad) = self.at.abroad(&session, given)? {
            return session.block_on(self.everywhere(ui, &session, &abroad));
        }
        if self.suggest {
            let name = session.name(given)?;
            let directory = Directory::of(&session.paths.federations(), &name);
            let plan: Plan = read(&directory.plan())?;
            let found = self.suggestion(&plan, || measured(&session, &name))?;
            return ui.result(&found, || found.to_string());
        }
        loop {
            let answer = of_last_run(&session, given)?;
            self.show(ui, &answer)?;
            if !self.watch {
                return Ok(());
            }
            std::thread::sleep(PERIOD);
        }
    }

    /// The same of a run over hosts: their files are copied here, each time only what is new.
    async fn everywhere(
        &self,
        ui: &mut Ui,
        session: &Session,
        abroad: &Abroad,
    ) -> Result<(), CliError> {
        let clients = abroad.clients(session).await?;
        let name = &abroad.name;
        let mut copied = Copied::new(&clients, name).await?;
        if self.suggest {
            let measures = each_measures(&clients, name).await?;
            let found = self.suggestion(&copied.plan, || Ok(all(name, measures)))?;
            return ui.result(&found, || found.to_string());
        }
        loop {
            copied.update(&clients, FileKind::Timing).await?;
            let measures = each_measures(&clients, name).await?;
            let clocks = ClockBounds::of(&measures);
            let files = copied.path(FileKind::Timing);
            let about = (&copied.plan, &copied.timing);
            let answer = Answer {
                clocks,
                ..Answer::of(&files, about, || Ok(all(name, measures)))?
            };
            self.show(ui, &answer)?;
            if !self.watch {
                return Ok(());
            }
            tokio::time::sleep(PERIOD).await;
        }
    }

    fn show(&self, ui: &mut Ui, answer: &Answer) -> Result<(), CliError> {
        if self.watch && ui.can_redraw() {
            ui.clear()?;
        }
        ui.result(answer, || answer.text())
    }

    fn suggestion(
        &self,
        plan: &Plan,
        measured: impl FnOnce() -> Result<FederationMeasures, CliError>,
    ) -> Result<Suggestion, CliError> {
        let name = &plan.federation;
        if plan.coordination == Coordination::Centralized {
            let message =
                format!("federation `{name}` is coordinated centrally: nobody waits an offset");
            return Err(CliError::failed(message)
                .hint("run it with `coordination: decentralized` and generous offsets first"));
        }
        let found = suggest(plan, &measured()?, u32::from(self.margin));
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
                    Ok(files) => directories.push(files),
                    Err(error) => {
                        result = Err(error);
                        break;
                    }
                }
            }
            let report = result.and_then(|()| {
                let directories = directories.iter().map(|it| it.timing.clone());
                let directories: Vec<_> = directories.collect();
                report_runs(&directories, &checked.timing, &checked.plan).map_err(CliError::failed)
            });
            runs.remove(ui).await;
            report
        })
    }
}

impl Answer {
    /// Reads a run's files; what was measured is only asked for under decentralized coordination.
    fn of(
        files: &Path,
        (plan, spec): (&Plan, &TimingSpec),
        measured: impl FnOnce() -> Result<FederationMeasures, CliError>,
    ) -> Result<Self, CliError> {
        let bounds = match plan.coordination {
            Coordination::Centralized => None,
            Coordination::Decentralized => bounds_report(plan, &measured()?),
        };
        let timing = if spec.is_empty() && bounds.is_some() {
            TimingReport::default()
        } else {
            report(files, spec, plan).map_err(CliError::failed)?
        };
        Ok(Self {
            timing,
            bounds,
            clocks: None,
        })
    }

    fn text(&self) -> String {
        let timing = self.timing.to_string();
        let bounds = self.bounds.as_ref().map(ToString::to_string);
        let clocks = self.clocks.as_ref().map(ToString::to_string);
        let parts = bounds.into_iter().chain([timing]).chain(clocks);
        let parts: Vec<String> = parts.filter(|part| !part.is_empty()).collect();
        parts.join("\n\n")
    }
}

fn of_last_run(session: &Session, name: Option<&str>) -> Result<Answer, CliError> {
    let name = session.name(name)?;
    let directory = Directory::of(&session.paths.federations(), &name);
    let spec: TimingSpec = read(&directory.timing_spec())?;
    let plan: Plan = read(&directory.plan())?;
    Answer::of(&directory.timing(), (&plan, &spec), || {
        measured(session, &name)
    })
}

/// What the federates have measured, by host.
async fn each_measures(
    clients: &Clients,
    name: &str,
) -> Result<BTreeMap<String, FederationMeasures>, CliError> {
    let mut measures = BTreeMap::new();
    for (host, client) in clients {
        measures.insert(host.clone(), client.measures(name).await?);
    }
    Ok(measures)
}

/// The same of all hosts as one.
fn all(name: &str, measures: BTreeMap<String, FederationMeasures>) -> FederationMeasures {
    let federates = measures.into_values().flat_map(|it| it.federates);
    FederationMeasures {
        federation: name.to_owned(),
        federates: federates.collect(),
    }
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
