//! What a reaction knows of its surroundings.

use crate::clock::Clock;
use ictus_core::{Duration, PhysicalTime, Program, ReactorId, Tag};
use std::fmt;
use std::io::Write;
use std::sync::Arc;

/// The context of a running reaction: its tag, its clock, its place.
#[derive(Debug)]
pub struct Ctx {
    pub(crate) tag: Tag,
    pub(crate) start: Tag,
    pub(crate) reactor: ReactorId,
    pub(crate) stop: bool,
    /// The tag at which the running reaction should have run, when a tardy message led to it.
    pub(crate) intended: Option<Tag>,
    pub(crate) clock: Arc<dyn Clock>,
    pub(crate) program: Arc<Program>,
}

impl Ctx {
    /// The present tag.
    #[inline]
    #[must_use]
    pub const fn tag(&self) -> Tag {
        self.tag
    }

    /// The tag at which this reaction should have run: the least tag over the tardy messages that led to it; the present tag
    /// when none was tardy.
    ///
    /// Only under decentralized coordination can a message be tardy: it came after the tag had been handled without it.
    #[must_use]
    pub fn intended(&self) -> Tag {
        self.intended.unwrap_or(self.tag)
    }

    /// Logical time since the start tag.
    #[inline]
    #[must_use]
    pub const fn elapsed(&self) -> Duration {
        self.tag.time.since(self.start.time)
    }

    /// The physical clock's reading, now.
    #[must_use]
    pub fn physical_time(&self) -> PhysicalTime {
        self.clock.now()
    }

    /// How far physical time is ahead of the tag, now; negative only where tags run ahead (`fast`).
    #[must_use]
    pub fn lag(&self) -> Duration {
        self.clock.now().since(self.tag.time.as_physical())
    }

    /// Asks the whole federation to stop at the earliest tag that all can reach; shutdown reactions run there.
    pub const fn request_stop(&mut self) {
        self.stop = true;
    }

    /// The reactor's path, such as `planner.filter[2]`.
    #[must_use]
    pub fn path(&self) -> &str {
        self.program.reactor_path(self.reactor)
    }

    /// Writes a line to standard error: time since start, microstep if not 0, reactor path, message.
    ///
    /// [`log!`](crate::log) is shorter. A line that cannot be written is lost.
    pub fn log(&self, message: fmt::Arguments<'_>) {
        let line = self.line(message);
        drop(std::io::stderr().lock().write_all(line.as_bytes()));
    }

    fn line(&self, message: fmt::Arguments<'_>) -> String {
        let (elapsed, path) = (self.elapsed(), self.path());
        match self.tag.microstep {
            0 => format!("[{elapsed}] {path}: {message}\n"),
            microstep => format!("[{elapsed} +{microstep}] {path}: {message}\n"),
        }
    }
}

/// Writes a line to standard error with the tag and the reactor's path: `log!(ctx, "count is {}", self.count)`.
#[macro_export]
macro_rules! log {
    ($ctx:expr, $($message:tt)+) => {
        $ctx.log(::core::format_args!($($message)+))
    };
}
