//! From a federation to programs: one per federate, or all of them in one.

use super::{Federation, PortRef, ReactionPlan, ReactorSpec};
use crate::seed::mix;
use ictus_coord::mutants::{Mutant, Mutants};
use ictus_core::{
    ActionId, ActionKind, Delay, Duration, PortId, PortKind, Program, ProgramBuilder, ProgramError,
    ReactionSpec, SlotId, Trigger,
};
use std::sync::Arc;

/// A program with what its executor needs.
#[derive(Clone, Debug)]
pub struct Assembly {
    /// The program.
    pub program: Arc<Program>,
    /// Per reaction.
    pub bodies: Vec<Body>,
    /// Per action: the slot whose value a delayed connection takes.
    pub forwards: Vec<Option<SlotId>>,
    /// The physical actions: federate, number among the federate's, id.
    pub physical: Vec<(usize, usize, ActionId)>,
    /// Indices into the links of the network inputs, in order.
    pub inputs: Vec<usize>,
    /// Indices into the links of the network outputs, in order.
    pub outputs: Vec<usize>,
    /// The number of reactors.
    pub reactors: usize,
}

/// What a synthetic reaction does: all follows from what it reads and from its reactor's state.
#[derive(Clone, Debug)]
pub struct Body {
    /// The reaction's number in the trace: reactor and position.
    pub name: (u32, u32),
    /// The reactor's state.
    pub state: usize,
    /// Whether it runs at the stop tag.
    pub shutdown: bool,
    /// Actions that trigger it, with a number that does not depend on the program.
    pub actions: Vec<(ActionId, u64)>,
    /// What it reads.
    pub reads: Vec<(SlotId, u64)>,
    /// What it may set.
    pub effects: Vec<(SlotId, u64)>,
    /// What it may schedule.
    pub schedules: Vec<(ActionId, u64)>,
    /// Asks for a stop once this much logical time has passed.
    pub stops_after: Option<Duration>,
    /// How often an output is set, in percent.
    pub eagerness: u64,
}

impl Federation {
    /// All federates in one program.
    ///
    /// # Errors
    ///
    /// What is wrong with the federation: a causality loop over federates shows here only.
    pub fn alone(&self) -> Result<Assembly, ProgramError> {
        let mut builder = Builder::new();
        builder.program.concurrent();
        for federate in 0..self.federates.len() {
            builder.add(self, federate);
        }
        for link in &self.links {
            let from = builder.parts[link.from.0].port(PortRef::Output(0, link.from.1));
            let to = builder.parts[link.to.0].port(PortRef::Input(0, link.to.1));
            builder.connect(from, to, link.delay);
        }
        builder.finish()
    }

    /// One federate as a program of its own.
    ///
    /// # Errors
    ///
    /// What is wrong with the federate.
    pub fn federate(
        &self,
        federate: usize,
        concurrent: bool,
        mutants: Mutants,
    ) -> Result<Assembly, ProgramError> {
        let mut builder = Builder::new();
        if concurrent {
            builder.program.concurrent();
        }
        if mutants.has(Mutant::AbsentsByLevel) {
            builder.program.cones_by_level();
        }
        builder.add(self, federate);
        for (index, link) in self.links.iter().enumerate() {
            let (sends, receives) = (link.from.0 == federate, link.to.0 == federate);
            let from = PortRef::Output(0, link.from.1);
            let to = PortRef::Input(0, link.to.1);
            if sends && receives {
                let (from, to) = (builder.parts[0].port(from), builder.parts[0].port(to));
                builder.connect(from, to, link.delay);
            } else if sends {
                builder.program.network_output(builder.parts[0].port(from));
                builder.outputs.push(index);
            } else if receives {
                let delayed = link.delay != Delay::None;
                let port = builder.parts[0].port(to);
                builder.program.network_input(port, delayed);
                builder.inputs.push(index);
            }
        }
        builder.finish()
    }
}

struct Builder {
    program: ProgramBuilder,
    parts: Vec<Parts>,
    pending: Vec<Pending>,
    forwards: Vec<(ActionId, PortId)>,
    physical: Vec<(usize, usize, ActionId)>,
    inputs: Vec<usize>,
    outputs: Vec<usize>,
    reactors: usize,
}

/// Where the ports of one federate stand in the program: inputs and outputs of each reactor.
struct Parts {
    ports: Vec<(Vec<PortId>, Vec<PortId>)>,
}

impl Parts {
    fn port(&self, port: PortRef) -> PortId {
        match port {
            PortRef::Input(reactor, index) => self.ports[reactor].0[index],
            PortRef::Output(reactor, index) => self.ports[reactor].1[index],
        }
    }
}

/// A body whose slots are known once the program is built.
struct Pending {
    body: Body,
    reads: Vec<(PortId, u64)>,
    effects: Vec<(PortId, u64)>,
}

impl Builder {
    fn new() -> Self {
        Self {
            program: ProgramBuilder::new(),
            parts: Vec::new(),
            pending: Vec::new(),
            forwards: Vec::new(),
            physical: Vec::new(),
            inputs: Vec::new(),
            outputs: Vec::new(),
            reactors: 0,
        }
    }

