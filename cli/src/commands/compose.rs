//! `ictus compose`: a federation of one host for docker-compose, without a daemon.

use std::path::{Path, PathBuf};

use clap::Args;
use ictus_deploy::compose::{Compose, ComposeError, ComposeOptions};
use ictus_deploy::{CheckOptions, Checked};
use serde_json::json;

use crate::args::ManifestArgs;
use crate::error::{CliError, Kind};
use crate::files::write_whole;
use crate::rollout::size;
use crate::session::{Session, checked_as};
use crate::ui::Ui;

/// Print a compose file that starts a federation on one host, without ictusd
///
/// It is for docker-compose 1.29 and Compose v2. Its images are loaded into this machine's engine by `--build`:
/// `ictus compose --build > compose.yaml && docker-compose up`.
#[derive(Debug, Args)]
pub(crate) struct ComposeCommand {
    #[command(flatten)]
    manifest: ManifestArgs,
    /// Make the images and load them into this machine's Docker engine
    #[arg(long)]
    build: bool,
    /// Add a collector of what federates measure, Prometheus and Grafana
    #[arg(long)]
    monitoring: bool,
    /// Have federates write their logical traces into this directory, which must be there and writable for them
    #[arg(long, value_name = "DIR")]
    trace: Option<PathBuf>,
    /// Write it there instead of to standard output
    #[arg(long, value_name = "FILE")]
    to: Option<PathBuf>,
}

impl ComposeCommand {
    pub(crate) fn run(&self, ui: &mut Ui) -> Result<(), CliError> {
        let options = CheckOptions {
            contained: true,
            ..CheckOptions::default()
        };
        let checked = checked_as(ui, &self.manifest, options)?;
        let options = ComposeOptions {
            monitoring: self.monitoring,
            trace: self.trace.clone(),
        };
        let compose = of(&checked, &options)?;
        if self.build {
            let session = Session::new()?;
            session.block_on(load(ui, &compose))?;
        }
        if let Some(path) = &self.to {
            write(path, &compose.text)?;
        } else {
            let images: Vec<_> = compose.images.iter().map(|it| &it.reference).collect();
            let answer = json!({ "compose": compose.text, "images": images });
            ui.result(&answer, || compose.text.trim_end().to_owned())?;
        }
        if !self.build {
            let manifest = self.manifest.manifest.display();
            ui.message(&format!(
                "its images are made and loaded by `ictus compose {manifest} --build`"
            ));
        }
        Ok(())
    }
}

/// The compose file of a federation, as a command's answer.
pub(crate) fn of(checked: &Checked, options: &ComposeOptions) -> Result<Compose, CliError> {
    Compose::of(checked, options).map_err(refused)
}

/// Makes the images that are not in the engine yet, and loads them.
pub(crate) async fn load(ui: &mut Ui, compose: &Compose) -> Result<(), CliError> {
    let ictus = std::env::current_exe().map_err(CliError::failed)?;
    let engine = ictusd::images::Local::connect().await;
    let engine = engine.map_err(CliError::failed)?;
    for image in &compose.images {
        ui.progress("loading", &image.reference);
        let archive = image.archive(&ictus).map_err(|error| {
            CliError::failed(error).hint(
                "an image holds one static program: `.ci/static` builds such an `ictus`; a federate of \
                 another language comes in an `image:`",
            )
        })?;
        let bytes = archive.layer_bytes();
        let loaded = engine.load(archive).await.map_err(CliError::failed)?;
        let what = if loaded { "loaded" } else { "unchanged" };
        ui.stage(what, &format!("{}, {}", image.reference, size(bytes)));
    }
    Ok(())
}

/// Writes a file whole or not at all.
pub(crate) fn write(path: &Path, text: &str) -> Result<(), CliError> {
    write_whole(path, text.as_bytes(), 0o666)
        .map_err(|error| CliError::failed(format!("cannot write {}: {error}", path.display())))
}

fn refused(error: ComposeError) -> CliError {
    let hint = match &error {
        ComposeError::SeveralHosts(_) => Some("`ictus up` starts it on its hosts"),
        ComposeError::LargePlan(_) => Some("`ictus up` hands it over as a file"),
        ComposeError::NameTaken(_) => Some("rename the federate, or leave `--monitoring` out"),
        ComposeError::NotBuilt | ComposeError::NotUnicode(_) | ComposeError::Unwritable(_) => None,
    };
    let error = CliError::new(Kind::Failed, error);
    match hint {
        Some(hint) => error.hint(hint),
        None => error,
    }
}
