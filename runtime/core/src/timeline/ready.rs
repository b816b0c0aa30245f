//! Triggered nodes, by level.

use crate::id::NodeId;
use crate::program::Program;

/// Triggered nodes by level.
#[derive(Debug)]
pub(super) struct ReadyLists {
    levels: Vec<Vec<NodeId>>,
    lowest: usize,
    count: usize,
    marked: Vec<bool>,
}

impl ReadyLists {
    pub(super) fn new(program: &Program) -> Self {
        let levels = program
            .levels
            .iter()
            .map(|l| *l as usize + 1)
            .max()
            .unwrap_or(0);
        Self {
            levels: vec![Vec::new(); levels],
            lowest: 0,
            count: 0,
            marked: vec![false; program.nodes.len()],
        }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.count == 0
    }

    pub(super) fn clear(&mut self) {
        self.levels.iter_mut().for_each(Vec::clear);
        self.marked.fill(false);
        self.count = 0;
    }

    /// Adds a node once; says whether it was not there yet.
    #[inline]
    pub(super) fn insert(&mut self, node: NodeId, level: u32) -> bool {
        if std::mem::replace(&mut self.marked[node.index()], true) {
            return false;
        }
        let level = level as usize;
        self.levels[level].push(node);
        self.lowest = if self.count == 0 {
            level
        } else {
            self.lowest.min(level)
        };
        self.count += 1;
        true
    }

    #[inline]
    pub(super) fn take_lowest(&mut self, batch: &mut Vec<NodeId>) {
        if self.count == 0 {
            return;
        }
        while self.levels[self.lowest].is_empty() {
            self.lowest += 1;
        }
        let list = &mut self.levels[self.lowest];
        self.count -= list.len();
        for node in list.iter() {
            self.marked[node.index()] = false;
        }
        if batch.is_empty() {
            std::mem::swap(batch, list);
        } else {
            batch.append(list);
        }
    }

    pub(super) fn take_if(&mut self, batch: &mut Vec<NodeId>, free: impl Fn(NodeId) -> bool) {
        let (marked, count) = (&mut self.marked, &mut self.count);
        for list in &mut self.levels[self.lowest..] {
            list.retain(|node| {
                let take = free(*node);
                if take {
                    marked[node.index()] = false;
                    *count -= 1;
                    batch.push(*node);
                }
                !take
            });
        }
    }
}
