//! A UDP socket that knows when its datagrams came.

use std::io::{self, IoSliceMut};
use std::net::{IpAddr, SocketAddr, UdpSocket};
use std::os::fd::{AsFd, AsRawFd, BorrowedFd};

use ictus_coord::clock::LONGEST;
use ictus_core::{Duration, PhysicalTime};
use nix::libc;
use nix::sys::socket::sockopt::Timestamping;
use nix::sys::socket::{
    ControlMessageOwned, MsgFlags, SockaddrStorage, TimestampingFlag, Timestamps, recvmsg,
    setsockopt,
};
use nix::sys::time::TimeSpec;

use crate::host::{HostClock, system};

/// A datagram that waited longer for its reader has a stamp from before a step.
const OLDEST: i64 = 10_000_000_000;

/// Who says when a datagram came.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stamps {
    /// The kernel, when it took it from the network (SO_TIMESTAMPING, software).
    Kernel,
    /// The reader, when it has it.
    Reader,
}

/// A non-blocking UDP socket for probes.
///
/// With [`Stamps::Kernel`] the time a datagram waits for its reader to be scheduled, tens of microseconds on an idle machine and
/// milliseconds on a busy one, counts no longer as time on its way. When it was *sent* is read by the sender just before:
/// what the
/// kernel knows of that, it knows afterwards ([`ProbeSocket::departed`]).
#[derive(Debug)]
pub struct ProbeSocket {
    socket: UdpSocket,
    stamps: Stamps,
    /// Datagrams sent, as the kernel counts them.
    sent: u32,
}

/// A datagram that was sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sent(u32);

/// When a datagram left.
#[derive(Clone, Copy, Debug)]
pub struct Departure {
    /// Which.
    pub sent: Sent,
    /// When it left, or a little earlier.
    pub when: PhysicalTime,
}

/// A datagram.
#[derive(Clone, Copy, Debug)]
pub struct Arrival {
    /// Who sent it.
    pub from: SocketAddr,
    bytes: [u8; LONGEST + 1],
    length: usize,
    /// How long before it was read it came.
    pub waited: Duration,
}

impl Arrival {
    /// What is in it, the first 12 bytes at most: no probe is longer than 11.
    #[must_use]
    pub fn bytes(&self) -> &[u8] {
        &self.bytes[..self.length]
    }

    /// When it came, or a little later, by a clock that is read now.
    #[must_use]
    pub fn came(&self, clock: &HostClock) -> PhysicalTime {
        clock.now() + -self.waited
    }
}

impl ProbeSocket {
    /// Opens a socket; port 0: the system chooses one. Where the kernel has no stamps, the reader's are taken.
    ///
    /// # Errors
    ///
    /// When the address cannot be used.
    pub fn bind(address: IpAddr, port: u16, wanted: Stamps) -> io::Result<Self> {
        let socket = UdpSocket::bind((address, port))?;
        socket.set_nonblocking(true)?;
        let flags = TimestampingFlag::SOF_TIMESTAMPING_RX_SOFTWARE
            | TimestampingFlag::SOF_TIMESTAMPING_TX_SOFTWARE
            | TimestampingFlag::SOF_TIMESTAMPING_SOFTWARE
            | TimestampingFlag::SOF_TIMESTAMPING_OPT_ID
            | TimestampingFlag::SOF_TIMESTAMPING_OPT_TSONLY;
        let stamps = match wanted {
            Stamps::Kernel if setsockopt(&socket, Timestamping, &flags).is_ok() => Stamps::Kernel,
            Stamps::Kernel | Stamps::Reader => Stamps::Reader,
        };
        Ok(Self {
            socket,
            stamps,
            sent: 0,
        })
    }

    /// Who says when a datagram came.
    #[must_use]
    pub const fn stamps(&self) -> Stamps {
        self.stamps
    }

    /// The port.
    ///
    /// # Errors
    ///
    /// When the system does not say it.
    pub fn port(&self) -> io::Result<u16> {
        self.socket.local_addr().map(|address| address.port())
    }

    /// Sends a datagram. One that cannot be sent is as good as lost on its way.
    pub fn send(&mut self, to: SocketAddr, bytes: &[u8]) -> Option<Sent> {
        self.socket.send_to(bytes, to).ok()?;
        let sent = Sent(self.sent);
        self.sent = self.sent.wrapping_add(1);
        Some(sent)
    }

