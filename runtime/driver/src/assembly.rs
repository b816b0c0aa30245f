//! From a plan to something that runs: instances, connections, bodies.

use crate::bodies::{Bodies, Counters};
use crate::class::Class;
use crate::clock::Clock;
use crate::ctx::Ctx;
use crate::linker::Linker;
use crate::outside::Outside;
use crate::parameters::ParameterError;
use crate::scope::{DeclaredPort, Elaboration, WiringError};
use crate::slot::Epoch;
use ictus_coord::measure::Histogram;
use ictus_coord::plan::{ConnectionPlan, Endpoint, FederatePlan, Plan};
use ictus_core::{Delay, Duration, PortId, PortKind, Program, ProgramError, ReactorId, Tag};
use std::any::Any;
use std::collections::BTreeSet;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::rc::Rc;
use std::sync::Arc;
use thiserror::Error;

/// The part of a plan that runs in this process.
#[derive(Debug)]
pub struct Assembly {
    /// What exists and depends on what.
    pub program: Arc<Program>,
    /// Values and reaction bodies.
    pub bodies: Bodies,
    /// By [`InputId`](ictus_core::InputId): the index of its connection in the plan.
    pub inputs: Vec<usize>,
    /// By [`OutputId`](ictus_core::OutputId): the index of its connection in the plan.
    pub outputs: Vec<usize>,
}

/// Why a plan cannot be assembled. All are fatal and name the place.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum AssemblyError {
    /// The plan has no federate with this id.
    #[error("the plan has no federate {id}")]
    NoFederate {
        /// The id.
        id: u16,
    },
    /// A name that cannot stand in traces and file names, or that two federates have.
    #[error("`{federate}` cannot be a federate's name: {why}")]
    Name {
        /// The name.
        federate: String,
        /// Why not.
        why: &'static str,
    },
    /// The class's own code panicked while an instance was built: an initial value, a width, a `#[connections]` function.
    #[error("federate {federate} (class {class}): building it panicked: {message}")]
    Panicked {
        /// The federate.
        federate: String,
        /// Its class.
        class: String,
        /// The panic's words.
        message: String,
    },
    /// The federate is a foreign one: it has no class to instantiate.
    #[error("federate {federate} is foreign: it has no class")]
    Foreign {
        /// The federate.
        federate: String,
    },
    /// The program does not have the class.
    #[error("federate {federate}: this program has no class `{class}`; it has {}", .known.join(", "))]
    NoClass {
        /// The federate.
        federate: String,
        /// The class.
        class: String,
        /// The program's classes.
        known: Vec<String>,
    },
    /// The parameters are not usable.
    #[error("federate {federate} (class {class}): {source}")]
    Parameter {
        /// The federate.
        federate: String,
        /// Its class.
        class: String,
        /// What is wrong.
        source: ParameterError,
    },
    /// A connection names a port that does not exist, or one of the wrong kind.
    #[error("federate {federate} (class {class}) has no {kind} `{port}`")]
    NoPort {
        /// The federate.
        federate: String,
        /// Its class.
        class: String,
        /// `input` or `output`, with the channel when it is out of range.
        kind: &'static str,
        /// The port with its channel.
        port: String,
    },
    /// The ends of a connection have different types.
    #[error("{from} ({from_type}) and {to} ({to_type}) have different types")]
    Types {
        /// The output.
        from: String,
        /// Its type.
        from_type: String,
        /// The input.
        to: String,
        /// Its type.
        to_type: String,
    },
    /// The type of a port does not offer the connection's serializer.
    #[error("{port}: its type {type_name} does not offer the serializer `{serializer}`")]
    Serializer {
        /// The port.
        port: String,
        /// Its type.
        type_name: String,
        /// The serializer.
        serializer: String,
    },
    /// A plan that runs ahead of physical time has something that is scheduled by it.
    #[error("`fast`, but {what} `{path}` goes by the physical clock")]
    Fast {
        /// `the physical action`, `the watchdog`, or `the physical connection to`.
        what: &'static str,
        /// The action, the watchdog, or the receiving port.
        path: String,
    },
    /// A mistake in a `#[connections]` function.
    #[error(transparent)]
    Wiring(#[from] WiringError),
    /// The parts do not fit together.
    #[error(transparent)]
    Program(#[from] ProgramError),
}

impl Assembly {
    /// Builds the federates `mine` (indices into the plan): connections among them become local, others network inputs
    /// and outputs.
    ///
    /// # Errors
    ///
    /// The first [`AssemblyError`] found.
    pub fn new(
        plan: &Plan,
        mine: &[u16],
        classes: &[Class],
        clock: Arc<dyn Clock>,
    ) -> Result<Self, AssemblyError> {
        check_names(plan)?;
        let mut assembler = Assembler::new(plan, clock);
        for id in mine {
            assembler.instantiate(*id, classes)?;
        }
        for index in 0..plan.connections.len() {
            assembler.connect(index)?;
        }
        assembler.check_fast()?;
        assembler.finish()
    }
}

fn check_names(plan: &Plan) -> Result<(), AssemblyError> {
    let mut seen = BTreeSet::new();
    for FederatePlan { name, .. } in &plan.federates {
        let letters = |b: u8| b.is_ascii_alphanumeric() || b == b'_' || b == b'-';
        let why = if !name.starts_with(|c: char| c.is_ascii_alphabetic()) {
            "it does not begin with a letter"
        } else if !name.bytes().all(letters) {
            "only letters, digits, `_` and `-` are allowed"
        } else if !seen.insert(name.as_str()) {
            "another federate has it"
        } else {
            continue;
        };
        let federate = name.clone();
        return Err(AssemblyError::Name { federate, why });
    }
    Ok(())
}

/// What a panic said.
pub(crate) fn words(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
    let text = text.or_else(|| panic.downcast_ref::<String>().cloned());
    text.unwrap_or_else(|| "a panic without words".to_owned())
}

/// An assembly in the making.
pub(crate) struct Assembler<'a> {
    plan: &'a Plan,
    clock: Arc<dyn Clock>,
    outside: Arc<Outside>,
    pub(crate) elaboration: Elaboration,
    /// By federate id: its top-level reactor, when it is built here.
    reactors: Vec<Option<ReactorId>>,
    senders: Vec<Box<dyn crate::carrier::Sender>>,
    input_types: Vec<String>,
    inputs: Vec<usize>,
    outputs: Vec<usize>,
}

