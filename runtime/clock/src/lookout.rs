//! Looks from time to time whether other hosts still answer: the kernel's counters go into [`Silence`].

use std::io;
use std::net::{IpAddr, SocketAddr};
use std::os::fd::{AsFd, BorrowedFd};

use ictus_coord::silence::{Reading, Silence, Silent, Traffic};
use ictus_core::{Duration, PhysicalTime};
use nix::libc;
use nix::sys::socket::{GetSockOpt, SetSockOpt};
use rustix::net::sockopt;

use crate::HostClock;

/// The kernel's own limit for data that is not acknowledged, at least: it counts windows that are closed, too, and a reaction
/// may run for minutes.
const UNACKNOWLEDGED_MIN: std::time::Duration = std::time::Duration::from_secs(120);
/// In timeouts.
const UNACKNOWLEDGED: u32 = 4;
/// Probes in a row until the kernel itself gives up, unless the limit above rules.
const PROBES_MAX: u32 = 100;

/// The beginning of the kernel's `struct tcp_info` (uapi/linux/tcp.h), as far as Linux 4.6 has it; libc's ends earlier.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
struct TcpInfo {
    states: [u8; 2],
    retransmits: u8,
    probes: u8,
    options: [u8; 4],
    measures: [u32; 24],
    totals: [u64; 4],
    segs_out: u32,
    segs_in: u32,
    rest: [u32; 3],
    data_segs_out: u32,
}

#[derive(Clone, Copy, Debug)]
struct Info;

nix::getsockopt_impl!(
    Info,
    libc::IPPROTO_TCP,
    libc::TCP_INFO,
    TcpInfo,
    nix::sys::socket::sockopt::GetStruct<TcpInfo>
);

/// How far apart data that is sent again is at most, in milliseconds (Linux 6.15).
const TCP_RTO_MAX_MS: libc::c_int = 44;

#[derive(Clone, Copy, Debug)]
struct ResendMax;

nix::setsockopt_impl!(
    ResendMax,
    libc::IPPROTO_TCP,
    TCP_RTO_MAX_MS,
    u32,
    nix::sys::socket::sockopt::SetStruct<'_, u32>
);

/// Watches the hosts at the other ends of connections; `K` names a connection.
#[derive(Debug)]
pub struct Lookout<K> {
    clock: HostClock,
    silence: Silence<K>,
    due: PhysicalTime,
}

impl<K: Ord + Copy> Lookout<K> {
    /// A host may be silent for `timeout`.
    #[must_use]
    pub fn new(timeout: Duration) -> Self {
        Self {
            clock: HostClock::steady(),
            silence: Silence::new(timeout),
            due: PhysicalTime::NEVER,
        }
    }

    /// How long until it is to be looked; zero when it is.
    #[must_use]
    pub fn patience(&self) -> Duration {
        self.due.since(self.clock.now()).max(Duration::ZERO)
    }

    /// Looks at all connections with other hosts, if it is time to; names the hosts that are lost.
    pub fn look<'a>(
        &mut self,
        sockets: impl Iterator<Item = (K, IpAddr, BorrowedFd<'a>)>,
    ) -> Vec<Silent> {
        let now = self.clock.now();
        if now < self.due {
            return Vec::new();
        }
        self.due = now + self.silence.period();
        let reading = |(connection, host, socket): (K, IpAddr, BorrowedFd<'_>)| {
            // What cannot be asked is about to be found out by who reads it.
            let traffic = traffic(socket).ok()?;
            Some(Reading {
                host,
                connection,
                traffic,
            })
        };
        let readings: Vec<_> = sockets.filter_map(reading).collect();
        self.silence.look(now, &readings)
    }
}

/// What the kernel has counted of a TCP connection.
fn traffic(socket: BorrowedFd<'_>) -> io::Result<Traffic> {
    let info = Info.get(&socket)?;
    Ok(Traffic {
        heard: info.segs_in,
        asked: info.data_segs_out,
        probes: info.probes.into(),
    })
}

/// The host at the other end of a connection, when it is not this one.
#[must_use]
pub fn other_host(local: io::Result<SocketAddr>, peer: SocketAddr) -> Option<IpAddr> {
    let host = peer.ip().to_canonical();
    let here = host.is_loopback() || local.is_ok_and(|local| local.ip().to_canonical() == host);
    (!here).then_some(host)
}

