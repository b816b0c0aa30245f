//! `ictus metrics`: what Prometheus would read.

use std::collections::BTreeMap;

use clap::Args;
use ictus_metrics::{Page, Sample};
use serde::Serialize;

use crate::error::CliError;
use crate::session::{Abroad, Session, Whereabouts};
use crate::ui::Ui;

/// Print this host's metrics as Prometheus reads them, or as a JSON list of samples; with hosts a page of each
#[derive(Debug, Args)]
pub(crate) struct Metrics {
    /// The manifest of the hosts to ask; left out, this machine or `--host`
    manifest: Option<String>,
    #[command(flatten)]
    at: Whereabouts,
}

/// One line of the page, for programs.
#[derive(Debug, Serialize)]
struct Line<'a> {
    /// Absent on this machine.
    #[serde(skip_serializing_if = "Option::is_none")]
    host: Option<&'a str>,
    name: &'a str,
    labels: BTreeMap<&'a str, &'a str>,
    /// Absent when it is not finite.
    value: Option<f64>,
}

impl<'a> Line<'a> {
    fn of(host: Option<&'a str>, sample: &'a Sample) -> Self {
        let labels = sample.labels.iter();
        Self {
            host,
            name: &sample.name,
            labels: labels
                .map(|(name, value)| (name.as_str(), value.as_str()))
                .collect(),
            value: Some(sample.value).filter(|value| value.is_finite()),
        }
    }
}

impl Metrics {
    pub(crate) fn run(&self, ui: &mut Ui) -> Result<(), CliError> {
        let session = Session::new()?;
        if let Some(abroad) = self.at.abroad(&session, self.manifest.as_deref())? {
            return session.block_on(everywhere(ui, &session, &abroad));
        }
        let page = match session.known().is_empty() {
            true => String::new(),
            false => session.block_on(async {
                let page = session.daemon().await?.metrics().await?;
                Ok::<_, CliError>(page)
            })?,
        };
        if !ui.json() {
            return ui.result(&(), || page);
        }
        let parsed = Page::parse(&page).map_err(CliError::failed)?;
        let samples = parsed.samples().iter();
        let lines: Vec<Line<'_>> = samples.map(|sample| Line::of(None, sample)).collect();
        ui.result(&lines, String::new)
    }
}

/// A page of each host, under its name: Prometheus, too, tells hosts apart by whom it asks.
async fn everywhere(ui: &mut Ui, session: &Session, abroad: &Abroad) -> Result<(), CliError> {
    let mut pages = Vec::new();
    for (host, client) in abroad.clients(session).await? {
        pages.push((host, client.metrics().await?));
    }
    if !ui.json() {
        let texts = pages
            .iter()
            .map(|(host, page)| format!("# host {host}\n{page}"));
        return ui.result(&(), || texts.collect::<Vec<_>>().join("\n"));
    }
    let mut parsed = Vec::new();
    for (host, page) in &pages {
        let page = Page::parse(page).map_err(CliError::failed)?;
        parsed.push((host.as_str(), page));
    }
    let lines = parsed.iter().flat_map(|(host, page)| {
        let samples = page.samples().iter();
        samples.map(|sample| Line::of(Some(host), sample))
    });
    ui.result(&lines.collect::<Vec<_>>(), String::new)
}
