//! Federations in tests: no process, no socket, no waiting. Feature `simulate`.
//!
//! [`Federation::simulate`] runs every federate and the RTI in a simulated world. The seed draws how long messages take, when the
//! network is cut, how clocks are off and how long reactions take; laws of coordination are checked on the way. Whatever the seed,
//! the trace must be the one of the program [`alone`](Federation::alone), unless a reaction reads the physical clock or misses a
//! deadline: then the seed decides.
//!
//! ```
//! use ictus::prelude::*;
//! use ictus::simulate::Federation;
//! use serde_json::json;
//!
//! #[reactor]
//! struct Source {
//!     #[timer(period = 10.ms())]
//!     tick: Timer,
//!     out: Output<u64>,
//!     count: u64,
//! }
//!
//! #[reactions]
//! impl Source {
//!     #[reaction]
//!     fn send(&mut self, tick: &Timer, out: &mut Output<u64>) {
//!         self.count += 1;
//!         out.set(self.count);
//!     }
//! }
//!
//! #[reactor]
//! struct Sink {
//!     input: Input<u64>,
//!     next: u64,
//! }
//!
//! #[reactions]
//! impl Sink {
//!     #[reaction]
//!     fn take(&mut self, input: &Input<u64>) {
//!         self.next += 1;
//!         assert_eq!(input.get(), Some(&self.next));
//!     }
//! }
//!
//! let federation = Federation::new()
//!     .federate::<Source>("source", json!({}))
//!     .federate::<Sink>("sink", json!({}))
//!     .connect("source.out", "sink.input", Some(5.ms()))
//!     .timeout(100.ms());
//! let alone = federation.alone()?;
//! assert_eq!(alone.of("sink").count(), 10);
//! for seed in 0..20 {
//!     assert_eq!(federation.simulate(seed)?, alone);
//! }
//! # Ok::<(), ictus::simulate::SimulateError>(())
//! ```

use crate::assembly::{Assembly, AssemblyError};
use crate::bodies::{Bodies, Fault};
use crate::class::Class;
use crate::clock::Clock;
use crate::describe;
use crate::observe::{Memory, Observer};
use crate::reactor::Reactions;
use ictus_coord::describe::InstanceRequest;
use ictus_coord::federate::{Federate, FederateConfig, Outcome, Poll};
use ictus_coord::plan::{ConnectionPlan, Coordination, Endpoint, FederatePlan, Plan};
use ictus_coord::{FederateExecutor, PayloadError};
use ictus_core::{
    ActionId, Duration, Effects, Executor, InputId, NodeId, OutputId, PhysicalTime, SlotId, Tag,
    ValueId,
};
use ictus_sim::executor::SimulatedExecutor;
use ictus_sim::observer::Violation;
use ictus_sim::plan::{Part, run_plan};
use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use thiserror::Error;

/// Where a program alone starts.
const START: Tag = Tag::at(1_700_000_000_000_000_000);

/// A mistake in the description of a federation.
#[derive(Clone, PartialEq, Eq, Debug, Error)]
#[non_exhaustive]
pub enum FederationError {
    /// A federate's parameters are no JSON object.
    #[error(
        "federate {federate}: parameters are an object, such as json!({{\"period\": \"10 ms\"}})"
    )]
    Parameters {
        /// The federate.
        federate: String,
    },
    /// There is no federate.
    #[error("the federation has no federate")]
    Empty,
    /// There is no time-out: a run must end by itself, and everywhere at the same tag.
    #[error("the federation has no time-out: add `.timeout(10.secs())`")]
    Endless,
    /// A delay or the time-out is negative.
    #[error("a delay or the time-out is negative")]
    Negative,
    /// An end of a connection is not `FEDERATE.PORT` or `FEDERATE.PORT[CHANNEL]`, or there is no such federate.
    #[error("`{end}` is no port: write FEDERATE.PORT or FEDERATE.PORT[CHANNEL]; federates are {}", .known.join(", "))]
    End {
        /// The end as given.
        end: String,
        /// The federates added before it.
        known: Vec<String>,
    },
}

