//! `ictus verify`: the same logical trace in one process, centralized and decentralized.

use std::collections::BTreeMap;
use std::fmt;
use std::time::Duration;

use clap::{Args, ValueEnum};
use ictus_coord::plan::Coordination;
use ictus_deploy::Checked;
use ictus_deploy::trace::{Record, TraceSet, Verdict, compare};
use serde::Serialize;

use crate::args::ManifestArgs;
use crate::error::CliError;
use crate::runs::Runs;
use crate::session::{Session, checked, count};
use crate::ui::{Table, Ui, nanoseconds};

/// Compare the logical traces of one process and of the federation under each coordination
///
/// Runs the whole program in one process, then the federation with sockets, centralized and decentralized, and compares
/// what every reaction did at every tag. What the manifest cannot run is left out. The manifest needs a `timeout`.
#[derive(Debug, Args)]
pub(crate) struct Verify {
    #[command(flatten)]
    manifest: ManifestArgs,
    /// How often the federation is run in each mode
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1000))]
    runs: u32,
    /// Compare what the last run has left (of `up --trace`, also on hosts) with one process, in place of running anew;
    /// waits for its end
    #[arg(long, conflicts_with_all = ["runs", "modes", "stp_offset"])]
    last: bool,
    /// What is compared with the first of them; left out, all that the manifest can run
    #[arg(long, value_name = "MODE,...", value_enum, value_delimiter = ',')]
    modes: Vec<Mode>,
    /// Decentralized: what each connection adds to the offsets, in place of the manifest's [default: the manifest's
    /// offsets, or 200 ms when it has none]
    #[arg(long, value_name = "TIME", value_parser = crate::args::duration)]
    stp_offset: Option<Duration>,
}

/// The longest offset that a manifest may have.
const LONGEST_OFFSET: Duration = Duration::from_secs(3_600);

/// A way to run a federation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, ValueEnum)]
#[serde(rename_all = "snake_case")]
enum Mode {
    /// The whole program in one process
    One,
    /// Processes; the coordinator grants tags
    Centralized,
    /// Processes; clocks and offsets decide
    Decentralized,
}

/// What was found.
#[derive(Debug, Serialize)]
struct Answer {
    federation: String,
    equal: u32,
    of: u32,
    /// What the others are compared with.
    reference: Mode,
    /// Of the reference.
    records_per_federate: BTreeMap<String, usize>,
    /// Of the reference.
    hash: String,
    /// Where the offsets of decentralized runs come from, in words; absent without one.
    #[serde(skip_serializing_if = "Option::is_none")]
    offsets: Option<String>,
    runs: Vec<Run>,
    /// The reference's traces.
    #[serde(skip)]
    first: Option<TraceSet>,
}

/// A run and how it compares with the reference.
#[derive(Debug, Serialize)]
struct Run {
    mode: Mode,
    hash: String,
    /// Messages that came too late.
    violations: usize,
    #[serde(flatten)]
    verdict: Verdict,
}

impl Verify {
    pub(crate) fn run(&self, ui: &mut Ui) -> Result<(), CliError> {
        if !self.modes.is_empty() {
            self.offset_has_an_effect(&self.modes)?;
        }
        let session = Session::new()?;
        let checked = checked(ui, &self.manifest, true)?;
        if self.last {
            return session.block_on(self.of_last(ui, &session, &checked));
        }
        let modes = self.modes(ui, &checked)?;
        self.offset_has_an_effect(&modes)?;
        session.block_on(async {
            let mut runs = Runs::new(&session, &checked).await?;
            let answer = self.compare(ui, &checked, (&mut runs, &modes)).await;
            runs.remove(ui).await;
            answer?.tell(ui)
        })
    }

