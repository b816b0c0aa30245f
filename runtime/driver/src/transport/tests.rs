//! Connections over real sockets, in the clear and under TLS.

use super::*;
use ictus_stream::Authority;

/// No test needs longer.
const PATIENCE: Duration = Duration::from_secs(20);

struct World {
    listener: TcpListener,
    waker: Waker,
    signals: Signals,
}

impl World {
    fn new() -> Self {
        Self {
            listener: TcpListener::bind("127.0.0.1:0").unwrap(),
            waker: Waker::new().unwrap(),
            signals: Signals::new().unwrap(),
        }
    }

    fn wait(&self, connection: &Connection, has_output: bool) {
        let awaited = [Awaited::Connection(connection, has_output)];
        wait(
            awaited.into_iter(),
            &self.waker,
            &self.signals,
            Some(PATIENCE),
        )
        .unwrap();
    }

    /// One that connects, and one that accepts.
    fn pair(
        &self,
        from: Option<(&Credentials, Member)>,
        at: Option<&Credentials>,
    ) -> (Connection, Connection) {
        let address = self.listener.local_addr().unwrap();
        let near = Connection::open(address, PATIENCE, from).unwrap();
        let (far, peer) = self.listener.accept().unwrap();
        (near, Connection::accepted(far, peer, at).unwrap())
    }
}

fn credentials(authority: &Authority, member: Member) -> Credentials {
    Credentials::of(&authority.certify(member).unwrap()).unwrap()
}

/// Reads to the end and gives the number of bytes.
fn read_all(world: &World, connection: &mut Connection) -> usize {
    let mut all = 0;
    loop {
        connection.read();
        let count = connection.bytes().len();
        assert!(connection.bytes().iter().all(|byte| *byte == 7));
        connection.take(count);
        all += count;
        if connection.closed() {
            return all;
        }
        connection.write(&mut Vec::new());
        world.wait(connection, false);
    }
}

#[test]
fn a_peer_that_only_half_closed_gets_everything() {
    let (world, sent) = (World::new(), 32 << 20);
    let (mut near, far) = world.pair(None, None);
    let mut peer = far.stream.tcp().try_clone().unwrap();
    drop(far);
    peer.set_nonblocking(false).unwrap();
    peer.shutdown(Shutdown::Write).unwrap();
    while !near.closed() {
        world.wait(&near, false);
        near.read();
    }
    let mut out = vec![7; sent];
    near.write(&mut out);
    assert!(!out.is_empty(), "more than the socket takes");
    let reader = std::thread::spawn(move || io::copy(&mut peer, &mut io::sink()).unwrap());
    while !out.is_empty() {
        world.wait(&near, true);
        near.write(&mut out);
    }
    assert!(near.finish());
    assert_eq!(reader.join().unwrap(), sent as u64);
}

/// The same with certificates: each byte comes, the end is said, and waiting for either takes no processor.
#[test]
fn certificates_change_nothing_of_what_comes() {
    let (world, sent) = (World::new(), 32 << 20);
    let authority = Authority::new("run").unwrap();
    let federates = [3, 4].map(|id| credentials(&authority, Member::Federate(id)));
    let to = (&federates[0], Member::Federate(4));
    let (mut near, mut far) = world.pair(Some(to), Some(&federates[1]));
    let reader = std::thread::spawn(move || {
        let world = World::new();
        let count = read_all(&world, &mut far);
        let known = (far.certified(), far.cut(), far.failure().is_some());
        while !far.finish() {
            world.wait(&far, false);
            far.write(&mut Vec::new());
        }
        (count, known)
    });
    let mut out = vec![7; sent];
    let mut waits = 0;
    loop {
        near.read();
        near.write(&mut out);
        if out.is_empty() && near.finish() {
            break;
        }
        world.wait(&near, !out.is_empty());
        waits += 1;
        assert!(waits < 100_000, "waiting does not wait");
    }
    assert_eq!(near.owed(), 0);
    assert_eq!(read_all(&world, &mut near), 0);
    assert!(!near.cut());
    assert_eq!(near.certified(), Some(4));
    assert_eq!(reader.join().unwrap(), (sent, (Some(3), false, false)));
}

/// While nobody answers, what is to be written wakes nobody up.
#[test]
fn a_handshake_that_is_not_answered_is_waited_for() {
    let world = World::new();
    let authority = Authority::new("run").unwrap();
    let federate = credentials(&authority, Member::Federate(3));
    let (mut near, _far) = world.pair(Some((&federate, Member::Rti)), None);
    let mut out = vec![7; 10];
    near.write(&mut out);
    assert_eq!(out.len(), 10);
    assert!(near.read() && !near.closed());
    assert!(!near.wants_write(true));
    let brief = Duration::from_millis(1);
    let awaited = [Awaited::Connection(&near, true)];
    let signal = wait(
        awaited.into_iter(),
        &world.waker,
        &world.signals,
        Some(brief),
    );
    assert!(!signal.unwrap());
}

#[test]
fn an_end_without_a_last_word_is_a_cut() {
    let world = World::new();
    let authority = Authority::new("run").unwrap();
    let federates = [3, 4].map(|id| credentials(&authority, Member::Federate(id)));
    let to = (&federates[0], Member::Federate(4));
    let (mut near, mut far) = world.pair(Some(to), Some(&federates[1]));
    let mut out = vec![7; 10];
    while !out.is_empty() {
        near.read();
        near.write(&mut out);
        far.read();
    }
    drop(near);
    while !far.closed() {
        world.wait(&far, false);
        far.read();
    }
    assert_eq!(far.bytes(), [7; 10]);
    assert!(far.cut() && far.failure().is_none());
    // In the clear both ends look alike.
    let (near, mut far) = world.pair(None, None);
    drop(near);
    while !far.closed() {
        world.wait(&far, false);
        far.read();
    }
    assert!(!far.cut());
}
