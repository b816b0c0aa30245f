//! All federations of this host as one page for Prometheus.

use ictus_coord::measure::{Downstream, Histogram, Own, Upstream};
use ictus_coord::plan::{Coordination, Plan};
use ictus_coord::report::ClockStatus;
use ictus_coord::stp::{self, Link};
use ictus_metrics::catalogue::{
    CLOCK_ERROR_BOUND, CLOCK_ERROR_LIMIT, CLOCK_FREQUENCY_ERROR, CLOCK_OFFSET, CLOCK_PROBES,
    CLOCK_STEPS, CLOCK_SYNCHRONIZED, DAEMON_BUILD_INFO, DEADLINE_LATENESS, DEADLINE_MISSES,
    FALLING_BEHIND, FEDERATE_EXITS, FEDERATE_RESTARTS, FEDERATE_STATE, FEDERATE_UP, FELL_BEHIND,
    GRANT_WAIT, LAUNCH_LAG, MESSAGE_BYTES, MESSAGE_LATENCY, MESSAGES_RECEIVED, MESSAGES_SENT,
    REACTIONS_EXECUTED, RTI_FEDERATES, RTI_UP, STP_OFFSET, STP_OFFSET_REQUIRED, STP_SLACK,
    STP_VIOLATION_LATENESS, STP_VIOLATIONS, TAG_LAG, TAGS_COMPLETED, WATCHDOGS_FIRED,
};
use ictus_metrics::{Metric, Registry};

use crate::api::{FederateMeasures, FederationMeasures, FederationView, MemberView};

/// What is known of one federation at a moment.
#[derive(Clone, Debug)]
pub(crate) struct Snapshot {
    pub(crate) view: FederationView,
    pub(crate) measures: FederationMeasures,
    /// What it runs, or ran; absent when that cannot be read.
    pub(crate) plan: Option<Plan>,
}

/// The page.
pub(crate) fn page(snapshots: &[Snapshot]) -> String {
    let mut registry = Registry::default();
    registry.set(DAEMON_BUILD_INFO, &[env!("CARGO_PKG_VERSION")], 1.0);
    for snapshot in snapshots {
        let federation = snapshot.view.name.as_str();
        processes(&mut registry, federation, &snapshot.view);
        if let Some(plan) = &snapshot.plan {
            declared(&mut registry, federation, plan);
        }
        for measures in &snapshot.measures.federates {
            measured(&mut registry, federation, measures);
        }
    }
    registry.text()
}

fn processes(registry: &mut Registry, federation: &str, view: &FederationView) {
    registry.set_flag(RTI_UP, &[federation], view.rti.lives());
    for state in MemberView::STATES {
        let in_state = view.federates.iter().filter(|member| member.state == state);
        let count = u32::try_from(in_state.count()).unwrap_or(u32::MAX);
        registry.set(RTI_FEDERATES, &[federation, state], f64::from(count));
    }
    for member in &view.federates {
        let labels = [federation, member.name.as_str()];
        registry.set_flag(FEDERATE_UP, &labels, member.lives());
        for state in MemberView::STATES {
            let labels = [federation, &member.name, state];
            registry.set_flag(FEDERATE_STATE, &labels, member.state == state);
        }
        // The protocol lets no federate in again.
        registry.count(FEDERATE_RESTARTS, &labels, 0);
        if let Some(exit) = member.exit {
            let labels = [federation, &member.name, exit.name()];
            registry.count(FEDERATE_EXITS, &labels, 1);
        }
    }
}

fn declared(registry: &mut Registry, federation: &str, plan: &Plan) {
    if let Some(limit) = plan.clock.max_error_ns {
        registry.set_duration(CLOCK_ERROR_LIMIT, &[federation], limit);
    }
    if plan.coordination == Coordination::Decentralized {
        for federate in &plan.federates {
            let labels = [federation, federate.name.as_str()];
            registry.set_duration(STP_OFFSET, &labels, federate.stp_offset_ns);
        }
        required(registry, federation, plan);
    }
}

/// The offsets that the declared bounds ask for, given the senders' offsets.
fn required(registry: &mut Registry, federation: &str, plan: &Plan) {
    let federates = plan.federates.iter();
    let offsets: Vec<_> = federates.map(|it| Some(it.stp_offset_ns)).collect();
    let links: Vec<_> = plan.connections.iter().filter_map(Link::of).collect();
    // Without a solution, nothing that is asked for would be enough.
    let Ok(solution) = stp::solve(&links, &offsets) else {
        return;
    };
    for (federate, offset) in plan.federates.iter().zip(&solution.federates) {
        if let Some(required) = offset.required_ns {
            let labels = [federation, federate.name.as_str()];
            registry.set_duration(STP_OFFSET_REQUIRED, &labels, required);
        }
    }
}

