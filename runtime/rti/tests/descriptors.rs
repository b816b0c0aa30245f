//! The server where hardly any descriptors are left. Alone in its process, for the limit.

#![allow(clippy::unwrap_used, missing_docs, reason = "a test")]

use std::io::{Read, Write};
use std::net::{Ipv4Addr, SocketAddrV4, TcpStream};
use std::os::fd::AsRawFd;
use std::time::Duration;

use ictus_coord::wire::{ToFederate, ToRti};
use ictus_rti::{Options, Server, Status};
use rustix::net::{AddressFamily, SocketType};
use rustix::process::{Resource, getrlimit, setrlimit};

/// Strangers, and descriptors for their connections.
const STRANGERS: usize = 40;
const LEFT: u64 = 10;

#[test]
fn the_last_descriptor_is_for_who_says_its_name() {
    let server = Server::bind(&Options::new("test", 1), Status::default()).unwrap();
    let address = SocketAddrV4::new(Ipv4Addr::LOCALHOST, server.port());
    let clients: Vec<_> = std::iter::repeat_with(|| {
        rustix::net::socket(AddressFamily::INET, SocketType::STREAM, None).unwrap()
    })
    .take(STRANGERS + 1)
    .collect();
    let mut limit = getrlimit(Resource::Nofile);
    let last = u64::try_from(clients.last().unwrap().as_raw_fd()).unwrap();
    limit.current = Some(last + 1 + LEFT);
    setrlimit(Resource::Nofile, limit).unwrap();
    let mut clients: Vec<TcpStream> = clients
        .into_iter()
        .map(|client| {
            rustix::net::connect(&client, &address).unwrap();
            TcpStream::from(client)
        })
        .collect();
    let mut hello = Vec::new();
    ToRti::FederateIds {
        federate: 0,
        federation: b"test",
    }
    .encode(&mut hello);
    let mut federate = clients.pop().unwrap();
    let patience = Some(Duration::from_secs(20));
    federate.set_read_timeout(patience).unwrap();
    federate.write_all(&hello).unwrap();
    let running = std::thread::spawn(move || server.run().unwrap());
    let mut answer = [0; 16];
    let read = federate.read(&mut answer).unwrap();
    assert_eq!(
        ToFederate::decode(&answer[..read]),
        Ok(Some((ToFederate::Ack, 1)))
    );
    drop(federate);
    assert_eq!(running.join().unwrap(), 1);
}
