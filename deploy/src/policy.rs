//! Keys of a manifest that exclude each other, or do nothing beside each other.

use ictus_coord::plan::{ClockSync, Coordination};

use crate::federation::Member;
use crate::manifest::Manifest;
use crate::problem::{Place, Report};

/// Reports what does not go together.
pub(crate) fn check(manifest: &Manifest, members: &[Member<'_>], report: &mut Report) {
    fast(manifest, members, report);
    if manifest.clock.period.is_some_and(|period| period.0 == 0) {
        let place = Place::value(&["clock", "period"]);
        report.add("F005", place, "the period is not longer than 0", "");
    }
    if manifest.clock.max_error.is_some() && manifest.clock.sync == ClockSync::Off {
        let message = "`max_error` has no effect with `sync: off`: no clock is measured";
        let place = Place::key(&["clock", "max_error"]);
        report.warn("W003", place, message, "");
    }
    match manifest.coordination.unwrap_or_default() {
        Coordination::Centralized => centralized(manifest, report),
        Coordination::Decentralized => decentralized(manifest, report),
    }
    physical(manifest, report);
    foreign(members, report);
}

/// `fast` runs ahead of physical time, so nothing may depend on it.
fn fast(manifest: &Manifest, members: &[Member<'_>], report: &mut Report) {
    if !manifest.fast {
        return;
    }
    let mut refuse = |message: String, fix: &str| {
        report.add("F019", Place::value(&["fast"]), message, fix);
    };
    let acts = |member: &&Member<'_>| {
        let description = member.description.as_ref();
        description.is_some_and(|known| known.physical)
    };
    let names: Vec<&str> = members.iter().filter(acts).map(|one| one.name).collect();
    if !names.is_empty() {
        let message = format!("`fast`, but `{}` has a physical action", names.join("`, `"));
        refuse(message, "remove `fast: true`");
    }
    let physical = manifest.connections.iter().find(|one| one.physical);
    if let Some(connection) = physical {
        let from = connection.from.as_deref().unwrap_or_default();
        let message = format!("`fast`, but a connection of `{from}` is physical");
        refuse(message, "remove `fast: true`");
    }
    if manifest.coordination == Some(Coordination::Decentralized) {
        let message = "`fast`, but decentralized coordination decides by physical time";
        refuse(
            message.to_owned(),
            "remove `fast: true`, or coordinate centrally",
        );
    }
}

/// Offsets, which only decentralized coordination has.
fn centralized(manifest: &Manifest, report: &mut Report) {
    let mut unused = |key: &str, paths: Vec<Vec<String>>| {
        if let [first, others @ ..] = paths.as_slice() {
            let more = match others.len() {
                0 => String::new(),
                more => format!(" (and {more} more of them)"),
            };
            let message = format!("`{key}` has no effect under centralized coordination{more}");
            let fix = "write `coordination: decentralized`, or remove it";
            report.warn("W003", Place::key(first), message, fix);
        }
    };
    let path = |path: &[&str]| path.iter().map(|step| (*step).to_owned()).collect();
    let defaults = &manifest.defaults;
    let mut offsets: Vec<Vec<String>> = Vec::new();
    let mut policies: Vec<Vec<String>> = Vec::new();
    for (name, federate) in &manifest.federates.0 {
        if federate.stp_offset.is_some() {
            offsets.push(path(&["federates", name, "stp_offset"]));
        }
        if federate.on_stp_violation.is_some() {
            policies.push(path(&["federates", name, "on_stp_violation"]));
        }
    }
    let mut waits: Vec<Vec<String>> = Vec::new();
    let tagged = manifest.connections.iter().enumerate();
    for (entry, connection) in tagged.filter(|(_, one)| !one.physical) {
        let entry = entry.to_string();
        if connection.stp_offset.is_some() {
            offsets.push(path(&["connections", &entry, "stp_offset"]));
        }
        if connection.absent_after.is_some() {
            waits.push(path(&["connections", &entry, "absent_after"]));
        }
    }
    if defaults.stp_offset.is_some() {
        offsets.push(path(&["defaults", "stp_offset"]));
    }
    if defaults.on_stp_violation.is_some() {
        policies.push(path(&["defaults", "on_stp_violation"]));
    }
    unused("stp_offset", offsets);
    unused("absent_after", waits);
    unused("on_stp_violation", policies);
}

/// Flow control by LTC, which only centralized coordination has.
fn decentralized(manifest: &Manifest, report: &mut Report) {
    if manifest.max_lead.is_some() {
        let message = "`max_lead` has no effect under decentralized coordination";
        report.warn("W003", Place::key(&["max_lead"]), message, "remove it");
    }
}

/// A physical connection has no tag to be late for.
fn physical(manifest: &Manifest, report: &mut Report) {
    for (entry, connection) in manifest.connections.iter().enumerate() {
        let bounds = connection.bounds;
        let keys = [
            ("stp_offset", connection.stp_offset.is_some()),
            ("absent_after", connection.absent_after.is_some()),
            (
                "bounds",
                bounds
                    .launch_lag
                    .or(bounds.latency)
                    .or(bounds.clock_error)
                    .is_some(),
            ),
        ];
        let keys = keys
            .iter()
            .filter(|(_, given)| *given && connection.physical);
        for (key, _) in keys {
            let message = format!("`{key}` has no effect on a physical connection");
            let place = Place::key(&["connections", &entry.to_string(), key]);
            report.warn("W003", place, message, "remove it");
        }
    }
}

/// What only our own federates can be told.
fn foreign(members: &[Member<'_>], report: &mut Report) {
    for member in members.iter().filter(|member| member.is_foreign()) {
        let federate = member.federate;
        let keys = [
            (
                &["on_stp_violation"][..],
                federate.on_stp_violation.is_some(),
            ),
            (
                &["clock", "test_offset"],
                federate.clock.test_offset.is_some(),
            ),
            (
                &["clock", "test_drift_ppm"],
                federate.clock.test_drift_ppm.is_some(),
            ),
        ];
        for (key, _) in keys.iter().filter(|(_, given)| *given) {
            let (name, shown) = (member.name, key.join("."));
            let message = format!("`{shown}` has no effect: `{name}` is foreign");
            let path: Vec<&str> = ["federates", name].iter().chain(*key).copied().collect();
            report.warn("W003", Place::key(&path), message, "remove it");
        }
    }
}
