//! SIGTERM at the server: an ordered stop first, a failed federation then. Alone in its process.

#![allow(clippy::unwrap_used, missing_docs, reason = "a test")]

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use ictus_coord::wire::{NO_CLOCK_SYNC, NeighborStructure, ToFederate, ToRti};
use ictus_core::PhysicalTime;
use ictus_rti::{Options, Server, Status};
use signal_hook::consts::SIGTERM;
use signal_hook::low_level::raise;

fn read_until(stream: &mut TcpStream, unread: &mut Vec<u8>, start: &str) {
    loop {
        while let Some((message, length)) = ToFederate::decode(unread).unwrap() {
            let found = format!("{message:?}").starts_with(start);
            unread.drain(..length);
            if found {
                return;
            }
        }
        let mut buffer = [0; 4096];
        let read = stream.read(&mut buffer).unwrap();
        assert!(read > 0, "no {start} before the end");
        unread.extend_from_slice(&buffer[..read]);
    }
}

#[test]
fn one_signal_stops_two_fail() {
    let server = Server::bind(&Options::new("test", 1), Status::default())
        .unwrap()
        .with_signals()
        .unwrap();
    let mut stream = TcpStream::connect(("127.0.0.1", server.port())).unwrap();
    stream
        .set_read_timeout(Some(Duration::from_secs(20)))
        .unwrap();
    let running = std::thread::spawn(move || server.run().unwrap());
    let mut bytes = Vec::new();
    ToRti::FederateIds {
        federate: 0,
        federation: b"test",
    }
    .encode(&mut bytes);
    ToRti::NeighborStructure(NeighborStructure::default()).encode(&mut bytes);
    ToRti::UdpPort(NO_CLOCK_SYNC).encode(&mut bytes);
    ToRti::Timestamp(PhysicalTime::from_nanos(0)).encode(&mut bytes);
    stream.write_all(&bytes).unwrap();
    let mut unread = Vec::new();
    read_until(&mut stream, &mut unread, "Timestamp");
    raise(SIGTERM).unwrap();
    read_until(&mut stream, &mut unread, "StopRequest");
    raise(SIGTERM).unwrap();
    read_until(&mut stream, &mut unread, "Failed");
    drop(stream);
    assert_eq!(running.join().unwrap(), 1);
}
