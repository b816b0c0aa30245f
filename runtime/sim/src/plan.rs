//! Any plan with any executor in the simulated world: what users' own tests run.

use crate::executor::SimulatedExecutor;
use crate::observer::Observer;
use crate::seed::Rng;
use crate::swarm::{Ending, Shape, Swarm};
use crate::world::{Conditions, Member, Run, World};
use ictus_coord::federate::{FederateConfig, LinkConfig};
use ictus_coord::mutants::Mutants;
use ictus_coord::plan::{ClockSync, Plan};
use ictus_core::{Duration, Program};
use std::sync::Arc;

/// One federate of a plan, assembled.
#[derive(Debug)]
pub struct Part<E> {
    /// Its program.
    pub program: Arc<Program>,
    /// By input id: the index of its connection in the plan.
    pub inputs: Vec<usize>,
    /// By output id: the index of its connection in the plan.
    pub outputs: Vec<usize>,
    /// Its values and reaction bodies.
    pub executor: E,
}

/// Runs a plan once: delays, jitter, partitions, clocks and the time that reactions take are drawn from `seed`.
///
/// `parts` are all federates in the order of the plan. Nobody crashes, and nothing comes from outside. A run of more than
/// 15 simulated minutes counts as one that does not end.
#[must_use]
pub fn run_plan<E: SimulatedExecutor>(plan: &Plan, parts: Vec<Part<E>>, seed: u64) -> Run<E> {
    let mut rng = Rng::new(seed);
    let members = parts.into_iter().enumerate().map(|(index, part)| {
        let id = u16::try_from(index).unwrap_or(u16::MAX);
        let mut link = LinkConfig::from_plan(plan, id, &part.inputs, &part.outputs);
        link.federation.clone_from(&plan.federation);
        Member {
            program: part.program,
            link,
            executor: part.executor,
            legacy: false,
        }
    });
    let members = members.collect();
    let conditions = Conditions {
        swarm: swarm(plan, &mut rng),
        config: FederateConfig {
            timeout: plan.timeout_ns.map(Duration::from_nanos),
            fast: plan.fast,
            keepalive: plan.keepalive,
        },
        mutants: Mutants::NONE,
    };
    let mut observer = Observer::of_plan(plan);
    observer.extensions = plan.extensions;
    World::new(members, plan, observer, conditions, &rng).run()
}

/// The world of a seed, without what the plan already says.
fn swarm(plan: &Plan, rng: &mut Rng) -> Swarm {
    let mut swarm = Swarm::draw(rng);
    swarm.federates = plan.federates.len();
    swarm.shape = Shape {
        cycles: false,
        zero_delay_cycles: false,
        microsteps: false,
        delays: false,
        physical: false,
    };
    swarm.mode.fast = plan.fast;
    swarm.mode.parallel = false;
    swarm.mode.clock_sync = plan.clock.sync == ClockSync::Init;
    swarm.mode.extensions = plan.extensions;
    swarm.mode.legacy_sources = false;
    swarm.mode.calm = false;
    swarm.ending = if plan.timeout_ns.is_some() {
        Ending::Timeout
    } else {
        Ending::Starvation
    };
    swarm
}
