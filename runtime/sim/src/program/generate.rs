//! Random federations.

use super::{FederateSpec, Federation, LinkSpec, PortRef, ReactionPlan, ReactorSpec, WireSpec};
use crate::seed::Rng;
use crate::swarm::{Ending, Shape, Swarm};
use ictus_core::{ActionKind, Delay, Duration, DurationExt as _, ProgramError, Spacing};

/// Tags fall on multiples of this, so that federates meet at them.
const GRAIN: i64 = 500_000;

/// How long runs last, in grains.
const TIMEOUT: (usize, usize) = (120, 260);

impl Federation {
    /// Draws a federation that has no causality loop.
    #[must_use]
    pub fn generate(swarm: &Swarm, rng: &mut Rng) -> Self {
        let links = draw_links(swarm, rng);
        let finite = swarm.ending == Ending::Starvation;
        let mut federation = Self {
            federates: Vec::new(),
            links,
            timeout: (!finite).then(|| grains(rng.between(TIMEOUT.0, TIMEOUT.1))),
            fast: swarm.mode.fast,
            max_lead: swarm.mode.max_lead,
            clock_sync: swarm.mode.clock_sync,
            extensions: swarm.mode.extensions,
        };
        for id in 0..swarm.federates {
            let inputs = federation.links.iter().filter(|l| l.to.0 == id).count();
            let outputs = federation
                .links
                .iter()
                .filter(|l| l.from.0 == id)
                .map(|l| l.from.1 + 1)
                .max()
                .unwrap_or(0);
            let mut draft = Draft::new(id, inputs, outputs, swarm.shape, finite);
            draft.fill(rng);
            federation.federates.push(draft.spec);
        }
        if swarm.shape.zero_delay_cycles {
            federation.add_answering_pair(finite, rng);
        }
        if swarm.ending == Ending::ReactionStop {
            federation.add_stopper(rng);
        }
        federation.mend(rng);
        federation
    }

    /// In A: p -> q -> out, and beside it r, which reads B's answer; in B: in -> out. Waiting by level deadlocks here.
    fn add_answering_pair(&mut self, finite: bool, rng: &mut Rng) {
        let a = rng.below(self.federates.len());
        let b = (a + 1 + rng.below(self.federates.len() - 1)) % self.federates.len();
        let (asks, asked) = (self.add_output(a), self.add_input(b));
        let (answers, answered) = (self.add_output(b), self.add_input(a));
        for (from, to) in [((a, asks), (b, asked)), ((b, answers), (a, answered))] {
            let delay = Delay::None;
            self.links.push(LinkSpec { from, to, delay });
        }
        let period = if finite {
            Duration::ZERO
        } else {
            grains(rng.between(1, 6))
        };
        let eagerness = *rng.pick(&[50, 90, 100]);
        let reacts = |inputs: &[usize], effects: &[usize]| ReactionPlan {
            inputs: inputs.to_vec(),
            effects: effects.to_vec(),
            eagerness,
            ..ReactionPlan::default()
        };
        let asker = &mut self.federates[a];
        let p = asker.add("p", 0, 1);
        asker.reactors[p].actions.push(ActionKind::Timer {
            offset: Duration::ZERO,
            period,
        });
        asker.reactors[p].reactions.push(ReactionPlan {
            actions: vec![0],
            ..reacts(&[], &[0])
        });
        let q = asker.add("q", 1, 1);
        asker.reactors[q].reactions.push(reacts(&[0], &[0]));
        let r = asker.add("r", 1, 0);
        asker.reactors[r].reactions.push(reacts(&[0], &[]));
        asker.wire(PortRef::Output(p, 0), PortRef::Input(q, 0), Delay::None);
        asker.wire(PortRef::Output(q, 0), PortRef::Output(0, asks), Delay::None);
        asker.wire(
            PortRef::Input(0, answered),
            PortRef::Input(r, 0),
            Delay::None,
        );
        let answerer = &mut self.federates[b];
        let s = answerer.add("s", 1, 1);
        answerer.reactors[s].reactions.push(reacts(&[0], &[0]));
        answerer.wire(PortRef::Input(0, asked), PortRef::Input(s, 0), Delay::None);
        answerer.wire(
            PortRef::Output(s, 0),
            PortRef::Output(0, answers),
            Delay::None,
        );
    }

