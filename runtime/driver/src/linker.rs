//! Joins ports of one zero-delay chain to one slot, once the program is built.

use crate::slot::{Shared, Slot};
use crate::value::Value;
use ictus_core::{PortId, Program, ReactorId};
use std::any::Any;
use std::fmt;

/// The slots of a program, typed at first use.
pub struct Linker<'a> {
    pub(crate) program: &'a Program,
    /// The reactor whose reaction is being linked: names are relative to it.
    pub(crate) reactor: Option<ReactorId>,
    slots: Vec<Option<Box<dyn Any>>>,
    /// A port whose type is not that of its slot.
    pub(crate) mismatch: Option<PortId>,
}

impl<'a> Linker<'a> {
    pub(crate) fn new(program: &'a Program) -> Self {
        Self {
            program,
            reactor: None,
            slots: (0..program.slot_count()).map(|_| None).collect(),
            mismatch: None,
        }
    }

    /// The slot of a port; all ports joined to it without delay get the same one.
    pub(crate) fn slot<T: Value>(&mut self, port: PortId) -> Shared<Slot<T>> {
        let place = &mut self.slots[self.program.slot(port).index()];
        let slot = place.get_or_insert_with(|| Box::new(Shared::new(Slot::<T>::new())));
        if let Some(slot) = slot.downcast_ref::<Shared<Slot<T>>>() {
            return slot.clone();
        }
        self.mismatch.get_or_insert(port);
        Shared::new(Slot::new())
    }

    /// The port's path as seen from the reaction's reactor: `out[2]`, or `child.out` for a child's.
    pub(crate) fn name(&self, port: PortId) -> String {
        let path = self.program.port_path(port);
        let own = self.reactor.map(|r| self.program.reactor_path(r));
        let below = own.and_then(|own| path.strip_prefix(own)?.strip_prefix('.'));
        below.map_or_else(|| path.clone(), str::to_owned)
    }
}

impl fmt::Debug for Linker<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Linker").finish_non_exhaustive()
    }
}
