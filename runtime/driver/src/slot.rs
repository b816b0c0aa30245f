//! Where values live while a tag is executed, and where they wait before.
//!
//! Everything that two reactions share goes through [`Shared`]; a worker pool would replace it here and nowhere else.

use ictus_core::ValueId;
use std::cell::{Cell, Ref, RefCell, RefMut};
use std::fmt;
use std::rc::Rc;

/// What is shared among the bodies of one process.
pub(crate) struct Shared<T>(Rc<RefCell<T>>);

impl<T> Shared<T> {
    pub(crate) fn new(value: T) -> Self {
        Self(Rc::new(RefCell::new(value)))
    }

    #[inline]
    pub(crate) fn read(&self) -> Ref<'_, T> {
        self.0.borrow()
    }

    #[inline]
    pub(crate) fn write(&self) -> RefMut<'_, T> {
        self.0.borrow_mut()
    }
}

impl<T> Clone for Shared<T> {
    fn clone(&self) -> Self {
        Self(Rc::clone(&self.0))
    }
}

impl<T> fmt::Debug for Shared<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Shared")
    }
}

/// A number that grows by one at every tag; what carries the present one is present.
#[derive(Clone, Copy, PartialEq, Eq, Default, Debug)]
pub struct Epoch(u64);

impl Epoch {
    #[inline]
    pub(crate) fn advance(&mut self) {
        self.0 += 1;
    }
}

/// A value read by a reaction: shared, so that the slot may be borrowed for a moment only.
pub(crate) type Held<T> = Rc<T>;

/// The value of ports that are joined without delay, or of an action.
#[derive(Debug)]
pub(crate) struct Slot<T> {
    value: Option<Held<T>>,
    epoch: Epoch,
}

impl<T> Slot<T> {
    pub(crate) fn new() -> Self {
        Self {
            value: None,
            epoch: Epoch::default(),
        }
    }

    /// Sets the value. The memory of the former one is used again unless a reader still holds it.
    #[inline]
    pub(crate) fn set(&mut self, value: T, epoch: Epoch) {
        self.epoch = epoch;
        if let Some(held) = &mut self.value
            && let Some(place) = Rc::get_mut(held)
        {
            *place = value;
            return;
        }
        self.value = Some(Rc::new(value));
    }

    /// The value, when it was set at `epoch`.
    #[inline]
    pub(crate) fn held(&self, epoch: Epoch) -> Option<Held<T>> {
        if self.epoch == epoch {
            self.value.clone()
        } else {
            None
        }
    }

    /// The value last set, at whichever tag.
    #[inline]
    pub(crate) fn last(&self) -> Option<&T> {
        self.value.as_deref()
    }
}

/// Presence without a value: timers, startup, shutdown.
#[derive(Clone, Debug, Default)]
pub(crate) struct Signal(Rc<Cell<Epoch>>);

impl Signal {
    #[inline]
    pub(crate) fn raise(&self, epoch: Epoch) {
        self.0.set(epoch);
    }

    #[inline]
    pub(crate) fn is_up(&self, epoch: Epoch) -> bool {
        self.0.get() == epoch
    }
}

/// Values that wait for their events.
#[derive(Debug)]
pub(crate) struct Slab<T> {
    values: Vec<Option<T>>,
    free: Vec<usize>,
}

impl<T> Slab<T> {
    pub(crate) const fn new() -> Self {
        Self {
            values: Vec::new(),
            free: Vec::new(),
        }
    }

    #[inline]
    pub(crate) fn insert(&mut self, value: T) -> ValueId {
        if let Some(index) = self.free.pop() {
            self.values[index] = Some(value);
            return ValueId::new(index);
        }
        self.values.push(Some(value));
        ValueId::new(self.values.len() - 1)
    }

    #[inline]
    pub(crate) fn take(&mut self, id: ValueId) -> Option<T> {
        let value = self.values.get_mut(id.index())?.take();
        if value.is_some() {
            self.free.push(id.index());
        }
        value
    }

    pub(crate) fn get(&self, id: ValueId) -> Option<&T> {
        self.values.get(id.index())?.as_ref()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slot_is_present_at_the_tag_it_was_set_at() {
        let mut epoch = Epoch::default();
        let mut slot = Slot::new();
        epoch.advance();
        assert_eq!(slot.held(epoch), None);
        slot.set(7, epoch);
        assert_eq!(slot.held(epoch).as_deref(), Some(&7));
        epoch.advance();
        assert_eq!(slot.held(epoch), None);
    }

    #[test]
    fn a_reader_keeps_its_value_when_the_slot_is_set_again() {
        let mut epoch = Epoch::default();
        epoch.advance();
        let mut slot = Slot::new();
        slot.set(1, epoch);
        let held = slot.held(epoch);
        slot.set(2, epoch);
        assert_eq!(held.as_deref(), Some(&1));
        assert_eq!(slot.held(epoch).as_deref(), Some(&2));
    }

    #[test]
    fn a_slab_uses_places_again() {
        let mut slab = Slab::new();
        let first = slab.insert('a');
        let second = slab.insert('b');
        assert_eq!(slab.take(first), Some('a'));
        assert_eq!(slab.take(first), None);
        assert_eq!(slab.insert('c'), first);
        assert_eq!(slab.get(second), Some(&'b'));
    }
}
