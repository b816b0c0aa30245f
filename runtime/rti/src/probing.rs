//! The socket over which clocks are compared.

use std::io;
use std::net::IpAddr;
use std::os::fd::{AsFd, AsRawFd};

use ictus_clock::{HostClock, ProbeSocket, Sent, Stamps};
use ictus_coord::rti::Rti;
use ictus_coord::topology::FederateId;
use mio::unix::SourceFd;
use mio::{Interest, Poll, Token};

/// The most datagrams that are taken before the federates have their turn.
const ROUND: usize = 256;

/// A UDP socket in the server's loop.
#[derive(Debug)]
pub(crate) struct Probing {
    socket: ProbeSocket,
    /// More may be read without waiting for an event.
    pub(crate) readable: bool,
    /// T1s of which the kernel has not said when they left, one a federate at most.
    leaving: Vec<(Sent, FederateId)>,
}

impl Probing {
    pub(crate) fn open(
        poll: &Poll,
        token: Token,
        address: IpAddr,
        port: u16,
        stamps: Stamps,
    ) -> io::Result<Self> {
        let socket = ProbeSocket::bind(address, port, stamps)?;
        let descriptor = socket.as_fd().as_raw_fd();
        poll.registry()
            .register(&mut SourceFd(&descriptor), token, Interest::READABLE)?;
        Ok(Self {
            socket,
            readable: true,
            leaving: Vec::new(),
        })
    }

    /// Answers what has come, and sends what is due.
    ///
    /// # Errors
    ///
    /// When the socket fails: clocks are compared no more.
    pub(crate) fn round(&mut self, rti: &mut Rti, clock: &HostClock) -> io::Result<()> {
        self.hear_departures(rti, clock);
        let mut taken = 0;
        while self.readable && taken < ROUND {
            match self.socket.receive()? {
                Some(arrival) => {
                    rti.receive_probe(arrival.from, arrival.bytes(), arrival.came(clock));
                    self.transmit(rti, clock);
                    taken += 1;
                }
                None => self.readable = false,
            }
        }
        self.transmit(rti, clock);
        Ok(())
    }

    fn transmit(&mut self, rti: &mut Rti, clock: &HostClock) {
        while let Some(transmit) = rti.poll_probe(clock.now()) {
            let sent = self.socket.send(transmit.to, &transmit.bytes);
            if let (Some(sent), Some(federate)) = (sent, transmit.begins) {
                self.leaving.retain(|(_, other)| *other != federate);
                self.leaving.push((sent, federate));
            }
        }
        self.hear_departures(rti, clock);
    }

    /// What the kernel says of when T1s left.
    fn hear_departures(&mut self, rti: &mut Rti, clock: &HostClock) {
        while let Some(departure) = self.socket.departed(clock) {
            let this = |(sent, _): &(Sent, FederateId)| *sent == departure.sent;
            if let Some(index) = self.leaving.iter().position(this) {
                let (_, federate) = self.leaving.swap_remove(index);
                rti.probe_left(federate, departure.when);
            }
        }
    }
}
