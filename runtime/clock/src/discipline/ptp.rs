//! ptp4l's data sets, over its management socket.
//!
//! Source: IEEE 1588-2008, 15 (management messages); linuxptp `uds.c`.

use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::path::Path;
use std::sync::atomic::{AtomicU32, Ordering};

use ictus_coord::report::ClockSource;
use ictus_core::Duration;

use super::{Discipline, PATIENCE, bytes};

const MANAGEMENT: u8 = 0x0d;
const VERSION: u8 = 2;
const GET_LENGTH: u8 = 54;
const RESPONSE: u8 = 2;
const MANAGEMENT_TLV: u16 = 1;
const CURRENT_DATA_SET: u16 = 0x2001;
const PORT_DATA_SET: u16 = 0x2004;
/// Where the TLV is, and what it holds.
const TLV: usize = 48;
const DATA: usize = 54;
const SLAVE: u8 = 9;
/// Replies that are read at most: a boundary clock has many ports.
const REPLIES: usize = 64;

/// What the ptp4l that listens at `path` says, when there is one.
pub(super) fn read(path: &Path) -> Option<Discipline> {
    static NEXT: AtomicU32 = AtomicU32::new(0);
    if !path.exists() {
        return None;
    }
    // An address without a file: nothing is left behind.
    let number = NEXT.fetch_add(1, Ordering::Relaxed);
    let name = format!("ictus-ptp-{}-{number}", std::process::id());
    let socket = UnixDatagram::bind_addr(&SocketAddr::from_abstract_name(name).ok()?).ok()?;
    socket.set_read_timeout(Some(PATIENCE)).ok()?;
    socket.set_write_timeout(Some(PATIENCE)).ok()?;
    let current = ask(&socket, path, CURRENT_DATA_SET, current)?;
    // Of several ports one at most follows a master; the first to say so is it.
    let follows = |packet: &[u8]| (port_state(packet)? == SLAVE).then_some(());
    let synchronized = ask(&socket, path, PORT_DATA_SET, follows).is_some();
    Some(Discipline {
        synchronized,
        ..current
    })
}

/// The first of the replies that `take` takes.
fn ask<T>(
    socket: &UnixDatagram,
    path: &Path,
    what: u16,
    take: impl Fn(&[u8]) -> Option<T>,
) -> Option<T> {
    socket.send_to(&get(what), path).ok()?;
    let mut packet = [0; 512];
    for _ in 0..REPLIES {
        let length = socket.recv(&mut packet).ok()?;
        if let Some(taken) = take(&packet[..length]) {
            return Some(taken);
        }
    }
    None
}

fn get(what: u16) -> [u8; GET_LENGTH as usize] {
    let mut packet = [0; GET_LENGTH as usize];
    packet[0] = MANAGEMENT;
    packet[1] = VERSION;
    packet[3] = GET_LENGTH;
    // Our port; then the sequence, the control field and the interval of a management message.
    packet[29] = 1;
    packet[32] = 4;
    packet[33] = 0x7f;
    // To all ports of all clocks that hear it; hops and action are 0.
    packet[34..44].fill(0xff);
    packet[TLV..TLV + 2].copy_from_slice(&MANAGEMENT_TLV.to_be_bytes());
    packet[TLV + 3] = 2;
    packet[TLV + 4..DATA].copy_from_slice(&what.to_be_bytes());
    packet
}

fn is_response(packet: &[u8], what: u16) -> Option<()> {
    let half = |at| bytes(packet, at).map(u16::from_be_bytes);
    let management = packet.first()? & 0x0f == MANAGEMENT && packet.get(46)? & 0x0f == RESPONSE;
    let wanted = half(TLV)? == MANAGEMENT_TLV && half(TLV + 4)? == what;
    (management && wanted).then_some(())
}

fn current(packet: &[u8]) -> Option<Discipline> {
    is_response(packet, CURRENT_DATA_SET)?;
    // Nanoseconds times 2^16.
    let interval = |at| bytes(packet, at).map(i64::from_be_bytes);
    let (offset, delay) = (interval(DATA + 2)? >> 16, interval(DATA + 10)? >> 16);
    let bound = offset
        .saturating_abs()
        .saturating_add(delay.saturating_abs());
    Some(Discipline {
        source: ClockSource::Ptp4l,
        offset: Duration::from_nanos(offset.saturating_neg()),
        bound: Duration::from_nanos(bound.saturating_add(1)),
        synchronized: false,
    })
}

fn port_state(packet: &[u8]) -> Option<u8> {
    is_response(packet, PORT_DATA_SET)?;
    packet.get(DATA + 10).copied()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::discipline::tests::unhex;

    /// linuxptp 3.1, alone on its network.
    const CURRENT: &str = "0d0200480000000000000000000000000000000002fc00fffe00000100000000047f000000000000\
        0000000100000200000100142001000000000000000000000000000000000000";
    const PORT: &str = "0d0200500000000000000000000000000000000002fc00fffe00000100010001047f000000000000\
        00000001000002000001001c200402fc00fffe000001000106000000000000000000010300010002";

    #[test]
    fn recorded_data_sets_are_read() {
        let mut packet = unhex(CURRENT);
        let report = current(&packet).unwrap();
        assert_eq!(
            (report.offset, report.bound.as_nanos()),
            (Duration::ZERO, 1)
        );
        packet[DATA + 2..DATA + 10].copy_from_slice(&(-1_500_i64 << 16).to_be_bytes());
        packet[DATA + 10..DATA + 18].copy_from_slice(&(20_000_i64 << 16).to_be_bytes());
        let report = current(&packet).unwrap();
        assert_eq!(report.offset, Duration::from_nanos(1_500));
        assert_eq!(report.bound, Duration::from_nanos(21_501));
        assert_eq!(port_state(&unhex(PORT)), Some(6));
    }

    #[test]
    fn anything_else_is_no_data_set() {
        let good = unhex(CURRENT);
        for length in 0..good.len() {
            let cut = current(&good[..length]);
            assert!(cut.is_none() || length >= DATA + 18, "{length} bytes");
        }
        assert_eq!(port_state(&good), None);
        assert_eq!(current(&unhex(PORT)), None);
    }

    #[test]
    fn the_question_is_what_pmc_asks() {
        let question = get(CURRENT_DATA_SET);
        assert_eq!((question[0], question[1], question.len()), (0x0d, 2, 54));
        assert_eq!(question[TLV..], [0, 1, 0, 2, 0x20, 1]);
    }
}