impl<'a> Assembler<'a> {
    pub(crate) fn new(plan: &'a Plan, clock: Arc<dyn Clock>) -> Self {
        let outside = Arc::new(Outside::new(Arc::clone(&clock)));
        Self {
            plan,
            clock,
            elaboration: Elaboration::new(Arc::clone(&outside)),
            outside,
            reactors: vec![None; plan.federates.len()],
            senders: Vec::new(),
            input_types: Vec::new(),
            inputs: Vec::new(),
            outputs: Vec::new(),
        }
    }

    pub(crate) fn instantiate(
        &mut self,
        id: u16,
        classes: &[Class],
    ) -> Result<ReactorId, AssemblyError> {
        let no_federate = || AssemblyError::NoFederate { id };
        let federates = &self.plan.federates;
        let federate = federates.get(usize::from(id)).ok_or_else(no_federate)?;
        let foreign = || AssemblyError::Foreign {
            federate: federate.name.clone(),
        };
        let name = federate.class.as_ref().ok_or_else(foreign)?;
        let class = classes.iter().find(|class| class.name() == name);
        let class = class.ok_or_else(|| AssemblyError::NoClass {
            federate: federate.name.clone(),
            class: name.clone(),
            known: classes.iter().map(|c| c.name().to_owned()).collect(),
        })?;
        let parameters = federate.parameters.clone();
        let elaboration = &mut self.elaboration;
        // What is half built is thrown away with the assembler.
        let build = AssertUnwindSafe(|| class.build(elaboration, &federate.name, parameters));
        let reactor = catch_unwind(build).map_err(|panic| AssemblyError::Panicked {
            federate: federate.name.clone(),
            class: name.clone(),
            message: words(&*panic),
        })?;
        let reactor = reactor.map_err(|source| AssemblyError::Parameter {
            federate: federate.name.clone(),
            class: name.clone(),
            source,
        })?;
        self.reactors[usize::from(id)] = Some(reactor);
        Ok(reactor)
    }

