//! `ictus lock`: who changes federations, and taking it away from somebody who is gone.

use std::collections::BTreeMap;

use clap::{Args, Subcommand};
use ictus_deploy::placement::Way;
use ictusd::api::part::LeaseView;

use crate::error::CliError;
use crate::hosts::connect_all;
use crate::session::{Session, Whereabouts};
use crate::ui::{Table, Ui};

/// Show who holds leases; `break` frees one
#[derive(Debug, Args)]
pub(crate) struct Lock {
    #[command(subcommand)]
    what: Option<What>,
    /// The manifest of the hosts to ask; left out, this machine or `--host`
    #[arg(global = true)]
    manifest: Option<String>,
    #[command(flatten)]
    at: Whereabouts,
}

#[derive(Debug, Subcommand)]
enum What {
    /// Free a lease whose holder is gone; the hosts write down who did it
    Break,
}

impl Lock {
    pub(crate) fn run(&self, ui: &mut Ui) -> Result<(), CliError> {
        let session = Session::new()?;
        session.block_on(async {
            let abroad = self.at.find(&session, self.manifest.as_deref()).await?;
            let here = || BTreeMap::from([("this machine".to_owned(), Way::Local)]);
            let ways = abroad
                .as_ref()
                .map_or_else(here, |abroad| abroad.ways.clone());
            let only = abroad.map(|abroad| abroad.name);
            let mut found: BTreeMap<String, Vec<LeaseView>> = BTreeMap::new();
            for (host, client) in connect_all(&session, &ways).await {
                let client = client?;
                let mut leases = client.leases().await?;
                leases.retain(|it| only.as_ref().is_none_or(|only| *only == it.federation));
                if matches!(self.what, Some(What::Break)) {
                    for lease in &leases {
                        let by = crate::rollout::who("lock break");
                        client.break_lease(&lease.federation, &by).await?;
                        ui.stage(
                            "freed",
                            &format!("{host}: {} of {}", lease.federation, lease.who),
                        );
                    }
                }
                found.insert(host, leases);
            }
            if found.values().all(Vec::is_empty) {
                ui.message("nobody holds a lease");
            }
            ui.result(&found, || text(&found))
        })
    }
}

fn text(found: &BTreeMap<String, Vec<LeaseView>>) -> String {
    if found.values().all(Vec::is_empty) {
        return String::new();
    }
    let mut table = Table::new(&["HOST", "FEDERATION", "HOLDER", "FREE IN"]);
    for (host, leases) in found {
        for lease in leases {
            let left = format!("{} s", lease.left_ms.div_ceil(1000));
            table.row([
                host.clone(),
                lease.federation.clone(),
                lease.who.clone(),
                left,
            ]);
        }
    }
    table.text()
}
