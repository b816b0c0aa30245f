//! Elaboration: from classes to the tables of a program and to its bodies.

use crate::access::{Args, Declaration, Outcome};
use crate::action::{ActionValues, LogicalAction, PhysicalAction, Shutdown, Startup, Timer};
use crate::carrier::{Carrier, PortType, Typed};
use crate::ctx::Ctx;
use crate::linker::Linker;
use crate::outside::Outside;
use crate::parameters::Complete;
use crate::port::{Input, Multi, Output};
use crate::reactor::{Bank, Child, Reactions};
use crate::slot::{Epoch, Shared, Signal};
use crate::value::Value;
use crate::watchdog::{Watchdog, WatchdogHandler, Watchdogs};
use crate::wiring::Wiring;
use ictus_core::{
    ActionId, ActionKind, Delay, Duration, PortId, PortKind, ProgramBuilder, ReactionSpec,
    ReactorId, Spacing,
};
use std::fmt;
use std::rc::Rc;
use std::sync::Arc;
use thiserror::Error;

/// Everything collected so far.
pub(crate) struct Elaboration {
    pub(crate) program: ProgramBuilder,
    pub(crate) ports: Vec<DeclaredPort>,
    pub(crate) bodies: Vec<BodyEntry>,
    pub(crate) carriers: Vec<Box<dyn Carrier>>,
    /// Paths of physical actions and of ports that physical connections feed, for the trace.
    pub(crate) physical: Vec<(ActionId, String)>,
    pub(crate) watchdogs: Watchdogs,
    pub(crate) errors: Vec<WiringError>,
    startup: Signal,
    shutdown: Signal,
    outside: Arc<Outside>,
}

/// A port of one instance, with all its channels.
pub(crate) struct DeclaredPort {
    pub(crate) reactor: ReactorId,
    pub(crate) name: &'static str,
    pub(crate) kind: PortKind,
    pub(crate) multi: bool,
    pub(crate) channels: Vec<PortId>,
    pub(crate) typed: Rc<dyn PortType>,
}

/// A mistake in the parts of a reactor or in a `#[connections]` function.
#[derive(Clone, PartialEq, Eq, Debug, Error)]
#[non_exhaustive]
pub enum WiringError {
    /// A span of time that cannot be negative is.
    #[error("{path}: the {what} is negative: {span}")]
    Negative {
        /// The reactor.
        path: String,
        /// What the span is.
        what: &'static str,
        /// The span.
        span: Duration,
    },
    /// A watchdog has no handler, or two.
    #[error("{path}: the watchdog has {count} handlers instead of one: write one method `#[watchdog({name})]`", name = path.rsplit('.').next().unwrap_or_default())]
    Watchdog {
        /// The watchdog's path.
        path: String,
        /// How many handlers it has.
        count: usize,
    },
    /// A connection that runs against the grain.
    #[error(
        "{path}: no connection can go {side} {port}: connections go from a child's output or an own port \
         to a child's input or an own output"
    )]
    Direction {
        /// The container.
        path: String,
        /// `from` or `to`.
        side: &'static str,
        /// The port that is at the wrong end.
        port: String,
    },
    /// A multiport is connected to one of another width.
    #[error("{path}: a connection joins {from} channels to {to}")]
    Widths {
        /// The container.
        path: String,
        /// Channels of the source.
        from: usize,
        /// Channels of the destination.
        to: usize,
    },
}

impl Elaboration {
    pub(crate) fn new(outside: Arc<Outside>) -> Self {
        let (startup, shutdown) = (Signal::default(), Signal::default());
        Self {
            program: ProgramBuilder::new(),
            ports: Vec::new(),
            bodies: Vec::new(),
            carriers: vec![Box::new(startup.clone()), Box::new(shutdown.clone())],
            physical: Vec::new(),
            watchdogs: Watchdogs::default(),
            errors: Vec::new(),
            startup,
            shutdown,
            outside,
        }
    }

