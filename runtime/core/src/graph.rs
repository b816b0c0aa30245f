//! The causality graph: levels, cycles, ancestors.

use crate::id::NodeId;

/// A fixed-size set of small integers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BitSet {
    words: Vec<u64>,
}

impl BitSet {
    /// An empty set for the numbers below `size`.
    #[must_use]
    pub fn new(size: usize) -> Self {
        Self {
            words: vec![0; size.div_ceil(64)],
        }
    }

    /// Adds a number.
    pub fn insert(&mut self, index: usize) {
        self.words[index / 64] |= 1 << (index % 64);
    }

    /// Removes a number.
    pub fn remove(&mut self, index: usize) {
        self.words[index / 64] &= !(1 << (index % 64));
    }

    /// Whether the number is in the set.
    #[must_use]
    pub fn contains(&self, index: usize) -> bool {
        self.words[index / 64] & (1 << (index % 64)) != 0
    }

    /// Whether the sets share a number.
    #[must_use]
    pub fn intersects(&self, other: &Self) -> bool {
        self.words.iter().zip(&other.words).any(|(a, b)| a & b != 0)
    }

    /// Adds all of the other set.
    pub fn union_with(&mut self, other: &Self) {
        for (a, b) in self.words.iter_mut().zip(&other.words) {
            *a |= b;
        }
    }

    /// Removes all.
    pub fn clear(&mut self) {
        self.words.fill(0);
    }

    /// Whether nothing is in the set.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.words.iter().all(|w| *w == 0)
    }
}

/// Nodes with their successors, in topological order, with levels.
#[derive(Debug)]
pub(crate) struct Graph {
    pub(crate) successors: Vec<Vec<NodeId>>,
    pub(crate) levels: Vec<u32>,
    order: Vec<NodeId>,
}

impl Graph {
    /// Sorts the nodes; a cycle comes back as the nodes on it.
    pub(crate) fn new(nodes: usize, edges: &[(NodeId, NodeId)]) -> Result<Self, Vec<NodeId>> {
        let mut successors = vec![Vec::new(); nodes];
        for (from, to) in edges {
            successors[from.index()].push(*to);
        }
        let mut missing = vec![0_u32; nodes];
        for list in &mut successors {
            list.sort_unstable();
            list.dedup();
            for to in list.iter() {
                missing[to.index()] += 1;
            }
        }
        let mut order: Vec<NodeId> = (0..nodes)
            .map(NodeId::new)
            .filter(|n| missing[n.index()] == 0)
            .collect();
        let mut next = 0;
        while let Some(node) = order.get(next).copied() {
            next += 1;
            for to in &successors[node.index()] {
                missing[to.index()] -= 1;
                if missing[to.index()] == 0 {
                    order.push(*to);
                }
            }
        }
        if order.len() < nodes {
            return Err(find_cycle(&successors, &missing));
        }
        let levels = longest_paths(&successors, &order);
        Ok(Self {
            successors,
            levels,
            order,
        })
    }
}

fn longest_paths(successors: &[Vec<NodeId>], order: &[NodeId]) -> Vec<u32> {
    let mut levels = vec![0_u32; successors.len()];
    for node in order {
        let level = levels[node.index()] + 1;
        for to in &successors[node.index()] {
            levels[to.index()] = levels[to.index()].max(level);
        }
    }
    levels
}

/// Walks among the nodes that no order was found for until one repeats.
fn find_cycle(successors: &[Vec<NodeId>], missing: &[u32]) -> Vec<NodeId> {
    let stuck = |n: &NodeId| missing[n.index()] > 0;
    // Every stuck node has a stuck predecessor, so walking backwards must close a cycle.
    let mut predecessor: Vec<Option<NodeId>> = vec![None; successors.len()];
    for (from, list) in successors.iter().enumerate() {
        let from = NodeId::new(from);
        if stuck(&from) {
            for to in list {
                predecessor[to.index()] = Some(from);
            }
        }
    }
    let mut path: Vec<NodeId> = Vec::new();
    let mut node = (0..successors.len()).map(NodeId::new).find(stuck);
    while let Some(at) = node {
        if let Some(start) = path.iter().position(|n| *n == at) {
            path.drain(..start);
            path.reverse();
            return path;
        }
        path.push(at);
        node = predecessor[at.index()];
    }
    path
}

/// Per node: all nodes from which it can be reached.
pub(crate) fn ancestors(graph: &Graph) -> Vec<BitSet> {
    let nodes = graph.levels.len();
    let mut sets = vec![BitSet::new(nodes); nodes];
    for node in &graph.order {
        let mut with_self = sets[node.index()].clone();
        with_self.insert(node.index());
        for to in &graph.successors[node.index()] {
            sets[to.index()].union_with(&with_self);
        }
    }
    sets
}

/// Spreads per-node sets along the edges.
pub(crate) fn closure(graph: &Graph, mut sets: Vec<BitSet>) -> Vec<BitSet> {
    for node in &graph.order {
        let own = sets[node.index()].clone();
        for to in &graph.successors[node.index()] {
            sets[to.index()].union_with(&own);
        }
    }
    sets
}
