//! A CLI that observes, plans and applies, one event after the other.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use ictus_deploy::rollout::{
    Apply, Desired, Moment, Observed, Operation, Outcome, Phase, Plan, Refusal, RunState, Step,
    StepId, plan, plan_down,
};

use super::Mutant;
use super::world::{Call, TTL_MS, World, failed};

#[derive(Clone, Debug)]
pub(crate) enum Wish {
    Up(Desired),
    /// Asks every host.
    Down {
        purge: bool,
    },
}

#[derive(Clone, Debug)]
pub(crate) enum Stage {
    Observing,
    Applying,
    /// There was nothing to do.
    Nothing,
    Refused(Refusal),
    Over(Phase),
}

/// A call and how far it is.
#[derive(Clone, Debug)]
enum Flight {
    Asked(Call),
    Answered(Step, Outcome),
    /// Lost on the way: its time limit ends it.
    Lost,
    /// It waits for a part to be healthy.
    Watches(Step),
}

#[derive(Debug)]
pub(crate) struct Cli {
    who: String,
    wish: Wish,
    pub(crate) stage: Stage,
    observed: BTreeMap<String, Observed>,
    apply: Option<Apply>,
    numbers: BTreeMap<String, u64>,
    flights: Vec<Flight>,
    /// Hosts that have answered that they are prepared.
    prepared: BTreeSet<String>,
    renewed_ms: u64,
    asleep_until_ms: u64,
    dead: bool,
}

impl Cli {
    pub(crate) fn new(who: &str, wish: Wish) -> Self {
        Self {
            who: who.to_owned(),
            wish,
            stage: Stage::Observing,
            observed: BTreeMap::new(),
            apply: None,
            numbers: BTreeMap::new(),
            flights: Vec::new(),
            prepared: BTreeSet::new(),
            renewed_ms: 0,
            asleep_until_ms: 0,
            dead: false,
        }
    }

    pub(crate) fn is_over(&self) -> bool {
        match self.stage {
            Stage::Observing | Stage::Applying => self.dead,
            Stage::Nothing | Stage::Refused(_) | Stage::Over(_) => true,
        }
    }

    pub(crate) fn sleep(&mut self, world: &World, ms: u64) {
        self.asleep_until_ms = world.now_ms + ms;
    }

    /// SIGKILL: its calls may arrive yet, its streams are closed.
    pub(crate) fn die(&mut self, world: &mut World) {
        self.dead = true;
        self.leave(world);
    }

    fn leave(&mut self, world: &mut World) {
        for flight in self.flights.drain(..) {
            if let Flight::Asked(call) = flight {
                world.late.push(call);
            }
        }
        for host in world.hosts.keys().cloned().collect::<Vec<_>>() {
            world.hang_up(&host, &self.who);
        }
    }

    /// One event.
    pub(crate) fn act(&mut self, world: &mut World) {
        if self.is_over() || world.now_ms < self.asleep_until_ms {
            return;
        }
        match self.stage {
            Stage::Observing => self.look(world),
            Stage::Applying => self.go_on(world),
            Stage::Nothing | Stage::Refused(_) | Stage::Over(_) => {}
        }
    }