    fn add(&mut self, federation: &Federation, federate: usize) {
        let spec = &federation.federates[federate];
        let mut parts = Parts { ports: Vec::new() };
        for (index, reactor) in spec.reactors.iter().enumerate() {
            let name = federation.first_reactor(federate) + index;
            let ports = self.add_reactor(reactor, federate, name);
            parts.ports.push(ports);
        }
        for wire in &spec.wires {
            self.connect(parts.port(wire.from), parts.port(wire.to), wire.delay);
        }
        self.parts.push(parts);
    }

    fn add_reactor(
        &mut self,
        spec: &ReactorSpec,
        federate: usize,
        name: usize,
    ) -> (Vec<PortId>, Vec<PortId>) {
        let program = &mut self.program;
        let id = program.reactor(spec.path.clone());
        let mut ports = |count: usize, kind, prefix| -> Vec<PortId> {
            let port = |i| program.port(id, format!("{prefix}{i}"), kind);
            (0..count).map(port).collect()
        };
        let inputs = ports(spec.inputs, PortKind::Input, "in");
        let outputs = ports(spec.outputs, PortKind::Output, "out");
        let actions: Vec<ActionId> = spec.actions.iter().map(|a| program.action(*a)).collect();
        for (kind, action) in spec.actions.iter().zip(&actions) {
            if matches!(kind, ActionKind::Physical { .. }) {
                let number = self.physical.iter().filter(|p| p.0 == federate).count();
                self.physical.push((federate, number, *action));
            }
        }
        for (index, plan) in spec.reactions.iter().enumerate() {
            let label = |n: usize| u32::try_from(n).unwrap_or(u32::MAX);
            let pending = Pending::new(plan, (&inputs, &outputs, &actions));
            self.program.reaction(ReactionSpec {
                reactor: id,
                name: format!("r{index}"),
                triggers: triggers(plan, &inputs, &actions),
                sources: plan.reads.iter().map(|i| inputs[*i]).collect(),
                effects: plan.effects.iter().map(|o| outputs[*o]).collect(),
                deadline: None,
            });
            self.pending.push(Pending {
                body: Body {
                    name: (label(name), label(index)),
                    state: self.reactors,
                    ..pending.body
                },
                ..pending
            });
        }
        self.reactors += 1;
        (inputs, outputs)
    }

    fn connect(&mut self, from: PortId, to: PortId, delay: Delay) {
        if let Some(action) = self.program.connect(from, to, delay) {
            self.forwards.push((action, from));
        }
    }

    fn finish(self) -> Result<Assembly, ProgramError> {
        let program = Arc::new(self.program.build()?);
        let slot = |(port, salt): (PortId, u64)| (program.slot(port), salt);
        let bodies = self.pending.into_iter().map(|pending| Body {
            reads: pending.reads.into_iter().map(slot).collect(),
            effects: pending.effects.into_iter().map(slot).collect(),
            ..pending.body
        });
        let mut forwards = vec![None; program.actions().len()];
        let bodies = bodies.collect();
        for (action, port) in self.forwards {
            forwards[action.index()] = Some(program.slot(port));
        }
        Ok(Assembly {
            bodies,
            forwards,
            physical: self.physical,
            inputs: self.inputs,
            outputs: self.outputs,
            reactors: self.reactors,
            program,
        })
    }
}

impl Pending {
    fn new(
        plan: &ReactionPlan,
        (inputs, outputs, actions): (&[PortId], &[PortId], &[ActionId]),
    ) -> Self {
        let salt = |kind: u64, index: usize| mix(kind, index as u64);
        Self {
            body: Body {
                name: (0, 0),
                state: 0,
                shutdown: plan.shutdown,
                actions: [
                    (plan.startup, ActionId::STARTUP),
                    (plan.shutdown, ActionId::SHUTDOWN),
                ]
                .into_iter()
                .filter_map(|(is, action)| is.then_some((action, salt(4, action.index()))))
                .chain(plan.actions.iter().map(|a| (actions[*a], salt(1, *a))))
                .collect(),
                reads: Vec::new(),
                effects: Vec::new(),
                schedules: plan
                    .schedules
                    .iter()
                    .map(|a| (actions[*a], salt(1, *a)))
                    .collect(),
                stops_after: plan.stops_after,
                eagerness: plan.eagerness,
            },
            reads: plan
                .inputs
                .iter()
                .chain(&plan.reads)
                .map(|i| (inputs[*i], salt(2, *i)))
                .collect(),
            effects: plan
                .effects
                .iter()
                .map(|o| (outputs[*o], salt(3, *o)))
                .collect(),
        }
    }
}

fn triggers(plan: &ReactionPlan, inputs: &[PortId], actions: &[ActionId]) -> Vec<Trigger> {
    let mut triggers = Vec::new();
    if plan.startup {
        triggers.push(Trigger::Action(ActionId::STARTUP));
    }
    if plan.shutdown {
        triggers.push(Trigger::Action(ActionId::SHUTDOWN));
    }
    triggers.extend(plan.actions.iter().map(|a| Trigger::Action(actions[*a])));
    triggers.extend(plan.inputs.iter().map(|i| Trigger::Port(inputs[*i])));
    triggers
}
