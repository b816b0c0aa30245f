//! The RTI's command line, as a plan asks for it.

use ictus_coord::plan::{ClockSync, FAILURE_TIMEOUT, OnFailure, Plan, Wire};
use ictus_core::Duration;

/// The arguments of `ictus`, beginning with `rti`, for a federation's RTI on this port (0: any).
#[must_use]
pub fn arguments(plan: &Plan, federation_id: &str, port: u16) -> Vec<String> {
    let clock = match plan.clock.sync {
        ClockSync::Off | ClockSync::External => "off",
        ClockSync::Init => "init",
        ClockSync::On => "on",
    };
    let (federates, port) = (plan.federates.len().to_string(), port.to_string());
    let last;
    let mut args = vec!["rti", "-i", federation_id, "-n", &federates, "-p", &port];
    let (period, trials) = (
        plan.clock.period_ns.to_string(),
        plan.clock.trials.to_string(),
    );
    args.extend(["-c", clock]);
    if clock != "off" {
        args.extend(["period", &period, "exchanges-per-interval", &trials]);
    }
    if plan.authentication {
        args.push("-a");
    }
    if plan.wire == Wire::V0_13 {
        args.extend(["--wire", "0.13"]);
    }
    if plan.failure_timeout_ns != FAILURE_TIMEOUT.as_nanos() {
        let failure_timeout = Duration::from_nanos(plan.failure_timeout_ns).to_std();
        args.push("--failure-timeout");
        last = failure_timeout.as_millis().to_string();
        args.push(&last);
    }
    let go_on: Vec<String> = (0_u16..)
        .zip(&plan.federates)
        .filter(|(_, federate)| federate.on_failure == OnFailure::Continue)
        .map(|(id, _)| id.to_string())
        .collect();
    let go_on = go_on.join(",");
    if !go_on.is_empty() {
        args.extend(["--continue", &go_on]);
    }
    args.into_iter().map(str::to_owned).collect()
}