    /// Asks one more host; when all were asked, plans.
    fn look(&mut self, world: &mut World) {
        let mut wanted: BTreeSet<String> = match &self.wish {
            Wish::Up(desired) => desired.hosts.keys().cloned().collect(),
            Wish::Down { .. } => world.hosts.keys().cloned().collect(),
        };
        let runs = self.observed.values().filter_map(Observed::run);
        wanted.extend(runs.flat_map(|run| run.hosts.iter().cloned()));
        let mut unasked = wanted.iter();
        if let Some(name) = unasked.find(|name| !self.observed.contains_key(*name)) {
            let mut observed = world.observe(name);
            if !world.calm && world.rng.percent(3) {
                observed = unreachable(observed, world.mutant);
            }
            self.observed.insert(name.clone(), observed);
            return;
        }
        let plan = match &self.wish {
            Wish::Up(desired) => plan(desired, &self.observed),
            Wish::Down { purge } => plan_down("demo", &self.observed, *purge, 30_000),
        };
        let plan = match plan {
            Ok(plan) => plan,
            Err(refusal) => {
                self.stage = Stage::Refused(refusal);
                return;
            }
        };
        let unknown = self.observed.values().any(|it| it.reached().is_none());
        assert!(!unknown, "law: what is not known is not planned for");
        if plan.is_empty() {
            self.stage = Stage::Nothing;
            return;
        }
        let plan = mutated(plan, &self.observed, world.mutant);
        world.runs += 1;
        self.apply = Some(Apply::new(plan, format!("run{}", world.runs)));
        self.stage = Stage::Applying;
        self.renewed_ms = world.now_ms;
        self.begin(world);
    }

    fn applying(&mut self) -> &mut Apply {
        self.apply.as_mut().unwrap()
    }

    /// Begins all that may begin.
    fn begin(&mut self, world: &mut World) {
        let wanted = match &self.wish {
            Wish::Up(desired) => Some(desired.clone()),
            Wish::Down { .. } => None,
        };
        while let Some(step) = self.applying().poll_step(moment(world)) {
            if step.operation == Operation::AwaitHealthy {
                self.flights.push(Flight::Watches(step));
                continue;
            }
            // What is given back is not renewed any more.
            let number = match step.operation == Operation::Release {
                true => self.numbers.remove(&step.host),
                false => self.numbers.get(&step.host).copied(),
            };
            let call = Call {
                who: self.who.clone(),
                number,
                run: self.applying().run().to_owned(),
                wanted: wanted.clone(),
                step,
            };
            self.flights.push(Flight::Asked(call));
        }
        self.conclude(world);
    }

    fn conclude(&mut self, world: &mut World) {
        let apply = self.applying();
        let phase = apply.phase().clone();
        if !phase.is_over() {
            return;
        }
        if matches!(phase, Phase::Undone { .. }) {
            for (name, host) in &world.hosts {
                let left = host.run.as_ref().filter(|run| run.id == apply.run());
                assert!(
                    left.is_none(),
                    "law: a failure before the commit leaves nothing: {name} {left:?}"
                );
            }
        }
        assert!(apply.poll_step(moment(world)).is_none());
        self.stage = Stage::Over(phase);
        self.leave(world);
    }

    fn go_on(&mut self, world: &mut World) {
        self.renew(world);
        if self.is_over() {
            return;
        }
        let now = moment(world);
        if !world.calm && world.rng.below(150) == 0 {
            let ms = world.rng.bits() % (2 * TTL_MS);
            self.sleep(world, ms);
        } else if !world.calm && world.rng.below(300) == 0 {
            self.applying().handle_interrupt(now);
        } else if self.flights.is_empty() {
            world.now_ms += 100;
        } else {
            let index = world.rng.below(self.flights.len());
            let flight = self.flights.swap_remove(index);
            let next = self.fly(world, flight);
            self.flights.extend(next);
        }
        let now = moment(world);
        if self
            .applying()
            .poll_timeout()
            .is_some_and(|until| until <= now.elapsed)
        {
            self.applying().handle_timeout(now);
        }
        self.begin(world);
    }