    fn connect(&mut self, index: usize) -> Result<(), AssemblyError> {
        let connection = &self.plan.connections[index];
        let from = self.end(&connection.from, PortKind::Output)?;
        let to = self.end(&connection.to, PortKind::Input)?;
        match (from, to) {
            (None, None) => {}
            (Some(from), Some(to)) => self.connect_here(connection, &from, &to)?,
            (Some(from), None) => {
                let sender = from.typed.sender(from.port, &connection.serializer);
                self.senders
                    .push(sender.ok_or_else(|| self.no_serializer(connection, &from))?);
                self.elaboration.program.network_output(from.port);
                self.outputs.push(index);
            }
            (None, Some(to)) => {
                let receiver = to.typed.receiver(to.port, &connection.serializer);
                let receiver = receiver.ok_or_else(|| self.no_serializer(connection, &to))?;
                if connection.physical {
                    self.elaboration
                        .physical_input(to.port, min_delay(connection), receiver);
                } else {
                    let delayed = connection.after_ns.is_some();
                    self.elaboration.program.network_input(to.port, delayed);
                    self.elaboration.carriers.push(receiver);
                }
                self.input_types.push(to.typed.identity().name);
                self.inputs.push(index);
            }
        }
        Ok(())
    }

    fn connect_here(
        &mut self,
        connection: &ConnectionPlan,
        from: &EndPort,
        to: &EndPort,
    ) -> Result<(), AssemblyError> {
        let (from_type, to_type) = (from.typed.identity(), to.typed.identity());
        if from_type != to_type {
            return Err(AssemblyError::Types {
                from: self.end_path(&connection.from),
                from_type: from_type.name,
                to: self.end_path(&connection.to),
                to_type: to_type.name,
            });
        }
        let ends = (from.port, to.port);
        if connection.physical {
            self.elaboration
                .connect_physical(ends, min_delay(connection), &*from.typed);
            return Ok(());
        }
        let delay = connection
            .after_ns
            .map_or(Delay::None, |ns| Delay::after(Duration::from_nanos(ns)));
        self.elaboration.connect(ends, delay, &*from.typed);
        Ok(())
    }

    /// A plan that runs ahead of physical time cannot have what is scheduled by it, here or at another federate.
    fn check_fast(&self) -> Result<(), AssemblyError> {
        if !self.plan.fast {
            return Ok(());
        }
        let mut connections = self.plan.connections.iter();
        if let Some(found) = connections.find(|c| c.physical) {
            return Err(AssemblyError::Fast {
                what: "the physical connection to",
                path: self.end_path(&found.to),
            });
        }
        let action = self.elaboration.physical.first().map(|(_, path)| path);
        let action = action.map(|path| ("the physical action", path.clone()));
        let watchdog = || {
            Some((
                "the watchdog",
                self.elaboration.watchdogs.first()?.to_owned(),
            ))
        };
        let found = action.or_else(watchdog);
        found.map_or(Ok(()), |(what, path)| {
            Err(AssemblyError::Fast { what, path })
        })
    }

