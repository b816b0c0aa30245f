//! Ports as reactions see them.

use crate::access::{Declaration, Item, Outcome, Readable, Role, Writable};
use crate::linker::Linker;
use crate::slot::{Epoch, Held, Shared, Slot};
use crate::value::{Value, digest_of};
use ictus_core::{PortId, SlotId, Trigger};
use std::ops::{Deref, DerefMut};

/// An input: a value of type `T`, present or absent at each tag.
#[derive(Clone, Debug)]
pub struct Input<T> {
    port: PortId,
    slot: Shared<Slot<T>>,
    held: Option<Held<T>>,
}

impl<T> Input<T> {
    /// The value at the present tag, or `None` when the input is absent.
    #[inline]
    #[must_use]
    pub fn get(&self) -> Option<&T> {
        self.held.as_deref()
    }

    /// Whether there is a value at the present tag.
    #[inline]
    #[must_use]
    pub const fn is_present(&self) -> bool {
        self.held.is_some()
    }
}

impl<T: Value> Input<T> {
    pub(crate) fn new(port: PortId) -> Self {
        Self {
            port,
            slot: Shared::new(Slot::new()),
            held: None,
        }
    }

    pub(crate) const fn port(&self) -> PortId {
        self.port
    }

    /// The input itself, for `#[of(ins[2])]`: one channel of a multiport.
    #[must_use]
    pub fn as_input(&self) -> Self {
        Self::new(self.port)
    }

    /// A child's input as the container's reactions write it.
    #[must_use]
    pub fn as_output(&self) -> Output<T> {
        Output::new(self.port)
    }
}

impl<T: Value> Item for Input<T> {
    fn declare(&self, role: Role, declaration: &mut Declaration) {
        if role.triggers() {
            declaration.triggers.push(Trigger::Port(self.port));
        } else {
            declaration.sources.push(self.port);
        }
    }

    fn link(&mut self, linker: &mut Linker<'_>) {
        self.slot = linker.slot(self.port);
    }

    #[inline]
    fn bind(&mut self, _: Role, epoch: Epoch) {
        self.held = self.slot.read().held(epoch);
    }

    #[inline]
    fn release(&mut self, _: Role, _: &mut Outcome<'_>) {
        self.held = None;
    }
}

impl<T: Value> Readable for Input<T> {}

/// An output: reactions set it, at most one value a tag counts.
#[derive(Clone, Debug)]
pub struct Output<T> {
    port: PortId,
    slot: Shared<Slot<T>>,
    slot_id: SlotId,
    epoch: Epoch,
    set: bool,
    name: String,
}

impl<T> Output<T> {
    /// Sets the value at the present tag; a later `set` at the same tag replaces it.
    #[inline]
    pub fn set(&mut self, value: T) {
        self.slot.write().set(value, self.epoch);
        self.set = true;
    }
}

impl<T: Value> Output<T> {
    pub(crate) fn new(port: PortId) -> Self {
        Self {
            port,
            slot: Shared::new(Slot::new()),
            slot_id: SlotId::new(0),
            epoch: Epoch::default(),
            set: false,
            name: String::new(),
        }
    }

    pub(crate) const fn port(&self) -> PortId {
        self.port
    }

    /// A child's output as the container's reactions read it.
    #[must_use]
    pub fn as_input(&self) -> Input<T> {
        Input::new(self.port)
    }

    /// The output itself, for `#[of(outs[2])]`: one channel of a multiport.
    #[must_use]
    pub fn as_output(&self) -> Self {
        Self::new(self.port)
    }
}

impl<T: Value> Item for Output<T> {
    fn declare(&self, _: Role, declaration: &mut Declaration) {
        declaration.effects.push(self.port);
    }

    fn link(&mut self, linker: &mut Linker<'_>) {
        self.slot = linker.slot(self.port);
        self.slot_id = linker.program.slot(self.port);
        self.name = linker.name(self.port);
    }

    #[inline]
    fn bind(&mut self, _: Role, epoch: Epoch) {
        self.epoch = epoch;
    }

    #[inline]
    fn release(&mut self, _: Role, outcome: &mut Outcome<'_>) {
        if self.set {
            self.set = false;
            outcome.effects.set.push(self.slot_id);
            outcome.note(&self.name, || digest_of(self.slot.read().last()?));
        }
    }
}

impl<T: Value> Writable for Output<T> {}

/// The channels of a multiport; a slice of [`Input`] or [`Output`].
#[derive(Clone, Debug)]
pub struct Multi<P> {
    channels: Vec<P>,
}

impl<P> Multi<P> {
    pub(crate) const fn new(channels: Vec<P>) -> Self {
        Self { channels }
    }
}

impl<T> Multi<Input<T>> {
    /// The channels that have a value at the present tag, with their index.
    pub fn present(&self) -> impl Iterator<Item = (usize, &T)> {
        let channels = self.channels.iter().enumerate();
        channels.filter_map(|(i, input)| input.get().map(|value| (i, value)))
    }
}

impl<T: Value> Multi<Input<T>> {
    /// A child's inputs as the container's reactions write them.
    #[must_use]
    pub fn as_output(&self) -> Multi<Output<T>> {
        Multi::new(self.iter().map(Input::as_output).collect())
    }
}

impl<T: Value> Multi<Output<T>> {
    /// A child's outputs as the container's reactions read them.
    #[must_use]
    pub fn as_input(&self) -> Multi<Input<T>> {
        Multi::new(self.iter().map(Output::as_input).collect())
    }
}

impl<P> Deref for Multi<P> {
    type Target = [P];

    #[inline]
    fn deref(&self) -> &[P] {
        &self.channels
    }
}

impl<P> DerefMut for Multi<P> {
    #[inline]
    fn deref_mut(&mut self) -> &mut [P] {
        &mut self.channels
    }
}

impl<'a, P> IntoIterator for &'a Multi<P> {
    type Item = &'a P;
    type IntoIter = std::slice::Iter<'a, P>;

    fn into_iter(self) -> Self::IntoIter {
        self.channels.iter()
    }
}

impl<'a, P> IntoIterator for &'a mut Multi<P> {
    type Item = &'a mut P;
    type IntoIter = std::slice::IterMut<'a, P>;

    fn into_iter(self) -> Self::IntoIter {
        self.channels.iter_mut()
    }
}

impl<P: Item> Item for Multi<P> {
    fn declare(&self, role: Role, declaration: &mut Declaration) {
        for channel in self {
            channel.declare(role, declaration);
        }
    }

    fn link(&mut self, linker: &mut Linker<'_>) {
        for channel in self {
            channel.link(linker);
        }
    }

    #[inline]
    fn bind(&mut self, role: Role, epoch: Epoch) {
        for channel in self {
            channel.bind(role, epoch);
        }
    }

    #[inline]
    fn release(&mut self, role: Role, outcome: &mut Outcome<'_>) {
        for channel in self {
            channel.release(role, outcome);
        }
    }
}

impl<P: Readable> Readable for Multi<P> {}
impl<P: Writable> Writable for Multi<P> {}
