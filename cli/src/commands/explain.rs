//! `ictus explain`: what an error code means.

use clap::Args;
use serde_json::json;

use crate::error::CliError;
use crate::ui::Ui;

/// Tell more about an error code
#[derive(Debug, Args)]
pub(crate) struct Explain {
    /// The code in brackets at the end of a message, such as F003
    code: String,
}

impl Explain {
    pub(crate) fn run(&self, ui: &mut Ui) -> Result<(), CliError> {
        let code = self.code.trim_matches(['[', ']']).to_ascii_uppercase();
        let Some(text) = ictus_deploy::explain(&code) else {
            let error = CliError::failed(format!("there is no code `{}`", self.code));
            return Err(error.hint("a code looks like F003 and stands at the end of a message"));
        };
        ui.result(&json!({ "code": code, "text": text }), || text.to_owned())
    }
}
