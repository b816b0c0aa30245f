//! Floors: what the machine does with the same bytes or events when nothing orders them.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::hint::black_box;
use std::io::{self, BufWriter, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::thread;
use std::time::{Duration, Instant};

/// A tagged message with 4 bytes of payload.
const MESSAGE_BYTES: usize = 25;

/// A next event tag, or a grant.
const NET_BYTES: usize = 13;

/// Messages a second over loopback TCP, one direction.
///
/// # Errors
///
/// When loopback sockets cannot be had.
pub(crate) fn tcp(messages: u64, buffered: bool) -> io::Result<f64> {
    let listener = TcpListener::bind("127.0.0.1:0")?;
    let address = listener.local_addr()?;
    let sender = thread::spawn(move || -> io::Result<()> {
        let stream = connect(address)?;
        let capacity = if buffered { 64 << 10 } else { 0 };
        let mut out = BufWriter::with_capacity(capacity, stream);
        let message = [7; MESSAGE_BYTES];
        for _ in 0..messages {
            out.write_all(&message)?;
        }
        out.flush()
    });
    let (mut stream, _) = listener.accept()?;
    let begin = Instant::now();
    let mut buffer = vec![0; 256 << 10];
    let mut left = messages * MESSAGE_BYTES as u64;
    while left > 0 {
        match stream.read(&mut buffer)? {
            0 => break,
            count => left -= count as u64,
        }
    }
    let elapsed = begin.elapsed();
    sender
        .join()
        .map_err(|_| io::Error::other("the sender panicked"))??;
    Ok(rate(messages, elapsed))
}

/// One-way latencies over loopback TCP through one relay, a message every `period`, in nanoseconds, sorted.
///
/// The relay stands where the RTI does.
///
/// # Errors
///
/// When loopback sockets cannot be had.
pub(crate) fn relay_latency(messages: usize, period: Duration) -> io::Result<Vec<u64>> {
    let relay = TcpListener::bind("127.0.0.1:0")?;
    let sink = TcpListener::bind("127.0.0.1:0")?;
    let (to_relay, to_sink) = (relay.local_addr()?, sink.local_addr()?);
    let origin = Instant::now();
    let elapsed = move || u64::try_from(origin.elapsed().as_nanos()).unwrap_or(u64::MAX);
    let sender = thread::spawn(move || -> io::Result<()> {
        let mut stream = connect(to_relay)?;
        for _ in 0..messages {
            thread::sleep(period);
            let mut message = [0; MESSAGE_BYTES];
            message[..8].copy_from_slice(&elapsed().to_le_bytes());
            stream.write_all(&message)?;
        }
        Ok(())
    });
    let relay = thread::spawn(move || -> io::Result<()> {
        let (mut from, mut to) = (relay.accept()?.0, connect(to_sink)?);
        let mut message = [0; MESSAGE_BYTES];
        for _ in 0..messages {
            from.read_exact(&mut message)?;
            to.write_all(&message)?;
        }
        Ok(())
    });
    let (mut stream, _) = sink.accept()?;
    let mut latencies = Vec::with_capacity(messages);
    for _ in 0..messages {
        let mut message = [0; MESSAGE_BYTES];
        stream.read_exact(&mut message)?;
        let now = elapsed();
        let mut sent = [0; 8];
        sent.copy_from_slice(&message[..8]);
        latencies.push(now.saturating_sub(u64::from_le_bytes(sent)));
    }
    for thread in [sender, relay] {
        let panicked = |_| io::Error::other("a thread of the floor panicked");
        thread.join().map_err(panicked)??;
    }
    latencies.sort_unstable();
    Ok(latencies)
}

/// Times from writing a message to having read it behind one relay: what a NET and the TAG that it allows cost in bare
/// bytes, in nanoseconds, sorted.
///
/// # Errors
///
/// When loopback sockets cannot be had.
pub(crate) fn relay_trip(count: u64) -> io::Result<Vec<u64>> {
    let relay = TcpListener::bind("127.0.0.1:0")?;
    let address = relay.local_addr()?;
    let passer = thread::spawn(move || -> io::Result<()> {
        let (mut from, mut to) = (relay.accept()?.0, relay.accept()?.0);
        from.set_nodelay(true)?;
        to.set_nodelay(true)?;
        let mut message = [0; NET_BYTES];
        for _ in 0..count {
            from.read_exact(&mut message)?;
            to.write_all(&message)?;
        }
        Ok(())
    });
    let (mut first, mut second) = (connect(address)?, connect(address)?);
    let mut trips = Vec::new();
    let mut message = [0; NET_BYTES];
    for _ in 0..count {
        let begin = Instant::now();
        first.write_all(&message)?;
        second.read_exact(&mut message)?;
        trips.push(u64::try_from(begin.elapsed().as_nanos()).unwrap_or(u64::MAX));
    }
    let panicked = |_| io::Error::other("a thread of the floor panicked");
    passer.join().map_err(panicked)??;
    trips.sort_unstable();
    Ok(trips)
}

fn connect(address: SocketAddr) -> io::Result<TcpStream> {
    let stream = TcpStream::connect(address)?;
    stream.set_nodelay(true)?;
    Ok(stream)
}

/// Events a second through a bare heap of closures, `fan` events a time step.
#[must_use]
pub(crate) fn heap(events: u64, fan: u64) -> f64 {
    struct Event(u64, u64, Box<dyn Fn(u64) -> u64>);
    impl PartialEq for Event {
        fn eq(&self, other: &Self) -> bool {
            (self.0, self.1) == (other.0, other.1)
        }
    }
    impl Eq for Event {}
    impl PartialOrd for Event {
        fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
            Some(self.cmp(other))
        }
    }
    impl Ord for Event {
        fn cmp(&self, other: &Self) -> std::cmp::Ordering {
            (self.0, self.1).cmp(&(other.0, other.1))
        }
    }
    let mut heap = BinaryHeap::new();
    let push = |heap: &mut BinaryHeap<Reverse<Event>>, time: u64| {
        for branch in 0..fan {
            heap.push(Reverse(Event(time, branch, Box::new(move |x| x ^ branch))));
        }
    };
    push(&mut heap, 0);
    let begin = Instant::now();
    let (mut done, mut state) = (0, 0);
    while done < events {
        let Some(Reverse(Event(time, branch, body))) = heap.pop() else {
            break;
        };
        state = black_box(body(state));
        done += 1;
        if branch + 1 == fan {
            push(&mut heap, time + 1);
        }
    }
    rate(done, begin.elapsed())
}

/// Events a second.
#[must_use]
pub(crate) fn rate(count: u64, elapsed: Duration) -> f64 {
    #[expect(clippy::cast_precision_loss, reason = "a rate, to three digits")]
    let count = count as f64;
    count / elapsed.as_secs_f64().max(1e-9)
}