/// Why a federation did not run to its end.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum SimulateError {
    /// It is not described well.
    #[error(transparent)]
    Federation(#[from] FederationError),
    /// The parts do not fit.
    #[error(transparent)]
    Assembly(#[from] AssemblyError),
    /// Threads outside the reactors are not simulated.
    #[error("the physical action {path} takes events from threads, which no seed repeats")]
    PhysicalAction {
        /// Its path.
        path: String,
    },
    /// Handlers that run by the physical clock are not simulated.
    #[error("the watchdog {path} goes by the physical clock, which the seed draws")]
    Watchdog {
        /// Its path.
        path: String,
    },
    /// A reaction panicked.
    #[error("reaction {} of {} panicked at {}: {}", .0.reaction, .0.path, .0.tag, .0.message)]
    Reaction(Fault),
    /// A federate ended otherwise than at its stop tag.
    #[error("federate {federate}: {outcome}")]
    Ended {
        /// The federate.
        federate: String,
        /// How.
        outcome: Outcome,
    },
    /// A law of coordination was broken, which is a bug of Ictus.
    #[error("seed {seed}: {violation}")]
    Violation {
        /// The seed.
        seed: u64,
        /// Which law, and how.
        violation: Violation,
    },
}

/// A federation in the making.
#[derive(Debug)]
pub struct Federation {
    plan: Plan,
    classes: BTreeMap<&'static str, Class>,
    error: Option<FederationError>,
}

impl Default for Federation {
    fn default() -> Self {
        Self::new()
    }
}

impl Federation {
    /// A federation of nobody, without the time-out that it needs.
    #[must_use]
    pub fn new() -> Self {
        Self {
            plan: Plan {
                federation: "simulated".to_owned(),
                extensions: true,
                ..Plan::default()
            },
            classes: BTreeMap::new(),
            error: None,
        }
    }

    /// Adds a federate: an instance of `R`, with parameters as a manifest gives them.
    #[must_use]
    pub fn federate<R: Reactions>(mut self, name: &str, parameters: serde_json::Value) -> Self {
        let serde_json::Value::Object(parameters) = parameters else {
            let federate = name.to_owned();
            self.error
                .get_or_insert(FederationError::Parameters { federate });
            return self;
        };
        let class = Class::of::<R>();
        self.classes.insert(class.name(), class);
        self.plan.federates.push(FederatePlan {
            name: name.to_owned(),
            class: Some(class.name().to_owned()),
            parameters,
            ..FederatePlan::default()
        });
        self
    }

    /// Connects an output to an input, each `FEDERATE.PORT` or `FEDERATE.PORT[CHANNEL]` of federates already added; `after`
    /// as in a manifest: zero is one microstep, `None` no delay.
    #[must_use]
    pub fn connect(mut self, from: &str, to: &str, after: Option<Duration>) -> Self {
        match self.ends(from, to) {
            Ok((from, to)) => {
                let known = self.plan.connections.iter();
                let ports = known.filter(|c| c.to.federate == to.federate).count();
                self.plan.connections.push(ConnectionPlan {
                    serializer: self.serializer(&from),
                    from,
                    to,
                    after_ns: after.map(Duration::as_nanos),
                    port_id: u16::try_from(ports).unwrap_or(u16::MAX),
                    ..ConnectionPlan::default()
                });
            }
            Err(error) => {
                self.error.get_or_insert(error);
            }
        }
        self
    }

    /// Ends the run this long after the start tag.
    #[must_use]
    pub fn timeout(mut self, timeout: Duration) -> Self {
        self.plan.timeout_ns = Some(timeout.as_nanos());
        self
    }

    /// Leaves coordination to time: each federate waits `offset` for what may still come.
    ///
    /// No seed's network is bound to it, so that messages can be tardy, and traces then differ from that of one program.
    #[must_use]
    pub fn decentralized(mut self, offset: Duration) -> Self {
        self.plan.coordination = Coordination::Decentralized;
        for federate in &mut self.plan.federates {
            federate.stp_offset_ns = offset.as_nanos();
        }
        self
    }

    fn ends(&self, from: &str, to: &str) -> Result<(Endpoint, Endpoint), FederationError> {
        let end = |text: &str| {
            self.end(text).ok_or_else(|| FederationError::End {
                end: text.to_owned(),
                known: self.plan.federates.iter().map(|f| f.name.clone()).collect(),
            })
        };
        Ok((end(from)?, end(to)?))
    }

    fn end(&self, text: &str) -> Option<Endpoint> {
        let (federate, port) = text.split_once('.')?;
        let (port, channel) = match port.split_once('[') {
            Some((port, rest)) => (port, rest.strip_suffix(']')?.parse().ok()?),
            None => (port, 0),
        };
        let index = self
            .plan
            .federates
            .iter()
            .position(|f| f.name == federate)?;
        Some(Endpoint {
            federate: u16::try_from(index).ok()?,
            port: port.to_owned(),
            channel,
        })
    }

    /// The best serializer of an output's type; one that does not exist is found when the federation is assembled.
    fn serializer(&self, from: &Endpoint) -> String {
        let federate = &self.plan.federates[usize::from(from.federate)];
        let request = InstanceRequest {
            name: federate.name.clone(),
            class: federate.class.clone().unwrap_or_default(),
            parameters: federate.parameters.clone(),
        };
        let described = describe::instance(&self.class_list(), request);
        let port = described.outputs.iter().find(|p| p.name == from.port);
        let best = port.and_then(|port| port.serializers.first());
        best.map_or_else(|| "native".to_owned(), Clone::clone)
    }

    fn class_list(&self) -> Vec<Class> {
        self.classes.values().copied().collect()
    }

    /// Runs all federates as one program, as fast as it goes: the trace that every seed must show.
    ///
    /// # Errors
    ///
    /// When the parts do not fit together, or a reaction panics.
    pub fn alone(&self) -> Result<Trace, SimulateError> {
        let all: Vec<u16> = (0..self.count()).collect();
        let (assembly, clock, memory) = self.assemble(&all)?;
        let mut bodies = assembly.bodies;
        let config = FederateConfig {
            timeout: self.plan.timeout_ns.map(Duration::from_nanos),
            fast: true,
            keepalive: false,
        };
        let mut federate = Federate::alone(assembly.program, config);
        clock.set(START.time.as_physical());
        bodies.start(START);
        federate.start(START);
        while let Poll::Run = federate.poll(clock.now(), &mut bodies) {
            federate.run_batch(&mut bodies);
            clock.set(federate.timeline().at().time.as_physical());
            if bodies.fault().is_some() {
                federate.fail();
            }
        }
        check_fault(&bodies)?;
        Ok(Trace::of_records(&memory.text()))
    }

    /// Runs every federate and the RTI in the simulated world of `seed`.
    ///
    /// Equal seeds give equal runs on every machine. A run of more than 15 simulated minutes counts as one that does not end.
    ///
    /// # Errors
    ///
    /// As [`Federation::alone`]; when there is a physical action or a watchdog; when a law of coordination is broken.
    pub fn simulate(&self, seed: u64) -> Result<Trace, SimulateError> {
        // What does not fit together is found in one program, with the better words.
        let all: Vec<u16> = (0..self.count()).collect();
        self.assemble(&all)?;
        let mut parts = Vec::new();
        let mut memories = Vec::new();
        for id in 0..self.count() {
            let (assembly, clock, memory) = self.assemble(&[id])?;
            memories.push(memory);
            parts.push(Part {
                program: assembly.program,
                inputs: assembly.inputs,
                outputs: assembly.outputs,
                executor: Simulated {
                    bodies: assembly.bodies,
                    clock,
                    arrived: false,
                },
            });
        }
        let run = run_plan(&self.plan, parts, seed);
        for member in &run.members {
            check_fault(&member.executor.bodies)?;
        }
        if let Some(violation) = run.violation() {
            let violation = violation.clone();
            return Err(SimulateError::Violation { seed, violation });
        }
        for (member, federate) in run.members.into_iter().zip(&self.plan.federates) {
            if let Some(outcome) = member.outcome.filter(|o| !matches!(o, Outcome::Stopped)) {
                let federate = federate.name.clone();
                return Err(SimulateError::Ended { federate, outcome });
            }
        }
        let texts: String = memories.iter().map(Memory::text).collect();
        Ok(Trace::of_records(&texts))
    }

    fn count(&self) -> u16 {
        u16::try_from(self.plan.federates.len()).unwrap_or(u16::MAX)
    }

    fn assemble(
        &self,
        ids: &[u16],
    ) -> Result<(Assembly, Arc<SimulatedClock>, Memory), SimulateError> {
        if let Some(error) = &self.error {
            return Err(error.clone().into());
        }
        if self.plan.federates.is_empty() {
            return Err(FederationError::Empty.into());
        }
        let timeout = self.plan.timeout_ns.ok_or(FederationError::Endless)?;
        let spans = self.plan.connections.iter().filter_map(|c| c.after_ns);
        if spans.chain([timeout]).any(|span| span < 0) {
            return Err(FederationError::Negative.into());
        }
        let clock = Arc::new(SimulatedClock::default());
        let mut assembly = Assembly::new(&self.plan, ids, &self.class_list(), clock.clone())?;
        if let Some((_, path)) = assembly.bodies.physical.first() {
            let path = path.clone();
            return Err(SimulateError::PhysicalAction { path });
        }
        if let Some(path) = assembly.bodies.watchdogs.first() {
            let path = path.to_owned();
            return Err(SimulateError::Watchdog { path });
        }
        let memory = Memory::default();
        assembly.bodies.observer = Some(Observer::in_memory(&assembly.program, &memory));
        Ok((assembly, clock, memory))
    }
}

fn check_fault(bodies: &Bodies) -> Result<(), SimulateError> {
    match bodies.fault() {
        Some(fault) => Err(SimulateError::Reaction(fault.clone())),
        None => Ok(()),
    }
}

/// The logical trace of a run: what every reaction did at which tag, in a canonical order.
///
/// A record is a line of a trace file; ARCHITECTURE.md has the format.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Trace {
    records: Vec<String>,
}

