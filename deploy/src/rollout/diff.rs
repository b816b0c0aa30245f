//! What differs between what is asked for and what is there, in words.

use std::collections::{BTreeMap, BTreeSet};

use super::desired::Desired;
use super::observed::{MemberState, Observed, Reached, Run, RunState};

/// Why the federation has to be started or restarted; empty when it runs exactly as asked for, and nothing else does.
pub(super) fn changes(desired: &Desired, observed: &BTreeMap<String, Observed>) -> Vec<String> {
    let runs: BTreeMap<&String, &Run> = observed
        .iter()
        .filter_map(|(host, observed)| Some((host, observed.run()?)))
        .collect();
    if runs.is_empty() {
        return vec!["it is not there yet".to_owned()];
    }
    let mut words = Words::default();
    for host in desired.hosts.keys().filter(|host| !runs.contains_key(host)) {
        words.add(format!("nothing on host `{host}`"));
    }
    let mut ids = BTreeSet::new();
    for (host, run) in &runs {
        if !desired.hosts.contains_key(*host) {
            words.add(format!(
                "host `{host}` is not among the manifest's any more"
            ));
            continue;
        }
        ids.insert(&run.id);
        if run.digest != desired.digest {
            words.all(differences(desired, run, host));
        }
        words.all(unhealthy(host, run));
        let reached = observed.get(*host).and_then(Observed::reached);
        words.all(reached.map(secrets).unwrap_or_default());
        words.all(absent(desired, host, run));
    }
    if ids.len() > 1 {
        let ids: Vec<_> = ids.into_iter().map(|id| short(id)).collect();
        words.add(format!("parts of different runs: {}", ids.join(", ")));
    }
    words.0
}

/// Words in the order in which they were found, each once.
#[derive(Default)]
struct Words(Vec<String>);

impl Words {
    fn add(&mut self, word: String) {
        if !self.0.contains(&word) {
            self.0.push(word);
        }
    }

    fn all(&mut self, words: impl IntoIterator<Item = String>) {
        for word in words {
            self.add(word);
        }
    }
}

/// What of the manifest has changed since a run was made.
fn differences(desired: &Desired, run: &Run, host: &str) -> Vec<String> {
    if run.digest.is_empty() {
        return vec![format!(
            "what host `{host}` runs is not known: its record is damaged"
        )];
    }
    if run.facets.is_empty() {
        return vec!["the manifest or a program changed".to_owned()];
    }
    let (new, old) = (&desired.facets, &run.facets);
    let keys: BTreeSet<&String> = new.keys().chain(old.keys()).collect();
    let changed = keys
        .into_iter()
        .filter(|key| new.get(*key) != old.get(*key));
    let mut words = Words::default();
    words.all(changed.map(|key| facet(key, new, old)));
    if words.0.is_empty() {
        words.add("the manifest changed".to_owned());
    }
    words.0
}

/// What a facet's change is called.
fn facet(key: &str, new: &BTreeMap<String, String>, old: &BTreeMap<String, String>) -> String {
    let mut parts = key.split('/');
    let (subject, name, aspect) = (parts.next(), parts.next(), parts.next());
    let has = |facets: &BTreeMap<String, String>, prefix: &str| {
        facets.keys().any(|key| key.starts_with(prefix))
    };
    match (subject, name, aspect) {
        (Some("federate"), Some(name), Some(aspect)) => {
            let prefix = format!("federate/{name}/");
            match (has(old, &prefix), has(new, &prefix)) {
                (false, _) => format!("new federate `{name}`"),
                (_, false) => format!("no federate `{name}` any more"),
                (true, true) => match aspect {
                    "parameters" => format!("parameter changed: federate `{name}`"),
                    "host" => format!("moved to another host: federate `{name}`"),
                    _ => format!("{aspect} changed: federate `{name}`"),
                },
            }
        }
        (Some("host"), Some(name), _) => match (old.get(key), new.get(key)) {
            (None, _) => format!("new host `{name}`"),
            (_, None) => format!("host `{name}` is not among the manifest's any more"),
            (Some(_), Some(_)) => format!("engine, address or ports changed: host `{name}`"),
        },
        (Some("rti"), ..) => "the RTI moved to another host".to_owned(),
        _ => format!("{key} changed"),
    }
}

/// Secrets that a host has not as they are now.
fn secrets(reached: &Reached) -> Vec<String> {
    let changed = reached.secrets_changed.iter();
    let words = changed.flat_map(|(federate, names)| {
        let word = move |name| format!("secret {name} changed: federate `{federate}`");
        names.iter().map(word)
    });
    words.collect()
}

/// Why a part is not healthy.
fn unhealthy(host: &str, run: &Run) -> Vec<String> {
    match &run.state {
        RunState::Running => {
            let failed = run.members.iter().filter_map(|(name, state)| match state {
                MemberState::Lives | MemberState::Completed => None,
                MemberState::Failed { how } => {
                    Some(format!("`{name}` on host `{host}` does not run: {how}"))
                }
            });
            failed.collect()
        }
        RunState::Prepared => vec![format!("a start was left unfinished on host `{host}`")],
        RunState::Starting => vec![format!("not healthy yet on host `{host}`")],
        RunState::Stopping => vec![format!("it is being stopped on host `{host}`")],
        RunState::Ended { how } => vec![format!("it has ended on host `{host}`: {how}")],
    }
}

/// Members that the host should have and does not.
fn absent(desired: &Desired, host: &str, run: &Run) -> Vec<String> {
    let Some(wanted) = desired.hosts.get(host) else {
        return Vec::new();
    };
    // Another digest says so already.
    let same = run.digest == desired.digest;
    let rti = wanted.rti.then_some("rti");
    let members = wanted.federates.iter().map(String::as_str).chain(rti);
    let absent = members.filter(|name| same && !run.members.contains_key(*name));
    absent
        .map(|name| format!("`{name}` is not there on host `{host}`"))
        .collect()
}

/// The first digits of an id, as people see it.
pub(super) fn short(id: &str) -> &str {
    id.char_indices().nth(8).map_or(id, |(end, _)| &id[..end])
}
