//! The socket over which clocks are compared.

use std::io;
use std::net::IpAddr;
use std::os::fd::{AsFd, AsRawFd};

use ictus_clock::{HostClock, ProbeSocket, Stamps};
use ictus_coord::rti::Rti;
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
        })
    }

    /// Answers what has come, and sends what is due.
    ///
    /// # Errors
    ///
    /// When the socket fails: clocks are compared no more.
    pub(crate) fn round(&mut self, rti: &mut Rti, clock: &HostClock) -> io::Result<()> {
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

    fn transmit(&self, rti: &mut Rti, clock: &HostClock) {
        while let Some(transmit) = rti.poll_probe(clock.now()) {
            self.socket.send(transmit.to, &transmit.bytes);
        }
    }
}