    /// Adds an instance and all that is in it.
    pub(crate) fn instance<R: Reactions>(
        &mut self,
        path: String,
        bank_index: usize,
        parameters: R::Parameters,
    ) -> (ReactorId, R::Parts) {
        let reactor = self.program.reactor(path.clone());
        let mut scope = Scope {
            elaboration: self,
            reactor,
            path,
            bank_index,
        };
        let (state, parts) = R::declare(parameters, &mut scope);
        let state = Shared::new(state);
        let mut reactions = ReactionScope {
            scope,
            state: state.clone(),
        };
        state.read().react(&parts, &mut reactions);
        (reactor, parts)
    }

    fn action(&mut self, kind: ActionKind, carrier: Box<dyn Carrier>) -> ActionId {
        let action = self.program.action(kind);
        self.carry(action, carrier);
        action
    }

    /// Carriers stand by action id; every action gets its own right after it was added.
    pub(crate) fn carry(&mut self, action: ActionId, carrier: Box<dyn Carrier>) {
        debug_assert_eq!(action.index(), self.carriers.len(), "one carrier an action");
        self.carriers.push(carrier);
    }

    pub(crate) fn connect(
        &mut self,
        (from, to): (PortId, PortId),
        delay: Delay,
        typed: &dyn PortType,
    ) {
        if let Some(action) = self.program.connect(from, to, delay) {
            self.carry(action, typed.delayed(from, to));
        }
    }

    pub(crate) fn connect_physical(
        &mut self,
        (from, to): (PortId, PortId),
        min_delay: Duration,
        typed: &dyn PortType,
    ) {
        let action = self.program.connect_physical(from, to, min_delay);
        self.carry(action, typed.delayed(from, to));
        self.physical.push((action, self.program.port_path(to)));
    }

    /// Adds an input that another federate feeds over a physical connection.
    pub(crate) fn physical_input(
        &mut self,
        to: PortId,
        min_delay: Duration,
        receiver: Box<dyn Carrier>,
    ) {
        self.program.network_input_physical(to, min_delay);
        // The input's action is the program's last.
        let action = ActionId::new(self.carriers.len());
        self.carry(action, receiver);
        self.physical.push((action, self.program.port_path(to)));
    }
}

/// Where a reactor declares its parts.
pub struct Scope<'a> {
    pub(crate) elaboration: &'a mut Elaboration,
    reactor: ReactorId,
    pub(crate) path: String,
    bank_index: usize,
}

