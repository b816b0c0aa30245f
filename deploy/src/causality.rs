//! Causality loops over the whole federation: ports that would need their own value at the same tag.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use crate::federation::Member;
use crate::problem::{Place, Report};
use crate::wiring::Wire;

/// Reports one loop for every group of ports that depend on each other without delay.
///
/// An edge leads from an output to an input over a connection without `after`, and from an input to an output
/// over a zero-delay dependency inside a federate. A cycle of connections that a federate breaks inside, because
/// no output of it depends on the input at the same tag, is legal.
pub(crate) fn check(members: &[Member<'_>], wires: &[Wire], report: &mut Report) {
    let graph = Graph::new(members, wires);
    let mut done: BTreeSet<usize> = BTreeSet::new();
    for wire in wires.iter().filter(|wire| wire.plan.after_ns.is_none()) {
        let (Some(&from), Some(&to)) = (graph.id(wire, true), graph.id(wire, false)) else {
            continue;
        };
        if done.contains(&from) {
            continue;
        }
        // The loop that this connection closes, if any: the shortest way back.
        let Some(back) = graph.path(to, from) else {
            continue;
        };
        let names: Vec<String> = back
            .iter()
            .chain(back.first())
            .map(|node| graph.name(*node, members))
            .collect();
        done.extend(&back);
        let message = format!("causality loop: `{}`", names.join("` -> `"));
        let fix = "give one connection of the loop an `after`; `after: 0 s` is one microstep";
        let place = Place::value(&["connections", &wire.entry.to_string(), "from"]);
        report.add("F018", place, message, fix);
    }
}

/// A port's channel: federate, name, channel.
type PortChannel = (u16, String, u32);

struct Graph {
    ids: BTreeMap<PortChannel, usize>,
    nodes: Vec<PortChannel>,
    edges: Vec<Vec<usize>>,
    /// Whether a multiport, so that a channel is worth naming.
    multiport: BTreeSet<(u16, String)>,
}

impl Graph {
    fn new(members: &[Member<'_>], wires: &[Wire]) -> Self {
        let mut graph = Self {
            ids: BTreeMap::new(),
            nodes: Vec::new(),
            edges: Vec::new(),
            multiport: BTreeSet::new(),
        };
        let mut inputs: BTreeMap<(u16, String), BTreeSet<usize>> = BTreeMap::new();
        let mut outputs: BTreeMap<(u16, String), BTreeSet<usize>> = BTreeMap::new();
        for wire in wires.iter().filter(|wire| wire.plan.after_ns.is_none()) {
            let (from, to) = (&wire.plan.from, &wire.plan.to);
            let source = graph.node((from.federate, from.port.clone(), from.channel));
            let target = graph.node((to.federate, to.port.clone(), to.channel));
            graph.edges[source].push(target);
            outputs
                .entry((from.federate, from.port.clone()))
                .or_default()
                .insert(source);
            inputs
                .entry((to.federate, to.port.clone()))
                .or_default()
                .insert(target);
        }
        for (federate, member) in (0_u16..).zip(members) {
            let Some(description) = &member.description else {
                continue;
            };
            for port in description.inputs.iter().chain(&description.outputs) {
                if port.width.is_some() {
                    graph.multiport.insert((federate, port.name.clone()));
                }
            }
            for (input, output) in &description.zero_delay {
                let from = inputs.get(&(federate, input.clone()));
                let to = outputs.get(&(federate, output.clone()));
                let (Some(from), Some(to)) = (from, to) else {
                    continue;
                };
                for node in from {
                    graph.edges[*node].extend(to);
                }
            }
        }
        graph
    }

    fn node(&mut self, port: PortChannel) -> usize {
        if let Some(id) = self.ids.get(&port) {
            return *id;
        }
        let id = self.nodes.len();
        self.nodes.push(port.clone());
        self.edges.push(Vec::new());
        self.ids.insert(port, id);
        id
    }

    fn id(&self, wire: &Wire, from: bool) -> Option<&usize> {
        let end = if from { &wire.plan.from } else { &wire.plan.to };
        self.ids.get(&(end.federate, end.port.clone(), end.channel))
    }

    /// The shortest path between two nodes, both included, rotated to start at `to`.
    fn path(&self, from: usize, to: usize) -> Option<Vec<usize>> {
        let mut before: BTreeMap<usize, usize> = BTreeMap::new();
        let mut queue = VecDeque::from([from]);
        while let Some(node) = queue.pop_front() {
            if node == to {
                let mut path = vec![node];
                let mut at = node;
                while at != from {
                    at = *before.get(&at)?;
                    path.push(at);
                }
                path.reverse();
                path.rotate_right(1);
                return Some(path);
            }
            for next in self.edges.get(node).into_iter().flatten() {
                if *next != from && !before.contains_key(next) {
                    before.insert(*next, node);
                    queue.push_back(*next);
                }
            }
        }
        None
    }

    fn name(&self, node: usize, members: &[Member<'_>]) -> String {
        let Some((federate, port, channel)) = self.nodes.get(node) else {
            return String::new();
        };
        let name = members
            .get(usize::from(*federate))
            .map_or("", |member| member.name);
        if self.multiport.contains(&(*federate, port.clone())) {
            format!("{name}.{port}[{channel}]")
        } else {
            format!("{name}.{port}")
        }
    }
}
