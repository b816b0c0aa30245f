//! Random federations: what they are made of, and the programs built from them, federated and alone.

mod build;
mod generate;

use ictus_coord::plan::{ClockPlan, ClockSync, ConnectionPlan, Endpoint, FederatePlan, Plan};
use ictus_core::{ActionKind, Delay, Duration};
use std::fmt;

pub use build::{Assembly, Body};

/// A federation of synthetic programs.
#[derive(Clone, Debug)]
pub struct Federation {
    /// Federates in order of their ids.
    pub federates: Vec<FederateSpec>,
    /// Connections between federates, and of a federate with itself.
    pub links: Vec<LinkSpec>,
    /// The time-out; `None` when the program ends by itself.
    pub timeout: Option<Duration>,
    /// Ahead of physical time.
    pub fast: bool,
    /// Flow control.
    pub max_lead: Option<Duration>,
    /// Clocks are compared while joining.
    pub clock_sync: bool,
    /// Our extensions are used.
    pub extensions: bool,
}

/// One federate: its first reactor is the federate itself.
#[derive(Clone, Debug, Default)]
pub struct FederateSpec {
    /// Reactors; the first has the federate's ports.
    pub reactors: Vec<ReactorSpec>,
    /// Connections inside the federate.
    pub wires: Vec<WireSpec>,
}

/// One reactor instance.
#[derive(Clone, Debug, Default)]
pub struct ReactorSpec {
    /// The whole path.
    pub path: String,
    /// The number of inputs.
    pub inputs: usize,
    /// The number of outputs.
    pub outputs: usize,
    /// Timers and actions.
    pub actions: Vec<ActionKind>,
    /// Reactions in order.
    pub reactions: Vec<ReactionPlan>,
}

/// One reaction; numbers index the reactor's inputs, outputs and actions.
#[derive(Clone, Debug, Default)]
pub struct ReactionPlan {
    /// Runs at the start tag.
    pub startup: bool,
    /// Runs at the stop tag.
    pub shutdown: bool,
    /// Actions and timers that trigger it.
    pub actions: Vec<usize>,
    /// Inputs that trigger it.
    pub inputs: Vec<usize>,
    /// Inputs it reads without being triggered.
    pub reads: Vec<usize>,
    /// Outputs it may set.
    pub effects: Vec<usize>,
    /// Logical actions it may schedule.
    pub schedules: Vec<usize>,
    /// Asks for a stop once this much logical time has passed.
    pub stops_after: Option<Duration>,
    /// Asked of the executor in percent: how often an output is set.
    pub eagerness: u64,
}

/// A port of a reactor of the same federate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PortRef {
    /// Input of a reactor.
    Input(usize, usize),
    /// Output of a reactor.
    Output(usize, usize),
}

/// A connection inside a federate.
#[derive(Clone, Copy, Debug)]
pub struct WireSpec {
    /// The sending end.
    pub from: PortRef,
    /// The receiving end.
    pub to: PortRef,
    /// Its delay.
    pub delay: Delay,
}

/// A connection between federates: output of the first reactor to input of the first reactor.
#[derive(Clone, Copy, Debug)]
pub struct LinkSpec {
    /// The sender and its output.
    pub from: (usize, usize),
    /// The receiver and its input.
    pub to: (usize, usize),
    /// Its delay.
    pub delay: Delay,
}

impl Federation {
    /// The resolved plan, as programs get it.
    ///
    /// # Panics
    ///
    /// When the federation has more than 65535 parts of a kind.
    #[must_use]
    pub fn plan(&self) -> Plan {
        let small = |n: usize| u16::try_from(n).expect("small federations");
        let federates = self.federates.iter().map(|f| FederatePlan {
            name: f.reactors[0].path.clone(),
            class: Some("Synthetic".to_owned()),
            program: Some("sim".to_owned()),
            ..FederatePlan::default()
        });
        let connections = self.links.iter().map(|link| ConnectionPlan {
            from: Endpoint {
                federate: small(link.from.0),
                port: format!("out{}", link.from.1),
                channel: 0,
            },
            to: Endpoint {
                federate: small(link.to.0),
                port: format!("in{}", link.to.1),
                channel: 0,
            },
            after_ns: match link.delay {
                Delay::None => None,
                Delay::Microstep => Some(0),
                Delay::Time(delay) => Some(delay.as_nanos()),
            },
            serializer: "native".to_owned(),
            port_id: small(link.to.1),
            ..ConnectionPlan::default()
        });
        Plan {
            federation: "simulated".to_owned(),
            timeout_ns: self.timeout.map(Duration::as_nanos),
            fast: self.fast,
            max_lead_ns: self.max_lead.map(Duration::as_nanos),
            clock: ClockPlan {
                sync: if self.clock_sync {
                    ClockSync::Init
                } else {
                    ClockSync::Off
                },
                ..ClockPlan::default()
            },
            extensions: self.extensions,
            federates: federates.collect(),
            connections: connections.collect(),
            ..Plan::default()
        }
    }

    /// The paths of all reactors, federate by federate: what the reactor numbers of a trace stand for.
    pub fn paths(&self) -> impl Iterator<Item = &str> {
        self.federates
            .iter()
            .flat_map(|f| f.reactors.iter().map(|r| r.path.as_str()))
    }

    /// The number of the first reactor of a federate in the trace.
    #[must_use]
    pub fn first_reactor(&self, federate: usize) -> usize {
        self.federates[..federate]
            .iter()
            .map(|f| f.reactors.len())
            .sum()
    }
}

impl fmt::Display for Federation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for federate in &self.federates {
            for (index, reactor) in federate.reactors.iter().enumerate() {
                writeln!(
                    f,
                    "{index} {}: {} inputs, {} outputs, {:?}",
                    reactor.path, reactor.inputs, reactor.outputs, reactor.actions
                )?;
                for (index, reaction) in reactor.reactions.iter().enumerate() {
                    writeln!(f, "  #{index} {reaction:?}")?;
                }
            }
            for wire in &federate.wires {
                writeln!(f, "  {:?} -> {:?} {:?}", wire.from, wire.to, wire.delay)?;
            }
        }
        for link in &self.links {
            writeln!(f, "{:?} -> {:?} {:?}", link.from, link.to, link.delay)?;
        }
        write!(f, "timeout {:?}, lead {:?}", self.timeout, self.max_lead)
    }
}
