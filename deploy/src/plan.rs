//! The plan of a manifest: what every federate and the RTI are told.

use ictus_coord::plan::{ClockPlan, Coordination, FAILURE_TIMEOUT, FORMAT, FederatePlan, Plan};

use crate::federation::{self, Member, Origin};
use crate::manifest::{Manifest, TimeSpan, ViolationPolicy};
use crate::offsets::Offsets;
use crate::wiring::Wire;

/// The plan; the offsets come in when federates use any.
pub(crate) fn resolve(
    manifest: &Manifest,
    members: &[Member<'_>],
    (wires, offsets): (Vec<Wire>, Option<&Offsets>),
) -> Plan {
    let nanos = |span: Option<TimeSpan>| span.map(|span| span.0);
    let mut plan = Plan {
        ictus: FORMAT.to_owned(),
        federation: manifest.federation.clone().unwrap_or_default(),
        coordination: manifest.coordination.unwrap_or_default(),
        timeout_ns: nanos(manifest.timeout),
        fast: manifest.fast,
        keepalive: manifest.keepalive,
        max_lead_ns: nanos(manifest.max_lead),
        failure_timeout_ns: nanos(manifest.defaults.failure_timeout)
            .unwrap_or(FAILURE_TIMEOUT.as_nanos()),
        clock: clock(manifest),
        extensions: true,
        wire: manifest.wire,
        authentication: manifest.authentication,
        federates: members
            .iter()
            .map(|member| federate(manifest, member))
            .collect(),
        connections: wires.into_iter().map(|wire| wire.plan).collect(),
    };
    if let (Coordination::Decentralized, Some(offsets)) = (plan.coordination, offsets) {
        offsets.apply(&mut plan);
    }
    plan
}

fn clock(manifest: &Manifest) -> ClockPlan {
    let basic = ClockPlan::default();
    let clock = &manifest.clock;
    ClockPlan {
        sync: clock.sync,
        period_ns: clock.period.map_or(basic.period_ns, |period| period.0),
        trials: clock.trials.unwrap_or(basic.trials),
        attenuation: clock.attenuation.unwrap_or(basic.attenuation),
        max_error_ns: clock.max_error.map(|error| error.0),
        on_exceed: clock.on_exceed,
    }
}

fn federate(manifest: &Manifest, member: &Member<'_>) -> FederatePlan {
    let (program, class) = match member.origin {
        Origin::Ours { program, class } => (program, class),
        Origin::Foreign { .. } => (None, None),
    };
    let (federate, defaults) = (member.federate, &manifest.defaults);
    let policy = federate.on_stp_violation.or(defaults.on_stp_violation);
    let drift = federate.clock.test_drift_ppm.unwrap_or(0.0) * 1000.0;
    FederatePlan {
        name: member.name.to_owned(),
        class: class.map(str::to_owned),
        program: program.map(str::to_owned),
        parameters: federation::parameters(federate),
        stp_offset_ns: 0,
        on_failure: federate
            .on_failure
            .or(defaults.on_failure)
            .unwrap_or_default(),
        max_stp_violations: policy.and_then(|policy| match policy {
            ViolationPolicy::Count(_) => None,
            ViolationPolicy::Stop(limit) => limit.stop_after.map(u64::from),
        }),
        test_clock_offset_ns: federate.clock.test_offset.map_or(0, |offset| offset.0),
        test_clock_drift_ppb: rounded(drift),
    }
}

/// The nearest integer; the schema keeps drifts within a hundred million ppb.
#[expect(
    clippy::cast_possible_truncation,
    reason = "a cast of floats saturates"
)]
fn rounded(value: f64) -> i64 {
    value.round() as i64
}
