//! chronyd's tracking report, over its command port.
//!
//! Source: chrony `candm.h` (protocol 6), `util.c` for its floating-point format.

use std::net::{Ipv4Addr, SocketAddr, UdpSocket};

use ictus_coord::report::ClockSource;
use ictus_core::Duration;

use super::{Discipline, PATIENCE, bytes};

const VERSION: u8 = 6;
const REQUEST: u8 = 1;
const REPLY: u8 = 2;
const TRACKING: u16 = 33;
const TRACKING_REPLY: u16 = 5;
/// A request is as long as its reply, so that nobody can be flooded by asking for it.
const LENGTH: usize = 104;
const LEAP_UNSYNCHRONIZED: u16 = 3;

/// What chronyd at `address` says, when there is one.
pub(super) fn read(address: SocketAddr) -> Option<Discipline> {
    let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).ok()?;
    socket.connect(address).ok()?;
    socket.set_read_timeout(Some(PATIENCE)).ok()?;
    socket.send(&request()).ok()?;
    let mut packet = [0; 2 * LENGTH];
    let length = socket.recv(&mut packet).ok()?;
    parse(&packet[..length])
}

fn request() -> [u8; LENGTH] {
    let mut request = [0; LENGTH];
    request[0] = VERSION;
    request[1] = REQUEST;
    request[4..6].copy_from_slice(&TRACKING.to_be_bytes());
    request
}

fn parse(packet: &[u8]) -> Option<Discipline> {
    let half = |at| bytes(packet, at).map(u16::from_be_bytes);
    let is_reply = packet.first() == Some(&VERSION) && packet.get(1) == Some(&REPLY);
    let succeeded = half(8)? == 0;
    if !is_reply || half(4)? != TRACKING || half(6)? != TRACKING_REPLY || !succeeded {
        return None;
    }
    let reference: [u8; 4] = bytes(packet, 28)?;
    let leap = half(54)?;
    let (offset, delay, dispersion) = (
        seconds(packet, 68)?,
        seconds(packet, 92)?,
        seconds(packet, 96)?,
    );
    Some(Discipline {
        source: ClockSource::Chrony,
        offset: duration(offset)?,
        bound: duration(offset.abs() + dispersion.abs() + delay.abs() / 2.0)?,
        synchronized: leap != LEAP_UNSYNCHRONIZED && reference != [0; 4],
    })
}

/// A number with a sign of its own in an exponent of 7 bits and a coefficient of 25.
fn seconds(packet: &[u8], at: usize) -> Option<f64> {
    let number = i32::from_be_bytes(bytes(packet, at)?);
    let exponent = (number >> 25) - 25;
    let coefficient = (number << 7) >> 7;
    Some(f64::from(coefficient) * f64::from(exponent).exp2())
}

/// `None` when it is more than a span can hold: such a report says nothing.
#[expect(
    clippy::cast_possible_truncation,
    reason = "within 2^53 ns, as is checked"
)]
fn duration(seconds: f64) -> Option<Duration> {
    let nanos = seconds * 1e9;
    (nanos.abs() < 9e15).then(|| Duration::from_nanos(nanos.ceil() as i64))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::discipline::tests::unhex;

    /// chronyd 4.3, a client of another over loopback; `chronyc tracking` said: 1.13 us fast, root delay 5.2 us, root
    /// dispersion 0.6 us.
    const SYNCHRONIZED: &str = "060200000021000500000000000000001234567800000000000000007f0000017f000001\
        0000000000000000000000000001000000030000000000006b02c1920cbec85bdd64595cc8ba2ac6d889da71faf6605b\
        f6923dce02a83d38e0adbeaede92f70efe937a15";
    /// chronyd 4.3, its own clock declared a reference of stratum 8.
    const LOCAL: &str = "060200000021000500000000000000001234567800000000000000007f7f0101000000000000000000\
        000000000000000000000000080000000000006b02c17c148eaf6f0000000000000000000000000000000000000000\
        00000000000000000000000000000000";

    #[test]
    fn recorded_reports_are_read() {
        let report = parse(&unhex(SYNCHRONIZED)).unwrap();
        assert_eq!(report.source, ClockSource::Chrony);
        assert!(report.synchronized);
        assert!((-2_000..-1_000).contains(&report.offset.as_nanos()));
        let bound = report.bound.as_nanos();
        assert!((3_000..9_000).contains(&bound), "{bound}");
        let report = parse(&unhex(LOCAL)).unwrap();
        assert!(report.synchronized && report.bound == Duration::ZERO);
    }

    #[test]
    fn anything_else_is_no_report() {
        let good = unhex(SYNCHRONIZED);
        for length in 0..100 {
            assert_eq!(parse(&good[..length]), None, "{length} bytes");
        }
        for (at, byte) in [(0, 5), (1, 1), (5, 14), (7, 1), (9, 2)] {
            let mut bad = good.clone();
            bad[at] = byte;
            assert_eq!(parse(&bad), None, "byte {at}");
        }
        let mut unsynchronized = good;
        unsynchronized[55] = 3;
        assert!(!parse(&unsynchronized).unwrap().synchronized);
    }
}
