//! `ictus schema`: the manifest's JSON Schema.

use crate::error::CliError;
use crate::ui::Ui;

pub(crate) fn run(ui: &mut Ui) -> Result<(), CliError> {
    let schema = ictus_deploy::schema();
    let pretty = serde_json::to_string_pretty(&schema).map_err(CliError::failed)?;
    ui.result(&schema, || pretty)
}
