//! Floors: what the machine does with the same bytes or events when nothing orders them.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::hint::black_box;
use std::io::{self, BufWriter, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::thread;
use std::time::{Duration, Instant};

/// A tagged message with 4 bytes of payload.
const MESSAGE_BYTES: usize = 25;

/// Messages a second over loopback TCP, one direction.
///
/// # Errors
///
/// When loopback sockets cannot be had.
pub(crate) fn tcp(messages: u64, buffered: bool) -> io::Result<f64> {
    let listener = TcpListener::bind("127.0.0.1:0")?;
    let address = listener.local_addr()?;
    let sender = thread::spawn(move || -> io::Result<()> {
        let stream = TcpStream::connect(address)?;
        stream.set_nodelay(true)?;
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

/// One-way latencies over loopback TCP, a message every `period`, in nanoseconds, sorted.
///
/// # Errors
///
/// When loopback sockets cannot be had.
pub(crate) fn tcp_latency(messages: usize, period: Duration) -> io::Result<Vec<u64>> {
    let listener = TcpListener::bind("127.0.0.1:0")?;
    let address = listener.local_addr()?;
    let origin = Instant::now();
    let sender = thread::spawn(move || -> io::Result<()> {
        let mut stream = TcpStream::connect(address)?;
        stream.set_nodelay(true)?;
        for _ in 0..messages {
            thread::sleep(period);
            let mut message = [0; MESSAGE_BYTES];
            let nanos = u64::try_from(origin.elapsed().as_nanos()).unwrap_or(u64::MAX);
            message[..8].copy_from_slice(&nanos.to_le_bytes());
            stream.write_all(&message)?;
        }
        Ok(())
    });
    let (mut stream, _) = listener.accept()?;
    let mut latencies = Vec::with_capacity(messages);
    for _ in 0..messages {
        let mut message = [0; MESSAGE_BYTES];
        stream.read_exact(&mut message)?;
        let now = u64::try_from(origin.elapsed().as_nanos()).unwrap_or(u64::MAX);
        let mut sent = [0; 8];
        sent.copy_from_slice(&message[..8]);
        latencies.push(now.saturating_sub(u64::from_le_bytes(sent)));
    }
    sender
        .join()
        .map_err(|_| io::Error::other("the sender panicked"))??;
    latencies.sort_unstable();
    Ok(latencies)
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
