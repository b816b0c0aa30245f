//! Bytes on their way to one connection, in chunks that end between messages.

use std::collections::VecDeque;

use crate::wire::ToFederate;

/// A chunk for a peer that may be confused by messages split between reads (bytes).
const CHUNK: usize = 32 << 10;
/// A chunk for one of our own peers (bytes).
const LARGE_CHUNK: usize = 256 << 10;
/// Chunks kept for reuse.
const SPARES: usize = 4;

/// What to write to one connection, in order.
///
/// The driver writes [`Output::chunk`] with one call, tells [`Output::advance`] how much went, and stops when the
/// socket or the output has had enough. A chunk holds whole messages and is at most 32 KiB (256 KiB to our own peers),
/// or one message if that is longer.
#[derive(Debug)]
pub struct Output {
    chunks: VecDeque<Vec<u8>>,
    spares: Vec<Vec<u8>>,
    /// Bytes of the first chunk that are written.
    written: usize,
    pending: usize,
    chunk: usize,
    closing: Closing,
    scratch: Vec<u8>,
}

/// What is to become of a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Closing {
    /// It stays.
    Open,
    /// Once everything is written: shut down the writing half, go on reading until the peer closes.
    AfterFlush,
    /// Close at once.
    Now,
}

impl Output {
    pub(super) const fn new() -> Self {
        Self {
            chunks: VecDeque::new(),
            spares: Vec::new(),
            written: 0,
            pending: 0,
            chunk: CHUNK,
            closing: Closing::Open,
            scratch: Vec::new(),
        }
    }

    /// The bytes to write next, ending with a whole message; empty when there is nothing to write.
    #[must_use]
    pub fn chunk(&self) -> &[u8] {
        self.chunks
            .front()
            .map_or(&[], |chunk| &chunk[self.written..])
    }

    /// The next `written` bytes of [`Output::chunk`] have been written.
    ///
    /// # Panics
    ///
    /// When they are more than the chunk has.
    pub fn advance(&mut self, written: usize) {
        assert!(
            written <= self.chunk().len(),
            "no more is written than there was"
        );
        self.written += written;
        self.pending -= written;
        if self
            .chunks
            .front()
            .is_some_and(|chunk| chunk.len() == self.written)
            && let Some(mut chunk) = self.chunks.pop_front()
        {
            self.written = 0;
            if self.spares.len() < SPARES && chunk.capacity() <= 2 * LARGE_CHUNK {
                chunk.clear();
                self.spares.push(chunk);
            }
        }
    }

    /// Bytes not yet written.
    #[must_use]
    pub const fn pending(&self) -> usize {
        self.pending
    }

    /// What is to become of the connection.
    #[must_use]
    pub const fn closing(&self) -> Closing {
        self.closing
    }

    /// Appends one whole message.
    #[inline]
    pub(super) fn push(&mut self, message: &[u8]) {
        self.pending += message.len();
        match self.chunks.back_mut() {
            Some(last) if last.len() + message.len() <= self.chunk => {
                last.extend_from_slice(message);
            }
            _ => self.push_new_chunk(message),
        }
    }

    fn push_new_chunk(&mut self, message: &[u8]) {
        let mut chunk = self.spares.pop().unwrap_or_default();
        chunk.extend_from_slice(message);
        self.chunks.push_back(chunk);
    }

    pub(super) fn send(&mut self, message: &ToFederate<'_>) {
        let mut scratch = std::mem::take(&mut self.scratch);
        scratch.clear();
        message.encode(&mut scratch);
        self.push(&scratch);
        self.scratch = scratch;
    }

    /// The peer is one of ours: it reassembles whatever is split.
    pub(super) const fn allow_large_chunks(&mut self) {
        self.chunk = LARGE_CHUNK;
    }

    pub(super) const fn close(&mut self, closing: Closing) {
        self.closing = closing;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ictus_core::Tag;

    #[test]
    fn chunks_end_between_messages() {
        let mut output = Output::new();
        for nanos in 0..10_000 {
            output.send(&ToFederate::TagAdvanceGrant(Tag::at(nanos)));
        }
        let mut total = 0;
        while !output.chunk().is_empty() {
            let length = output.chunk().len();
            assert!(length <= CHUNK && length.is_multiple_of(13), "{length}");
            total += length;
            output.advance(length);
        }
        assert_eq!((total, output.pending()), (130_000, 0));
    }

    #[test]
    fn a_long_message_is_a_chunk_of_its_own() {
        let mut output = Output::new();
        output.push(&[1; 13]);
        output.push(&[2; 100_000]);
        output.push(&[3; 13]);
        assert_eq!(output.chunk(), [1; 13]);
        output.advance(5);
        assert_eq!(output.chunk(), [1; 8]);
        output.advance(8);
        assert_eq!(output.chunk().len(), 100_000);
        output.advance(100_000);
        assert_eq!(output.chunk(), [3; 13]);
    }
}