impl Trace {
    fn of_records(text: &str) -> Self {
        let records = text.lines().filter(|line| !line.starts_with('#'));
        let mut keyed: Vec<_> = records.map(|line| (key(line), line.to_owned())).collect();
        keyed.sort();
        let records = keyed.into_iter().map(|(_, line)| line).collect();
        Self { records }
    }

    /// All records, by tag, then reactor and reaction.
    #[must_use]
    pub fn records(&self) -> &[String] {
        &self.records
    }

    /// The records of the federate `name`, in order.
    pub fn of(&self, name: &str) -> impl Iterator<Item = &str> {
        self.records.iter().map(String::as_str).filter(move |line| {
            let path = line.split('\t').nth(2).unwrap_or_default();
            path.split('.').next() == Some(name)
        })
    }
}

impl fmt::Display for Trace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.records
            .iter()
            .try_for_each(|line| writeln!(f, "{line}"))
    }
}

fn key(line: &str) -> (i64, u32, String, u32) {
    let mut fields = line.split('\t');
    let time = fields.next().and_then(|field| field.parse().ok());
    let microstep = fields.next().and_then(|field| field.parse().ok());
    let path = fields.next().unwrap_or_default().to_owned();
    let index = fields.next().and_then(|field| field.parse().ok());
    let unread = "records are written by the observer";
    debug_assert!(
        time.is_some() && microstep.is_some() && index.is_some(),
        "{unread}"
    );
    (
        time.unwrap_or_default(),
        microstep.unwrap_or_default(),
        path,
        index.unwrap_or_default(),
    )
}