    /// What the kernel has to say, by `clock`, of one that was sent; to be asked until it says `None`, else the socket stays
    /// ready.
    pub fn departed(&mut self, clock: &HostClock) -> Option<Departure> {
        let mut byte = [0; 1];
        let mut parts = [IoSliceMut::new(&mut byte)];
        let mut control = nix::cmsg_space!(Timestamps, libc::sock_extended_err, [u8; 64]);
        let flags = MsgFlags::MSG_ERRQUEUE | MsgFlags::MSG_DONTWAIT;
        let descriptor = self.socket.as_raw_fd();
        loop {
            let message =
                recvmsg::<SockaddrStorage>(descriptor, &mut parts, Some(&mut control), flags)
                    .ok()?;
            // In this order, so that the time between the two makes it earlier.
            let (now, read_at) = (clock.now(), system());
            let (mut left, mut sent) = (None, None);
            for part in message.cmsgs().ok()? {
                if let ControlMessageOwned::ScmTimestampsns(stamps) = part {
                    left = Some(stamps.system);
                } else if let ControlMessageOwned::Ipv4RecvErr(error, _)
                | ControlMessageOwned::Ipv6RecvErr(error, _) = part
                {
                    sent = Some(error.ee_data);
                }
            }
            if let (Some(left), Some(sent)) = (left, sent) {
                let sent = Sent(sent);
                let when = now + -since(read_at, left);
                return Some(Departure { sent, when });
            }
        }
    }

    /// The next datagram; `None` when there is none.
    ///
    /// # Errors
    ///
    /// When the socket fails for good; errors of single datagrams are passed over.
    pub fn receive(&self) -> io::Result<Option<Arrival>> {
        loop {
            match self.receive_one() {
                Ok(Some(arrival)) => return Ok(Some(arrival)),
                Ok(None) => {}
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Ok(None),
                // A peer that is gone refuses, by ICMP, what was sent before.
                Err(error)
                    if matches!(
                        error.kind(),
                        io::ErrorKind::Interrupted | io::ErrorKind::ConnectionRefused
                    ) => {}
                Err(error) => return Err(error),
            }
        }
    }

    /// `None`: it came from nowhere.
    fn receive_one(&self) -> io::Result<Option<Arrival>> {
        let mut bytes = [0; LONGEST + 1];
        let mut parts = [IoSliceMut::new(&mut bytes)];
        let mut control = nix::cmsg_space!(Timestamps);
        let message = recvmsg::<SockaddrStorage>(
            self.socket.as_raw_fd(),
            &mut parts,
            Some(&mut control),
            MsgFlags::MSG_DONTWAIT,
        )?;
        let read_at = system();
        let length = message.bytes;
        let from = message.address.as_ref().and_then(address);
        let stamp = message.cmsgs().ok().and_then(|mut messages| {
            messages.find_map(|message| {
                if let ControlMessageOwned::ScmTimestampsns(stamps) = message {
                    Some(stamps.system)
                } else {
                    None
                }
            })
        });
        let waited = stamp.map_or(Duration::ZERO, |stamp| since(read_at, stamp));
        Ok(from.map(|from| Arrival {
            from,
            bytes,
            length,
            waited,
        }))
    }
}

impl AsFd for ProbeSocket {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }
}

/// The time since a stamp; none when it makes no sense.
fn since(now: i64, stamp: TimeSpec) -> Duration {
    let stamp = stamp.tv_sec() * 1_000_000_000 + stamp.tv_nsec();
    let passed = now.saturating_sub(stamp);
    let sense = (0..OLDEST).contains(&passed);
    Duration::from_nanos(if sense { passed } else { 0 })
}

fn address(storage: &SockaddrStorage) -> Option<SocketAddr> {
    if let Some(v4) = storage.as_sockaddr_in() {
        return Some(SocketAddr::new(v4.ip().into(), v4.port()));
    }
    let v6 = storage.as_sockaddr_in6()?;
    Some(SocketAddr::new(v6.ip().into(), v6.port()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::net::Ipv4Addr;

    #[test]
    fn the_kernel_knows_how_long_a_datagram_has_waited() {
        let local = IpAddr::V4(Ipv4Addr::LOCALHOST);
        let bind = |stamps| ProbeSocket::bind(local, 0, stamps).unwrap();
        let (mut sender, reader) = (bind(Stamps::Kernel), bind(Stamps::Kernel));
        assert!(reader.receive().unwrap().is_none());
        let to = SocketAddr::new(local, reader.port().unwrap());
        let clock = HostClock::raw();
        loop {
            let before = clock.now();
            let which = sender.send(to, &[7; 20]);
            let sent = clock.now();
            while clock.now() < sent + Duration::from_millis(3) {}
            let arrival = reader.receive().unwrap().unwrap();
            assert_eq!(arrival.bytes(), [7; LONGEST + 1], "cut, and so no probe");
            assert_eq!(arrival.from.port(), sender.port().unwrap());
            assert!(arrival.came(&clock) >= before);
            // The kernel begins to stamp a little after it was asked to, and until then says when it was read.
            if reader.stamps() == Stamps::Kernel && arrival.waited < Duration::from_millis(3) {
                while sender.departed(&clock).is_some() {}
                continue;
            }
            if sender.stamps() == Stamps::Kernel {
                let departure = sender.departed(&clock).unwrap();
                assert_eq!(Some(departure.sent), which);
                assert!(departure.when <= sent, "it left while it was sent");
            }
            assert!(sender.departed(&clock).is_none());
            return;
        }
    }
}
