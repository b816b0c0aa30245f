//! `ictus plan`: what runs, how it is connected, and how long each federate waits and why.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use clap::Args;
use ictus_coord::plan::{ClockSync, ConnectionPlan, Coordination, Endpoint, FederatePlan, Plan};
use ictus_deploy::{Checked, Offsets};
use serde::Serialize;

use crate::args::ManifestArgs;
use crate::error::{CliError, Kind};
use crate::rollout::Rollout;
use crate::session::{Session, checked};
use crate::ui::{Table, Ui, nanoseconds};

/// Show what a manifest runs: federates, connections, and every federate's STP offset with its terms
#[derive(Debug, Args)]
pub(crate) struct PlanCommand {
    #[command(flatten)]
    manifest: ManifestArgs,
    /// Run nothing the manifest names; widths, serializers and types are then not known
    #[arg(long)]
    no_build: bool,
    /// Plan a run whose federates write their logical traces
    #[arg(long)]
    trace: bool,
    /// Write what would be done on the manifest's hosts to a file, for `ictus up --plan FILE`
    #[arg(long, value_name = "FILE", conflicts_with = "no_build")]
    out: Option<PathBuf>,
}

/// The answer for programs.
#[derive(Debug, Serialize)]
struct Answer<'a> {
    plan: &'a Plan,
    /// Also under centralized coordination, where they play no part, as far as the bounds suffice.
    offsets: Option<&'a Offsets>,
    /// What each federate executes; empty when nothing was built.
    executables: BTreeMap<&'a str, &'a Path>,
}

impl PlanCommand {
    pub(crate) fn run(&self, ui: &mut Ui) -> Result<(), CliError> {
        let checked = checked(ui, &self.manifest, !self.no_build)?;
        let runs = checked.federates.iter();
        let answer = Answer {
            plan: &checked.plan,
            offsets: checked.offsets.as_ref(),
            executables: runs
                .map(|run| (run.name.as_str(), run.executable.as_path()))
                .collect(),
        };
        let hosts = checked.placement.as_ref().filter(|_| !self.no_build);
        let Some(placement) = hosts else {
            if self.out.is_some() {
                let message = "only what is done on hosts can be planned ahead";
                return Err(CliError::failed(message).hint("the manifest names no `hosts`"));
            }
            return ui.result(&answer, || text(&checked));
        };
        let session = Session::new()?;
        let rollout = Rollout::new(&session, &checked, placement, self.trace);
        let rollout = session.block_on(rollout)?;
        for missing in &rollout.secrets.missing {
            ui.warning(&format!("{missing}; not compared, and `ictus up` needs it"));
        }
        if let Some(out) = &self.out {
            rollout.saved(&self.manifest.set).write(out)?;
            ui.stage("saved", &out.display().to_string());
        }
        let shut = session.block_on(rollout.shut_ways())?;
        let plan = rollout.plan;
        let answer = serde_json::json!({ "federation": answer, "rollout": plan, "shut": shut });
        ui.result(&answer, || format!("{}\n\n{plan}", text(&checked)))?;
        if !shut.is_empty() {
            Err(CliError::new(Kind::Unreachable, shut.join("\n")))
        } else if plan.is_empty() {
            Ok(())
        } else {
            Err(CliError::new(Kind::Changes, "there are changes"))
        }
    }
}

fn text(checked: &Checked) -> String {
    let plan = &checked.plan;
    let mut text = vec![head(plan), String::new(), federates(plan)];
    if !plan.connections.is_empty() {
        text.extend([String::new(), connections(plan)]);
    }
    text.push(String::new());
    text.push(match (plan.coordination, &checked.offsets) {
        (Coordination::Centralized, _) => {
            "offsets play no part under centralized coordination: the RTI grants tags".to_owned()
        }
        (Coordination::Decentralized, Some(offsets)) => offsets.to_string(),
        (Coordination::Decentralized, None) => "no offsets".to_owned(),
    });
    text.join("\n")
}

/// What holds for all.
fn head(plan: &Plan) -> String {
    let coordination = match plan.coordination {
        Coordination::Centralized => "centralized",
        Coordination::Decentralized => "decentralized",
    };
    let clocks = match plan.clock.sync {
        ClockSync::Off => "clocks as they are",
        ClockSync::Init => "clocks compared at the start",
        ClockSync::On => "clocks synchronized",
        ClockSync::External => "clocks of the hosts' own service",
    };
    let mut all = vec![coordination.to_owned(), clocks.to_owned()];
    all.extend(
        plan.timeout_ns
            .map(|ns| format!("{} long", nanoseconds(ns))),
    );
    let words = [
        (plan.fast, "fast"),
        (plan.keepalive, "keepalive"),
        (plan.authentication, "authenticated"),
    ];
    let words = words.iter().filter(|(given, _)| *given);
    all.extend(words.map(|(_, word)| (*word).to_owned()));
    format!("{}: {}", plan.federation, all.join(", "))
}

fn federates(plan: &Plan) -> String {
    let mut table = Table::new(&["FEDERATE", "PROGRAM", "CLASS"]);
    for FederatePlan {
        name,
        program,
        class,
        ..
    } in &plan.federates
    {
        let cell = |cell: &Option<String>| cell.clone().unwrap_or_else(|| "foreign".to_owned());
        table.row([name.clone(), cell(program), cell(class)]);
    }
    table.text()
}

fn connections(plan: &Plan) -> String {
    let mut table = Table::new(&["CONNECTION", "AFTER", "SERIALIZER"]);
    for wire in &plan.connections {
        let after = match wire.after_ns {
            None => "-".to_owned(),
            Some(0) if wire.physical => "0 s".to_owned(),
            Some(0) => "1 microstep".to_owned(),
            Some(ns) => nanoseconds(ns),
        };
        table.row([connection(plan, wire), after, wire.serializer.clone()]);
    }
    table.text()
}

/// `radar.object -> planner.object`; `~>` for a physical connection, a channel where there are several.
pub(crate) fn connection(plan: &Plan, wire: &ConnectionPlan) -> String {
    let name = |end: &Endpoint| {
        let federate = plan.federates.get(usize::from(end.federate));
        let federate = federate.map_or("?", |federate| federate.name.as_str());
        let all = plan.connections.iter();
        let mut ends = all.flat_map(|wire| [&wire.from, &wire.to]);
        let same = |one: &Endpoint| (one.federate, &one.port) == (end.federate, &end.port);
        match ends.any(|one| same(one) && one.channel > 0) {
            true => format!("{federate}.{}[{}]", end.port, end.channel),
            false => format!("{federate}.{}", end.port),
        }
    };
    let arrow = if wire.physical { "~>" } else { "->" };
    format!("{} {arrow} {}", name(&wire.from), name(&wire.to))
}
