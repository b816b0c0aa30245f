//! Durations counted in buckets whose width grows with the value.

use ictus_core::Duration;
use serde::{Deserialize, Serialize, Serializer};
use thiserror::Error;

/// log2 of the sub-buckets per power of two.
const SUB_BITS: u32 = 3;
/// Sub-buckets per power of two.
const SUBS: usize = 1 << SUB_BITS;
/// Buckets for 0 to 2^63 - 1 nanoseconds.
const BUCKETS: usize = (63 - SUB_BITS as usize + 1) * SUBS;

/// A histogram of durations: log-linear, 8 sub-buckets per power of two, in nanoseconds.
///
/// Count, sum, minimum and maximum are exact (the sum saturates). A negative duration counts as 0.
/// Laws: a quantile is at most 1/8 above the exact one and never below it, a floor of one at most 1/8 below and never above;
/// `merge` equals recording both sequences; the serialized form reads back as the same histogram.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(try_from = "Sparse")]
pub struct Histogram {
    counts: Box<[u64]>,
    count: u64,
    sum: u64,
    min: u64,
    max: u64,
}

/// Why a serialized histogram is none.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum HistogramError {
    /// The list of gaps and counts has an odd length.
    #[error("a gap without its count")]
    Odd,
    /// A gap leads past the last bucket.
    #[error("a bucket that does not exist")]
    Bucket,
    /// A listed bucket is empty, or all together overflow.
    #[error("a count out of range")]
    Count,
    /// The smallest value does not lie in the first bucket.
    #[error("a minimum outside the first bucket")]
    Min,
    /// The largest value does not lie in the last bucket.
    #[error("a maximum outside the last bucket")]
    Max,
}

/// What is written: `buckets` is gap, count, gap, count, ..., a gap being the empty buckets before this one.
#[derive(Serialize, Deserialize)]
struct Sparse {
    sum: u64,
    /// Absent in what older releases wrote, and when nothing was counted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    min: Option<u64>,
    max: u64,
    buckets: Vec<u64>,
}

impl Default for Histogram {
    fn default() -> Self {
        Self {
            counts: vec![0; BUCKETS].into_boxed_slice(),
            count: 0,
            sum: 0,
            min: 0,
            max: 0,
        }
    }
}

impl Histogram {
    /// Counts one duration.
    pub fn record(&mut self, duration: Duration) {
        let nanos = u64::try_from(duration.as_nanos()).unwrap_or(0);
        if let Some(count) = self.counts.get_mut(bucket(nanos)) {
            *count += 1;
        }
        self.min = if self.is_empty() {
            nanos
        } else {
            self.min.min(nanos)
        };
        self.count += 1;
        self.sum = self.sum.saturating_add(nanos);
        self.max = self.max.max(nanos);
    }

    /// Adds what `other` counted.
    pub fn merge(&mut self, other: &Self) {
        for (mine, theirs) in self.counts.iter_mut().zip(&other.counts) {
            *mine = mine.saturating_add(*theirs);
        }
        self.min = match (self.is_empty(), other.is_empty()) {
            (true, _) => other.min,
            (false, true) => self.min,
            (false, false) => self.min.min(other.min),
        };
        self.count = self.count.saturating_add(other.count);
        self.sum = self.sum.saturating_add(other.sum);
        self.max = self.max.max(other.max);
    }

    /// Becomes `other`, another state of the same histogram, if that is not an earlier one.
    pub(super) fn update(&mut self, other: Self) {
        if other.count >= self.count {
            *self = other;
        }
    }

    /// Whether nothing was counted.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// How many durations were counted.
    #[must_use]
    pub const fn count(&self) -> u64 {
        self.count
    }

    /// The sum of all durations, in nanoseconds, saturating.
    #[must_use]
    pub const fn sum_ns(&self) -> u64 {
        self.sum
    }

    /// The shortest duration; zero when nothing was counted.
    #[must_use]
    pub fn min(&self) -> Duration {
        duration(self.min)
    }

    /// The longest duration; zero when nothing was counted.
    #[must_use]
    pub fn max(&self) -> Duration {
        duration(self.max)
    }

    /// The mean; zero when nothing was counted.
    #[must_use]
    pub fn mean(&self) -> Duration {
        duration(self.sum.checked_div(self.count).unwrap_or(0))
    }

    /// The least bucket edge that at least a share `q` of all durations does not exceed, and never more than the maximum; zero when
    /// nothing was counted. `q` is 0 to 1; what is beyond counts as the end it is beyond.
    #[must_use]
    pub fn quantile(&self, q: f64) -> Duration {
        let bucket = self.ranked(q);
        bucket.map_or(self.max(), |index| {
            duration(upper_edge(index)).min(self.max())
        })
    }

