//! Timers and actions as reactions see them.

use crate::access::{Declaration, Item, Outcome, Readable, Role, Writable};
use crate::linker::Linker;
use crate::outside::{Outside, SendError};
use crate::slot::{Epoch, Held, Shared, Signal, Slab, Slot};
use crate::value::{Value, digest_of};
use ictus_core::{ActionId, Duration, Scheduled, Trigger};
use std::fmt;
use std::marker::PhantomData;
use std::sync::Arc;

macro_rules! signals {
    ($($(#[$doc:meta])* $name:ident;)*) => {$(
        $(#[$doc])*
        #[derive(Clone, Debug)]
        pub struct $name {
            action: ActionId,
            signal: Signal,
            present: bool,
        }

        impl $name {
            pub(crate) const fn new(action: ActionId, signal: Signal) -> Self {
                Self { action, signal, present: false }
            }

            /// Whether it fires at the present tag.
            #[inline]
            #[must_use]
            pub const fn is_present(&self) -> bool {
                self.present
            }
        }

        impl Item for $name {
            fn declare(&self, role: Role, declaration: &mut Declaration) {
                if role.triggers() {
                    declaration.triggers.push(Trigger::Action(self.action));
                }
            }

            fn link(&mut self, _: &mut Linker<'_>) {}

            #[inline]
            fn bind(&mut self, _: Role, epoch: Epoch) {
                self.present = self.signal.is_up(epoch);
            }

            #[inline]
            fn release(&mut self, _: Role, _: &mut Outcome<'_>) {}
        }

        impl Readable for $name {}
    )*};
}

signals! {
    /// A timer: fires at start + offset, then every period.
    Timer;
    /// Fires once, at the start tag.
    Startup;
    /// Fires once, at the stop tag.
    Shutdown;
}

/// The values of an action: those that wait and the present one.
#[derive(Debug)]
pub(crate) struct ActionValues<T> {
    pub(crate) waiting: Slab<T>,
    pub(crate) slot: Slot<T>,
}

impl<T> ActionValues<T> {
    pub(crate) fn new() -> Self {
        Self {
            waiting: Slab::new(),
            slot: Slot::new(),
        }
    }
}

/// An action that reactions schedule in logical time.
#[derive(Clone, Debug)]
pub struct LogicalAction<T> {
    action: ActionId,
    name: &'static str,
    values: Shared<ActionValues<T>>,
    held: Option<Held<T>>,
    scheduled: Vec<Scheduled>,
}

impl<T> LogicalAction<T> {
    /// The value at the present tag, or `None` when the action is absent.
    #[inline]
    #[must_use]
    pub fn get(&self) -> Option<&T> {
        self.held.as_deref()
    }

    /// Whether the action fires at the present tag.
    #[inline]
    #[must_use]
    pub const fn is_present(&self) -> bool {
        self.held.is_some()
    }

    /// Schedules the action `delay` plus its minimum delay after the present tag; a sum of zero is one microstep later.
    ///
    /// The n-th event for one tag is handled n-1 microsteps later. A negative delay counts as zero.
    #[inline]
    pub fn schedule(&mut self, delay: Duration, value: T) {
        let value = self.values.write().waiting.insert(value);
        self.scheduled.push(Scheduled {
            action: self.action,
            delay,
            value,
        });
    }
}

impl<T: Value> LogicalAction<T> {
    pub(crate) const fn new(
        action: ActionId,
        name: &'static str,
        values: Shared<ActionValues<T>>,
    ) -> Self {
        Self {
            action,
            name,
            values,
            held: None,
            scheduled: Vec::new(),
        }
    }
}

impl<T: Value> Item for LogicalAction<T> {
    fn declare(&self, role: Role, declaration: &mut Declaration) {
        if role.triggers() {
            declaration.triggers.push(Trigger::Action(self.action));
        }
    }

    fn link(&mut self, _: &mut Linker<'_>) {}

    #[inline]
    fn bind(&mut self, role: Role, epoch: Epoch) {
        if role.reads() {
            self.held = self.values.read().slot.held(epoch);
        }
    }

    #[inline]
    fn release(&mut self, _: Role, outcome: &mut Outcome<'_>) {
        self.held = None;
        if self.scheduled.is_empty() {
            return;
        }
        for event in &self.scheduled {
            outcome.effects.scheduled.push(*event);
            outcome.note(self.name, || {
                digest_of(self.values.read().waiting.get(event.value)?)
            });
        }
        self.scheduled.clear();
    }
}

impl<T: Value> Readable for LogicalAction<T> {}
impl<T: Value> Writable for LogicalAction<T> {}

/// An action that threads outside the reactors schedule; its tag comes from the physical clock.
#[derive(Clone, Debug)]
pub struct PhysicalAction<T> {
    action: ActionId,
    name: &'static str,
    values: Shared<ActionValues<T>>,
    outside: Arc<Outside>,
    held: Option<Held<T>>,
    scheduled: Vec<T>,
}

impl<T> PhysicalAction<T> {
    /// The value at the present tag, or `None` when the action is absent.
    #[inline]
    #[must_use]
    pub fn get(&self) -> Option<&T> {
        self.held.as_deref()
    }

    /// Whether the action fires at the present tag.
    #[inline]
    #[must_use]
    pub const fn is_present(&self) -> bool {
        self.held.is_some()
    }

    /// Schedules the action at the physical time at which the reaction, or the handler of a watchdog, ends, plus its minimum
    /// delay. Once the program has ended, nothing happens.
    pub fn schedule(&mut self, value: T) {
        self.scheduled.push(value);
    }
}

impl<T: Value> PhysicalAction<T> {
    pub(crate) const fn new(
        action: ActionId,
        name: &'static str,
        values: Shared<ActionValues<T>>,
        outside: Arc<Outside>,
    ) -> Self {
        Self {
            action,
            name,
            values,
            outside,
            held: None,
            scheduled: Vec::new(),
        }
    }

    /// A handle that schedules the action from any thread.
    #[must_use]
    pub fn sender(&self) -> PhysicalSender<T> {
        PhysicalSender {
            action: self.action,
            outside: Arc::clone(&self.outside),
            value: PhantomData,
        }
    }
}

impl<T: Value> Item for PhysicalAction<T> {
    fn declare(&self, role: Role, declaration: &mut Declaration) {
        if role.triggers() {
            declaration.triggers.push(Trigger::Action(self.action));
        }
    }

    fn link(&mut self, _: &mut Linker<'_>) {}

    #[inline]
    fn bind(&mut self, role: Role, epoch: Epoch) {
        if role.reads() {
            self.held = self.values.read().slot.held(epoch);
        }
    }

    #[inline]
    fn release(&mut self, _: Role, outcome: &mut Outcome<'_>) {
        self.held = None;
        for value in self.scheduled.drain(..) {
            outcome.note(self.name, || digest_of(&value));
            // The program has ended: nobody will miss the value.
            drop(self.outside.push(self.action, value));
        }
    }
}

impl<T: Value> Readable for PhysicalAction<T> {}
impl<T: Value> Writable for PhysicalAction<T> {}

/// Schedules a [`PhysicalAction`] from any thread.
pub struct PhysicalSender<T> {
    action: ActionId,
    outside: Arc<Outside>,
    value: PhantomData<fn(T)>,
}

impl<T: Value> PhysicalSender<T> {
    /// Schedules the action at the clock's present reading plus its minimum delay.
    ///
    /// # Errors
    ///
    /// When the program has ended: the value comes back.
    pub fn schedule(&self, value: T) -> Result<(), SendError<T>> {
        self.outside.push(self.action, value)
    }
}

impl<T> Clone for PhysicalSender<T> {
    fn clone(&self) -> Self {
        Self {
            action: self.action,
            outside: Arc::clone(&self.outside),
            value: PhantomData,
        }
    }
}

impl<T> fmt::Debug for PhysicalSender<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("PhysicalSender")
            .field("action", &self.action)
            .finish_non_exhaustive()
    }
}
