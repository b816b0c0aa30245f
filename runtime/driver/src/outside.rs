//! Events from outside the reactors: physical actions scheduled by any thread.

use ictus_core::{ActionId, PhysicalTime, ValueId};

/// The queue that senders of physical actions fill and the run loop drains.
#[derive(Debug, Default)]
pub struct Outside {}

impl Outside {
    /// Sets what is called, from any thread, after an event was queued.
    pub fn on_event(&self, wake: Box<dyn Fn() + Send + Sync>) {
        drop(wake);
    }

    /// Refuses events from now on: senders get an error value.
    pub fn close(&self) {}
}

/// A physical event, taken by the run loop to [`Timeline::schedule_physical`](ictus_core::Timeline::schedule_physical).
#[derive(Clone, Copy, Debug)]
pub struct OutsideEvent {
    /// The physical action.
    pub action: ActionId,
    /// The clock's reading when the event was sent.
    pub stamp: PhysicalTime,
    /// The value, held by the bodies.
    pub value: ValueId,
}