impl Scope<'_> {
    fn ports<T: Value>(
        &mut self,
        name: &'static str,
        kind: PortKind,
        width: Option<usize>,
    ) -> Vec<PortId> {
        let program = &mut self.elaboration.program;
        let channels: Vec<PortId> = match width {
            None => vec![program.port(self.reactor, name, kind)],
            Some(width) => (0..width)
                .map(|channel| program.port(self.reactor, format!("{name}[{channel}]"), kind))
                .collect(),
        };
        self.elaboration.ports.push(DeclaredPort {
            reactor: self.reactor,
            name,
            kind,
            multi: width.is_some(),
            channels: channels.clone(),
            typed: Rc::new(Typed::<T>::new()),
        });
        channels
    }

    /// Adds an input.
    pub fn input<T: Value>(&mut self, name: &'static str) -> Input<T> {
        Input::new(self.ports::<T>(name, PortKind::Input, None)[0])
    }

    /// Adds an output.
    pub fn output<T: Value>(&mut self, name: &'static str) -> Output<T> {
        Output::new(self.ports::<T>(name, PortKind::Output, None)[0])
    }

    /// Adds an input of several channels.
    pub fn multi_input<T: Value>(&mut self, name: &'static str, width: usize) -> Multi<Input<T>> {
        let ports = self.ports::<T>(name, PortKind::Input, Some(width));
        Multi::new(ports.into_iter().map(Input::new).collect())
    }

    /// Adds an output of several channels.
    pub fn multi_output<T: Value>(&mut self, name: &'static str, width: usize) -> Multi<Output<T>> {
        let ports = self.ports::<T>(name, PortKind::Output, Some(width));
        Multi::new(ports.into_iter().map(Output::new).collect())
    }

    fn not_negative(&mut self, what: &'static str, span: Duration) {
        if span < Duration::ZERO {
            let path = self.path.clone();
            let error = WiringError::Negative { path, what, span };
            self.elaboration.errors.push(error);
        }
    }

    /// Adds a timer that fires at start + `offset`, then every `period`; a period of zero means once.
    pub fn timer(&mut self, offset: Duration, period: Duration) -> Timer {
        self.not_negative("offset of a timer", offset);
        self.not_negative("period of a timer", period);
        let signal = Signal::default();
        let kind = ActionKind::Timer { offset, period };
        let action = self.elaboration.action(kind, Box::new(signal.clone()));
        Timer::new(action, signal)
    }

    /// Adds a logical action.
    pub fn logical_action<T: Value>(
        &mut self,
        name: &'static str,
        min_delay: Duration,
        spacing: Spacing,
    ) -> LogicalAction<T> {
        self.not_negative("minimum delay of an action", min_delay);
        self.not_negative("minimum spacing of an action", spacing.min);
        let values = Shared::new(ActionValues::new());
        let kind = ActionKind::Logical { min_delay, spacing };
        let action = self.elaboration.action(kind, Box::new(values.clone()));
        LogicalAction::new(action, name, values)
    }

    /// Adds a physical action.
    pub fn physical_action<T: Value>(
        &mut self,
        name: &'static str,
        min_delay: Duration,
        spacing: Spacing,
    ) -> PhysicalAction<T> {
        self.not_negative("minimum delay of an action", min_delay);
        self.not_negative("minimum spacing of an action", spacing.min);
        let values = Shared::new(ActionValues::new());
        let kind = ActionKind::Physical { min_delay, spacing };
        let action = self.elaboration.action(kind, Box::new(values.clone()));
        let path = format!("{}.{name}", self.path);
        self.elaboration.physical.push((action, path));
        PhysicalAction::new(action, name, values, Arc::clone(&self.elaboration.outside))
    }

    /// Adds a watchdog that expires `timeout` after the tag at which it was started.
    pub fn watchdog(&mut self, name: &'static str, timeout: Duration) -> Watchdog {
        self.not_negative("timeout of a watchdog", timeout);
        let path = format!("{}.{name}", self.path);
        self.elaboration.watchdogs.add(path, timeout)
    }

    /// Adds a nested reactor.
    pub fn child<R: Reactions>(
        &mut self,
        name: &str,
        parameters: impl Complete<R::Parameters>,
    ) -> Child<R> {
        let path = format!("{}.{name}", self.path);
        let instance = self
            .elaboration
            .instance::<R>(path, 0, parameters.complete());
        Child::new(instance.1)
    }

    /// Adds `width` nested reactors of one class; `parameters` gets the index of each.
    pub fn bank<R: Reactions, P: Complete<R::Parameters>>(
        &mut self,
        name: &str,
        width: usize,
        parameters: impl Fn(usize) -> P,
    ) -> Bank<R> {
        let members = (0..width).map(|index| {
            let path = format!("{}.{name}[{index}]", self.path);
            let parameters = parameters(index).complete();
            let instance = self.elaboration.instance::<R>(path, index, parameters);
            Child::new(instance.1)
        });
        Bank::new(members.collect())
    }

    /// The reactor's index in its bank; 0 outside banks.
    #[must_use]
    pub const fn bank_index(&self) -> usize {
        self.bank_index
    }
}

impl fmt::Debug for Scope<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Scope")
            .field("path", &self.path)
            .finish_non_exhaustive()
    }
}

/// Where a reactor adds its reactions and connections.
#[derive(Debug)]
pub struct ReactionScope<'a, R> {
    scope: Scope<'a>,
    state: Shared<R>,
}

impl<R: 'static> ReactionScope<'_, R> {
    /// The startup signal.
    #[must_use]
    pub fn startup(&self) -> Startup {
        Startup::new(ActionId::STARTUP, self.scope.elaboration.startup.clone())
    }