fn measured(registry: &mut Registry, federation: &str, measures: &FederateMeasures) {
    let federate = measures.federate.as_str();
    let labels = [federation, federate];
    own(registry, labels, &measures.own);
    registry.set_flag(FALLING_BEHIND, &labels, measures.behind);
    if let Some(status) = &measures.clock {
        clock(registry, labels, status);
    }
    let mut lateness = Histogram::default();
    for (name, peer) in &measures.upstreams {
        upstream(registry, [federation, federate, name], peer);
        lateness.merge(&peer.lateness);
    }
    observed(registry, STP_VIOLATION_LATENESS, &labels, &lateness);
    for (name, peer) in &measures.downstreams {
        downstream(registry, [federation, federate, name], peer);
    }
}

fn own(registry: &mut Registry, labels: [&str; 2], own: &Own) {
    let counters = [
        (TAGS_COMPLETED, own.tags_completed),
        (REACTIONS_EXECUTED, own.reactions),
        (DEADLINE_MISSES, own.deadline_misses),
        (WATCHDOGS_FIRED, own.watchdogs_fired),
        (FELL_BEHIND, own.fell_behind),
    ];
    for (metric, value) in counters {
        registry.count(metric, &labels, value);
    }
    observed(registry, TAG_LAG, &labels, &own.tag_lag);
    observed(registry, GRANT_WAIT, &labels, &own.grant_wait);
    observed(registry, DEADLINE_LATENESS, &labels, &own.deadline_lateness);
}

fn clock(registry: &mut Registry, labels: [&str; 2], status: &ClockStatus) {
    let [federation, federate] = labels;
    let by_source = [federation, federate, status.source.name()];
    registry.set_duration(CLOCK_OFFSET, &by_source, status.offset_ns);
    if let Some(bound) = status.bound_ns {
        registry.set_duration(CLOCK_ERROR_BOUND, &by_source, bound);
    }
    registry.set_flag(CLOCK_SYNCHRONIZED, &by_source, status.synchronized);
    // Parts per 10^9 are nanoseconds a second.
    registry.set_duration(CLOCK_FREQUENCY_ERROR, &by_source, status.drift_ppb);
    registry.count(CLOCK_STEPS, &labels, status.steps);
    let probes = [
        ("kept", status.probes_kept),
        ("dropped", status.probes_dropped),
        ("stranger", status.strangers),
    ];
    for (result, count) in probes {
        registry.count(CLOCK_PROBES, &[federation, federate, result], count);
    }
}

fn upstream(registry: &mut Registry, labels: [&str; 3], peer: &Upstream) {
    let [federation, federate, name] = labels;
    registry.count(MESSAGES_RECEIVED, &labels, peer.messages);
    let direction = [federation, federate, name, "received"];
    registry.count(MESSAGE_BYTES, &direction, peer.bytes);
    registry.count(STP_VIOLATIONS, &labels, peer.stp_violations);
    observed(registry, STP_SLACK, &labels, &peer.slack);
    observed(registry, MESSAGE_LATENCY, &labels, &peer.arrival);
}

fn downstream(registry: &mut Registry, labels: [&str; 3], peer: &Downstream) {
    let [federation, federate, name] = labels;
    registry.count(MESSAGES_SENT, &labels, peer.messages);
    let direction = [federation, federate, name, "sent"];
    registry.count(MESSAGE_BYTES, &direction, peer.bytes);
    observed(registry, LAUNCH_LAG, &labels, &peer.launch_lag);
}

/// Shows a histogram; one of which nothing is measured in this federation's mode would only be noise.
fn observed(registry: &mut Registry, metric: Metric, labels: &[&str], histogram: &Histogram) {
    if !histogram.is_empty() {
        registry.observed(metric, labels, histogram.buckets(), histogram.sum_ns());
    }
}

/// The page of these measures alone.
#[cfg(test)]
pub(crate) fn measures_page(measures: &FederationMeasures) -> String {
    let mut registry = Registry::default();
    for federate in &measures.federates {
        measured(&mut registry, &measures.federation, federate);
    }
    registry.text()
}

#[cfg(test)]
mod tests;
