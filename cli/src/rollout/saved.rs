//! A plan in a file, to be looked at and carried out later: exactly that one, or none.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use ictus_deploy::rollout::{Plan, Stale};
use serde::{Deserialize, Serialize};

use crate::error::{CliError, Kind};
use crate::files::write_whole;

/// A plan with what it was made from.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct SavedPlan {
    /// The manifest, as an absolute path.
    pub(crate) manifest: PathBuf,
    /// What was changed in it.
    pub(crate) set: Vec<(String, String)>,
    /// Whether federates write their logical traces.
    pub(crate) trace: bool,
    /// The digest of each thing that matters, by what it is.
    pub(crate) facets: BTreeMap<String, String>,
    pub(crate) plan: Plan,
}

impl SavedPlan {
    pub(crate) fn write(&self, path: &Path) -> Result<(), CliError> {
        let text = serde_json::to_vec_pretty(self).map_err(CliError::failed)?;
        write_whole(path, &text, 0o666).map_err(|error| unusable(path, &error))
    }

    pub(crate) fn read(path: &Path) -> Result<Self, CliError> {
        let text = std::fs::read(path).map_err(|error| unusable(path, &error))?;
        serde_json::from_slice(&text).map_err(|error| {
            unusable(path, &error).hint("`ictus plan --out FILE` of this version writes one")
        })
    }

    /// Why it is not carried out, in words: `facets` are those of the manifest as it is, `causes` what would be done now.
    pub(crate) fn refused(
        &self,
        stale: &Stale,
        facets: &BTreeMap<String, String>,
        causes: &[String],
    ) -> CliError {
        let error = CliError::new(Kind::Stale, stale.to_string());
        match stale {
            Stale::Manifest => {
                let keys: BTreeSet<&String> = self.facets.keys().chain(facets.keys()).collect();
                let differs = |key: &&String| self.facets.get(*key) != facets.get(*key);
                let changed: Vec<_> = keys.into_iter().filter(differs).cloned().collect();
                error.hint(format!("changed since: {}", changed.join(", ")))
            }
            Stale::Moved { .. } if causes.is_empty() => {
                error.hint("it already runs as the manifest says")
            }
            Stale::Moved { .. } => error.hint(format!("by now: {}", causes.join("; "))),
            Stale::Unknown { .. } | Stale::Format { .. } => error,
        }
    }
}

fn unusable(path: &Path, error: &dyn std::fmt::Display) -> CliError {
    CliError::failed(format!("cannot use plan {}: {error}", path.display()))
}
