//! What a federate measures of itself and of its peers: counters, histograms, and whether it falls behind.
//!
//! All values are cumulative since the federate's start. Recording is plain arithmetic: no allocation, no lock. Serialized forms
//! leave out what is empty, so that one part fits a status line.

use crate::report::Pick;
use ictus_core::{Duration, PhysicalTime, Tag};
use serde::{Deserialize, Serialize};

mod histogram;
mod lag;

pub use histogram::{Histogram, HistogramError};
pub use lag::{LagNews, LagWatch};

/// What a federate measured at one of its upstream peers' connections, all connections from that peer together.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct Upstream {
    /// Messages received.
    pub messages: u64,
    /// Payload bytes received.
    pub bytes: u64,
    /// Messages that came after their input had been decided at their tag.
    pub stp_violations: u64,
    /// By how much those were late.
    #[serde(skip_serializing_if = "Histogram::is_empty")]
    pub lateness: Histogram,
    /// How long before they would have been late the others came.
    #[serde(skip_serializing_if = "Histogram::is_empty")]
    pub slack: Histogram,
    /// L + N: arrival here (this federate's clock) minus the sender's tag time minus the sender's offset S.
    #[serde(skip_serializing_if = "Histogram::is_empty")]
    pub arrival: Histogram,
}

/// What a federate measured towards one of its downstream peers.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct Downstream {
    /// Messages sent.
    pub messages: u64,
    /// Payload bytes sent.
    pub bytes: u64,
    /// L: when messages were handed to the transport, minus their tag's time, minus this federate's offset S.
    #[serde(skip_serializing_if = "Histogram::is_empty")]
    pub launch_lag: Histogram,
}

/// What a federate measured of itself.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct Own {
    /// Tags completed.
    pub tags_completed: u64,
    /// Reactions run.
    pub reactions: u64,
    /// Deadlines missed.
    pub deadline_misses: u64,
    /// Watchdogs that fired.
    pub watchdogs_fired: u64,
    /// Times the federate began to fall behind.
    pub fell_behind: u64,
    /// Physical minus logical time when a tag is begun.
    #[serde(skip_serializing_if = "Histogram::is_empty")]
    pub tag_lag: Histogram,
    /// How long tags that were not granted at once waited for nothing but their grant.
    #[serde(skip_serializing_if = "Histogram::is_empty")]
    pub grant_wait: Histogram,
    /// By how much deadlines were missed.
    #[serde(skip_serializing_if = "Histogram::is_empty")]
    pub deadline_lateness: Histogram,
}

/// All that one federate measures.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Measures {
    upstreams: Vec<(u16, Upstream)>,
    downstreams: Vec<(u16, Downstream)>,
    own: Own,
    lag: LagWatch,
}

impl Measures {
    /// Nothing measured yet; room for these peers, by federate id.
    #[must_use]
    pub fn new(upstreams: &[u16], downstreams: &[u16]) -> Self {
        let mut measures = Self::default();
        for id in upstreams {
            peer(&mut measures.upstreams, *id);
        }
        for id in downstreams {
            peer(&mut measures.downstreams, *id);
        }
        measures
    }

    /// Upstream peers, ascending by federate id.
    pub fn upstreams(&self) -> impl Iterator<Item = (u16, &Upstream)> {
        self.upstreams.iter().map(|(id, peer)| (*id, peer))
    }

    /// Downstream peers, ascending by federate id.
    pub fn downstreams(&self) -> impl Iterator<Item = (u16, &Downstream)> {
        self.downstreams.iter().map(|(id, peer)| (*id, peer))
    }

    /// The federate's own measures.
    #[must_use]
    pub const fn own(&self) -> &Own {
        &self.own
    }

    /// Whether the federate is falling behind at the moment.
    #[must_use]
    pub const fn behind(&self) -> bool {
        self.lag.behind()
    }

    /// STP violations of all upstreams together.
    #[must_use]
    pub fn stp_violations(&self) -> u64 {
        let each = self.upstreams.iter().map(|(_, peer)| peer.stp_violations);
        each.fold(0, u64::saturating_add)
    }

    /// A message of `bytes` payload bytes came from `upstream`.
    pub fn arrived(&mut self, upstream: u16, bytes: usize) {
        let peer = peer(&mut self.upstreams, upstream);
        peer.messages += 1;
        peer.bytes = add(peer.bytes, bytes);
    }

    /// A message from `upstream` took `span` from the moment its sender might have begun its tag: L + N.
    pub fn arrival(&mut self, upstream: u16, span: Duration) {
        peer(&mut self.upstreams, upstream).arrival.record(span);
    }

    /// A message from `upstream` came `early` before it would have been late.
    pub fn slack(&mut self, upstream: u16, early: Duration) {
        peer(&mut self.upstreams, upstream).slack.record(early);
    }