    /// Compares the run that is there, or was, with one process.
    async fn of_last(
        &self,
        ui: &mut Ui,
        session: &Session,
        checked: &Checked,
    ) -> Result<(), CliError> {
        if let Some((why, hint)) = Mode::One.obstacle(checked) {
            let message = format!("the federation cannot run in one process: {why}");
            return Err(CliError::failed(message).hint(hint));
        }
        let mut runs = Runs::new(session, checked).await?;
        let answer = async {
            let (plan, files) = runs.last().await?;
            let checked = Checked {
                plan,
                ..checked.clone()
            };
            let many = read(&files.trace, &checked)?;
            let one = read(&runs.in_one_process(&checked.plan).await?, &checked)?;
            let mode = match checked.plan.coordination {
                Coordination::Centralized => Mode::Centralized,
                Coordination::Decentralized => Mode::Decentralized,
            };
            let mut answer = Answer::new(&checked, Mode::One);
            answer.add(ui, &Mode::One.to_string(), (Mode::One, one));
            answer.add(ui, "the last run", (mode, many));
            Ok(answer)
        };
        let answer: Result<Answer, CliError> = answer.await;
        runs.remove(ui).await;
        answer?.tell(ui)
    }

    /// Refuses `--stp-offset` when nothing runs decentralized, or when it is beyond sense.
    fn offset_has_an_effect(&self, modes: &[Mode]) -> Result<(), CliError> {
        let Some(offset) = self.stp_offset else {
            return Ok(());
        };
        if !modes.contains(&Mode::Decentralized) {
            let message = "`--stp-offset` has no effect: nothing runs decentralized";
            return Err(
                CliError::failed(message).hint("remove it, or add `decentralized` to `--modes`")
            );
        }
        if offset > LONGEST_OFFSET {
            let error = CliError::failed("`--stp-offset`: an offset is at most 1 h");
            return Err(error.hint("write it as `200ms`"));
        }
        Ok(())
    }

    /// The modes asked for, or all that the manifest can run, the reference first.
    fn modes(&self, ui: &mut Ui, checked: &Checked) -> Result<Vec<Mode>, CliError> {
        let mut modes = Vec::new();
        for mode in [Mode::One, Mode::Centralized, Mode::Decentralized] {
            let asked = self.modes.contains(&mode);
            if !self.modes.is_empty() && !asked {
                continue;
            }
            match mode.obstacle(checked) {
                None => modes.push(mode),
                Some((why, hint)) if asked => {
                    let message = format!("the federation cannot run {mode}: {why}");
                    return Err(CliError::failed(message).hint(hint));
                }
                Some((why, _)) => ui.stage("left out", &format!("{mode}: {why}")),
            }
        }
        let often = |mode: &Mode| if *mode == Mode::One { 1 } else { self.runs };
        if modes.iter().map(often).fold(0, u32::saturating_add) < 2 {
            let error = CliError::failed("there is only one run, so nothing to compare it with");
            return Err(
                error.hint("`--runs 2`, or more of `--modes one,centralized,decentralized`")
            );
        }
        Ok(modes)
    }

    async fn compare(
        &self,
        ui: &mut Ui,
        checked: &Checked,
        (runs, modes): (&mut Runs<'_>, &[Mode]),
    ) -> Result<Answer, CliError> {
        let span = self.stp_offset;
        let span = span.map(|span| i64::try_from(span.as_nanos()).unwrap_or(i64::MAX));
        let (decentralized, origin) = checked.decentralized(span);
        let centralized = checked.centralized();
        let first = modes.first().copied().unwrap_or(Mode::One);
        let mut answer = Answer::new(checked, first);
        if modes.contains(&Mode::Decentralized) {
            answer.offsets = Some(origin.to_string());
        }
        for mode in modes {
            let often = if *mode == Mode::One { 1 } else { self.runs };
            for number in 1..=often {
                let (name, plan) = match mode {
                    Mode::One => (mode.to_string(), None),
                    Mode::Centralized => {
                        (format!("{mode}, {number} of {often}"), Some(&centralized))
                    }
                    Mode::Decentralized => (
                        format!("{mode}, {number} of {often}, {origin}"),
                        Some(&decentralized),
                    ),
                };
                ui.progress("running", &name);
                let traces = match plan {
                    None => read(&runs.in_one_process(&checked.plan).await?, checked)?,
                    // Copies are removed when they are read.
                    Some(plan) => read(&runs.federated(plan, true).await?.trace, checked)?,
                };
                answer.add(ui, &name, (*mode, traces));
            }
        }
        Ok(answer)
    }
}

impl Mode {
    /// Why a manifest cannot be run so, and what to do about it.
    fn obstacle(self, checked: &Checked) -> Option<(&'static str, &'static str)> {
        match self {
            Self::One => checked.one_program.is_none().then_some((
                "its federates come from several programs",
                "every federate must come from the same program, and none may be foreign",
            )),
            Self::Centralized => None,
            Self::Decentralized => checked.plan.fast.then_some((
                "`fast` runs ahead of physical time, by which it decides",
                "remove `fast: true`",
            )),
        }
    }
}

impl fmt::Display for Mode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::One => "in one process",
            Self::Centralized => "centralized",
            Self::Decentralized => "decentralized",
        })
    }
}