    /// The port at an end of a connection; `None` when its federate is elsewhere.
    fn end(&self, endpoint: &Endpoint, kind: PortKind) -> Result<Option<EndPort>, AssemblyError> {
        let id = endpoint.federate;
        let place = self.reactors.get(usize::from(id));
        let reactor = place.ok_or(AssemblyError::NoFederate { id })?;
        let Some(reactor) = *reactor else {
            return Ok(None);
        };
        let mut ports = self.elaboration.ports.iter();
        let declared = ports
            .find(|p| p.reactor == reactor && p.kind == kind && p.name == endpoint.port)
            .and_then(|declared| EndPort::new(declared, endpoint.channel));
        declared.map(Some).ok_or_else(|| AssemblyError::NoPort {
            federate: self.federate(endpoint).name.clone(),
            class: self.federate(endpoint).class.clone().unwrap_or_default(),
            kind: match kind {
                PortKind::Input => "input",
                PortKind::Output => "output",
            },
            port: match endpoint.channel {
                0 => endpoint.port.clone(),
                channel => format!("{}[{channel}]", endpoint.port),
            },
        })
    }

    fn no_serializer(&self, connection: &ConnectionPlan, end: &EndPort) -> AssemblyError {
        AssemblyError::Serializer {
            port: self.end_path(match end.kind {
                PortKind::Input => &connection.to,
                PortKind::Output => &connection.from,
            }),
            type_name: end.typed.identity().name,
            serializer: connection.serializer.clone(),
        }
    }

    fn federate(&self, endpoint: &Endpoint) -> &'a FederatePlan {
        &self.plan.federates[usize::from(endpoint.federate)]
    }

    fn end_path(&self, endpoint: &Endpoint) -> String {
        format!("{}.{}", self.federate(endpoint).name, endpoint.port)
    }

    pub(crate) fn finish(self) -> Result<Assembly, AssemblyError> {
        let Elaboration {
            program,
            mut bodies,
            mut carriers,
            physical,
            mut watchdogs,
            errors,
            ..
        } = self.elaboration;
        let errors = errors.into_iter().chain(watchdogs.unhandled());
        if let Some(error) = { errors }.next() {
            return Err(error.into());
        }
        let program = Arc::new(program.build()?);
        let mut senders = self.senders;
        let mut linker = Linker::new(&program);
        for carrier in &mut carriers {
            carrier.link(&mut linker);
        }
        for sender in &mut senders {
            sender.link(&mut linker);
        }
        for entry in &mut bodies {
            linker.reactor = Some(entry.reactor);
            entry.body.link(&mut linker);
        }
        for handler in watchdogs.handlers_mut() {
            linker.reactor = Some(handler.reactor);
            handler.body.link(&mut linker);
        }
        debug_assert_eq!(linker.mismatch, None, "connections were checked");
        let ctx = Ctx {
            tag: Tag::NEVER,
            start: Tag::ZERO,
            reactor: ReactorId::new(0),
            stop: false,
            intended: None,
            clock: self.clock,
            program: Arc::clone(&program),
        };
        let bodies = Bodies {
            program: Arc::clone(&program),
            ctx,
            epoch: Epoch::default(),
            bodies,
            carriers,
            senders,
            input_types: self.input_types,
            physical,
            watchdogs,
            outside: self.outside,
            observer: None,
            counters: Counters::default(),
            lateness: Histogram::default(),
            fault: None,
        };
        Ok(Assembly {
            program,
            bodies,
            inputs: self.inputs,
            outputs: self.outputs,
        })
    }
}

/// What a physical connection adds to the physical time of an arrival.
fn min_delay(connection: &ConnectionPlan) -> Duration {
    let after = connection.after_ns.unwrap_or(0);
    Duration::from_nanos(after.max(0))
}

/// One channel of a top-level port.
struct EndPort {
    port: PortId,
    kind: PortKind,
    typed: Rc<dyn crate::carrier::PortType>,
}

impl EndPort {
    fn new(declared: &DeclaredPort, channel: u32) -> Option<Self> {
        let channel = usize::try_from(channel).ok()?;
        Some(Self {
            port: *declared.channels.get(channel)?,
            kind: declared.kind,
            typed: Rc::clone(&declared.typed),
        })
    }
}
