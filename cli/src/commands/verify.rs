//! `ictus verify`: the same logical trace in one process and federated.

use std::collections::BTreeMap;

use clap::Args;
use ictus_deploy::Checked;
use ictus_deploy::trace::{Record, TraceSet, Verdict, compare};
use serde::Serialize;

use crate::args::ManifestArgs;
use crate::error::CliError;
use crate::runs::Runs;
use crate::session::{Session, checked};
use crate::ui::{Table, Ui, nanoseconds};

/// Compare the logical trace of one process with that of the federation
///
/// Runs the whole program in one process, then the federation with RTI and sockets several times, and compares what
/// every reaction did at every tag. The manifest needs a `timeout`.
#[derive(Debug, Args)]
pub(crate) struct Verify {
    #[command(flatten)]
    manifest: ManifestArgs,
    /// How often the federation is run
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1000))]
    runs: u32,
}

/// What was found.
#[derive(Debug, Serialize)]
struct Answer {
    federation: String,
    equal: u32,
    of: u32,
    /// Of the run in one process.
    records_per_federate: BTreeMap<String, usize>,
    /// Of the run in one process.
    hash: String,
    runs: Vec<Verdict>,
}

impl Verify {
    pub(crate) fn run(&self, ui: &mut Ui) -> Result<(), CliError> {
        let session = Session::new()?;
        let checked = checked(ui, &self.manifest, true)?;
        session.block_on(async {
            let mut runs = Runs::new(&session, &checked).await?;
            let answer = self.compare(ui, &checked, &mut runs).await;
            runs.remove(ui).await;
            let answer = answer?;
            ui.result(&answer, || answer.text())?;
            if answer.equal == answer.of {
                return Ok(());
            }
            Err(CliError::failed(format!(
                "equal only {} of {}",
                answer.equal, answer.of
            )))
        })
    }

    async fn compare(
        &self,
        ui: &mut Ui,
        checked: &Checked,
        runs: &mut Runs<'_>,
    ) -> Result<Answer, CliError> {
        ui.progress("running", "in one process");
        let reference = read(&runs.in_one_process().await?, checked)?;
        ui.stage("ran", &format!("in one process: {}", reference.hash()));
        let mut answer = Answer {
            federation: checked.plan.federation.clone(),
            equal: 0,
            of: self.runs,
            records_per_federate: records(&reference),
            hash: reference.hash(),
            runs: Vec::new(),
        };
        for number in 1..=self.runs {
            ui.progress("running", &format!("federated, {number} of {}", self.runs));
            let directory = runs.federated(true).await?;
            let trace = read(&directory.trace(), checked)?;
            let verdict = compare(&reference, &trace);
            let said = describe(&verdict);
            ui.stage(
                "ran",
                &format!("federated, {number} of {}: {said}", self.runs),
            );
            answer.equal += u32::from(matches!(verdict, Verdict::Equal { .. }));
            answer.runs.push(verdict);
        }
        Ok(answer)
    }
}

impl Answer {
    fn text(&self) -> String {
        let mut table = Table::new(&["FEDERATE", "RECORDS"]);
        for (federate, records) in &self.records_per_federate {
            table.row([federate.clone(), records.to_string()]);
        }
        format!("{}\nequal {} of {}", table.text(), self.equal, self.of)
    }
}

/// Reads a run's traces; each federate must have come as far as the timeout.
fn read(directory: &std::path::Path, checked: &Checked) -> Result<TraceSet, CliError> {
    let traces = TraceSet::read(directory).map_err(CliError::failed)?;
    let timeout_ns = checked.plan.timeout_ns.unwrap_or(0);
    for federate in &checked.plan.federates {
        let name = &federate.name;
        let Some(trace) = traces.federates.get(name) else {
            return Err(CliError::failed(format!(
                "federate `{name}` has left no trace"
            )));
        };
        let Some((end, reason)) = &trace.end else {
            return Err(CliError::failed(format!(
                "the trace of federate `{name}` has no end"
            )));
        };
        if end.time_ns < timeout_ns {
            let (at, timeout) = (nanoseconds(end.time_ns), nanoseconds(timeout_ns));
            let message = format!("federate `{name}` ended at {at} ({reason}), not at {timeout}");
            return Err(CliError::failed(message)
                .hint("a comparison of less than the whole run proves nothing"));
        }
    }
    Ok(traces)
}

fn records(traces: &TraceSet) -> BTreeMap<String, usize> {
    traces
        .federates
        .iter()
        .map(|(name, trace)| (name.clone(), trace.records.len()))
        .collect()
}

fn describe(verdict: &Verdict) -> String {
    match verdict {
        Verdict::Equal { .. } => "equal".to_owned(),
        Verdict::Different {
            federate,
            left,
            right,
        } => format!(
            "different at federate `{federate}`\n  one process: {}\n  federated:   {}",
            describe_record(left.as_ref()),
            describe_record(right.as_ref())
        ),
        Verdict::NotComparable { why } => format!("not comparable: {why}"),
    }
}

fn describe_record(record: Option<&Record>) -> String {
    record.map_or_else(
        || "no record".to_owned(),
        |Record {
             tag,
             path,
             index,
             kind,
             effects,
         }| {
            let at = nanoseconds(tag.time_ns);
            format!(
                "at {at}, microstep {}: {path} reaction {index} {kind}: {effects}",
                tag.microstep
            )
        },
    )
}
