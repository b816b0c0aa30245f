//! Digests: 64 bits that stand for a value in a trace.

/// Mixes words into 64 bits.
///
/// The result depends on the words and their order alone: not on addresses, the machine or the serializer, and it
/// stays the same in later versions. It is no defence against forgery. Law: sequences that differ in one word differ.
#[derive(Clone, Copy, Debug)]
pub struct Digest {
    state: u64,
    refused: bool,
}

const SEED: u64 = 0x9e37_79b9_7f4a_7c15;
const FACTOR: u64 = 0xd6e8_feb8_6659_fd93;

impl Digest {
    /// The digest of nothing so far.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            state: SEED,
            refused: false,
        }
    }

    /// Says that a part of the value has no digest, so that the whole has none.
    pub const fn refuse(&mut self) {
        self.refused = true;
    }

    /// Mixes one word in.
    #[inline]
    pub const fn word(&mut self, word: u64) {
        let mixed = (self.state ^ word).wrapping_mul(FACTOR);
        self.state = mixed ^ (mixed >> 32);
        self.state = self.state.wrapping_add(SEED);
    }

    /// Mixes bytes in, eight to a word, the last word filled with zeros. The length is not mixed in.
    #[inline]
    pub fn bytes(&mut self, bytes: &[u8]) {
        let (words, rest) = bytes.as_chunks::<8>();
        for word in words {
            self.word(u64::from_le_bytes(*word));
        }
        if !rest.is_empty() {
            let mut last = [0; 8];
            last[..rest.len()].copy_from_slice(rest);
            self.word(u64::from_le_bytes(last));
        }
    }

    /// The result; `None` when a part has no digest.
    #[must_use]
    pub const fn finish(self) -> Option<u64> {
        if self.refused {
            return None;
        }
        Some(self.mixed())
    }

    /// The state, mixed once more.
    pub(crate) const fn mixed(self) -> u64 {
        let mut x = self.state;
        x = (x ^ (x >> 32)).wrapping_mul(FACTOR);
        x = (x ^ (x >> 29)).wrapping_mul(FACTOR);
        x ^ (x >> 32)
    }
}

impl Default for Digest {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digests_never_change() {
        let mut digest = Digest::new();
        digest.word(1);
        digest.bytes(b"twelve bytes");
        assert_eq!(format!("{:016x}", digest.mixed()), "b4d951db7d2a909d");
    }
}
