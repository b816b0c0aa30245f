//! One direction of a network path.

use ictus_core::Duration;

use crate::seed::Rng;

/// How long datagrams take, and which of them arrive.
#[derive(Clone, Copy, Debug, Default)]
pub struct Path {
    /// No datagram is faster, in nanoseconds.
    pub least: i64,
    /// The mean of what is added at random (exponentially).
    pub jitter: i64,
    /// So many of a hundred meet a queue...
    pub queued: u64,
    /// ... that takes up to this long.
    pub queue: i64,
    /// So many of a hundred are lost.
    pub lost: u64,
    /// So many of a hundred come twice.
    pub doubled: u64,
}

impl Path {
    /// A path whose fastest datagrams take `least`.
    pub(super) fn draw(rng: &mut Rng, least: i64) -> Self {
        let most = least.min(150_000);
        let jitter = rng
            .span(Duration::ZERO, Duration::from_nanos(most))
            .as_nanos();
        let bad = rng.percent(30);
        Self {
            least,
            jitter,
            queued: *rng.pick(&[0, 0, 1, 5]),
            queue: 20_000_000,
            lost: if bad { *rng.pick(&[1, 5, 20]) } else { 0 },
            doubled: if bad { *rng.pick(&[0, 1, 5]) } else { 0 },
        }
    }

    /// How long one that is not lost takes.
    pub(super) fn delay(&self, rng: &mut Rng) -> i64 {
        let queue = if rng.percent(self.queued) {
            rng.span(Duration::ZERO, Duration::from_nanos(self.queue))
                .as_nanos()
        } else {
            0
        };
        self.least + exponential(rng, self.jitter) + queue
    }

    /// How long each copy takes that arrives.
    pub(super) fn copies(&self, rng: &mut Rng) -> Vec<i64> {
        let count = if rng.percent(self.lost) {
            0
        } else if rng.percent(self.doubled) {
            2
        } else {
            1
        };
        (0..count).map(|_| self.delay(rng)).collect()
    }
}

/// An exponential number: von Neumann's comparison method, integers only, so that every machine draws the same.
fn exponential(rng: &mut Rng, mean: i64) -> i64 {
    let mut whole = 0;
    loop {
        let first = rng.bits() >> 32;
        let (mut last, mut run) = (first, 1);
        loop {
            let next = rng.bits() >> 32;
            if next >= last {
                break;
            }
            last = next;
            run += 1;
        }
        if run % 2 == 1 {
            let fraction = (i128::from(first) * i128::from(mean)) >> 32;
            return whole * mean + i64::try_from(fraction).unwrap_or(0);
        }
        whole += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponential_numbers_have_their_mean() {
        let mut rng = Rng::new(7);
        let mut drawn: Vec<i64> = (0..20_000).map(|_| exponential(&mut rng, 1_000)).collect();
        let mean = drawn.iter().sum::<i64>() / 20_000;
        drawn.sort_unstable();
        assert!((970..1_030).contains(&mean), "{mean}");
        assert!((660..726).contains(&drawn[10_000]), "{}", drawn[10_000]);
    }
}