    /// The lower edge of the bucket in which `quantile` lies, and never less than the minimum: for durations of which the short
    /// ones are the bad ones. Zero when nothing was counted.
    #[must_use]
    pub fn quantile_floor(&self, q: f64) -> Duration {
        let bucket = self.ranked(q);
        bucket.map_or(self.max(), |index| {
            duration(lower_edge(index)).max(self.min())
        })
    }

    /// The first bucket up to which at least a share `q` was counted.
    #[expect(clippy::cast_precision_loss, reason = "a rank of 2^53 is out of reach")]
    fn ranked(&self, q: f64) -> Option<usize> {
        let (rank, mut seen) = (q * self.count as f64, 0_u64);
        let mut full = self.counts.iter().enumerate().filter(|(_, n)| **n > 0);
        let found = full.find(|(_, count)| {
            seen = seen.saturating_add(**count);
            seen as f64 >= rank
        });
        found.map(|(index, _)| index)
    }

    /// The buckets that counted something, ascending: upper edge (inclusive), count.
    pub fn buckets(&self) -> impl Iterator<Item = (Duration, u64)> {
        let full = self.counts.iter().enumerate().filter(|(_, n)| **n > 0);
        full.map(|(index, n)| (duration(upper_edge(index)), *n))
    }
}

/// The bucket of a value: one for each value below 16, then 8 for each power of two.
const fn bucket(nanos: u64) -> usize {
    let nanos = if nanos > i64::MAX as u64 {
        i64::MAX as u64
    } else {
        nanos
    };
    let Some(log) = nanos.checked_ilog2() else {
        return 0;
    };
    let shift = log.saturating_sub(SUB_BITS);
    #[expect(clippy::cast_possible_truncation, reason = "below 16 after the shift")]
    let sub = (nanos >> shift) as usize;
    shift as usize * SUBS + sub
}

/// The largest value in a bucket.
const fn upper_edge(index: usize) -> u64 {
    let shift = (index / SUBS).saturating_sub(1);
    let sub = index - shift * SUBS;
    ((sub as u64 + 1) << shift) - 1
}

/// The smallest value in a bucket.
const fn lower_edge(index: usize) -> u64 {
    match index.checked_sub(1) {
        Some(before) => upper_edge(before) + 1,
        None => 0,
    }
}

fn duration(nanos: u64) -> Duration {
    Duration::from_nanos(i64::try_from(nanos).unwrap_or(i64::MAX))
}

impl Serialize for Histogram {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        Sparse::from(self).serialize(serializer)
    }
}

impl From<&Histogram> for Sparse {
    fn from(histogram: &Histogram) -> Self {
        let mut buckets = Vec::new();
        let mut gap = 0;
        for count in &histogram.counts {
            if *count == 0 {
                gap += 1;
            } else {
                buckets.extend([gap, *count]);
                gap = 0;
            }
        }
        Self {
            sum: histogram.sum,
            min: (!histogram.is_empty()).then_some(histogram.min),
            max: histogram.max,
            buckets,
        }
    }
}

impl TryFrom<Sparse> for Histogram {
    type Error = HistogramError;

    fn try_from(sparse: Sparse) -> Result<Self, HistogramError> {
        let mut histogram = Self::default();
        let (pairs, rest) = sparse.buckets.as_chunks::<2>();
        if !rest.is_empty() {
            return Err(HistogramError::Odd);
        }
        let (mut next, mut last) = (0_usize, 0);
        let mut first = None;
        for [gap, count] in pairs {
            let gap = usize::try_from(*gap).map_err(|_| HistogramError::Bucket)?;
            last = next.checked_add(gap).ok_or(HistogramError::Bucket)?;
            let place = histogram.counts.get_mut(last);
            *place.ok_or(HistogramError::Bucket)? = *count;
            let sum = histogram.count.checked_add(*count);
            histogram.count = sum.filter(|_| *count > 0).ok_or(HistogramError::Count)?;
            first.get_or_insert(last);
            next = last + 1;
        }
        if bucket(sparse.max) != last || sparse.max > i64::MAX.unsigned_abs() {
            return Err(HistogramError::Max);
        }
        let first = first.unwrap_or(0);
        let min = sparse.min.unwrap_or(lower_edge(first));
        if bucket(min) != first || min > sparse.max {
            return Err(HistogramError::Min);
        }
        histogram.min = min;
        histogram.sum = sparse.sum;
        histogram.max = sparse.max;
        Ok(histogram)
    }
}
