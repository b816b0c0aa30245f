//! Programs: immutable tables of reactors, ports, actions and reactions, and the builder that checks them.
//!
//! A program knows structure only. Values and reaction bodies belong to an [`Executor`](crate::Executor).

use crate::graph::{self, BitSet, Graph};
use crate::id::{ActionId, InputId, NodeId, OutputId, PortId, ReactorId, SlotId};
use crate::tag::Delay;
use crate::time::Duration;
use thiserror::Error;

/// What makes an action fire, and when.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum ActionKind {
    /// At the start tag.
    Startup,
    /// At the stop tag.
    Shutdown,
    /// At start + offset, then every period; a period of zero means once.
    Timer {
        /// First firing, after the start tag.
        offset: Duration,
        /// Span between firings; zero for a single one.
        period: Duration,
    },
    /// When a reaction schedules it; the tag is the current one plus `min_delay` plus what the reaction adds.
    Logical {
        /// Added to every delay; a total of zero is one microstep.
        min_delay: Duration,
        /// How far events are kept apart.
        spacing: Spacing,
    },
    /// When something outside schedules it; the tag comes from the physical clock.
    Physical {
        /// Added to the physical time of the event.
        min_delay: Duration,
        /// How far events are kept apart.
        spacing: Spacing,
    },
    /// When the source of a delayed connection was set.
    Connection {
        /// The connection's delay; never [`Delay::None`].
        delay: Delay,
    },
    /// When a message from another federate is due.
    Network {
        /// The input.
        input: InputId,
    },
    /// When a value came over a physical connection: the tag comes from the receiver's physical clock.
    PhysicalConnection {
        /// The connection's `after`: added to the physical time of the arrival.
        min_delay: Duration,
    },
}

/// The least span between two events of an action, and what becomes of one that would come sooner.
#[derive(Clone, Copy, Default, PartialEq, Eq, Debug)]
pub struct Spacing {
    /// From the tag of the action's last event, pending or handled; zero: no spacing, the policy does not matter.
    pub min: Duration,
    /// What becomes of an event that would come sooner.
    pub policy: SpacingPolicy,
}

/// What becomes of an event that would come too soon after the one before.
///
/// Source: Lingua Franca, reactor-c `lf_schedule_trigger`.
#[derive(Clone, Copy, Default, PartialEq, Eq, Debug)]
pub enum SpacingPolicy {
    /// It comes later: at the first tag that keeps the spacing.
    #[default]
    Defer,
    /// It does not come; its value is released.
    Drop,
    /// Its value takes the place of the value before, which is released, when that event is still pending; else as
    /// [`SpacingPolicy::Defer`].
    Replace,
}

impl Spacing {
    /// Events may come as they like.
    pub const NONE: Self = Self {
        min: Duration::ZERO,
        policy: SpacingPolicy::Defer,
    };
}

/// What makes a reaction run.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Trigger {
    /// An action, a timer, [`ActionId::STARTUP`] or [`ActionId::SHUTDOWN`].
    Action(ActionId),
    /// A present port.
    Port(PortId),
}

/// Whether a port is an input or an output of its reactor.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum PortKind {
    /// Read by the reactor's own reactions; written by connections and by the reactions of the container.
    Input,
    /// Written by the reactor's own reactions; read by connections and by the reactions of the container.
    Output,
}

/// A reaction as it is declared.
#[derive(Clone, Debug)]
pub struct ReactionSpec {
    /// The reactor it belongs to.
    pub reactor: ReactorId,
    /// Its name, for messages.
    pub name: String,
    /// What makes it run.
    pub triggers: Vec<Trigger>,
    /// What it reads without being triggered by it.
    pub sources: Vec<PortId>,
    /// What it may set.
    pub effects: Vec<PortId>,
    /// How long after the tag's time it may start, physically, before its deadline handler runs instead.
    pub deadline: Option<Duration>,
}

/// What a node is.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum NodeKind {
    /// A user's reaction: index into [`Program::reactions`].
    Reaction,
    /// Takes the value of a slot to the delayed connection's queue.
    Forward {
        /// The connection's action.
        action: ActionId,
    },
    /// Sends the value of a slot to another federate.
    Send {
        /// Which of the network outputs.
        output: OutputId,
    },
}

