//! What runs nodes: the border between deciding and executing.

use crate::id::{ActionId, NodeId, SlotId, ValueId};
use crate::tag::Tag;
use crate::timeline::Effects;

/// Holds values and bodies; runs nodes when the [`Timeline`](crate::Timeline) says so.
///
/// Real programs, the simulator and tests implement it. It never decides what runs.
pub trait Executor {
    /// Begins a tag: nothing is present any more.
    fn begin(&mut self, tag: Tag);

    /// Makes an action, or the slot it fills, present with a value scheduled earlier.
    fn arrive(&mut self, action: ActionId, slot: Option<SlotId>, value: ValueId);

    /// Lets go of a value scheduled earlier: the policy of the action's spacing dropped or replaced it.
    fn release(&mut self, action: ActionId, value: ValueId) {
        let _ = (action, value);
    }

    /// Runs one node and adds what it did to `effects`.
    ///
    /// For a user reaction: its body or deadline handler. For a forwarder: copies the slot's value to the
    /// connection's queue and adds it with [`Effects::forward`]. For a sender: hands the slot's value to the transport.
    fn run(&mut self, node: NodeId, tag: Tag, effects: &mut Effects);

    /// Runs one node that should have run at `intended`, before `tag`: a reaction's STP handler, when it has one.
    fn run_tardy(&mut self, node: NodeId, tag: Tag, intended: Tag, effects: &mut Effects) {
        let _ = intended;
        self.run(node, tag, effects);
    }
}
