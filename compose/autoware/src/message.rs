//! `Message4kb`: who handled the sample, when, and what was lost on the way.

use ictus::prelude::*;

/// One handling of a sample by a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Value)]
#[value(native)]
pub(crate) struct Entry {
    /// Logical time since the start, in nanoseconds.
    timestamp: u64,
    /// The node's messages so far, from 1.
    sequence_number: u32,
    /// Messages that the node missed so far.
    dropped_samples: u32,
    /// The node, filled with zeros.
    node_name: [u8; 48],
}

/// The message of every topic: 4096 bytes.
///
/// Source: `reference_interfaces/msg/Message4kb`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Value)]
#[value(native)]
pub(crate) struct Message4kb {
    /// Entries in use.
    size: u64,
    entries: [Entry; 63],
    data: [i64; 7],
}

impl Message4kb {
    /// The entries in use.
    fn used(&self) -> &[Entry] {
        let used = usize::try_from(self.size).unwrap_or(usize::MAX);
        &self.entries[..used.min(self.entries.len())]
    }

    /// Adds an entry, or replaces the node's own; a full message stays as it is.
    fn put(&mut self, entry: Entry) {
        let own = self
            .used()
            .iter()
            .position(|e| e.node_name == entry.node_name);
        let place = own.unwrap_or(self.used().len());
        if let Some(free) = self.entries.get_mut(place) {
            *free = entry;
            self.size = self.size.max(place as u64 + 1);
        }
    }

    /// Adds the entries of nodes that are not in this message yet.
    pub(crate) fn merge(&mut self, other: &Self) {
        for entry in other.used() {
            if !self.used().iter().any(|e| e.node_name == entry.node_name) {
                self.put(*entry);
            }
        }
    }
}

impl Default for Message4kb {
    fn default() -> Self {
        let empty = Entry {
            timestamp: 0,
            sequence_number: 0,
            dropped_samples: 0,
            node_name: [0; 48],
        };
        Self {
            size: 0,
            entries: [empty; 63],
            data: [0; 7],
        }
    }
}

/// What a node remembers from message to message.
#[derive(Debug, Default)]
pub(crate) struct History {
    sent: u32,
    dropped: u32,
    last_received: u32,
}

impl History {
    /// Counts what was lost between this message and the one before, from the sender's sequence number.
    pub(crate) fn missed(&mut self, message: &Message4kb) {
        let sequence = message.used().last().map_or(0, |e| e.sequence_number);
        self.dropped += sequence.saturating_sub(self.last_received + 1);
        self.last_received = sequence;
    }

    /// Messages lost so far.
    pub(crate) const fn dropped(&self) -> u32 {
        self.dropped
    }

    /// Adds the node's entry to a message that it publishes.
    pub(crate) fn sign(&mut self, message: &mut Message4kb, ctx: &Ctx) {
        self.sent += 1;
        let mut node_name = [0; 48];
        for (byte, from) in node_name.iter_mut().zip(ctx.path().bytes()) {
            *byte = from;
        }
        message.put(Entry {
            timestamp: u64::try_from(ctx.elapsed().as_nanos()).unwrap_or(0),
            sequence_number: self.sent,
            dropped_samples: self.dropped,
            node_name,
        });
    }

    /// The message as a transform publishes it.
    pub(crate) fn pass_on(&mut self, message: &Message4kb, ctx: &Ctx) -> Message4kb {
        self.missed(message);
        let mut message = *message;
        self.sign(&mut message, ctx);
        message
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_has_4096_bytes() {
        assert_eq!(<Message4kb as ictus::value::Native>::SIZE, 4096);
    }

    #[test]
    fn merging_keeps_one_entry_a_node() {
        let entry = |name: u8, timestamp| Entry {
            timestamp,
            sequence_number: 1,
            dropped_samples: 0,
            node_name: [name; 48],
        };
        let (mut a, mut b) = (Message4kb::default(), Message4kb::default());
        a.put(entry(b'a', 1));
        b.put(entry(b'a', 2));
        b.put(entry(b'b', 3));
        a.merge(&b);
        assert_eq!(a.used(), [entry(b'a', 1), entry(b'b', 3)]);
    }
}