/// Why a program cannot be built. All are fatal for the program and name the place by reactor path.
#[derive(Debug, Error, PartialEq, Eq)]
#[non_exhaustive]
pub enum ProgramError {
    /// Zero-delay dependencies form a loop.
    #[error("causality loop: {}; give one of its connections an `after` delay", .ports.join(" -> "))]
    CausalityLoop {
        /// The ports and reactions of the cycle, in order.
        ports: Vec<String>,
    },
    /// An input is fed twice.
    #[error("{port} has more than one incoming connection: {first} and {second}")]
    ManyWriters {
        /// The input's path.
        port: String,
        /// One source.
        first: String,
        /// The other.
        second: String,
    },
    /// A reaction writes a port that a connection feeds.
    #[error("reaction {reaction} writes {port}, which is fed by a connection")]
    WritesConnected {
        /// The reaction.
        reaction: String,
        /// The port's path.
        port: String,
    },
    /// Two different reactors write the same port.
    #[error("{port} is written by reactions of two reactors: {first} and {second}")]
    TwoOwners {
        /// The port's path.
        port: String,
        /// A reaction.
        first: String,
        /// A reaction of another reactor.
        second: String,
    },
}

#[derive(Debug)]
pub(crate) struct Reactor {
    pub(crate) path: String,
    reactions: u32,
}

#[derive(Debug)]
pub(crate) struct Port {
    pub(crate) reactor: ReactorId,
    pub(crate) name: String,
    pub(crate) kind: PortKind,
}

#[derive(Debug)]
pub(crate) struct Connection {
    from: PortId,
    to: PortId,
    action: Option<ActionId>,
}

/// A user's reaction.
#[derive(Debug)]
pub struct Reaction {
    /// As declared.
    pub spec: ReactionSpec,
    /// Position among the reactions of its reactor, from 0.
    pub index: u32,
}

/// Collects the parts of a program; [`ProgramBuilder::build`] checks them.
#[derive(Debug, Default)]
pub struct ProgramBuilder {
    reactors: Vec<Reactor>,
    ports: Vec<Port>,
    actions: Vec<ActionKind>,
    reactions: Vec<Reaction>,
    connections: Vec<Connection>,
    inputs: Vec<NetworkInput>,
    outputs: Vec<PortId>,
    concurrent: bool,
    cones_by_level: bool,
}

/// An input that is fed by another federate.
#[derive(Clone, Copy, Debug)]
pub struct NetworkInput {
    /// The input port.
    pub port: PortId,
    /// The action that carries its messages.
    pub action: ActionId,
    /// Whether several messages may claim one tag (the connection has a delay): the n-th goes n microsteps later.
    pub delayed: bool,
    /// Whether its messages carry no tag: they are scheduled by physical time, and its status is never unknown.
    pub physical: bool,
}

impl ProgramBuilder {
    /// An empty program: it has only startup and shutdown.
    #[must_use]
    pub fn new() -> Self {
        Self {
            actions: vec![ActionKind::Startup, ActionKind::Shutdown],
            ..Self::default()
        }
    }

    /// Says that reactions may be in flight at the same time, which needs the table of ancestors.
    pub fn concurrent(&mut self) {
        self.concurrent = true;
    }

    /// Makes reactions wait for inputs by level instead of by cone: the wrong rule, for the simulator's proof that it
    /// notices.
    #[doc(hidden)]
    pub fn cones_by_level(&mut self) {
        self.cones_by_level = true;
    }

    /// Adds a reactor instance with its whole path (`planner.filter[2]`).
    pub fn reactor(&mut self, path: impl Into<String>) -> ReactorId {
        self.reactors.push(Reactor {
            path: path.into(),
            reactions: 0,
        });
        ReactorId::new(self.reactors.len() - 1)
    }