    fn add_input(&mut self, federate: usize) -> usize {
        let inputs = &mut self.federates[federate].reactors[0].inputs;
        *inputs += 1;
        *inputs - 1
    }

    fn add_output(&mut self, federate: usize) -> usize {
        let outputs = &mut self.federates[federate].reactors[0].outputs;
        *outputs += 1;
        *outputs - 1
    }

    /// One or two reactions that ask for a stop, perhaps at the same tag.
    fn add_stopper(&mut self, rng: &mut Rng) {
        let elapsed = grains(rng.between(30, TIMEOUT.0));
        for _ in 0..rng.between(1, 2) {
            let at = rng.below(self.federates.len());
            let federate = &mut self.federates[at];
            let stopper = federate.add("stopper", 0, 0);
            federate.reactors[stopper].actions.push(ActionKind::Timer {
                offset: Duration::ZERO,
                period: grains(rng.between(1, 5)),
            });
            federate.reactors[stopper].reactions.push(ReactionPlan {
                actions: vec![0],
                stops_after: Some(elapsed),
                ..ReactionPlan::default()
            });
        }
    }

    /// Delays connections between federates until no causality loop is left.
    fn mend(&mut self, rng: &mut Rng) {
        while let Err(error) = self.alone() {
            assert!(
                matches!(error, ProgramError::CausalityLoop { .. }),
                "generated programs have loops at worst: {error}"
            );
            let free: Vec<usize> = (0..self.links.len())
                .filter(|l| self.links[*l].delay == Delay::None)
                .collect();
            let choice = *rng.pick(&free);
            self.links[choice].delay = if rng.percent(50) {
                Delay::Microstep
            } else {
                Delay::Time(grains(rng.between(1, 6)))
            };
        }
    }
}

impl FederateSpec {
    /// Adds a reactor inside the federate.
    fn add(&mut self, name: &str, inputs: usize, outputs: usize) -> usize {
        let path = format!("{}.{name}", self.reactors[0].path);
        self.reactors.push(ReactorSpec {
            path,
            inputs,
            outputs,
            ..ReactorSpec::default()
        });
        self.reactors.len() - 1
    }

    fn wire(&mut self, from: PortRef, to: PortRef, delay: Delay) {
        self.wires.push(WireSpec { from, to, delay });
    }
}

/// A federate being drawn.
struct Draft {
    spec: FederateSpec,
    shape: Shape,
    finite: bool,
    /// Outputs of inner reactors that nothing reads yet.
    loose: Vec<PortRef>,
}

impl Draft {
    fn new(id: usize, inputs: usize, outputs: usize, shape: Shape, finite: bool) -> Self {
        let top = ReactorSpec {
            path: format!("f{id}"),
            inputs,
            outputs,
            ..ReactorSpec::default()
        };
        Self {
            spec: FederateSpec {
                reactors: vec![top],
                wires: Vec::new(),
            },
            shape,
            finite,
            loose: Vec::new(),
        }
    }

    fn fill(&mut self, rng: &mut Rng) {
        let top = &self.spec.reactors[0];
        let (inputs, outputs) = (top.inputs, top.outputs);
        // Every input goes to an inner reactor, or to the federate's own reactions.
        let mut own = Vec::new();
        let mut given: Vec<PortRef> = Vec::new();
        for input in 0..inputs {
            if rng.percent(30) {
                own.push(input);
            } else {
                given.push(PortRef::Input(0, input));
            }
        }
        let lanes = rng.between(1, 4).max(given.len().div_ceil(2));
        for lane in 0..lanes {
            let share = if lane + 1 == lanes {
                given.len()
            } else {
                given.len().min(rng.between(0, 2))
            };
            let sources = given.drain(..share).collect();
            self.add_lane(lane, sources, rng);
        }
        let mut written = Vec::new();
        for output in 0..outputs {
            if self.loose.is_empty() || rng.percent(25) {
                written.push(output);
            } else {
                let from = self.loose[rng.below(self.loose.len())];
                let delay = self.inner_delay(rng);
                self.spec.wire(from, PortRef::Output(0, output), delay);
            }
        }
        self.add_own_reactions(&own, &written, rng);
    }

    fn inner_delay(&self, rng: &mut Rng) -> Delay {
        match rng.below(10) {
            0 if self.shape.microsteps => Delay::Microstep,
            1 if self.shape.delays => Delay::Time(grains(rng.between(1, 4))),
            _ => Delay::None,
        }
    }

