//! Watchdogs: handlers at a physical time, although no tag advances.

use crate::access::{Declaration, Item, Outcome, Role, Writable};
use crate::linker::Linker;
use crate::scope::{Body, WiringError};
use crate::slot::Epoch;
use ictus_core::{Duration, LogicalTime, PhysicalTime, ReactorId};
use std::cell::{Cell, RefCell};
use std::fmt;
use std::rc::Rc;

/// A timer on the physical clock that reactions start and stop. When it expires, its handler (`#[watchdog(name)]`) runs once,
/// between reactions, also while the federate waits for a tag.
#[derive(Clone)]
pub struct Watchdog {
    index: usize,
    board: Rc<Board>,
}

impl Watchdog {
    /// Starts it, or starts it again: it expires when the physical clock reads the present tag's time plus its timeout plus
    /// `extra`. A negative `extra` counts as zero.
    pub fn start(&mut self, extra: Duration) {
        self.board.start(self.index, extra.max(Duration::ZERO));
    }

    /// Stops it; nothing happens when it does not run.
    pub fn stop(&mut self) {
        self.board.set(self.index, PhysicalTime::FOREVER);
    }
}

impl Item for Watchdog {
    fn declare(&self, _: Role, _: &mut Declaration) {}

    fn link(&mut self, _: &mut Linker<'_>) {}

    #[inline]
    fn bind(&mut self, _: Role, _: Epoch) {}

    #[inline]
    fn release(&mut self, _: Role, _: &mut Outcome<'_>) {}
}

impl Writable for Watchdog {}

impl fmt::Debug for Watchdog {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Watchdog")
            .field("expires", &self.board.expires.borrow()[self.index])
            .finish_non_exhaustive()
    }
}

/// When the watchdogs of a process expire.
struct Board {
    /// The time of the tag begun last.
    time: Cell<LogicalTime>,
    timeouts: RefCell<Vec<Duration>>,
    /// By watchdog; FOREVER: it does not run.
    expires: RefCell<Vec<PhysicalTime>>,
    /// The least of them.
    next: Cell<PhysicalTime>,
}

impl Default for Board {
    fn default() -> Self {
        Self {
            time: Cell::new(LogicalTime::NEVER),
            timeouts: RefCell::default(),
            expires: RefCell::default(),
            next: Cell::new(PhysicalTime::FOREVER),
        }
    }
}

impl Board {
    fn start(&self, index: usize, extra: Duration) {
        let timeout = self.timeouts.borrow()[index];
        let time = self.time.get().as_physical();
        self.set(index, time.saturating_add(timeout.saturating_add(extra)));
    }

    fn set(&self, index: usize, at: PhysicalTime) {
        let mut expires = self.expires.borrow_mut();
        expires[index] = at;
        let next = expires.iter().copied().min();
        self.next.set(next.unwrap_or(PhysicalTime::FOREVER));
    }
}

/// All watchdogs of a process with their handlers.
#[derive(Default)]
pub(crate) struct Watchdogs {
    board: Rc<Board>,
    entries: Vec<Entry>,
}

struct Entry {
    path: String,
    handlers: Vec<WatchdogHandler>,
}

/// What runs when a watchdog expires.
pub(crate) struct WatchdogHandler {
    /// The method's name.
    pub(crate) name: &'static str,
    pub(crate) reactor: ReactorId,
    pub(crate) body: Box<dyn Body>,
}

/// What [`Bodies::fire_watchdogs`](crate::Bodies::fire_watchdogs) did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Fired {
    /// How many handlers ran.
    pub count: u64,
    /// Whether one asked for the federation to stop.
    pub stop: bool,
}

impl Watchdogs {
    pub(crate) fn add(&mut self, path: String, timeout: Duration) -> Watchdog {
        let index = self.entries.len();
        self.entries.push(Entry {
            path,
            handlers: Vec::new(),
        });
        self.board.timeouts.borrow_mut().push(timeout);
        self.board.expires.borrow_mut().push(PhysicalTime::FOREVER);
        Watchdog {
            index,
            board: Rc::clone(&self.board),
        }
    }

    pub(crate) fn handle(&mut self, watchdog: &Watchdog, handler: WatchdogHandler) {
        self.entries[watchdog.index].handlers.push(handler);
    }

    /// Mistakes: every watchdog has one handler.
    pub(crate) fn unhandled(&self) -> Vec<WiringError> {
        let wrong = self
            .entries
            .iter()
            .filter(|entry| entry.handlers.len() != 1);
        wrong
            .map(|entry| WiringError::Watchdog {
                path: entry.path.clone(),
                count: entry.handlers.len(),
            })
            .collect()
    }

    pub(crate) fn handlers_mut(&mut self) -> impl Iterator<Item = &mut WatchdogHandler> {
        self.entries
            .iter_mut()
            .flat_map(|entry| &mut entry.handlers)
    }

    /// The path of one, when there is one.
    pub(crate) fn first(&self) -> Option<&str> {
        self.entries.first().map(|entry| entry.path.as_str())
    }

    #[inline]
    pub(crate) const fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }

    pub(crate) fn begin(&self, time: LogicalTime) {
        self.board.time.set(time);
    }

    /// When the next one expires.
    #[inline]
    pub(crate) fn next(&self) -> Option<PhysicalTime> {
        if self.is_empty() {
            return None;
        }
        let next = self.board.next.get();
        (next != PhysicalTime::FOREVER).then_some(next)
    }

    /// Stops those that have expired and returns them in the order of their times.
    pub(crate) fn take_expired(&self, now: PhysicalTime) -> Vec<usize> {
        let mut expired: Vec<_> = {
            let expires = self.board.expires.borrow();
            let due = expires.iter().copied().enumerate();
            due.filter(|(_, at)| *at <= now)
                .map(|(i, at)| (at, i))
                .collect()
        };
        expired.sort_unstable();
        for (_, index) in &expired {
            self.board.set(*index, PhysicalTime::FOREVER);
        }
        expired.into_iter().map(|(_, index)| index).collect()
    }

    /// The path and the handler of one.
    pub(crate) fn entry(&mut self, index: usize) -> Option<(&str, &mut WatchdogHandler)> {
        let entry = self.entries.get_mut(index)?;
        Some((&entry.path, entry.handlers.first_mut()?))
    }
}