    /// Adds one channel of a port; `name` includes the channel (`out[2]`).
    pub fn port(&mut self, reactor: ReactorId, name: impl Into<String>, kind: PortKind) -> PortId {
        self.ports.push(Port {
            reactor,
            name: name.into(),
            kind,
        });
        PortId::new(self.ports.len() - 1)
    }

    /// The reactor that has a port, and the port's kind.
    #[must_use]
    pub fn owner(&self, port: PortId) -> (ReactorId, PortKind) {
        let port = &self.ports[port.index()];
        (port.reactor, port.kind)
    }

    /// Adds a timer or an action.
    pub fn action(&mut self, kind: ActionKind) -> ActionId {
        self.actions.push(kind);
        ActionId::new(self.actions.len() - 1)
    }

    /// Adds a reaction; within one reactor, the order of calls is the order of execution.
    pub fn reaction(&mut self, spec: ReactionSpec) -> NodeId {
        let count = &mut self.reactors[spec.reactor.index()].reactions;
        let index = *count;
        *count += 1;
        self.reactions.push(Reaction { spec, index });
        NodeId::new(self.reactions.len() - 1)
    }

    /// Connects two ports. A delayed connection gets an action, which is returned.
    pub fn connect(&mut self, from: PortId, to: PortId, delay: Delay) -> Option<ActionId> {
        let action = (delay != Delay::None).then(|| self.action(ActionKind::Connection { delay }));
        self.connections.push(Connection { from, to, action });
        action
    }

    /// Connects two ports of this program by a physical connection: a value's tag at `to` is the physical time at which
    /// it was set plus `min_delay`. No dependency without delay goes through it.
    ///
    /// [`Effects::physical`](crate::Effects::physical) lists what was set.
    pub fn connect_physical(&mut self, from: PortId, to: PortId, min_delay: Duration) -> ActionId {
        let action = self.action(ActionKind::PhysicalConnection { min_delay });
        self.connections.push(Connection {
            from,
            to,
            action: Some(action),
        });
        action
    }

    /// Declares that `port` is fed by another federate over a connection that is `delayed` or not.
    pub fn network_input(&mut self, port: PortId, delayed: bool) -> InputId {
        let input = InputId::new(self.inputs.len());
        let action = self.action(ActionKind::Network { input });
        self.inputs.push(NetworkInput {
            port,
            action,
            delayed,
            physical: false,
        });
        input
    }

    /// Declares that `port` is fed by another federate over a physical connection: a message's tag is the physical time
    /// of its arrival plus `min_delay`. It goes to [`Timeline::schedule_physical`](crate::Timeline::schedule_physical)
    /// with the input's action.
    pub fn network_input_physical(&mut self, port: PortId, min_delay: Duration) -> InputId {
        let input = InputId::new(self.inputs.len());
        let action = self.action(ActionKind::PhysicalConnection { min_delay });
        self.inputs.push(NetworkInput {
            port,
            action,
            delayed: false,
            physical: true,
        });
        input
    }

    /// Declares that `port` is sent to another federate.
    pub fn network_output(&mut self, port: PortId) -> OutputId {
        self.outputs.push(port);
        OutputId::new(self.outputs.len() - 1)
    }

    /// A port's path, for messages.
    #[must_use]
    pub fn port_path(&self, port: PortId) -> String {
        let port = &self.ports[port.index()];
        join_path(&self.reactors[port.reactor.index()].path, &port.name)
    }

    fn reaction_path(&self, node: NodeId) -> String {
        let spec = &self.reactions[node.index()].spec;
        join_path(&self.reactors[spec.reactor.index()].path, &spec.name)
    }

    /// What feeds each port without delay, or marks it as fed by the queue.
    fn feeds(&self) -> Result<Vec<Option<Feed>>, ProgramError> {
        let mut feeds: Vec<Option<Feed>> = vec![None; self.ports.len()];
        let delayed = self.connections.iter().map(|c| match c.action {
            Some(action) => (c.to, Feed::Queue(action), self.port_path(c.from)),
            None => (c.to, Feed::Port(c.from), self.port_path(c.from)),
        });
        let network = self
            .inputs
            .iter()
            .map(|i| (i.port, Feed::Queue(i.action), "another federate".to_owned()));
        for (to, feed, source) in delayed.chain(network) {
            if let Some(first) = feeds[to.index()] {
                let first = match first {
                    Feed::Port(port) => self.port_path(port),
                    Feed::Queue(action) => self.queue_source(action),
                };
                return Err(ProgramError::ManyWriters {
                    port: self.port_path(to),
                    first,
                    second: source,
                });
            }
            feeds[to.index()] = Some(feed);
        }
        Ok(feeds)
    }