    /// The shutdown signal.
    #[must_use]
    pub fn shutdown(&self) -> Shutdown {
        Shutdown::new(ActionId::SHUTDOWN, self.scope.elaboration.shutdown.clone())
    }

    /// Adds a reaction. `body` gets which of its functions is to run: never a handler that it does not have.
    pub fn reaction<A: Args>(
        &mut self,
        name: &str,
        handlers: Handlers,
        args: A,
        body: impl FnMut(&mut R, &mut Ctx, &mut A, Case) + 'static,
    ) {
        let deadline = handlers.deadline;
        if let Some(deadline) = deadline {
            self.scope.not_negative("deadline of a reaction", deadline);
        }
        let mut declaration = Declaration::default();
        args.declare(&mut declaration);
        let elaboration = &mut *self.scope.elaboration;
        elaboration.program.reaction(ReactionSpec {
            reactor: self.scope.reactor,
            name: name.to_owned(),
            triggers: declaration.triggers,
            sources: declaration.sources,
            effects: declaration.effects,
            deadline,
        });
        elaboration.bodies.push(BodyEntry {
            reactor: self.scope.reactor,
            handlers,
            body: Box::new(TypedBody {
                state: self.state.clone(),
                args,
                body,
            }),
        });
    }

    /// Says what runs when `watchdog` expires: once a watchdog, with physical actions only.
    pub fn watchdog<A: Args>(
        &mut self,
        watchdog: &Watchdog,
        name: &'static str,
        args: A,
        mut body: impl FnMut(&mut R, &mut Ctx, &mut A) + 'static,
    ) {
        let handler = WatchdogHandler {
            name,
            reactor: self.scope.reactor,
            body: Box::new(TypedBody {
                state: self.state.clone(),
                args,
                body: move |state: &mut R, ctx: &mut Ctx, args: &mut A, _| body(state, ctx, args),
            }),
        };
        self.scope.elaboration.watchdogs.handle(watchdog, handler);
    }

    /// Connects ports of children and of the reactor itself.
    pub fn connections(&mut self, wire: impl FnOnce(&mut Wiring)) {
        let mut wiring = Wiring::default();
        wire(&mut wiring);
        wiring.apply(self.scope.reactor, &self.scope.path, self.scope.elaboration);
    }
}

/// A reaction's body with what its run needs to know.
pub(crate) struct BodyEntry {
    pub(crate) reactor: ReactorId,
    pub(crate) handlers: Handlers,
    pub(crate) body: Box<dyn Body>,
}

/// What may run instead of a reaction's body.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Handlers {
    /// How long after its tag's time the reaction may start, physically, before its deadline handler runs instead.
    pub deadline: Option<Duration>,
    /// Whether an STP handler runs instead when a tardy message led to it.
    pub stp: bool,
}

/// Which of a reaction's functions runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Case {
    /// The reaction itself.
    Body,
    /// The handler of a missed deadline.
    Deadline,
    /// The handler of a tardy message; a deadline missed as well comes first.
    Stp,
}

/// A reaction's body.
pub(crate) trait Body {
    fn link(&mut self, linker: &mut Linker<'_>);

    fn run(&mut self, ctx: &mut Ctx, epoch: Epoch, case: Case, outcome: &mut Outcome<'_>);
}

struct TypedBody<R, A, F> {
    state: Shared<R>,
    args: A,
    body: F,
}

impl<R, A: Args, F: FnMut(&mut R, &mut Ctx, &mut A, Case)> Body for TypedBody<R, A, F> {
    fn link(&mut self, linker: &mut Linker<'_>) {
        self.args.link(linker);
    }

    #[inline]
    fn run(&mut self, ctx: &mut Ctx, epoch: Epoch, case: Case, outcome: &mut Outcome<'_>) {
        self.args.bind(epoch);
        (self.body)(&mut self.state.write(), ctx, &mut self.args, case);
        self.args.release(outcome);
    }
}
