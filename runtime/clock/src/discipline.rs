//! Who disciplines the host's clock, and how well: ptp4l, chronyd, systemd-timesyncd, or what the kernel knows.
//!
//! Nothing here needs a privilege, and nothing waits longer than a tenth of a second for a service. What is said is of the
//! *system* clock, for all processes of the host alike.

use std::net::{Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::time::Duration as StdDuration;

use ictus_coord::report::{ClockSource, ClockStatus};
use ictus_core::Duration;

mod chrony;
mod kernel;
mod ptp;

/// A service that does not answer within this is not there.
const PATIENCE: StdDuration = StdDuration::from_millis(100);

/// What a time service, or the kernel, says of the system clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Discipline {
    /// Who says it.
    pub source: ClockSource,
    /// What would have to be added to the system clock.
    pub offset: Duration,
    /// How far the system clock may be off.
    ///
    /// - chrony: |system time offset| + root dispersion + root delay / 2, its own formula.
    /// - ptp4l: |offset from master| + mean path delay: all of the delay may be on one way.
    /// - timesyncd, kernel: the kernel's maximum error, which grows by 500 ppm between corrections.
    pub bound: Duration,
    /// Whether the source says that the clock is synchronized.
    pub synchronized: bool,
}

/// Where services are looked for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sources {
    /// chronyd's command port.
    pub chrony: SocketAddr,
    /// ptp4l's management socket.
    pub ptp4l: PathBuf,
    /// The file that systemd-timesyncd keeps while it is synchronized.
    pub timesyncd: PathBuf,
}

impl Default for Sources {
    fn default() -> Self {
        Self {
            chrony: SocketAddr::from((Ipv4Addr::LOCALHOST, 323)),
            ptp4l: PathBuf::from("/var/run/ptp4l"),
            timesyncd: PathBuf::from("/run/systemd/timesync/synchronized"),
        }
    }
}

impl Sources {
    /// Asks ptp4l, then chronyd, then looks for timesyncd, then takes what the kernel knows; `None`: not even that.
    ///
    /// A service that is there and not synchronized is passed over when the next one is.
    #[must_use]
    pub fn read(&self) -> Option<Discipline> {
        let ptp = || ptp::read(&self.ptp4l);
        let chrony = || chrony::read(self.chrony);
        let kernel = || {
            let mut kernel = kernel::read()?;
            if self.timesyncd.exists() {
                kernel.source = ClockSource::Timesyncd;
            }
            Some(kernel)
        };
        let mut first = None;
        let sources: [&dyn Fn() -> Option<Discipline>; 3] = [&ptp, &chrony, &kernel];
        for source in sources {
            match source() {
                Some(found) if found.synchronized => return Some(found),
                found => first = first.or(found),
            }
        }
        first
    }
}

impl Discipline {
    /// As a federate or a daemon reports it.
    #[must_use]
    pub fn status(&self) -> ClockStatus {
        ClockStatus {
            source: self.source,
            offset_ns: self.offset.as_nanos(),
            bound_ns: Some(self.bound.as_nanos()),
            synchronized: self.synchronized,
            ..ClockStatus::default()
        }
    }
}

/// The bytes at `at`.
fn bytes<const N: usize>(packet: &[u8], at: usize) -> Option<[u8; N]> {
    packet.get(at..)?.first_chunk::<N>().copied()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::net::UdpSocket;

    pub(super) fn unhex(text: &str) -> Vec<u8> {
        let digits: Vec<u8> = text
            .bytes()
            .filter(u8::is_ascii_hexdigit)
            .map(|digit| u8::from_str_radix(&char::from(digit).to_string(), 16).unwrap())
            .collect();
        digits
            .chunks(2)
            .map(|pair| pair[0] << 4 | pair[1])
            .collect()
    }

    fn nowhere(directory: &std::path::Path) -> (UdpSocket, Sources) {
        let silent = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        let sources = Sources {
            chrony: silent.local_addr().unwrap(),
            ptp4l: directory.join("ptp4l"),
            timesyncd: directory.join("synchronized"),
        };
        (silent, sources)
    }

    #[test]
    fn a_service_that_does_not_answer_is_not_there() {
        let directory = tempfile::tempdir().unwrap();
        let (_silent, sources) = nowhere(directory.path());
        assert_eq!(sources.read().unwrap().source, ClockSource::Kernel);
        std::fs::write(&sources.timesyncd, "").unwrap();
        assert_eq!(sources.read().unwrap().source, ClockSource::Timesyncd);
    }

    #[test]
    fn ptp4l_is_asked_over_its_socket() {
        let directory = tempfile::tempdir().unwrap();
        let (_silent, sources) = nowhere(directory.path());
        let server = std::os::unix::net::UnixDatagram::bind(&sources.ptp4l).unwrap();
        let answers = std::thread::spawn(move || {
            let mut packet = [0; 512];
            for _ in 0..2 {
                let (length, from) = server.recv_from(&mut packet).unwrap();
                let mut reply = packet[..length].to_vec();
                reply[46] = 2;
                reply.extend([0; 20]);
                // The port's state.
                reply[64] = 9;
                server.send_to_addr(&reply, &from).unwrap();
            }
        });
        let found = sources.read().unwrap();
        answers.join().unwrap();
        assert_eq!(found.source, ClockSource::Ptp4l);
        assert!(found.synchronized);
    }
}
