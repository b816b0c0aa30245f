//! The RTI's host, driven as its driver would.

use super::{Conditions, World};
use crate::clock::HostClock;
use crate::executor::SimulatedExecutor;
use crate::network::Arrival;
use crate::seed::Rng;
use ictus_coord::rti::{Closing, ConnectionId, Disconnect, Rti, RtiConfig, RtiEvent};
use ictus_core::Duration;

#[derive(Debug)]
pub(super) struct RtiHost {
    rti: Rti,
    clock: HostClock,
    rng: Rng,
    /// Per federate.
    peers: Vec<Peer>,
    dead: bool,
    wake_at: Option<i64>,
    calm: bool,
}

#[derive(Debug, Default)]
struct Peer {
    connection: Option<ConnectionId>,
    received: Vec<u8>,
    end: Option<Disconnect>,
    /// Our writing half is shut down.
    half_closed: bool,
    joined: bool,
}

impl RtiHost {
    pub(super) fn new(federates: usize, conditions: &Conditions, mut rng: Rng) -> Self {
        let clocks = conditions.swarm.clocks;
        let offset = rng.span(-clocks.offset, clocks.offset);
        let mut config = RtiConfig::new("simulated", u16::try_from(federates).unwrap_or(u16::MAX));
        config.clock_exchanges = if conditions.swarm.mode.clock_sync {
            10
        } else {
            0
        };
        config.dnet = conditions.swarm.mode.dnet;
        config.mutants = conditions.mutants;
        Self {
            rti: Rti::new(config),
            clock: HostClock::new(offset, 0),
            rng,
            peers: std::iter::repeat_with(Peer::default)
                .take(federates)
                .collect(),
            dead: false,
            wake_at: None,
            calm: conditions.swarm.mode.calm,
        }
    }

    pub(super) fn is_over(&self) -> bool {
        self.dead || self.rti.finished().is_some()
    }

    pub(super) fn is_dead(&self) -> bool {
        self.dead
    }

    pub(super) fn die(&mut self) {
        self.dead = true;
    }

    /// Whether the federate has connected.
    pub(super) fn knows(&self, federate: usize) -> bool {
        self.peers[federate].connection.is_some()
    }

    /// A federate will never connect: whoever started the processes gives up.
    pub(super) fn give_up(&mut self, now: i64) {
        let now = self.clock.reading(now);
        self.rti.request_stop(now);
    }

    pub(super) fn accept(&mut self, now: i64, federate: usize) {
        let now = self.clock.reading(now);
        let peer = format!("127.0.0.1:{}", 40_000 + federate);
        self.peers[federate].connection = Some(self.rti.connect(now, peer));
    }

    pub(super) fn woken(&mut self, now: i64) -> bool {
        if self.wake_at.is_some_and(|at| at <= now) {
            self.wake_at = None;
        }
        !self.dead
    }

    pub(super) fn wants_wake(&mut self, at: i64) -> bool {
        let sooner = self.wake_at.is_none_or(|planned| at < planned);
        if sooner {
            self.wake_at = Some(at);
        }
        sooner && !self.dead
    }

    /// How long the RTI takes to look at what has arrived: more may arrive meanwhile.
    pub(super) fn dawdle(&mut self) -> i64 {
        let most = *self.rng.pick(&[0, 0, 5_000, 300_000]);
        let most = if self.calm { 0 } else { most };
        self.rng
            .span(Duration::ZERO, Duration::from_nanos(most))
            .as_nanos()
    }
}

impl<E: SimulatedExecutor> World<E> {
    /// One or more rounds: read some connections, decide, write.
    pub(super) fn drive_rti(&mut self) {
        let now = self.rti.clock.reading(self.now);
        let count = self.hosts.len();
        let first = self.rti.rng.below(count);
        for turn in 0..count {
            self.rti_read((first + turn) % count);
            // Any split of the same input into rounds is as good.
            if self.rti.rng.percent(30) {
                self.rti_decide();
            }
        }
        if self.rti.rti.poll_timeout().is_some_and(|at| at <= now) {
            self.rti.rti.handle_timeout(now);
        }
        self.rti_decide();
        self.rti_disconnect();
        if let Some(at) = self
            .rti
            .rti
            .poll_timeout()
            .and_then(|at| self.rti.clock.when(at))
        {
            self.wake_rti(at);
        }
    }

    fn rti_read(&mut self, federate: usize) {
        let now = self.rti.clock.reading(self.now);
        let peer = &mut self.rti.peers[federate];
        let Some(connection) = peer.connection else {
            return;
        };
        let up = &mut self.hosts[federate].up;
        while let Some(arrival) = up.take(self.now) {
            match arrival {
                Arrival::Bytes(bytes) => peer.received.extend_from_slice(&bytes),
                Arrival::Eof => peer.end = Some(Disconnect::Eof),
                Arrival::Reset => peer.end = Some(Disconnect::Reset),
            }
        }
        let used = self.rti.rti.receive(now, connection, &peer.received);
        peer.received.drain(..used);
    }

    /// The ends of connections come after everything that was read.
    fn rti_disconnect(&mut self) {
        let now = self.rti.clock.reading(self.now);
        for federate in 0..self.hosts.len() {
            let peer = &mut self.rti.peers[federate];
            if let (Some(connection), Some(end)) = (peer.connection, peer.end.take()) {
                peer.connection = None;
                self.rti.rti.disconnect(now, connection, &end);
                if !peer.joined {
                    // Whoever started the processes gives up: the RTI cannot know that this one will not come again.
                    self.rti.rti.request_stop(now);
                }
                self.hosts[federate].down.close(self.now, &mut self.wakes);
                self.wake_for_arrivals(federate);
                self.rti_decide();
            }
        }
    }

    fn rti_decide(&mut self) {
        let now = self.rti.clock.reading(self.now);
        self.rti.rti.drain(now);
        let truth = self.truth();
        while let Some(connection) = self.rti.rti.poll_output() {
            let Some(federate) = self
                .rti
                .peers
                .iter()
                .position(|p| p.connection == Some(connection))
            else {
                continue;
            };
            let output = self.rti.rti.output(connection);
            while !output.chunk().is_empty() {
                let chunk = output.chunk();
                self.observer.rti_wrote(federate, chunk, &truth);
                self.hosts[federate]
                    .down
                    .write(self.now, chunk, &mut self.wakes);
                output.advance(chunk.len());
            }
            let closing = output.closing();
            self.obey(federate, closing);
            self.wake_for_arrivals(federate);
        }
        while let Some(event) = self.rti.rti.poll_event() {
            if let RtiEvent::Joined { federate } = event {
                self.rti.peers[federate.index()].joined = true;
            }
        }
    }

    fn obey(&mut self, federate: usize, closing: Closing) {
        let now = self.rti.clock.reading(self.now);
        let peer = &mut self.rti.peers[federate];
        match closing {
            Closing::Open => {}
            Closing::AfterFlush => {
                if !peer.half_closed {
                    peer.half_closed = true;
                    self.hosts[federate].down.close(self.now, &mut self.wakes);
                }
            }
            Closing::Now => {
                self.hosts[federate].down.close(self.now, &mut self.wakes);
                if let Some(connection) = peer.connection.take() {
                    self.rti.rti.disconnect(now, connection, &Disconnect::Eof);
                }
            }
        }
    }
}