impl Run {
    fn new(mode: Mode, reference: &TraceSet, traces: &TraceSet) -> Self {
        Self {
            mode,
            hash: traces.hash(),
            violations: traces.federates.values().map(|one| one.tardy.len()).sum(),
            verdict: compare(reference, traces),
        }
    }

    fn describe(&self, reference: Mode) -> String {
        let said = describe(&self.verdict, reference, self.mode);
        match self.mode {
            Mode::One | Mode::Centralized => said,
            Mode::Decentralized => {
                let violations = count(self.violations, "violation");
                match self.verdict {
                    Verdict::Equal { .. } => format!("{said}, {violations}"),
                    Verdict::Different { .. } | Verdict::NotComparable { .. } => {
                        format!("{violations}; {said}")
                    }
                }
            }
        }
    }
}

impl Answer {
    fn new(checked: &Checked, reference: Mode) -> Self {
        Self {
            federation: checked.plan.federation.clone(),
            equal: 0,
            of: 0,
            reference,
            records_per_federate: BTreeMap::new(),
            hash: String::new(),
            offsets: None,
            runs: Vec::new(),
            first: None,
        }
    }

    /// Takes a run's traces and says what they are: the first is what the others are compared with.
    fn add(&mut self, ui: &mut Ui, name: &str, (mode, traces): (Mode, TraceSet)) {
        let Some(reference) = &self.first else {
            ui.stage("ran", &format!("{name}: {}", traces.hash()));
            self.hash = traces.hash();
            self.records_per_federate = traces.records_per_federate();
            self.first = Some(traces);
            return;
        };
        let run = Run::new(mode, reference, &traces);
        let how = run.describe(self.reference);
        ui.stage("ran", &format!("{name}: {how}"));
        self.of += 1;
        self.equal += u32::from(matches!(run.verdict, Verdict::Equal { .. }));
        self.runs.push(run);
    }

    /// Shows it; anything but equality is a failure.
    fn tell(&self, ui: &mut Ui) -> Result<(), CliError> {
        ui.result(self, || self.text())?;
        if self.equal == self.of {
            return Ok(());
        }
        let (equal, of) = (self.equal, self.of);
        Err(CliError::failed(format!("equal only {equal} of {of}")))
    }

    fn text(&self) -> String {
        let mut records = Table::new(&["FEDERATE", "RECORDS"]);
        for (federate, number) in &self.records_per_federate {
            records.row([federate.clone(), number.to_string()]);
        }
        let mut runs = Table::new(&["RUN", "TRACE", "VIOLATIONS"]);
        let reference = [
            self.reference.to_string(),
            self.hash.clone(),
            "-".to_owned(),
        ];
        runs.row(reference);
        for run in &self.runs {
            let violations = match run.mode {
                Mode::One | Mode::Centralized => "-".to_owned(),
                Mode::Decentralized => run.violations.to_string(),
            };
            runs.row([run.mode.to_string(), run.hash.clone(), violations]);
        }
        let (equal, of) = (self.equal, self.of);
        format!(
            "{}\n\n{}\nequal {equal} of {of}",
            records.text(),
            runs.text()
        )
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

fn describe(verdict: &Verdict, reference: Mode, mode: Mode) -> String {
    match verdict {
        Verdict::Equal { .. } => "equal".to_owned(),
        Verdict::Different {
            federate,
            left,
            right,
        } => format!(
            "different at federate `{federate}`\n  {reference}: {}\n  {mode}: {}",
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
