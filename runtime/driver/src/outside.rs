//! Events from outside the reactors: physical actions scheduled by any thread.

use crate::clock::Clock;
use ictus_core::{ActionId, PhysicalTime, ValueId};
use std::any::Any;
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use thiserror::Error;

/// The queue that senders of physical actions fill and the run loop drains.
pub struct Outside {
    clock: Arc<dyn Clock>,
    queue: Mutex<Queue>,
}

#[derive(Default)]
struct Queue {
    events: Vec<SentEvent>,
    closed: bool,
    wake: Option<Arc<dyn Fn() + Send + Sync>>,
}

pub(crate) struct SentEvent {
    pub(crate) action: ActionId,
    pub(crate) stamp: PhysicalTime,
    pub(crate) value: Box<dyn Any + Send>,
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

/// The program has ended; nothing will handle the event.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Error)]
#[error("the program has ended")]
pub struct SendError<T>(
    /// The value that was not scheduled.
    pub T,
);

impl Outside {
    pub(crate) fn new(clock: Arc<dyn Clock>) -> Self {
        Self {
            clock,
            queue: Mutex::default(),
        }
    }

    /// Sets what is called, from any thread, after an event was queued.
    pub fn on_event(&self, wake: Box<dyn Fn() + Send + Sync>) {
        self.lock().wake = Some(Arc::from(wake));
    }

    /// Refuses events from now on: senders get an error value. Queued events stay.
    pub fn close(&self) {
        self.lock().closed = true;
    }

    /// Whether an event is queued.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.lock().events.is_empty()
    }

    pub(crate) fn push<T: Send + 'static>(
        &self,
        action: ActionId,
        value: T,
    ) -> Result<(), SendError<T>> {
        let mut queue = self.lock();
        if queue.closed {
            return Err(SendError(value));
        }
        // Read under the lock: stamps are in the order of the queue.
        let stamp = self.clock.now();
        queue.events.push(SentEvent {
            action,
            stamp,
            value: Box::new(value),
        });
        let wake = queue.wake.clone();
        drop(queue);
        if let Some(wake) = wake {
            wake();
        }
        Ok(())
    }

    pub(crate) fn take(&self) -> Vec<SentEvent> {
        std::mem::take(&mut self.lock().events)
    }

    fn lock(&self) -> MutexGuard<'_, Queue> {
        // A sender that panicked left a whole queue behind: every change is one push or one store.
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl fmt::Debug for Outside {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Outside").finish_non_exhaustive()
    }
}
