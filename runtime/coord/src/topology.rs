//! Who is connected to whom, and the least delay along every path.
//!
//! A path's delay is a tag: (0,0) for no delay, (0,m) for m microsteps, (d,m) for a time d and the m microsteps after
//! it; connections are added from the upstream end by [`Tag::plus_path`]. Only pairs that have a path are stored.
//!
//! Source: reactor-c `rti_common.c`, which keeps a dense matrix; section 6.2 of the wire document.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::fmt;

use ictus_core::{Delay, Duration, Tag};

use crate::plan::{ConnectionPlan, Plan};
use crate::wire::NeighborStructure;

/// A federate's id on the wire: its index in the plan.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct FederateId(u16);

impl FederateId {
    /// The id with this number.
    #[must_use]
    pub const fn new(id: u16) -> Self {
        Self(id)
    }

    /// The number on the wire.
    #[must_use]
    pub const fn get(self) -> u16 {
        self.0
    }

    /// The position in tables of federates.
    #[must_use]
    pub const fn index(self) -> usize {
        self.0 as usize
    }

    /// The id at a position in a table of federates.
    ///
    /// # Panics
    ///
    /// When `index` is over 65535: a federation has fewer federates.
    #[must_use]
    pub fn from_index(index: usize) -> Self {
        Self(u16::try_from(index).expect("a federation has under 65536 federates"))
    }
}

impl fmt::Display for FederateId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(&self.0, f)
    }
}

impl fmt::Debug for FederateId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "F{}", self.0)
    }
}

/// The connections between federates and the delays of all paths.
#[derive(Clone, Debug, Default)]
pub struct Topology {
    nodes: Vec<Node>,
}

#[derive(Clone, Debug, Default)]
struct Node {
    upstream: Vec<(FederateId, Delay)>,
    downstream: Vec<(FederateId, Delay)>,
    sources: Vec<(FederateId, Tag)>,
    sinks: Vec<(FederateId, Tag)>,
    cycle: Option<Tag>,
}

impl Topology {
    /// The topology of `federates` federates with these connections (from, to, delay); of parallel ones the least delay
    /// counts. Connections that name a federate out of range are left out. O(federates x connections).
    #[must_use]
    pub fn new(
        federates: usize,
        connections: impl IntoIterator<Item = (FederateId, FederateId, Delay)>,
    ) -> Self {
        let mut nodes = vec![Node::default(); federates];
        for (from, to, delay) in connections {
            if from.index() < federates && to.index() < federates {
                keep_least(&mut nodes[to.index()].upstream, from, delay);
                keep_least(&mut nodes[from.index()].downstream, to, delay);
            }
        }
        let mut topology = Self { nodes };
        for index in 0..federates {
            topology.add_paths_from(FederateId::from_index(index));
        }
        topology
    }

    /// The topology of a plan's connections between different federates.
    #[must_use]
    pub fn of_plan(plan: &Plan) -> Self {
        let remote = |c: &&ConnectionPlan| c.from.federate != c.to.federate && !c.physical;
        Self::new(
            plan.federates.len(),
            plan.connections.iter().filter(remote).map(|c| {
                (
                    FederateId::new(c.from.federate),
                    FederateId::new(c.to.federate),
                    connection_delay(c),
                )
            }),
        )
    }

    /// The topology that federates have told the RTI, in order of their ids: their *upstream* lists count.
    #[must_use]
    pub fn from_neighbors(neighbors: &[NeighborStructure]) -> Self {
        Self::new(
            neighbors.len(),
            neighbors.iter().enumerate().flat_map(|(index, neighbors)| {
                let to = FederateId::from_index(index);
                neighbors
                    .upstream
                    .iter()
                    .map(move |&(from, delay)| (FederateId(from), to, delay))
            }),
        )
    }

    /// The number of federates.
    #[must_use]
    pub fn len(&self) -> usize {
        self.nodes.len()
    }

