//! Generations: the runs of a federation that were committed here, the last few with all that they were run from.

use std::collections::BTreeSet;
use std::fs;
use std::io;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::api::Outcome;
use crate::api::recorded::{Generation, GenerationView};
use crate::files;

/// Runs that can be brought back.
const KEPT_MAX: usize = 3;
/// Runs of which at least a line is left.
const LINES_MAX: usize = 20;
/// The format of a generation's file.
const FORMAT: u32 = 1;

/// The directory of a federation's generations: a file each, `NUMBER.json`.
#[derive(Clone, Debug)]
pub(crate) struct History(PathBuf);

/// A generation's file.
#[derive(Debug, Serialize, Deserialize)]
struct Stored {
    format: u32,
    #[serde(flatten)]
    generation: Generation,
}

/// What becomes of a generation when a newer one comes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fate {
    Kept,
    Line,
    Removed,
}

impl History {
    pub(crate) fn new(directory: PathBuf) -> Self {
        Self(directory)
    }

    /// Enters a run that begins: its number is the one that is proposed, or follows the last one when that is larger.
    pub(crate) fn begin(&self, mut generation: Generation) -> io::Result<u64> {
        let last = self.all().first().map_or(0, |newest| newest.view.number);
        let number = generation.view.number.max(last.saturating_add(1));
        generation.view.number = number;
        let mut directory = fs::DirBuilder::new();
        directory.recursive(true).mode(0o700).create(&self.0)?;
        self.write(generation)?;
        self.prune()?;
        Ok(number)
    }

    /// Enters how a run ended, unless that is known.
    pub(crate) fn end(&self, id: &str, outcome: &Outcome) -> io::Result<()> {
        let all = self.all().into_iter();
        let Some(mut generation) = all
            .filter(|it| it.view.id == id)
            .find(|it| it.view.outcome.is_none())
        else {
            return Ok(());
        };
        generation.view.outcome = Some(outcome.clone());
        self.write(generation)?;
        self.prune()
    }

    /// Every run that is known, the newest first.
    pub(crate) fn views(&self) -> Vec<GenerationView> {
        self.all().into_iter().map(|it| it.view).collect()
    }

    /// One run, by its id.
    pub(crate) fn find(&self, id: &str) -> Option<Generation> {
        self.all().into_iter().find(|it| it.view.id == id)
    }

    /// Digests of the programs that generations need.
    pub(crate) fn blobs(&self) -> BTreeSet<String> {
        let all = self.all().into_iter();
        all.filter_map(|it| it.request?.part)
            .flat_map(|part| part.programs.into_values())
            .collect()
    }

    /// Names and ids of the images that generations need.
    pub(crate) fn images(&self) -> BTreeSet<String> {
        let all = self.all().into_iter().filter_map(|it| it.request);
        all.flat_map(|request| request.federates)
            .filter_map(|run| run.needs.image)
            .collect()
    }

    /// The newest first; files that are none, or of a newer version, are passed over.
    fn all(&self) -> Vec<Generation> {
        let files = fs::read_dir(&self.0).into_iter().flatten().flatten();
        let mut all: Vec<Generation> = files.filter_map(|file| read(&file.path())).collect();
        all.sort_by_key(|it| std::cmp::Reverse(it.view.number));
        all
    }

    fn path(&self, number: u64) -> PathBuf {
        self.0.join(format!("{number}.json"))
    }

    fn write(&self, generation: Generation) -> io::Result<()> {
        let path = self.path(generation.view.number);
        let format = FORMAT;
        let bytes = serde_json::to_vec_pretty(&Stored { format, generation })?;
        files::write_durably(&path, &bytes)
    }

    fn prune(&self) -> io::Result<()> {
        let all = self.all();
        let views: Vec<_> = all.iter().map(|it| &it.view).collect();
        for (mut generation, fate) in all.clone().into_iter().zip(fates(&views)) {
            match fate {
                Fate::Kept => {}
                Fate::Line if generation.request.is_none() => {}
                Fate::Line => {
                    (generation.view.kept, generation.request) = (false, None);
                    self.write(generation)?;
                }
                Fate::Removed => files::remove(&self.path(generation.view.number))?,
            }
        }
        Ok(())
    }
}

