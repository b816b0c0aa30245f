//! What runs have left: their files, and the generations before the one that is there.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use crate::api::part::Part;
use crate::api::recorded::{FileKind, Generation, GenerationView, Recorded};
use crate::api::{ApiError, ErrorCode, StartRequest};
use crate::history::History;
use crate::store::{self, Directory, Record};

use super::{Host, recorded, store_error};

impl Host {
    /// What the last run has written.
    pub(crate) fn recorded(&self, name: &str) -> Result<Recorded, ApiError> {
        let directory = self.known_directory(name)?;
        let (plan, timing) = directory.read_plan().map_err(|error| ApiError {
            code: ErrorCode::Unknown,
            message: format!("no run of federation `{name}` has left its plan here: {error}"),
            known: Vec::new(),
        })?;
        Ok(Recorded {
            plan,
            timing,
            traces: sizes(&directory.trace(), FileKind::Trace),
            timings: sizes(&directory.timing(), FileKind::Timing),
        })
    }

    /// Where a member's file is, whether it exists or not.
    pub(crate) fn recorded_file(
        &self,
        name: &str,
        kind: FileKind,
        member: &str,
    ) -> Result<PathBuf, ApiError> {
        let directory = self.known_directory(name)?;
        if !store::is_name(member) {
            return Err(ApiError {
                code: ErrorCode::BadRequest,
                message: format!("`{member}` cannot be a federate's name"),
                known: Vec::new(),
            });
        }
        let files = match kind {
            FileKind::Trace => directory.trace(),
            FileKind::Timing => directory.timing(),
        };
        Ok(files.join(format!("{member}.{}", kind.name())))
    }

    /// The federation's runs, the newest first.
    pub(crate) fn generations(&self, name: &str) -> Result<Vec<GenerationView>, ApiError> {
        self.known_directory(name)?;
        self.settle(name);
        Ok(self.history(name).views())
    }

    /// One of its runs, with what it was run from.
    pub(crate) fn generation(&self, name: &str, run: &str) -> Result<Generation, ApiError> {
        self.known_directory(name)?;
        let found = self.history(name).find(run);
        found.ok_or_else(|| ApiError {
            code: ErrorCode::Unknown,
            message: format!("there is no generation of `{name}` with the run {run}"),
            known: Vec::new(),
        })
    }

    /// Enters a run that is committed.
    pub(super) fn enter(
        &self,
        name: &str,
        record: &Record,
        request: &StartRequest,
    ) -> Result<(), ApiError> {
        let leases = self.lease_views();
        let lease = leases.into_iter().find(|lease| lease.federation == name);
        let view = &record.view;
        let generation = Generation {
            view: GenerationView {
                number: view.generation.unwrap_or(1),
                id: view.id.clone(),
                at_ns: crate::stamp::now_ns(),
                who: lease.map_or_else(String::new, |lease| lease.who),
                digest: view.digest.clone(),
                outcome: None,
                kept: true,
            },
            facets: view.facets.clone(),
            request: Some(request.clone()),
        };
        let entered = self.history(name).begin(generation);
        entered.map(drop).map_err(|source| {
            let path = self.directory(name).history();
            store_error(&store::StoreError::Io { path, source })
        })
    }

    /// Enters how the run that is there ended, if it has; an earlier daemon may have had no time for it.
    pub(super) fn settle(&self, name: &str) {
        let Ok(Some(record)) = recorded(name, &self.directory(name)) else {
            return;
        };
        let living = self.handle(name).is_some();
        if let (Some(outcome), false) = (&record.view.outcome, living)
            && let Err(error) = self.history(name).end(&record.view.id, outcome)
        {
            tracing::warn!(%name, %error, "the end of a generation was not written down");
        }
    }

    /// Programs that a run or a generation of this host needs.
    pub(super) fn needed_blobs(&self) -> BTreeSet<String> {
        let mut needed = BTreeSet::new();
        for name in self.names() {
            let directory = self.directory(&name);
            let request = directory.read_request().ok();
            let part: Option<Part> = request.and_then(|request| request.part);
            needed.extend(
                part.into_iter()
                    .flat_map(|part| part.programs.into_values()),
            );
            needed.extend(self.history(&name).blobs());
        }
        needed
    }

    pub(super) fn history(&self, name: &str) -> History {
        History::new(Directory::of(&self.paths().federations(), name).history())
    }
}

/// Bytes of each file of a kind, by federate.
fn sizes(directory: &Path, kind: FileKind) -> BTreeMap<String, u64> {
    let entries = std::fs::read_dir(directory).into_iter().flatten().flatten();
    let size = |entry: std::fs::DirEntry| {
        let path = entry.path();
        if path.extension()? != kind.name() {
            return None;
        }
        let federate = path.file_stem()?.to_str()?.to_owned();
        Some((federate, entry.metadata().ok()?.len()))
    };
    entries.filter_map(size).collect()
}
