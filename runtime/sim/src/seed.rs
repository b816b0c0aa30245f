//! One seed, and everything that is drawn from it.

use ictus_core::Duration;

/// A pseudo-random generator: splitmix64. Equal seeds give equal sequences on every machine.
///
/// Source: Steele, Lea, Flood, "Fast splittable pseudorandom number generators".
#[derive(Clone, Debug)]
pub struct Rng(u64);

impl Rng {
    /// The generator of a seed.
    #[must_use]
    pub const fn new(seed: u64) -> Self {
        Self(seed)
    }

    /// A generator for one purpose: draws from it do not move this one.
    #[must_use]
    pub fn fork(&self, purpose: u64) -> Self {
        Self(mix(self.0, purpose))
    }

    /// The next 64 bits.
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        scramble(self.0)
    }

    /// A number below `bound`; 0 when `bound` is 0.
    #[expect(clippy::cast_possible_truncation, reason = "below a usize")]
    pub fn below(&mut self, bound: usize) -> usize {
        if bound == 0 {
            return 0;
        }
        (self.bits() % bound as u64) as usize
    }

    /// A number from `low` to `high`, both included.
    pub fn between(&mut self, low: usize, high: usize) -> usize {
        low + self.below(high.saturating_sub(low) + 1)
    }

    /// A span from `low` to `high`, both included.
    pub fn span(&mut self, low: Duration, high: Duration) -> Duration {
        let width = (high - low).as_nanos().max(0).cast_unsigned();
        let extra = self.bits() % (width + 1);
        low + Duration::from_nanos(extra.cast_signed())
    }

    /// True `parts` times out of a hundred.
    pub fn percent(&mut self, parts: u64) -> bool {
        self.bits() % 100 < parts
    }

    /// One of them.
    ///
    /// # Panics
    ///
    /// When there is none.
    pub fn pick<'a, T>(&mut self, choices: &'a [T]) -> &'a T {
        &choices[self.below(choices.len())]
    }
}

/// Mixes two numbers into one that depends on every bit of both, and on their order.
#[must_use]
pub const fn mix(a: u64, b: u64) -> u64 {
    scramble(
        scramble(a ^ 0x51_7c_c1_b7_27_22_0a_95).wrapping_add(b.wrapping_mul(0x9e37_79b9_7f4a_7c15)),
    )
}

const fn scramble(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}