    /// A reactor, or a bank of equal ones, and perhaps a reactor behind it.
    fn add_lane(&mut self, lane: usize, sources: Vec<PortRef>, rng: &mut Rng) {
        let bank = if rng.percent(20) {
            rng.between(2, 3)
        } else {
            1
        };
        let mut template = ReactorSpec {
            inputs: sources.len(),
            outputs: rng.between(1, 2),
            ..ReactorSpec::default()
        };
        self.draw_actions(&mut template, rng);
        self.draw_reactions(&mut template, rng);
        for member in 0..bank {
            let name = if bank == 1 {
                format!("r{lane}")
            } else {
                format!("b{lane}[{member}]")
            };
            let at = self.spec.add(&name, 0, 0);
            let path = std::mem::take(&mut self.spec.reactors[at].path);
            self.spec.reactors[at] = ReactorSpec {
                path,
                ..template.clone()
            };
            for (input, source) in sources.iter().enumerate() {
                let delay = self.inner_delay(rng);
                self.spec.wire(*source, PortRef::Input(at, input), delay);
            }
            for output in 0..template.outputs {
                self.loose.push(PortRef::Output(at, output));
            }
        }
        if rng.percent(40) {
            self.add_follower(lane, rng);
        }
    }

    /// A reactor nested a level deeper, fed by one of the loose outputs.
    fn add_follower(&mut self, lane: usize, rng: &mut Rng) {
        let source = self.loose[rng.below(self.loose.len())];
        let at = self.spec.add(&format!("r{lane}.inner"), 1, 1);
        let path = self.spec.reactors[at].path.clone();
        let mut inner = ReactorSpec {
            path,
            inputs: 1,
            outputs: 1,
            ..ReactorSpec::default()
        };
        if rng.percent(30) {
            inner.actions.push(ActionKind::Logical {
                min_delay: Duration::ZERO,
                spacing: Spacing::NONE,
            });
        }
        self.draw_reactions(&mut inner, rng);
        self.spec.reactors[at] = inner;
        let delay = self.inner_delay(rng);
        self.spec.wire(source, PortRef::Input(at, 0), delay);
        self.loose.push(PortRef::Output(at, 0));
    }

    fn draw_actions(&self, reactor: &mut ReactorSpec, rng: &mut Rng) {
        let timer = |rng: &mut Rng| ActionKind::Timer {
            offset: grains(rng.between(0, if self.finite { 40 } else { 4 })),
            period: if self.finite {
                Duration::ZERO
            } else {
                grains(rng.between(2, 12))
            },
        };
        let timers = if self.finite { 4 } else { 1 };
        if reactor.inputs == 0 || rng.percent(40) {
            for _ in 0..rng.between(1, timers) {
                reactor.actions.push(timer(rng));
            }
        }
        if rng.percent(45) {
            let min_delay = grains(*rng.pick(&[0, 0, 1, 3]));
            reactor.actions.push(ActionKind::Logical {
                min_delay,
                spacing: Spacing::NONE,
            });
        }
        if self.shape.physical && rng.percent(35) {
            reactor.actions.push(ActionKind::Physical {
                min_delay: *rng.pick(&[Duration::ZERO, 1.ms(), 300.us()]),
                spacing: Spacing {
                    min: *rng.pick(&[Duration::ZERO, Duration::ZERO, 2.ms()]),
                    ..Spacing::NONE
                },
            });
        }
    }

    /// Reactions that between them are triggered by every action and input, and may set every output.
    fn draw_reactions(&self, reactor: &mut ReactorSpec, rng: &mut Rng) {
        let count = rng.between(1, 3);
        let mut reactions: Vec<ReactionPlan> = (0..count)
            .map(|_| ReactionPlan {
                eagerness: *rng.pick(&[30, 60, 60, 90]),
                ..ReactionPlan::default()
            })
            .collect();
        for (index, action) in reactor.actions.iter().enumerate() {
            reactions[rng.below(count)].actions.push(index);
            if matches!(action, ActionKind::Logical { .. }) {
                reactions[rng.below(count)].schedules.push(index);
            }
        }
        for input in 0..reactor.inputs {
            let reads = rng.below(count);
            reactions[rng.below(count)].inputs.push(input);
            if rng.percent(30) && !reactions[reads].inputs.contains(&input) {
                reactions[reads].reads.push(input);
            }
        }
        for output in 0..reactor.outputs {
            for _ in 0..rng.between(1, 2) {
                let writer = &mut reactions[rng.below(count)];
                if !writer.effects.contains(&output) {
                    writer.effects.push(output);
                }
            }
        }
        if rng.percent(15) {
            reactions[rng.below(count)].startup = true;
        }
        // A reaction that nothing triggers would be dead weight; one that only shutdown triggers is not.
        for reaction in &mut reactions {
            if reaction.actions.is_empty() && reaction.inputs.is_empty() && !reaction.startup {
                reaction.shutdown = true;
            }
        }
        reactor.reactions = reactions;
    }

