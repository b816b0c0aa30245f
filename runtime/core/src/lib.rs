//! The reactor model: tags, programs, event queue, timeline. Pure.

mod tag;
mod time;

pub use tag::{Delay, Tag};
pub use time::{Duration, DurationExt, LogicalTime, PhysicalTime};
