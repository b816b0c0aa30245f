//! Causality loops over the whole federation: ports that would need their own value at the same tag.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use crate::federation::Member;
use crate::problem::{Place, Report};
use crate::wiring::Wire;

/// Reports one loop for every group of ports that depend on each other without delay.
///
/// An edge leads from an output to an input over a connection without `after`, and from an input to an output
/// over a zero-delay dependency inside a federate. A physical connection makes no edge: its tag is a later one. A cycle of connections that a federate breaks inside, because
/// no output of it depends on the input at the same tag, is legal.
pub(crate) fn check(members: &[Member<'_>], wires: &[Wire], report: &mut Report) {
    let graph = Graph::new(members, wires);
    let mut done: BTreeSet<usize> = graph.orderly();
    for wire in wires.iter().filter(immediate) {
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

/// Whether a connection keeps the tag.
fn immediate(wire: &&Wire) -> bool {
    wire.plan.after_ns.is_none() && !wire.plan.physical
}

/// A port's channel: federate, name, channel.
type PortChannel = (u16, String, u32);

#[derive(Debug)]
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
        for wire in wires.iter().filter(immediate) {
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

    /// The nodes that no loop leads to: those that a topological order can begin with.
    fn orderly(&self) -> BTreeSet<usize> {
        let mut waiting = vec![0_usize; self.nodes.len()];
        for next in self.edges.iter().flatten() {
            waiting[*next] += 1;
        }
        let mut ready: Vec<usize> = (0..waiting.len())
            .filter(|node| waiting[*node] == 0)
            .collect();
        let mut orderly = BTreeSet::new();
        while let Some(node) = ready.pop() {
            orderly.insert(node);
            for next in &self.edges[node] {
                waiting[*next] -= 1;
                if waiting[*next] == 0 {
                    ready.push(*next);
                }
            }
        }
        orderly
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

#[cfg(test)]
mod tests {
    use std::path::Path;

    use ictus_coord::describe::{ClassDescription, PortDescription, TypeIdentity};
    use ictus_coord::plan::{ConnectionPlan, Endpoint};
    use proptest::prelude::*;

    use super::*;
    use crate::federation::Origin;
    use crate::manifest::Federate;

    fn port(name: &str) -> PortDescription {
        PortDescription {
            name: name.to_owned(),
            width: None,
            type_identity: TypeIdentity {
                name: "f64".to_owned(),
                fingerprint: String::new(),
            },
            serializers: vec!["native".to_owned()],
        }
    }

    fn wire((from, to, after_ns, physical): Edge, entry: usize) -> Wire {
        let end = |federate: usize, port: &str| Endpoint {
            federate: u16::try_from(federate).unwrap(),
            port: port.to_owned(),
            channel: 0,
        };
        let (from, to) = (end(from, "out"), end(to, "input"));
        let serializer = "native".to_owned();
        Wire {
            entry,
            plan: ConnectionPlan {
                from,
                to,
                after_ns,
                serializer,
                port_id: 0,
                physical,
                ..ConnectionPlan::default()
            },
        }
    }

    /// Sender, receiver, `after`, whether physical.
    type Edge = (usize, usize, Option<i64>, bool);

    /// Whether any federate can reach itself without delay: over connections without `after`, through
    /// federates that pass an input on at the same tag.
    fn brute_force(passes: &[bool], edges: &[(usize, usize)]) -> bool {
        let count = passes.len();
        let mut reach = vec![vec![false; count]; count];
        for &(from, to) in edges.iter().filter(|(_, to)| passes[*to]) {
            reach[from][to] = true;
        }
        for via in 0..count {
            for from in 0..count {
                for to in 0..count {
                    reach[from][to] |= reach[from][via] && reach[via][to];
                }
            }
        }
        (0..count).any(|node| reach[node][node])
    }

    proptest! {
        /// A loop is reported exactly when some port depends on itself at the same tag.
        #[test]
        fn loops_are_found_and_only_they(
            passes in prop::collection::vec(any::<bool>(), 1..6),
            pairs in prop::collection::vec(
                (0_usize..6, 0_usize..6, prop::option::of(0_i64..2), prop::bool::weighted(0.2)),
                0..10,
            ),
        ) {
            let count = passes.len();
            let names: Vec<String> = (0..count).map(|index| format!("f{index}")).collect();
            let federate = Federate::default();
            let members: Vec<Member<'_>> = names
                .iter()
                .zip(&passes)
                .map(|(name, passes)| Member {
                    name,
                    federate: &federate,
                    origin: Origin::Ours { program: None, class: None },
                    description: Some(ClassDescription {
                        inputs: vec![port("input")],
                        outputs: vec![port("out")],
                        zero_delay: passes
                            .then(|| ("input".to_owned(), "out".to_owned()))
                            .into_iter()
                            .collect(),
                        ..ClassDescription::default()
                    }),
                })
                .collect();
            let pairs: Vec<Edge> = pairs
                .into_iter()
                .map(|(from, to, after, physical)| (from % count, to % count, after, physical))
                .collect();
            let wires: Vec<Wire> = pairs
                .iter()
                .enumerate()
                .map(|(entry, edge)| wire(*edge, entry))
                .collect();
            let immediate: Vec<(usize, usize)> = pairs
                .iter()
                .filter(|(_, _, after, physical)| after.is_none() && !physical)
                .map(|(from, to, _, _)| (*from, *to))
                .collect();
            let mut report = Report::new(Path::new("x.yaml"), "");
            check(&members, &wires, &mut report);
            let (problems, _) = report.finish();
            prop_assert_eq!(!problems.0.is_empty(), brute_force(&passes, &immediate), "{}", problems);
        }
    }
}
