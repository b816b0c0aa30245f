//! The reactor model: tags, programs, event queue, timeline. Pure.
//!
//! A [`Program`] says what exists and what depends on what; a [`Timeline`] decides what may run at which tag; an
//! [`Executor`] runs it. No clock, thread or socket is known here: time comes in as an argument, and values are
//! handles ([`ValueId`]) that the executor resolves.

mod executor;
mod graph;
mod id;
mod program;
mod queue;
mod tag;
mod time;
mod timeline;

pub use executor::Executor;
pub use graph::BitSet;
pub use id::{ActionId, InputId, NodeId, OutputId, PortId, ReactorId, SlotId, ValueId};
pub use program::{
    ActionKind, NetworkInput, NodeKind, PortKind, Program, ProgramBuilder, ProgramError, Reaction,
    ReactionSpec, Spacing, SpacingPolicy, Trigger,
};
pub use tag::{Delay, Tag};
pub use time::{Duration, DurationExt, LogicalTime, ParseDurationError, PhysicalTime};
pub use timeline::{Admission, Effects, Progress, Scheduled, Timeline};