    /// Whether there is no federate.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.nodes.is_empty()
    }

    /// All federates' ids, ascending.
    pub fn federates(&self) -> impl Iterator<Item = FederateId> + use<> {
        (0..self.nodes.len()).map(FederateId::from_index)
    }

    /// The immediate upstreams of `federate` with the least delay of the connections from each, ascending.
    #[must_use]
    pub fn upstream(&self, federate: FederateId) -> &[(FederateId, Delay)] {
        &self.nodes[federate.index()].upstream
    }

    /// The immediate downstreams of `federate` with the least delay of the connections to each, ascending.
    #[must_use]
    pub fn downstream(&self, federate: FederateId) -> &[(FederateId, Delay)] {
        &self.nodes[federate.index()].downstream
    }

    /// Every federate with a path to `federate` and the least delay of such a path, ascending; itself if in a cycle.
    #[must_use]
    pub fn sources(&self, federate: FederateId) -> &[(FederateId, Tag)] {
        &self.nodes[federate.index()].sources
    }

    /// Every federate that `federate` has a path to and the least delay of such a path, ascending; itself if in a cycle.
    #[must_use]
    pub fn sinks(&self, federate: FederateId) -> &[(FederateId, Tag)] {
        &self.nodes[federate.index()].sinks
    }

    /// The least delay of the paths of at least one connection between two federates.
    #[must_use]
    pub fn path(&self, from: FederateId, to: FederateId) -> Option<Tag> {
        let sinks = self.sinks(from);
        let at = sinks.binary_search_by_key(&to, |&(sink, _)| sink).ok()?;
        Some(sinks[at].1)
    }

    /// Whether `federate` can reach itself.
    #[must_use]
    pub fn in_cycle(&self, federate: FederateId) -> bool {
        self.nodes[federate.index()].cycle.is_some()
    }

    /// Whether `federate` can reach itself without delay.
    #[must_use]
    pub fn in_zero_delay_cycle(&self, federate: FederateId) -> bool {
        self.nodes[federate.index()].cycle == Some(Tag::ZERO)
    }

    /// Whether two federates reach each other without delay.
    #[must_use]
    pub fn share_zero_delay_cycle(&self, a: FederateId, b: FederateId) -> bool {
        self.in_zero_delay_cycle(a)
            && self.in_zero_delay_cycle(b)
            && self.path(a, b) == Some(Tag::ZERO)
            && self.path(b, a) == Some(Tag::ZERO)
    }

    /// What `federate` tells the RTI of its neighbours.
    #[must_use]
    pub fn neighbor_structure(&self, federate: FederateId) -> NeighborStructure {
        NeighborStructure {
            upstream: self
                .upstream(federate)
                .iter()
                .map(|&(id, delay)| (id.0, delay))
                .collect(),
            downstream: self
                .downstream(federate)
                .iter()
                .map(|&(id, _)| id.0)
                .collect(),
        }
    }

    /// Dijkstra's algorithm from `source`: extending a path is monotone and never shortens it.
    fn add_paths_from(&mut self, source: FederateId) {
        let mut least: Vec<Option<Tag>> = vec![None; self.nodes.len()];
        let mut heap: BinaryHeap<Reverse<(Tag, FederateId)>> = BinaryHeap::new();
        for &(next, delay) in &self.nodes[source.index()].downstream {
            heap.push(Reverse((Tag::of_delay(delay), next)));
        }
        while let Some(Reverse((path, federate))) = heap.pop() {
            let known = &mut least[federate.index()];
            if known.is_some() {
                continue;
            }
            *known = Some(path);
            for &(next, delay) in &self.nodes[federate.index()].downstream {
                if least[next.index()].is_none() {
                    heap.push(Reverse((path.delayed(delay), next)));
                }
            }
        }
        for (index, path) in least.into_iter().enumerate() {
            let Some(path) = path else { continue };
            let sink = FederateId::from_index(index);
            self.nodes[source.index()].sinks.push((sink, path));
            self.nodes[index].sources.push((source, path));
            if sink == source {
                self.nodes[index].cycle = Some(path);
            }
        }
    }
}

/// Returns the delay that a connection of a plan adds to its messages.
#[must_use]
pub fn connection_delay(connection: &ConnectionPlan) -> Delay {
    connection.after_ns.map_or(Delay::None, |nanos| {
        Delay::after(Duration::from_nanos(nanos))
    })
}

/// Returns the indices into [`Plan::connections`] of the inputs of `federate` that are unknown at a provisional tag:
/// those over a connection without delay from a member of the same zero-delay cycle.
#[must_use]
pub fn zero_delay_cycle_inputs(
    plan: &Plan,
    topology: &Topology,
    federate: FederateId,
) -> Vec<usize> {
    plan.connections
        .iter()
        .enumerate()
        .filter(|(_, connection)| {
            connection.to.federate == federate.get()
                && !connection.physical
                && connection_delay(connection) == Delay::None
                && topology.share_zero_delay_cycle(FederateId(connection.from.federate), federate)
        })
        .map(|(index, _)| index)
        .collect()
}