/// Has the kernel ask the peer's host four times per `timeout` (but at most once a second) while nothing is under way. What
/// [`Lookout`] does not watch, the kernel gives up itself after 2 min or four timeouts.
///
/// # Errors
///
/// When it is no TCP connection.
pub fn ask_often(socket: &impl AsFd, timeout: Duration) -> io::Result<()> {
    let timeout = timeout.to_std();
    let quarter = std::time::Duration::from_secs((timeout.as_secs() / 4).max(1));
    sockopt::set_socket_keepalive(socket, true)?;
    sockopt::set_tcp_keepidle(socket, quarter)?;
    sockopt::set_tcp_keepintvl(socket, quarter)?;
    sockopt::set_tcp_keepcnt(socket, PROBES_MAX)?;
    let silence = UNACKNOWLEDGED_MIN.max(timeout * UNACKNOWLEDGED);
    let silence = u32::try_from(silence.as_millis()).unwrap_or(u32::MAX);
    sockopt::set_tcp_user_timeout(socket, silence)?;
    let quarter = u32::try_from(quarter.as_millis()).unwrap_or(u32::MAX);
    // Older kernels send again after ever longer times, which is found out later.
    let _older = ResendMax.set(socket, &quarter);
    Ok(())
}

/// Has the kernel forget what is under way when the socket is closed: nobody is there to take it.
///
/// # Errors
///
/// When it is no connection.
pub fn give_up(socket: &impl AsFd) -> io::Result<()> {
    Ok(sockopt::set_socket_linger(
        socket,
        Some(std::time::Duration::ZERO),
    )?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::{Read, Write};
    use std::net::{TcpListener, TcpStream};

    /// No test waits longer than this.
    const PATIENCE: std::time::Duration = std::time::Duration::from_secs(20);

    fn pair() -> (TcpStream, TcpStream) {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let ours = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        (ours, listener.accept().unwrap().0)
    }

    #[test]
    fn the_kernel_is_told_to_ask() {
        let (ours, _theirs) = pair();
        for (seconds, asks, gives_up) in [(10, 2, 120_000), (1, 1, 120_000), (60, 15, 240_000)] {
            ask_often(&ours, Duration::from_secs(seconds)).unwrap();
            assert!(sockopt::socket_keepalive(&ours).unwrap());
            let idle = sockopt::tcp_keepidle(&ours).unwrap().as_secs();
            assert_eq!(idle, asks, "{seconds} s");
            assert_eq!(sockopt::tcp_user_timeout(&ours).unwrap(), gives_up);
        }
    }

    #[test]
    fn what_comes_and_goes_is_counted() {
        let (mut ours, mut theirs) = pair();
        let before = traffic(ours.as_fd()).unwrap();
        ours.write_all(&[1]).unwrap();
        let mut byte = [0];
        theirs.read_exact(&mut byte).unwrap();
        theirs.write_all(&byte).unwrap();
        ours.read_exact(&mut byte).unwrap();
        let after = traffic(ours.as_fd()).unwrap();
        assert_eq!(after.asked, before.asked + 1);
        assert!(after.heard > before.heard, "{before:?} {after:?}");
    }

    /// A program that takes nothing for minutes is not lost: its host answers the probes of the closed window.
    #[test]
    fn a_closed_window_is_answered() {
        let (mut ours, _theirs) = pair();
        ours.set_nonblocking(true).unwrap();
        let piece = vec![0; 1 << 20];
        while ours.write(&piece).is_ok() {}
        let mut silence = Silence::new(Duration::from_secs(1));
        let mut look = |seconds: i64| {
            let now = PhysicalTime::from_nanos(0) + Duration::from_secs(seconds);
            let reading = Reading {
                host: IpAddr::from([10, 0, 0, 1]),
                connection: (),
                traffic: traffic(ours.as_fd()).unwrap(),
            };
            (silence.look(now, &[reading]), reading.traffic.heard)
        };
        let (_, mut heard) = look(0);
        for seconds in [2, 4, 6] {
            // The kernel probes after 0.2 s, then ever more rarely.
            let begun = std::time::Instant::now();
            while traffic(ours.as_fd()).unwrap().heard == heard {
                assert!(begun.elapsed() < PATIENCE, "no answer");
                std::thread::yield_now();
            }
            let (lost, now) = look(seconds);
            assert!(lost.is_empty(), "{lost:?}");
            heard = now;
        }
    }

    #[test]
    fn this_host_is_no_other() {
        let address = |text: &str| text.parse::<SocketAddr>().unwrap();
        let table = [
            ("127.0.0.1:1", "127.0.0.1:2", None),
            ("10.0.0.1:1", "10.0.0.1:2", None),
            ("10.0.0.1:1", "[::ffff:10.0.0.1]:2", None),
            ("10.0.0.1:1", "10.0.0.2:2", Some("10.0.0.2")),
        ];
        for (local, peer, expected) in table {
            let host = other_host(Ok(address(local)), address(peer));
            assert_eq!(host.map(|host| host.to_string()).as_deref(), expected);
        }
    }
}
