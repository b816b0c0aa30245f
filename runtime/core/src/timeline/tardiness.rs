//! What is late: queued events and nodes with the tags at which they should have been handled.

use crate::id::{ActionId, NodeId, SlotId};
use crate::program::Program;
use crate::tag::Tag;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Tardy events that wait, and tardy nodes of the current tag. Both are empty as long as no message was late.
#[derive(Debug)]
pub(super) struct Tardiness {
    queued: BinaryHeap<Reverse<TardyEvent>>,
    /// Nodes that are ready or in flight.
    nodes: Vec<NodeId>,
    /// By node id: the intended tag of those in `nodes`; FOREVER for the others.
    intended: Vec<Tag>,
}

/// In order of the tags at which they are handled.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
struct TardyEvent {
    actual: Tag,
    action: ActionId,
    intended: Tag,
}

impl Tardiness {
    pub(super) fn new(nodes: usize) -> Self {
        Self {
            queued: BinaryHeap::new(),
            nodes: Vec::new(),
            intended: vec![Tag::FOREVER; nodes],
        }
    }

    #[inline]
    pub(super) fn any_queued(&self) -> bool {
        !self.queued.is_empty()
    }

    #[inline]
    pub(super) const fn any(&self) -> bool {
        !self.nodes.is_empty()
    }

    pub(super) fn of(&self, node: NodeId) -> Option<Tag> {
        let intended = self.intended[node.index()];
        (intended != Tag::FOREVER).then_some(intended)
    }

    pub(super) fn queue(&mut self, actual: Tag, action: ActionId, intended: Tag) {
        self.queued.push(Reverse(TardyEvent {
            actual,
            action,
            intended,
        }));
    }

    pub(super) fn drop_queued(&mut self) {
        self.queued.clear();
    }

    /// Marks what the tardy events due at `tag` trigger.
    #[cold]
    pub(super) fn fire(&mut self, tag: Tag, program: &Program) {
        while let Some(Reverse(event)) = self.queued.peek() {
            if event.actual > tag {
                return;
            }
            let (action, intended) = (event.action, event.intended);
            self.queued.pop();
            self.mark(&program.action_triggers[action.index()], intended);
        }
    }

    /// Marks what the tardy nodes of `batch`, which is done, triggered by setting `slots`.
    #[cold]
    pub(super) fn pass_on(&mut self, batch: &[NodeId], slots: &[SlotId], program: &Program) {
        let tardy = batch.iter().filter_map(|node| self.of(*node));
        let Some(intended) = tardy.min() else { return };
        for node in batch {
            self.intended[node.index()] = Tag::FOREVER;
        }
        let marked = &self.intended;
        self.nodes
            .retain(|node| marked[node.index()] != Tag::FOREVER);
        for slot in slots {
            self.mark(&program.slot_triggers[slot.index()], intended);
        }
    }

    pub(super) fn clear(&mut self) {
        for node in self.nodes.drain(..) {
            self.intended[node.index()] = Tag::FOREVER;
        }
    }

    fn mark(&mut self, nodes: &[NodeId], tag: Tag) {
        for node in nodes {
            let intended = &mut self.intended[node.index()];
            if *intended == Tag::FOREVER {
                self.nodes.push(*node);
            }
            *intended = tag.min(*intended);
        }
    }
}