    fn queue_source(&self, action: ActionId) -> String {
        let connection = self.connections.iter().find(|c| c.action == Some(action));
        connection.map_or_else(|| "another federate".to_owned(), |c| self.port_path(c.from))
    }

    /// The slot of every port: the root of its zero-delay chain.
    fn slots(&self, feeds: &[Option<Feed>]) -> Result<Vec<SlotId>, ProgramError> {
        let mut slots: Vec<Option<SlotId>> = vec![None; self.ports.len()];
        let mut next = 0;
        for start in 0..self.ports.len() {
            let mut chain = vec![PortId::new(start)];
            let slot = loop {
                let port = *chain.last().expect("the chain begins with one port");
                if let Some(slot) = slots[port.index()] {
                    break slot;
                }
                match feeds[port.index()] {
                    Some(Feed::Port(from)) if chain.contains(&from) => {
                        let ports = chain.iter().rev().map(|p| self.port_path(*p)).collect();
                        return Err(ProgramError::CausalityLoop { ports });
                    }
                    Some(Feed::Port(from)) => chain.push(from),
                    Some(Feed::Queue(_)) | None => {
                        next += 1;
                        break SlotId::new(next - 1);
                    }
                }
            };
            for port in chain {
                slots[port.index()] = Some(slot);
            }
        }
        Ok(slots
            .into_iter()
            .map(|s| s.expect("every port was visited"))
            .collect())
    }

    /// Checks the parts and makes the tables.
    ///
    /// # Errors
    ///
    /// The first [`ProgramError`] found.
    pub fn build(self) -> Result<Program, ProgramError> {
        let feeds = self.feeds()?;
        let slots = self.slots(&feeds)?;
        let slot_count = slots.iter().map(|s| s.index() + 1).max().unwrap_or(0);
        let mut tables = SlotTables::new(slot_count);
        self.fill_reactions(&feeds, &slots, &mut tables)?;
        let nodes = self.nodes(&slots, &mut tables);
        let graph = Graph::new(nodes.len(), &self.edges(&tables))
            .map_err(|cycle| self.explain_cycle(&cycle, &tables, &slots))?;
        let mut action_triggers = self.action_triggers(&tables, &slots, &feeds);
        for triggers in &mut action_triggers {
            triggers.sort_unstable();
            triggers.dedup();
        }
        let mut relations = (self.concurrent || !self.inputs.is_empty())
            .then(|| Relations::new(&graph, &self.inputs, &slots, &tables));
        if let Some(relations) = relations.as_mut().filter(|_| self.cones_by_level) {
            relations.widen_to_levels(&graph.levels, self.inputs.len());
        }
        let mut action_slots = vec![None; self.actions.len()];
        for (port, feed) in feeds.iter().enumerate() {
            if let Some(Feed::Queue(action)) = feed {
                action_slots[action.index()] = Some(slots[port]);
            }
        }
        Ok(Program {
            slot_triggers: tables.triggers,
            slot_readers: tables.readers,
            slot_writers: tables.writers,
            levels: graph.levels,
            successors: graph.successors,
            nodes,
            relations,
            action_triggers,
            action_slots,
            slots,
            reactors: self.reactors,
            ports: self.ports,
            actions: self.actions,
            reactions: self.reactions,
            inputs: self.inputs,
            outputs: self.outputs,
        })
    }

