//! One direction of a TCP connection: in order, nothing lost but by disconnection, cut anywhere, delayed at random.

use crate::seed::Rng;
use crate::swarm::Network;
use ictus_core::Duration;
use std::collections::VecDeque;

/// What arrives.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Arrival {
    /// Bytes.
    Bytes(Vec<u8>),
    /// The sender closed its half.
    Eof,
    /// The connection was reset.
    Reset,
}

/// One direction of a connection.
#[derive(Debug)]
pub struct Pipe {
    rng: Rng,
    network: Network,
    /// True times between which nothing passes.
    partitions: Vec<(i64, i64)>,
    in_flight: VecDeque<(i64, Arrival)>,
    last: i64,
    closed: bool,
}

impl Pipe {
    /// A pipe with its own randomness.
    #[must_use]
    pub const fn new(rng: Rng, network: Network) -> Self {
        Self {
            rng,
            network,
            partitions: Vec::new(),
            in_flight: VecDeque::new(),
            last: 0,
            closed: false,
        }
    }

    /// Lets nothing pass from `from` until `to`.
    pub fn partition(&mut self, from: i64, to: i64) {
        self.partitions.push((from, to));
    }

    /// Sends bytes at true time `now`; whoever listens is to be woken at the times added to `wake`.
    pub fn write(&mut self, now: i64, bytes: &[u8], wake: &mut Vec<i64>) {
        if self.closed || bytes.is_empty() {
            return;
        }
        let mut rest = bytes;
        while !rest.is_empty() {
            let cut = if rest.len() > 1 && self.rng.percent(self.network.cut) {
                1 + self.rng.below(rest.len() - 1)
            } else {
                rest.len()
            };
            let (piece, tail) = rest.split_at(cut);
            rest = tail;
            self.enqueue(now, Arrival::Bytes(piece.to_vec()), wake);
        }
    }

    /// Closes this half after what is in flight.
    pub fn close(&mut self, now: i64, wake: &mut Vec<i64>) {
        if !self.closed {
            self.enqueue(now, Arrival::Eof, wake);
            self.closed = true;
        }
    }

    /// The sending process died: part of what is in flight may be lost, then the connection ends.
    pub fn break_off(&mut self, now: i64, lose: bool, wake: &mut Vec<i64>) {
        if self.closed {
            return;
        }
        if lose {
            let keep = self.rng.below(self.in_flight.len() + 1);
            self.in_flight.truncate(keep);
        }
        let end = if lose { Arrival::Reset } else { Arrival::Eof };
        self.enqueue(now, end, wake);
        self.closed = true;
    }

    /// When the next thing arrives.
    #[must_use]
    pub fn next_at(&self) -> Option<i64> {
        self.in_flight.front().map(|(at, _)| *at)
    }

    /// What has arrived by `now`, in order.
    pub fn take(&mut self, now: i64) -> Option<Arrival> {
        match self.in_flight.front() {
            Some((at, _)) if *at <= now => self.in_flight.pop_front().map(|(_, a)| a),
            Some(_) | None => None,
        }
    }

    fn enqueue(&mut self, now: i64, arrival: Arrival, wake: &mut Vec<i64>) {
        let mut delay = self
            .rng
            .span(self.network.delay_min, self.network.delay_max);
        if self.rng.percent(self.network.clog) {
            let worst = Duration::from_nanos(self.network.delay_max.as_nanos() * 20);
            delay = self.rng.span(self.network.delay_max, worst);
        }
        let mut at = (now + delay.as_nanos()).max(self.last);
        for (from, to) in &self.partitions {
            if (*from..*to).contains(&at) {
                at = *to;
            }
        }
        self.last = at;
        self.in_flight.push_back((at, arrival));
        wake.push(at);
    }
}