/// What becomes of each, the newest first. One that was undone is nothing to go back to, and takes nobody's place.
fn fates(views: &[&GenerationView]) -> Vec<Fate> {
    let mut kept = 0;
    let fate = |(index, view): (usize, &&GenerationView)| {
        if view.kept && kept < KEPT_MAX && !was_undone(view.outcome.as_ref()) {
            kept += 1;
            Fate::Kept
        } else if index < LINES_MAX {
            Fate::Line
        } else {
            Fate::Removed
        }
    };
    views.iter().enumerate().map(fate).collect()
}

fn was_undone(outcome: Option<&Outcome>) -> bool {
    match outcome {
        Some(Outcome::Aborted) => true,
        Some(Outcome::Failed { was_healthy, .. }) => !was_healthy,
        Some(Outcome::Completed | Outcome::Stopped { .. }) | None => false,
    }
}

fn read(path: &Path) -> Option<Generation> {
    let stored: Stored = serde_json::from_slice(&fs::read(path).ok()?).ok()?;
    (stored.format <= FORMAT).then_some(stored.generation)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use proptest::prelude::*;

    use super::*;

    fn run(number: u64, outcome: Option<Outcome>, kept: bool) -> GenerationView {
        GenerationView {
            number,
            id: format!("run-{number}"),
            at_ns: 0,
            who: "a test".to_owned(),
            digest: String::new(),
            outcome,
            kept,
        }
    }

    fn outcome() -> impl Strategy<Value = Option<Outcome>> {
        let stopped = Outcome::Stopped { missed: Vec::new() };
        prop_oneof![
            Just(None),
            Just(Some(Outcome::Completed)),
            Just(Some(stopped)),
            Just(Some(Outcome::Aborted)),
        ]
    }

    proptest! {
        /// Three at most can be brought back, the newest ones, and none that was undone; what has lost its request does not
        /// get it back.
        #[test]
        fn the_last_three_that_ran_are_kept(runs in prop::collection::vec((outcome(), any::<bool>()), 0..40)) {
            let count = u64::try_from(runs.len()).unwrap();
            let views: Vec<_> = (1..=count).rev().zip(runs).map(|(number, (how, kept))| run(number, how, kept)).collect();
            let fates = fates(&views.iter().collect::<Vec<_>>());
            let good = |view: &GenerationView| view.kept && !was_undone(view.outcome.as_ref());
            let expected: Vec<_> = views.iter().filter(|it| good(it)).take(KEPT_MAX).map(|it| it.number).collect();
            let with = |fate| views.iter().zip(&fates).filter(move |(_, it)| **it == fate).map(|(view, _)| view.number);
            prop_assert_eq!(with(Fate::Kept).collect::<Vec<_>>(), expected);
            prop_assert!(with(Fate::Line).count() + with(Fate::Kept).count() <= LINES_MAX + KEPT_MAX);
            prop_assert!(fates.iter().take(LINES_MAX).all(|fate| *fate != Fate::Removed));
        }
    }

    #[test]
    fn a_generation_is_numbered_ended_and_found() {
        let directory = tempfile::tempdir().unwrap();
        let history = History::new(directory.path().join("history"));
        let generation = |id: &str, number| Generation {
            view: GenerationView {
                id: id.to_owned(),
                ..run(number, None, true)
            },
            facets: BTreeMap::new(),
            request: None,
        };
        assert_eq!(history.begin(generation("a", 1)).unwrap(), 1);
        // Other hosts have seen more.
        assert_eq!(history.begin(generation("b", 7)).unwrap(), 7);
        assert_eq!(history.begin(generation("c", 2)).unwrap(), 8);
        history.end("b", &Outcome::Completed).unwrap();
        history.end("b", &Outcome::Aborted).unwrap();
        history.end("unheard of", &Outcome::Aborted).unwrap();
        fs::write(directory.path().join("history/9.json"), "{").unwrap();
        let views = history.views();
        let numbers: Vec<_> = views.iter().map(|it| it.number).collect();
        assert_eq!(numbers, [8, 7, 1]);
        assert_eq!(views[1].outcome, Some(Outcome::Completed));
        assert_eq!(history.find("c").unwrap().view.number, 8);
    }
}