    fn fill_reactions(
        &self,
        feeds: &[Option<Feed>],
        slots: &[SlotId],
        tables: &mut SlotTables,
    ) -> Result<(), ProgramError> {
        for (index, reaction) in self.reactions.iter().enumerate() {
            let node = NodeId::new(index);
            for trigger in &reaction.spec.triggers {
                if let Trigger::Port(port) = trigger {
                    let slot = slots[port.index()].index();
                    push_once(&mut tables.triggers[slot], node);
                    push_once(&mut tables.readers[slot], node);
                }
            }
            for port in &reaction.spec.sources {
                push_once(&mut tables.readers[slots[port.index()].index()], node);
            }
            for port in &reaction.spec.effects {
                if feeds[port.index()].is_some() {
                    return Err(ProgramError::WritesConnected {
                        reaction: self.reaction_path(node),
                        port: self.port_path(*port),
                    });
                }
                let writers = &mut tables.writers[slots[port.index()].index()];
                let other = writers
                    .iter()
                    .find(|w| self.reactions[w.index()].spec.reactor != reaction.spec.reactor);
                if let Some(first) = other {
                    return Err(ProgramError::TwoOwners {
                        port: self.port_path(*port),
                        first: self.reaction_path(*first),
                        second: self.reaction_path(node),
                    });
                }
                push_once(writers, node);
            }
        }
        Ok(())
    }

    /// User reactions, then forwarders, then senders; the latter two become triggers of their slot.
    fn nodes(&self, slots: &[SlotId], tables: &mut SlotTables) -> Vec<NodeKind> {
        let mut nodes = vec![NodeKind::Reaction; self.reactions.len()];
        let forwards = self.connections.iter().filter_map(|c| {
            c.action
                .map(|action| (c.from, NodeKind::Forward { action }))
        });
        let sends = self.outputs.iter().enumerate().map(|(i, port)| {
            (
                *port,
                NodeKind::Send {
                    output: OutputId::new(i),
                },
            )
        });
        for (port, kind) in forwards.chain(sends) {
            let slot = slots[port.index()].index();
            let node = NodeId::new(nodes.len());
            tables.triggers[slot].push(node);
            tables.readers[slot].push(node);
            nodes.push(kind);
        }
        nodes
    }

    fn edges(&self, tables: &SlotTables) -> Vec<(NodeId, NodeId)> {
        let mut edges = Vec::new();
        let mut last_of: Vec<Option<NodeId>> = vec![None; self.reactors.len()];
        for (index, reaction) in self.reactions.iter().enumerate() {
            let node = NodeId::new(index);
            let last = &mut last_of[reaction.spec.reactor.index()];
            if let Some(previous) = last.replace(node) {
                edges.push((previous, node));
            }
        }
        for (writers, readers) in tables.writers.iter().zip(&tables.readers) {
            for writer in writers {
                edges.extend(readers.iter().map(|reader| (*writer, *reader)));
            }
        }
        edges
    }

    fn action_triggers(
        &self,
        tables: &SlotTables,
        slots: &[SlotId],
        feeds: &[Option<Feed>],
    ) -> Vec<Vec<NodeId>> {
        let mut triggers = vec![Vec::new(); self.actions.len()];
        for (index, reaction) in self.reactions.iter().enumerate() {
            for trigger in &reaction.spec.triggers {
                if let Trigger::Action(action) = trigger {
                    triggers[action.index()].push(NodeId::new(index));
                }
            }
        }
        for (port, feed) in feeds.iter().enumerate() {
            if let Some(Feed::Queue(action)) = feed {
                let slot = slots[port].index();
                triggers[action.index()].extend(tables.triggers[slot].iter().copied());
            }
        }
        triggers
    }

    /// Names the ports between consecutive reactions of a cycle.
    fn explain_cycle(
        &self,
        cycle: &[NodeId],
        tables: &SlotTables,
        slots: &[SlotId],
    ) -> ProgramError {
        let mut ports = Vec::new();
        for (i, node) in cycle.iter().enumerate() {
            let next = cycle[(i + 1) % cycle.len()];
            ports.push(self.reaction_path(*node));
            let between = (0..self.ports.len()).map(PortId::new).find(|port| {
                let slot = slots[port.index()].index();
                self.reactions[node.index()].spec.effects.contains(port)
                    && tables.readers[slot].contains(&next)
            });
            ports.extend(between.map(|port| self.port_path(port)));
        }
        ports.extend(cycle.first().map(|node| self.reaction_path(*node)));
        ProgramError::CausalityLoop { ports }
    }
}

