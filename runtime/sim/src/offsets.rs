//! STP offsets for simulated federations, solved the slow way (which is how the solver is checked), from bounds that hold mostly.

use crate::seed::Rng;
use crate::swarm::{Offsets, Swarm};
use ictus_coord::plan::{Bounds, Coordination, Plan};

/// Makes a plan decentralized, with the offsets that the swarm wants; says whether they are solved from bounds.
pub fn decentralize(plan: &mut Plan, swarm: &Swarm, wanted: Offsets, rng: &mut Rng) {
    plan.coordination = Coordination::Decentralized;
    match wanted {
        Offsets::Zero => {}
        Offsets::Solved if solve(plan, bounds(swarm)) => {}
        Offsets::Solved | Offsets::Random => draw(plan, rng),
    }
}

/// Bounds that every message keeps unless a host is busy or a network clogged.
fn bounds(swarm: &Swarm) -> Bounds {
    let drift = swarm.clocks.drift * 2 * 1_000;
    Bounds {
        launch_lag_ns: swarm.mode.reaction.as_nanos() * 3 + 100_000,
        latency_ns: swarm.network.delay_max.as_nanos(),
        clock_error_ns: swarm.clocks.offset.as_nanos() * 3 + drift,
    }
}

/// The least offsets by repeated relaxation; false, and nothing changed, when a cycle is positive.
fn solve(plan: &mut Plan, bounds: Bounds) -> bool {
    let sum = bounds.launch_lag_ns + bounds.latency_ns + bounds.clock_error_ns;
    let mut offsets = vec![0_i64; plan.federates.len()];
    let remote = |c: &&ictus_coord::plan::ConnectionPlan| c.from.federate != c.to.federate;
    for round in 0..=offsets.len() {
        let mut changed = false;
        for c in plan.connections.iter().filter(remote) {
            let (from, to) = (usize::from(c.from.federate), usize::from(c.to.federate));
            let needed = offsets[from] + sum - c.after_ns.unwrap_or(0);
            if needed > offsets[to] {
                offsets[to] = needed;
                changed = true;
            }
        }
        if !changed {
            break;
        }
        if round == offsets.len() {
            return false;
        }
    }
    for (federate, offset) in plan.federates.iter_mut().zip(&offsets) {
        federate.stp_offset_ns = *offset;
    }
    for c in &mut plan.connections {
        let needed = offsets[usize::from(c.from.federate)] + sum - c.after_ns.unwrap_or(0);
        c.stp_offset_ns = Some(needed.max(0));
        c.bounds = Some(bounds);
    }
    true
}

fn draw(plan: &mut Plan, rng: &mut Rng) {
    for federate in &mut plan.federates {
        federate.stp_offset_ns = *rng.pick(&[0, 300_000, 2_000_000, 20_000_000]);
    }
    for c in &mut plan.connections {
        c.stp_offset_ns = rng
            .percent(50)
            .then(|| *rng.pick(&[0, 500_000, 5_000_000, 30_000_000]));
        c.absent_after_ns = *rng.pick(&[0, 0, 1_000_000]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::program::Federation;
    use ictus_coord::stp::{Link, SolveError, solve};

    #[test]
    fn the_solver_finds_what_relaxation_finds() {
        let (mut solved, mut refused) = (0, 0);
        for seed in 1..=400 {
            let mut rng = Rng::new(seed);
            let swarm = Swarm::draw_decentralized(&mut rng);
            let plan = Federation::generate(&swarm, &mut rng).plan();
            let mut relaxed = plan.clone();
            decentralize(&mut relaxed, &swarm, Offsets::Solved, &mut rng);
            let mut links: Vec<Link> = plan.connections.iter().filter_map(Link::of).collect();
            for link in &mut links {
                link.bounds = Some(bounds(&swarm));
            }
            let solution = solve(&links, &vec![None; plan.federates.len()]);
            let positive = relaxed.connections.iter().any(|c| c.bounds.is_none());
            match solution {
                Ok(solution) => {
                    assert!(!positive, "seed {seed}");
                    let ours = relaxed.federates.iter().map(|f| f.stp_offset_ns);
                    let theirs = solution.federates.iter().map(|f| f.used_ns);
                    assert!(ours.eq(theirs), "seed {seed}");
                    solved += 1;
                }
                Err(SolveError::Cycle(_)) => {
                    assert!(positive, "seed {seed}");
                    refused += 1;
                }
                Err(error) => panic!("seed {seed}: {error}"),
            }
        }
        assert!(
            solved > 20 && refused > 20,
            "{solved} solved, {refused} refused"
        );
    }
}
