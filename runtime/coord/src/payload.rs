//! What coordination asks of an executor beyond running nodes: bytes.

use ictus_core::{ActionId, Executor, InputId, OutputId, Tag, ValueId};
use thiserror::Error;

/// A message whose bytes are not a value of the input's type. Fatal for the federation: sender and receiver disagree.
#[derive(Debug, Error)]
#[error("message of {length} bytes for {input} is not a {type_name}: {reason}")]
pub struct PayloadError {
    /// Path of the input.
    pub input: String,
    /// The input's type.
    pub type_name: String,
    /// Bytes received.
    pub length: usize,
    /// The serializer's words.
    pub reason: String,
}

/// An executor whose values cross process borders.
pub trait FederateExecutor: Executor {
    /// Appends the present value of a network output to `out`.
    fn encode(&mut self, output: OutputId, out: &mut Vec<u8>);

    /// Makes a value of a message for `input`, to be fetched by [`Executor::arrive`] when it is due.
    ///
    /// # Errors
    ///
    /// [`PayloadError`] when the bytes are not a value of the input's type.
    fn decode(&mut self, input: InputId, payload: &[u8]) -> Result<ValueId, PayloadError>;

    /// Notes that an event from outside, or a message on a physical connection, got `tag`.
    fn note_physical(&mut self, action: ActionId, tag: Tag) {
        let _ = (action, tag);
    }

    /// Notes that a message for `input` came after the input had been decided at `intended`: it is handled at `actual`.
    fn note_tardy(&mut self, input: InputId, intended: Tag, actual: Tag) {
        let _ = (input, intended, actual);
    }
}