    /// Moves one call on.
    fn fly(&mut self, world: &mut World, flight: Flight) -> Option<Flight> {
        let lossy = !world.calm;
        Some(match flight {
            Flight::Asked(call) if lossy && world.rng.percent(3) => {
                // Lost, or so late that nobody waits any more.
                if world.rng.percent(50) {
                    world.late.push(call);
                }
                Flight::Lost
            }
            Flight::Asked(call) if lossy && world.rng.percent(2) => {
                Flight::Answered(call.step, failed("no space left", 0))
            }
            Flight::Asked(call) => {
                let outcome = self.ask(world, &call);
                if lossy && world.rng.percent(3) {
                    world.hang_up(&call.step.host, &self.who);
                    return Some(Flight::Lost);
                }
                if let Outcome::Leased { .. } = &outcome {
                    let host = call.step.host.clone();
                    self.numbers.insert(host.clone(), world.number(&host));
                }
                Flight::Answered(call.step, outcome)
            }
            Flight::Answered(step, outcome) => {
                if matches!(step.operation, Operation::Prepare { .. }) {
                    self.prepared.insert(step.host.clone());
                }
                let now = moment(world);
                self.applying().handle_done(now, step.id, outcome);
                return None;
            }
            Flight::Lost => {
                world.now_ms += 1_000;
                let waits = self.applying().poll_timeout();
                return waits.map(|_| Flight::Lost);
            }
            Flight::Watches(step) => {
                let run = self.applying().run().to_owned();
                match world.health(&step.host, &run) {
                    Some(outcome) => Flight::Answered(step, outcome),
                    None => {
                        world.now_ms += 50;
                        Flight::Watches(step)
                    }
                }
            }
        })
    }

    /// Asks a host, or does not where a mutant does not.
    fn ask(&self, world: &mut World, call: &Call) -> Outcome {
        let host = &call.step.host;
        let undoes = matches!(call.step.operation, Operation::RemovePart { .. });
        if world.mutant == Some(Mutant::ForgetsWhoDidNotAnswer)
            && undoes
            && !self.prepared.contains(host)
        {
            return Outcome::Done;
        }
        let mut outcome = world.execute(call);
        if let Outcome::Leased { run } = &mut outcome
            && world.mutant == Some(Mutant::AbsentWhenUnreachable)
            && self.observed[host].run().is_none()
        {
            *run = None;
        }
        outcome
    }

    /// Leases last as long as somebody is awake.
    fn renew(&mut self, world: &mut World) {
        if world.now_ms < self.renewed_ms + TTL_MS / 3 {
            return;
        }
        self.renewed_ms = world.now_ms;
        for (host, number) in self.numbers.clone() {
            if !world.renew(&host, number) {
                let what = "the number is not the last one".to_owned();
                self.applying().handle_fenced(host, what);
            }
        }
        self.conclude(world);
    }
}

fn moment(world: &World) -> Moment {
    Moment {
        elapsed: Duration::from_millis(world.now_ms),
        wall_ns: i64::try_from(world.now_ms).unwrap() * 1_000_000,
    }
}

fn unreachable(observed: Observed, mutant: Option<Mutant>) -> Observed {
    match (mutant, observed) {
        (Some(Mutant::AbsentWhenUnreachable), Observed::Reached(mut reached)) => {
            reached.run = Ok(None);
            Observed::Reached(reached)
        }
        (_, _) => Observed::Unreachable {
            why: "no route".to_owned(),
        },
    }
}

/// A plan as a buggy planner would have made it.
fn mutated(mut plan: Plan, observed: &BTreeMap<String, Observed>, mutant: Option<Mutant>) -> Plan {
    let healthy = |host: &String| {
        let run = observed.get(host).and_then(Observed::run);
        run.is_some_and(|run| run.state == RunState::Running)
    };
    for step in &mut plan.steps {
        let changes = !matches!(step.operation, Operation::Lease | Operation::Release);
        let stops = matches!(step.operation, Operation::StopOld { .. });
        if mutant == Some(Mutant::EarlyStop) && stops {
            step.needs = vec![StepId(observed.len() - 1)];
        }
        if mutant == Some(Mutant::PartialRestart) && changes && healthy(&step.host) {
            // A file that is there already stands for doing nothing.
            step.operation = Operation::SendBlob {
                digest: "program7".to_owned(),
                bytes: 0,
            };
        }
    }
    plan
}
