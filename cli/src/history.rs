//! The runs of a federation as its hosts remember them, as one list.

use std::collections::{BTreeMap, BTreeSet};

use ictus_deploy::rollout::{PartOutcome, merge_outcomes};
use ictusd::api::recorded::GenerationView;
use serde::Serialize;

use crate::error::CliError;
use crate::hosts::{Clients, outcome};

/// A run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(crate) struct Entry {
    /// Counts up with every run.
    pub(crate) number: u64,
    /// The run's id.
    pub(crate) id: String,
    /// When the first host was told to begin it, nanoseconds since the Unix epoch.
    pub(crate) at_ns: i64,
    pub(crate) who: String,
    /// Of the manifest and its programs.
    pub(crate) digest: String,
    /// How it ended, in words; absent while it runs, and where nobody was there to see it.
    pub(crate) outcome: Option<String>,
    /// Whether it can be brought back.
    pub(crate) kept: bool,
    pub(crate) hosts: BTreeSet<String>,
}

/// Asks every host.
pub(crate) async fn ask(clients: &Clients, federation: &str) -> Result<Vec<Entry>, CliError> {
    let mut by_host = BTreeMap::new();
    for (host, client) in clients {
        // A host that the manifest has now may have had no part yet.
        let names = client.names().await?;
        if names.iter().any(|name| name == federation) {
            by_host.insert(host.clone(), client.history(federation).await?);
        }
    }
    Ok(merge(&by_host))
}

/// One list of what each host remembers, the newest first. A run can be brought back when every host that remembers it
/// has kept it.
fn merge(by_host: &BTreeMap<String, Vec<GenerationView>>) -> Vec<Entry> {
    let mut runs: BTreeMap<&str, BTreeMap<&String, &GenerationView>> = BTreeMap::new();
    for (host, views) in by_host {
        for view in views {
            runs.entry(&view.id).or_default().insert(host, view);
        }
    }
    let entry = |(id, views): (&str, BTreeMap<&String, &GenerationView>)| {
        let first = views.values().min_by_key(|view| view.at_ns)?;
        let parts = views.iter().map(|(host, view)| {
            let ended = view.outcome.as_ref();
            let part = ended.map_or(PartOutcome::Runs, |how| {
                PartOutcome::Ended(outcome::ended(host, how))
            });
            ((*host).clone(), part)
        });
        let merged = merge_outcomes(&parts.collect());
        Some(Entry {
            number: views.values().map(|view| view.number).max()?,
            id: id.to_owned(),
            at_ns: first.at_ns,
            who: first.who.clone(),
            digest: first.digest.clone(),
            outcome: merged.ended.as_ref().map(outcome::describe),
            kept: views.values().all(|view| view.kept),
            hosts: views.keys().map(|host| (*host).clone()).collect(),
        })
    };
    let mut entries: Vec<Entry> = runs.into_iter().filter_map(entry).collect();
    entries.sort_by_key(|entry| std::cmp::Reverse((entry.number, entry.at_ns)));
    entries
}

/// The run to go back to: the one that is wanted, or the last one that is kept before the one that is there.
pub(crate) fn choose<'a>(
    entries: &'a [Entry],
    there: Option<&str>,
    wanted: Option<u64>,
) -> Result<&'a Entry, CliError> {
    let kept: Vec<_> = entries.iter().filter(|entry| entry.kept).collect();
    let numbers: Vec<_> = kept.iter().map(|entry| entry.number.to_string()).collect();
    let found = match wanted {
        Some(number) => kept.iter().find(|entry| entry.number == number),
        None => {
            let current = entries
                .iter()
                .find(|entry| Some(entry.id.as_str()) == there);
            kept.iter()
                .find(|entry| current.is_none_or(|current| entry.number < current.number))
        }
    };
    found.copied().ok_or_else(|| {
        let what = match wanted {
            Some(number) => format!("generation {number} is not kept"),
            None => "there is no generation before the one that is there".to_owned(),
        };
        let error = CliError::failed(what);
        match numbers.is_empty() {
            true => error.hint("no generation is kept"),
            false => error.hint(format!("kept: {}", numbers.join(", "))),
        }
    })
}

#[cfg(test)]
mod tests {
    use ictusd::api::Outcome;

    use super::*;

    fn view(number: u64, outcome: Option<Outcome>, kept: bool) -> GenerationView {
        GenerationView {
            number,
            id: format!("run-{number}"),
            at_ns: i64::try_from(number).unwrap(),
            who: "ann".to_owned(),
            digest: "d".to_owned(),
            outcome,
            kept,
        }
    }

    #[test]
    fn hosts_remember_one_history() {
        let done = || Some(Outcome::Completed);
        let by_host = BTreeMap::from([
            (
                "a".to_owned(),
                vec![
                    view(3, None, true),
                    view(2, done(), true),
                    view(1, done(), true),
                ],
            ),
            // It was away when the first was pruned.
            (
                "b".to_owned(),
                vec![
                    view(3, None, true),
                    view(2, None, true),
                    view(1, done(), false),
                ],
            ),
        ]);
        let entries = merge(&by_host);
        let told: Vec<_> = entries
            .iter()
            .map(|it| (it.number, it.outcome.as_deref(), it.kept, it.hosts.len()))
            .collect();
        assert_eq!(
            told,
            [
                (3, None, true, 2),
                (2, None, true, 2),
                (1, Some("completed"), false, 2)
            ]
        );
    }

    #[test]
    fn the_run_before_is_the_last_that_is_kept_and_older() {
        let runs = vec![
            view(4, Some(Outcome::Aborted), false),
            view(3, None, true),
            view(2, None, true),
            view(1, None, false),
        ];
        let entries = merge(&BTreeMap::from([("a".to_owned(), runs)]));
        let number = |there, wanted| choose(&entries, there, wanted).map(|it| it.number).ok();
        assert_eq!(number(Some("run-3"), None), Some(2));
        // After a start that was undone, what ran before it.
        assert_eq!(number(Some("run-4"), None), Some(3));
        assert_eq!(number(None, None), Some(3), "after `down`");
        assert_eq!(number(Some("run-2"), None), None);
        assert_eq!(number(Some("run-3"), Some(2)), Some(2));
        assert_eq!(number(Some("run-3"), Some(3)), Some(3));
        let error = choose(&entries, None, Some(1)).unwrap_err();
        assert_eq!(error.to_string(), "generation 1 is not kept");
        assert_eq!(error.hints, ["kept: 3, 2"]);
    }
}