/// What feeds a port.
#[derive(Clone, Copy)]
enum Feed {
    Port(PortId),
    Queue(ActionId),
}

struct SlotTables {
    triggers: Vec<Vec<NodeId>>,
    readers: Vec<Vec<NodeId>>,
    writers: Vec<Vec<NodeId>>,
}

impl SlotTables {
    fn new(slots: usize) -> Self {
        let empty = vec![Vec::new(); slots];
        Self {
            triggers: empty.clone(),
            readers: empty.clone(),
            writers: empty,
        }
    }
}

/// Who must be done, and which network inputs must be known, before a node may run.
#[derive(Debug)]
pub(crate) struct Relations {
    /// Per node: all nodes before it in the graph.
    pub(crate) ancestors: Vec<BitSet>,
    /// Per node: the network inputs of its upstream cone.
    pub(crate) cone: Vec<BitSet>,
}

impl Relations {
    fn new(graph: &Graph, inputs: &[NetworkInput], slots: &[SlotId], tables: &SlotTables) -> Self {
        let mut direct = vec![BitSet::new(inputs.len()); graph.levels.len()];
        let tagged = inputs.iter().enumerate().filter(|(_, i)| !i.physical);
        for (i, input) in tagged {
            for reader in &tables.readers[slots[input.port.index()].index()] {
                direct[reader.index()].insert(i);
            }
        }
        Self {
            ancestors: graph::ancestors(graph),
            cone: graph::closure(graph, direct),
        }
    }
}

impl Relations {
    /// Every node from the level of an input's first reader on waits for the input.
    fn widen_to_levels(&mut self, levels: &[u32], inputs: usize) {
        for input in 0..inputs {
            let reads = |node: &usize| self.cone[*node].contains(input);
            let first = (0..levels.len()).filter(reads).map(|n| levels[n]).min();
            for (node, level) in levels.iter().enumerate() {
                if first.is_some_and(|first| *level >= first) {
                    self.cone[node].insert(input);
                }
            }
        }
    }
}

/// A checked program: what may run when, without values or bodies.
#[derive(Debug)]
pub struct Program {
    pub(crate) nodes: Vec<NodeKind>,
    pub(crate) levels: Vec<u32>,
    pub(crate) successors: Vec<Vec<NodeId>>,
    pub(crate) relations: Option<Relations>,
    pub(crate) slot_triggers: Vec<Vec<NodeId>>,
    pub(crate) slot_readers: Vec<Vec<NodeId>>,
    pub(crate) slot_writers: Vec<Vec<NodeId>>,
    pub(crate) action_triggers: Vec<Vec<NodeId>>,
    pub(crate) action_slots: Vec<Option<SlotId>>,
    pub(crate) slots: Vec<SlotId>,
    pub(crate) reactors: Vec<Reactor>,
    pub(crate) ports: Vec<Port>,
    pub(crate) actions: Vec<ActionKind>,
    pub(crate) reactions: Vec<Reaction>,
    pub(crate) inputs: Vec<NetworkInput>,
    pub(crate) outputs: Vec<PortId>,
}

impl Program {
    /// What a node is.
    #[must_use]
    pub fn node(&self, node: NodeId) -> NodeKind {
        self.nodes[node.index()]
    }

    /// The number of nodes: reactions, forwarders and senders.
    #[must_use]
    pub fn node_count(&self) -> usize {
        self.nodes.len()
    }

    /// The user's reactions; their node ids are their indices.
    #[must_use]
    pub fn reactions(&self) -> &[Reaction] {
        &self.reactions
    }

    /// The path of a reactor.
    #[must_use]
    pub fn reactor_path(&self, reactor: ReactorId) -> &str {
        &self.reactors[reactor.index()].path
    }

    /// The paths of all reactors, by id.
    pub fn reactor_paths(&self) -> impl Iterator<Item = &str> {
        self.reactors.iter().map(|reactor| reactor.path.as_str())
    }

