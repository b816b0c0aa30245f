//! What a reaction may touch: items with roles, bound for the time of one run.

use crate::linker::Linker;
use crate::slot::Epoch;
use ictus_core::{Effects, PortId, Trigger};
use std::fmt::Write;

/// How a reaction uses an item of its signature.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Role {
    /// Its presence runs the reaction; the reaction reads it.
    Trigger,
    /// The reaction reads it when it runs for another reason.
    Uses,
    /// The reaction sets or schedules it.
    Effect,
    /// Its presence runs the reaction, which may schedule it again.
    TriggerAndEffect,
}

impl Role {
    pub(crate) fn triggers(self) -> bool {
        matches!(self, Self::Trigger | Self::TriggerAndEffect)
    }

    pub(crate) fn reads(self) -> bool {
        !matches!(self, Self::Effect)
    }
}

/// The triggers, sources and effects of one reaction.
#[derive(Debug, Default)]
pub struct Declaration {
    pub(crate) triggers: Vec<Trigger>,
    pub(crate) sources: Vec<PortId>,
    pub(crate) effects: Vec<PortId>,
}

/// What a run of a reaction did, for the timeline and for the trace.
#[derive(Debug)]
pub struct Outcome<'a> {
    pub(crate) effects: &'a mut Effects,
    pub(crate) trace: Option<&'a mut String>,
}

impl Outcome<'_> {
    /// Adds `name=digest` to the trace, when there is one.
    #[inline]
    pub(crate) fn note(&mut self, name: &str, digest: impl FnOnce() -> Option<u64>) {
        if let Some(trace) = &mut self.trace {
            Self::write(trace, name, digest());
        }
    }

    #[cold]
    fn write(trace: &mut String, name: &str, digest: Option<u64>) {
        if !trace.is_empty() {
            trace.push(',');
        }
        let _ = match digest {
            Some(digest) => write!(trace, "{name}={digest:016x}"),
            None => write!(trace, "{name}=?"),
        };
    }
}

/// A port, timer or action as one reaction sees it.
///
/// `bind` makes present values readable, `release` reports what was set and scheduled.
pub trait Item: Clone + 'static {
    /// Adds the item to the reaction's declaration.
    fn declare(&self, role: Role, declaration: &mut Declaration);

    /// Finds the item's slot in the finished program.
    fn link(&mut self, linker: &mut Linker<'_>);

    /// Before the body: fetches what is present.
    fn bind(&mut self, role: Role, epoch: Epoch);

    /// After the body: gives up what was fetched, reports what was done.
    fn release(&mut self, role: Role, outcome: &mut Outcome<'_>);
}

/// Items that a reaction can be triggered by or read.
#[diagnostic::on_unimplemented(
    message = "a reaction cannot read or be triggered by `{Self}`",
    label = "only inputs, timers and actions can be read",
    note = "an output is taken as `&mut Output<..>`"
)]
pub trait Readable: Item {}

/// Items that a reaction can set, schedule or start.
#[diagnostic::on_unimplemented(
    message = "a reaction cannot set or schedule `{Self}`",
    label = "only outputs, actions and watchdogs are taken by `&mut`",
    note = "an input is taken as `&Input<..>`, a timer as `&Timer`"
)]
pub trait Writable: Item {}

/// An item with the role that one reaction gives it.
#[derive(Clone, Debug)]
pub struct Access<I> {
    role: Role,
    item: I,
}

impl<I> Access<I> {
    /// The item, for reading.
    #[inline]
    pub fn item(&self) -> &I {
        &self.item
    }

    /// The item, for setting and scheduling.
    #[inline]
    pub fn item_mut(&mut self) -> &mut I {
        &mut self.item
    }
}

/// The item triggers the reaction.
pub fn trigger<I: Readable>(item: &I) -> Access<I> {
    Access {
        role: Role::Trigger,
        item: item.clone(),
    }
}

/// The reaction reads the item without being triggered by it.
pub fn uses<I: Readable>(item: &I) -> Access<I> {
    Access {
        role: Role::Uses,
        item: item.clone(),
    }
}

/// The reaction sets or schedules the item.
pub fn effect<I: Writable>(item: &I) -> Access<I> {
    Access {
        role: Role::Effect,
        item: item.clone(),
    }
}

/// The item triggers the reaction, which may schedule it again.
pub fn trigger_and_effect<I: Readable + Writable>(item: &I) -> Access<I> {
    Access {
        role: Role::TriggerAndEffect,
        item: item.clone(),
    }
}

/// The items of a reaction: `()`, or a pair of an [`Access`] and the rest.
pub trait Args: 'static {
    /// See [`Item::declare`].
    fn declare(&self, declaration: &mut Declaration);
    /// See [`Item::link`].
    fn link(&mut self, linker: &mut Linker<'_>);
    /// See [`Item::bind`].
    fn bind(&mut self, epoch: Epoch);
    /// See [`Item::release`].
    fn release(&mut self, outcome: &mut Outcome<'_>);
}

impl Args for () {
    fn declare(&self, _: &mut Declaration) {}
    fn link(&mut self, _: &mut Linker<'_>) {}
    #[inline]
    fn bind(&mut self, _: Epoch) {}
    #[inline]
    fn release(&mut self, _: &mut Outcome<'_>) {}
}

impl<I: Item, R: Args> Args for (Access<I>, R) {
    fn declare(&self, declaration: &mut Declaration) {
        self.0.item.declare(self.0.role, declaration);
        self.1.declare(declaration);
    }

    fn link(&mut self, linker: &mut Linker<'_>) {
        self.0.item.link(linker);
        self.1.link(linker);
    }

    #[inline]
    fn bind(&mut self, epoch: Epoch) {
        self.0.item.bind(self.0.role, epoch);
        self.1.bind(epoch);
    }

    #[inline]
    fn release(&mut self, outcome: &mut Outcome<'_>) {
        self.0.item.release(self.0.role, outcome);
        self.1.release(outcome);
    }
}