/// Inserts into a list sorted by federate, or lowers the delay that stands there.
fn keep_least(list: &mut Vec<(FederateId, Delay)>, federate: FederateId, delay: Delay) {
    match list.binary_search_by_key(&federate, |&(id, _)| id) {
        Ok(at) => list[at].1 = list[at].1.min(delay),
        Err(at) => list.insert(at, (federate, delay)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const NONE: Delay = Delay::None;
    const ZERO: Delay = Delay::Microstep;

    fn ms(ms: i64) -> Delay {
        Delay::Time(Duration::from_millis(ms))
    }

    fn id(id: u16) -> FederateId {
        FederateId(id)
    }

    fn topology(federates: usize, connections: &[(u16, u16, Delay)]) -> Topology {
        Topology::new(
            federates,
            connections
                .iter()
                .map(|&(a, b, delay)| (id(a), id(b), delay)),
        )
    }

    #[test]
    fn the_shortest_path_wins() {
        let t = topology(
            4,
            &[
                (0, 1, ms(5)),
                (1, 3, NONE),
                (0, 2, ZERO),
                (2, 3, ms(4)),
                (0, 3, ms(9)),
            ],
        );
        assert_eq!(t.path(id(0), id(3)), Some(Tag::at(4_000_000)));
        assert_eq!(t.path(id(3), id(0)), None);
        assert!(!t.in_cycle(id(0)));
        assert_eq!(t.sinks(id(0)).len(), 3);
        assert_eq!(t.sources(id(3)).len(), 3);
    }

    #[test]
    fn a_microstep_after_a_time_counts_and_before_it_does_not() {
        let t = topology(3, &[(0, 1, ms(5)), (1, 2, ZERO)]);
        assert_eq!(t.path(id(0), id(2)), Some(Tag::at(5_000_000).delayed(ZERO)));
        let t = topology(3, &[(0, 1, ZERO), (1, 2, ms(5))]);
        assert_eq!(t.path(id(0), id(2)), Some(Tag::at(5_000_000)));
    }

    #[test]
    fn cycles_with_and_without_delay() {
        let t = topology(
            4,
            &[
                (0, 1, NONE),
                (1, 0, NONE),
                (1, 2, NONE),
                (2, 3, NONE),
                (3, 2, ZERO),
            ],
        );
        assert!(t.in_zero_delay_cycle(id(0)) && t.in_zero_delay_cycle(id(1)));
        assert!(t.in_cycle(id(2)) && !t.in_zero_delay_cycle(id(2)));
        assert!(t.share_zero_delay_cycle(id(0), id(1)));
        assert!(!t.share_zero_delay_cycle(id(1), id(2)));
    }

    #[test]
    fn two_zero_delay_cycles_stay_apart() {
        let t = topology(
            4,
            &[
                (0, 1, NONE),
                (1, 0, NONE),
                (1, 2, NONE),
                (2, 3, NONE),
                (3, 2, NONE),
            ],
        );
        assert!(t.in_zero_delay_cycle(id(2)));
        assert!(!t.share_zero_delay_cycle(id(1), id(2)));
    }

    #[test]
    fn neighbours_round_trip() {
        let t = topology(
            3,
            &[(0, 1, NONE), (0, 1, ms(3)), (1, 2, ZERO), (7, 1, NONE)],
        );
        let told: Vec<_> = t.federates().map(|f| t.neighbor_structure(f)).collect();
        assert_eq!(told[1].upstream, [(0, NONE)]);
        let again = Topology::from_neighbors(&told);
        assert_eq!(again.path(id(0), id(2)), t.path(id(0), id(2)));
    }

    fn delay() -> impl Strategy<Value = Delay> {
        (-1i64..4).prop_map(|nanos| Delay::after(Duration::from_nanos(nanos)))
    }

    /// The least delay over all paths of at most `left` connections, by trying them all.
    fn brute(
        edges: &[(u16, u16, Delay)],
        at: u16,
        to: u16,
        so_far: Tag,
        left: usize,
    ) -> Option<Tag> {
        if left == 0 {
            return None;
        }
        edges
            .iter()
            .filter(|edge| edge.0 == at)
            .flat_map(|&(_, next, delay)| {
                let here = so_far.delayed(delay);
                let arrived = (next == to).then_some(here);
                [arrived, brute(edges, next, to, here, left - 1)]
            })
            .flatten()
            .min()
    }

    proptest! {
        #[test]
        fn paths_are_the_least_of_all(
            edges in proptest::collection::vec((0u16..4, 0u16..4, delay()), 0..7),
        ) {
            let t = topology(4, &edges);
            for a in 0..4 {
                for b in 0..4 {
                    prop_assert_eq!(t.path(id(a), id(b)), brute(&edges, a, b, Tag::ZERO, 5));
                }
            }
        }
    }
}
