//! `ictus metrics`: what Prometheus would read.

use std::collections::BTreeMap;

use clap::Args;
use ictus_metrics::{Page, Sample};
use serde::Serialize;

use crate::error::CliError;
use crate::session::Session;
use crate::ui::Ui;

/// Print this host's metrics as Prometheus reads them, or as a JSON list of samples
#[derive(Debug, Args)]
pub(crate) struct Metrics {}

/// One line of the page, for programs.
#[derive(Debug, Serialize)]
struct Line<'a> {
    name: &'a str,
    labels: BTreeMap<&'a str, &'a str>,
    /// Absent when it is not finite.
    value: Option<f64>,
}

impl<'a> From<&'a Sample> for Line<'a> {
    fn from(sample: &'a Sample) -> Self {
        let labels = sample.labels.iter();
        Self {
            name: &sample.name,
            labels: labels
                .map(|(name, value)| (name.as_str(), value.as_str()))
                .collect(),
            value: Some(sample.value).filter(|value| value.is_finite()),
        }
    }
}

impl Metrics {
    #[expect(clippy::unused_self, reason = "every command is run in the same way")]
    pub(crate) fn run(&self, ui: &mut Ui) -> Result<(), CliError> {
        let session = Session::new()?;
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
        let lines: Vec<Line<'_>> = parsed.samples().iter().map(Line::from).collect();
        ui.result(&lines, String::new)
    }
}
