//! Values and reaction bodies: what the timeline decides about, executed.

use crate::outside::{Outside, OutsideEvent};
use ictus_coord::{FederateExecutor, PayloadError};
use ictus_core::{ActionId, Effects, Executor, InputId, NodeId, OutputId, SlotId, Tag, ValueId};
use std::path::PathBuf;
use std::sync::Arc;

/// All values and bodies of an [`Assembly`](crate::Assembly).
#[derive(Debug)]
pub struct Bodies {
    outside: Arc<Outside>,
}

/// A panic in a reaction, or a value that no serializer could write. Fatal: no further body runs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Fault {
    /// The reactor's path.
    pub path: String,
    /// The reaction's name.
    pub reaction: String,
    /// The tag at which it happened.
    pub tag: Tag,
    /// The panic's words.
    pub message: String,
}

/// What the bodies did so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Reactions run, deadline handlers included.
    pub reactions: u64,
    /// Deadline handlers run instead of a body.
    pub deadlines_missed: u64,
}

/// Directories for trace and timing files; both exist.
#[derive(Clone, Debug, Default)]
pub struct Observation {
    /// Where `FEDERATE.trace` goes.
    pub trace: Option<PathBuf>,
    /// Where `FEDERATE.timing` goes.
    pub timing: Option<PathBuf>,
}

impl Bodies {
    /// Says where the start tag is; before [`Executor::begin`].
    pub fn start(&mut self, start: Tag) {
        let _ = start;
    }

    /// Opens trace and timing files, one per federate.
    ///
    /// # Errors
    ///
    /// When a file cannot be created.
    pub fn observe(&mut self, observation: &Observation) -> std::io::Result<()> {
        let _ = observation;
        Ok(())
    }

    /// The first fault.
    #[must_use]
    pub fn fault(&self) -> Option<&Fault> {
        None
    }

    /// What was done so far.
    #[must_use]
    pub fn counters(&self) -> Counters {
        Counters::default()
    }

    /// The queue of physical events.
    #[must_use]
    pub fn outside(&self) -> &Arc<Outside> {
        &self.outside
    }

    /// Moves the queued physical events to `events`, in the order of their arrival.
    pub fn drain_outside(&mut self, events: &mut Vec<OutsideEvent>) {
        let _ = events;
    }

    /// Notes in the trace that a physical event got `tag`.
    pub fn note_physical(&mut self, action: ActionId, tag: Tag) {
        let _ = (action, tag);
    }

    /// Notes in the trace a stop by request.
    pub fn note_stop(&mut self, tag: Tag) {
        let _ = tag;
    }

    /// Ends and flushes trace and timing: the last completed tag and why (one line).
    ///
    /// # Errors
    ///
    /// When a file could not be written, now or earlier.
    pub fn note_end(&mut self, tag: Tag, reason: &str) -> std::io::Result<()> {
        let _ = (tag, reason);
        Ok(())
    }
}

impl Executor for Bodies {
    fn begin(&mut self, tag: Tag) {
        let _ = tag;
    }
    fn arrive(&mut self, action: ActionId, slot: Option<SlotId>, value: ValueId) {
        let _ = (action, slot, value);
    }
    fn run(&mut self, node: NodeId, tag: Tag, effects: &mut Effects) {
        let _ = (node, tag, effects);
    }
}

impl FederateExecutor for Bodies {
    fn encode(&mut self, output: OutputId, out: &mut Vec<u8>) {
        let _ = (output, out);
    }
    fn decode(&mut self, input: InputId, payload: &[u8]) -> Result<ValueId, PayloadError> {
        let _ = (input, payload);
        Ok(ValueId::NONE)
    }
}