    /// The federate's own reactions: they read its inputs and write the outputs that no inner reactor feeds.
    fn add_own_reactions(&mut self, own: &[usize], written: &[usize], rng: &mut Rng) {
        if own.is_empty() && written.is_empty() {
            return;
        }
        let mut top = ReactorSpec::default();
        self.draw_actions(&mut top, rng);
        let top_spec = &mut self.spec.reactors[0];
        top_spec.actions = top.actions;
        if rng.percent(50) || own.is_empty() {
            let period = if self.finite {
                Duration::ZERO
            } else {
                grains(rng.between(3, 12))
            };
            let offset = grains(rng.between(0, 3));
            top_spec.actions.push(ActionKind::Timer { offset, period });
        }
        let count = rng.between(1, 3);
        let mut reactions = vec![
            ReactionPlan {
                eagerness: 60,
                ..ReactionPlan::default()
            };
            count
        ];
        for (index, action) in top_spec.actions.iter().enumerate() {
            reactions[rng.below(count)].actions.push(index);
            if matches!(action, ActionKind::Logical { .. }) {
                reactions[rng.below(count)].schedules.push(index);
            }
        }
        for input in own {
            reactions[rng.below(count)].inputs.push(*input);
        }
        for output in written {
            reactions[rng.below(count)].effects.push(*output);
        }
        top_spec.reactions = reactions;
    }
}

fn grains(count: usize) -> Duration {
    Duration::from_nanos(
        i64::try_from(count)
            .unwrap_or(i64::MAX)
            .saturating_mul(GRAIN),
    )
}

/// Connections between federates: forward ones, and backward ones when the run has cycles.
fn draw_links(swarm: &Swarm, rng: &mut Rng) -> Vec<LinkSpec> {
    let federates = swarm.federates;
    let mut links: Vec<LinkSpec> = Vec::new();
    let count = federates - 1 + rng.between(0, federates);
    let mut inputs = vec![0; federates];
    let mut outputs = vec![0; federates];
    for index in 0..count {
        let (from, to) = draw_ends(index, swarm, rng);
        let reused = rng.percent(30) && outputs[from] > 0;
        let output = if reused {
            rng.below(outputs[from])
        } else {
            outputs[from] += 1;
            outputs[from] - 1
        };
        let delay = draw_delay(swarm.shape, rng);
        let delay = if from == to && delay == Delay::None {
            Delay::Microstep
        } else {
            delay
        };
        links.push(LinkSpec {
            from: (from, output),
            to: (to, inputs[to]),
            delay,
        });
        inputs[to] += 1;
    }
    links
}

fn draw_ends(index: usize, swarm: &Swarm, rng: &mut Rng) -> (usize, usize) {
    let federates = swarm.federates;
    if index + 1 < federates && rng.percent(85) {
        // Most federates hear from an earlier one.
        return (rng.below(index + 1), index + 1);
    }
    let (a, b) = (rng.below(federates), rng.below(federates));
    match a.cmp(&b) {
        std::cmp::Ordering::Equal if rng.percent(80) => (a, (a + 1) % federates),
        std::cmp::Ordering::Equal => (a, a),
        std::cmp::Ordering::Greater if swarm.shape.cycles => (a, b),
        std::cmp::Ordering::Less | std::cmp::Ordering::Greater => (a.min(b), a.max(b)),
    }
}

fn draw_delay(shape: Shape, rng: &mut Rng) -> Delay {
    match rng.below(10) {
        0..=1 if shape.microsteps => Delay::Microstep,
        2..=5 if shape.delays => Delay::Time(grains(rng.between(1, 8))),
        _ => Delay::None,
    }
}