/// A clock that the simulated world moves.
#[derive(Debug, Default)]
struct SimulatedClock(AtomicI64);

impl SimulatedClock {
    fn set(&self, now: PhysicalTime) {
        self.0.fetch_max(now.as_nanos(), Ordering::Relaxed);
    }
}

impl Clock for SimulatedClock {
    fn now(&self) -> PhysicalTime {
        PhysicalTime::from_nanos(self.0.load(Ordering::Relaxed))
    }
}

/// Bodies on a simulated host.
#[derive(Debug)]
struct Simulated {
    bodies: Bodies,
    clock: Arc<SimulatedClock>,
    /// Whether anything has arrived at the current tag.
    arrived: bool,
}

impl Executor for Simulated {
    fn begin(&mut self, tag: Tag) {
        self.arrived = false;
        self.bodies.begin(tag);
    }

    fn arrive(&mut self, action: ActionId, slot: Option<SlotId>, value: ValueId) {
        self.arrived = true;
        self.bodies.arrive(action, slot, value);
    }

    fn release(&mut self, action: ActionId, value: ValueId) {
        self.bodies.release(action, value);
    }

    fn run(&mut self, node: NodeId, tag: Tag, effects: &mut Effects) {
        self.bodies.run(node, tag, effects);
    }

    fn run_tardy(&mut self, node: NodeId, tag: Tag, intended: Tag, effects: &mut Effects) {
        self.bodies.run_tardy(node, tag, intended, effects);
    }
}

impl FederateExecutor for Simulated {
    fn encode(&mut self, output: OutputId, out: &mut Vec<u8>) {
        self.bodies.encode(output, out);
    }

    fn decode(&mut self, input: InputId, payload: &[u8]) -> Result<ValueId, PayloadError> {
        self.bodies.decode(input, payload)
    }

    fn note_physical(&mut self, action: ActionId, tag: Tag) {
        self.bodies.note_physical(action, tag);
    }

    fn note_tardy(&mut self, input: InputId, intended: Tag, actual: Tag) {
        self.bodies.note_tardy(input, intended, actual);
    }
}

impl SimulatedExecutor for Simulated {
    fn started(&mut self, start: Tag) {
        self.bodies.start(start);
    }

    fn reads_clock(&mut self, now: PhysicalTime) {
        self.clock.set(now);
    }

    fn failed(&self) -> bool {
        self.bodies.fault().is_some()
    }

    fn outside(&mut self, _draw: u64) -> Option<(ActionId, ValueId)> {
        None
    }

    fn stamped(&mut self, _tag: Tag) {}

    fn quiet(&self) -> bool {
        !self.arrived
    }

    fn observe(&mut self, _node: NodeId) {}
}