    /// The level of a node: the longest chain of nodes before it.
    #[must_use]
    pub fn level(&self, node: NodeId) -> u32 {
        self.levels[node.index()]
    }

    /// The kinds of all actions, by id.
    #[must_use]
    pub fn actions(&self) -> &[ActionKind] {
        &self.actions
    }

    /// The slot that an action fills when it fires; `None` for actions that reactions name themselves.
    #[must_use]
    pub fn action_slot(&self, action: ActionId) -> Option<SlotId> {
        self.action_slots[action.index()]
    }

    /// The slot of a port.
    #[must_use]
    pub fn slot(&self, port: PortId) -> SlotId {
        self.slots[port.index()]
    }

    /// The number of slots.
    #[must_use]
    pub fn slot_count(&self) -> usize {
        self.slot_triggers.len()
    }

    /// The name of a port within its reactor.
    #[must_use]
    pub fn port_name(&self, port: PortId) -> &str {
        &self.ports[port.index()].name
    }

    /// The whole path of a port.
    #[must_use]
    pub fn port_path(&self, port: PortId) -> String {
        let port = &self.ports[port.index()];
        join_path(&self.reactors[port.reactor.index()].path, &port.name)
    }

    /// Whether a port is an input or an output.
    #[must_use]
    pub fn port_kind(&self, port: PortId) -> PortKind {
        self.ports[port.index()].kind
    }

    /// The inputs fed by other federates.
    #[must_use]
    pub fn network_inputs(&self) -> &[NetworkInput] {
        &self.inputs
    }

    /// The ports sent to other federates.
    #[must_use]
    pub fn network_outputs(&self) -> &[PortId] {
        &self.outputs
    }

    /// Whether a physical action exists.
    #[must_use]
    pub fn has_physical_actions(&self) -> bool {
        self.actions
            .iter()
            .any(|a| matches!(a, ActionKind::Physical { .. }))
    }

    /// Whether `output` may be set, or must wait, at the very tag at which `input` is present: a path of zero delay
    /// exists, the order of reactions within a reactor included.
    #[must_use]
    pub fn depends_without_delay(&self, input: PortId, output: PortId) -> bool {
        if self.slot(input) == self.slot(output) {
            return true;
        }
        let writers = &self.slot_writers[self.slot(output).index()];
        let mut seen = vec![false; self.nodes.len()];
        let mut stack = self.slot_readers[self.slot(input).index()].clone();
        while let Some(node) = stack.pop() {
            if writers.contains(&node) {
                return true;
            }
            if !std::mem::replace(&mut seen[node.index()], true) {
                stack.extend(self.successors[node.index()].iter().copied());
            }
        }
        false
    }

    /// Whether a message on `input` makes a reaction run.
    #[must_use]
    pub fn triggers_reaction(&self, input: InputId) -> bool {
        let triggered = &self.action_triggers[self.inputs[input.index()].action.index()];
        let reaction = |node: &NodeId| self.nodes[node.index()] == NodeKind::Reaction;
        triggered.iter().any(reaction)
    }

    /// The least minimum delay over all physical actions and connections, or `None` when there is none: what comes from
    /// outside never gets a tag before physical time plus this.
    #[must_use]
    pub fn least_physical_delay(&self) -> Option<Duration> {
        let delays = self.actions.iter().filter_map(|action| match action {
            ActionKind::Physical { min_delay, .. }
            | ActionKind::PhysicalConnection { min_delay } => Some(*min_delay),
            ActionKind::Startup
            | ActionKind::Shutdown
            | ActionKind::Timer { .. }
            | ActionKind::Logical { .. }
            | ActionKind::Connection { .. }
            | ActionKind::Network { .. } => None,
        });
        delays.min()
    }
}

fn push_once(nodes: &mut Vec<NodeId>, node: NodeId) {
    if !nodes.contains(&node) {
        nodes.push(node);
    }
}

fn join_path(reactor: &str, name: &str) -> String {
    if reactor.is_empty() {
        name.to_owned()
    } else {
        format!("{reactor}.{name}")
    }
}