    /// A message from `upstream` came `late`: an STP violation. Returns how many there are now when that is worth
    /// an event: at the first, and then at every power of ten.
    pub fn violation(&mut self, upstream: u16, late: Duration) -> Option<u64> {
        let peer = peer(&mut self.upstreams, upstream);
        peer.stp_violations += 1;
        peer.lateness.record(late);
        let count = peer.stp_violations;
        (10_u64.pow(count.ilog10()) == count).then_some(count)
    }

    /// A message of `bytes` payload bytes went to `downstream`.
    pub fn sent(&mut self, downstream: u16, bytes: usize) {
        let peer = peer(&mut self.downstreams, downstream);
        peer.messages += 1;
        peer.bytes = add(peer.bytes, bytes);
    }

    /// A message was handed to the transport towards `downstream`, `lag` after its tag might have begun: L.
    pub fn launch_lag(&mut self, downstream: u16, lag: Duration) {
        let peer = peer(&mut self.downstreams, downstream);
        peer.launch_lag.record(lag);
    }

    /// `tag` is begun at `now`. Says when the federate begins to fall behind, and when it has caught up.
    ///
    /// Not to be called by a federate that runs `fast`: its lag means nothing.
    pub fn tag_begun(&mut self, now: PhysicalTime, tag: Tag) -> Option<LagNews> {
        let lag = now.since(tag.time.as_physical());
        self.own.tag_lag.record(lag);
        let news = self.lag.sample(now, lag);
        if let Some(LagNews::FallingBehind { .. }) = news {
            self.own.fell_behind += 1;
        }
        news
    }

    /// A tag that was not granted at once waited `span` for nothing but its grant.
    pub fn grant_wait(&mut self, span: Duration) {
        self.own.grant_wait.record(span);
    }

    /// A tag is completed.
    pub const fn tag_completed(&mut self) {
        self.own.tags_completed += 1;
    }

    /// What was executed so far: reactions, watchdogs' handlers, and by how much deadlines were missed. The executor counts these
    /// itself and hands in the sums.
    pub fn executed(
        &mut self,
        reactions: u64,
        watchdogs_fired: u64,
        deadline_lateness: &Histogram,
    ) {
        self.own.reactions = reactions;
        self.own.watchdogs_fired = watchdogs_fired;
        if self.own.deadline_misses != deadline_lateness.count() {
            self.own.deadline_misses = deadline_lateness.count();
            self.own.deadline_lateness = deadline_lateness.clone();
        }
    }
}

impl Upstream {
    pub(crate) const HISTOGRAMS: &[Pick<Self>] = &[
        |it| &mut it.lateness,
        |it| &mut it.slack,
        |it| &mut it.arrival,
    ];

    /// Takes over what another report of the same federate says. Nothing goes back: the larger count is the later one, and a histogram
    /// that is left out stays.
    pub fn update(&mut self, other: Self) {
        raise(&mut self.messages, other.messages);
        raise(&mut self.bytes, other.bytes);
        raise(&mut self.stp_violations, other.stp_violations);
        self.lateness.update(other.lateness);
        self.slack.update(other.slack);
        self.arrival.update(other.arrival);
    }
}

impl Downstream {
    pub(crate) const HISTOGRAMS: &[Pick<Self>] = &[|it| &mut it.launch_lag];

    /// As [`Upstream::update`].
    pub fn update(&mut self, other: Self) {
        raise(&mut self.messages, other.messages);
        raise(&mut self.bytes, other.bytes);
        self.launch_lag.update(other.launch_lag);
    }
}

impl Own {
    pub(crate) const HISTOGRAMS: &[Pick<Self>] = &[
        |it| &mut it.tag_lag,
        |it| &mut it.grant_wait,
        |it| &mut it.deadline_lateness,
    ];

    /// As [`Upstream::update`].
    pub fn update(&mut self, other: Self) {
        raise(&mut self.tags_completed, other.tags_completed);
        raise(&mut self.reactions, other.reactions);
        raise(&mut self.deadline_misses, other.deadline_misses);
        raise(&mut self.watchdogs_fired, other.watchdogs_fired);
        raise(&mut self.fell_behind, other.fell_behind);
        self.tag_lag.update(other.tag_lag);
        self.grant_wait.update(other.grant_wait);
        self.deadline_lateness.update(other.deadline_lateness);
    }
}

fn raise(count: &mut u64, other: u64) {
    *count = (*count).max(other);
}

/// The measures of peer `id`; a peer nobody announced gets its place now.
#[expect(
    clippy::indexing_slicing,
    reason = "the index was found or made just before"
)]
fn peer<T: Default>(peers: &mut Vec<(u16, T)>, id: u16) -> &mut T {
    let index = match peers.binary_search_by_key(&id, |(id, _)| *id) {
        Ok(index) => index,
        Err(index) => {
            peers.insert(index, (id, T::default()));
            index
        }
    };
    &mut peers[index].1
}

fn add(sum: u64, bytes: usize) -> u64 {
    sum.saturating_add(u64::try_from(bytes).unwrap_or(u64::MAX))
}
