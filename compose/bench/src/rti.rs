//! The RTI alone: two bare sockets that speak the protocol, no runtime behind them.

use crate::floor::rate;
use crate::harness::{Bench, FEDERATION, Rti};
use ictus_coord::wire::{
    NO_CLOCK_SYNC, NeighborStructure, ToFederate, ToRti, encode_tagged_message,
};
use ictus_core::{Delay, PhysicalTime, Tag};
use std::io::{self, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::thread;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

struct Peer {
    stream: TcpStream,
    buffer: Vec<u8>,
    filled: usize,
}

impl Peer {
    fn join(port: u16, federate: u16, structure: NeighborStructure) -> io::Result<Self> {
        let stream = TcpStream::connect(("127.0.0.1", port))?;
        stream.set_nodelay(true)?;
        let mut peer = Self {
            stream,
            buffer: vec![0; 256 << 10],
            filled: 0,
        };
        let since_epoch = SystemTime::now()
            .duration_since(UNIX_EPOCH)
            .unwrap_or_default();
        let now = i64::try_from(since_epoch.as_nanos()).unwrap_or(0);
        peer.say(&[
            ToRti::FederateIds {
                federate,
                federation: FEDERATION.as_bytes(),
            },
            ToRti::NeighborStructure(structure),
            ToRti::UdpPort(NO_CLOCK_SYNC),
            ToRti::Timestamp(PhysicalTime::from_nanos(now)),
        ])?;
        Ok(peer)
    }

    fn say(&mut self, messages: &[ToRti<'_>]) -> io::Result<()> {
        let mut out = Vec::new();
        for message in messages {
            message.encode(&mut out);
        }
        self.stream.write_all(&out)
    }

    /// Reads until `take` returns something for a message.
    fn until<T>(&mut self, mut take: impl FnMut(&ToFederate<'_>) -> Option<T>) -> io::Result<T> {
        loop {
            let (mut used, mut found) = (0, None);
            while found.is_none() {
                match ToFederate::decode(&self.buffer[used..self.filled]) {
                    Ok(Some((message, length))) => {
                        used += length;
                        found = take(&message);
                    }
                    Ok(None) => break,
                    Err(error) => return Err(io::Error::other(error)),
                }
            }
            self.buffer.copy_within(used..self.filled, 0);
            self.filled -= used;
            if let Some(found) = found {
                return Ok(found);
            }
            let count = self.stream.read(&mut self.buffer[self.filled..])?;
            if count == 0 {
                return Err(io::Error::other("the RTI closed"));
            }
            self.filled += count;
        }
    }

    fn start(&mut self) -> io::Result<Tag> {
        self.until(|message| {
            let ToFederate::Timestamp(start) = message else {
                return None;
            };
            Some(Tag::at(start.as_nanos()))
        })
    }

    fn leave(mut self) -> io::Result<()> {
        self.say(&[ToRti::NextEventTag(Tag::FOREVER), ToRti::Resign])?;
        self.stream.shutdown(Shutdown::Write)?;
        io::copy(&mut self.stream, &mut io::sink()).map(|_| ())
    }
}

fn pair(port: u16) -> io::Result<(Peer, Peer, Tag)> {
    let down = NeighborStructure {
        upstream: Vec::new(),
        downstream: vec![1],
    };
    let up = NeighborStructure {
        upstream: vec![(0, Delay::None)],
        downstream: Vec::new(),
    };
    let (mut source, mut sink) = (Peer::join(port, 0, down)?, Peer::join(port, 1, up)?);
    let start = source.start()?;
    sink.start()?;
    Ok((source, sink, start))
}

fn after(start: Tag, nanos: u64) -> Tag {
    Tag::at(start.time.as_nanos() + i64::try_from(nanos).unwrap_or(0))
}

/// Messages a second through the RTI process, one a tag.
///
/// # Errors
///
/// When the RTI cannot be started or reached.
pub(crate) fn flood(bench: &Bench, messages: u64) -> io::Result<f64> {
    let rti = Rti::start(&bench.ictus, 2)?;
    let (mut source, mut sink, start) = pair(rti.port)?;
    let reader = thread::spawn(move || -> io::Result<Instant> {
        let (mut seen, mut told) = (0_u64, 0_u64);
        sink.say(&[ToRti::NextEventTag(start)])?;
        while seen < messages {
            let tag = sink.until(|message| {
                let ToFederate::TaggedMessage(message) = message else {
                    return None;
                };
                seen += 1;
                (seen == messages || seen - told >= 10_000).then_some(message.tag)
            })?;
            told = seen;
            sink.say(&[
                ToRti::LatestTagConfirmed(tag),
                ToRti::NextEventTag(Tag::FOREVER),
            ])?;
        }
        let end = Instant::now();
        sink.leave()?;
        Ok(end)
    });
    let begin = Instant::now();
    let mut out = Vec::with_capacity(64 << 10);
    for index in 0..messages {
        let tag = after(start, index * 1000);
        encode_tagged_message(0, 1, tag, &mut out, |out| {
            out.extend_from_slice(&index.to_le_bytes()[..4]);
        });
        if out.len() > 60 << 10 || index + 1 == messages {
            ToRti::NextEventTag(after(start, index * 1000 + 1000)).encode(&mut out);
            source.stream.write_all(&out)?;
            out.clear();
        }
    }
    source.leave()?;
    let end = reader
        .join()
        .map_err(|_| io::Error::other("the sink panicked"))??;
    rti.finish()?;
    Ok(rate(messages, end.duration_since(begin)))
}

/// From writing a NET to having read the TAG that it allows, in nanoseconds, sorted.
///
/// # Errors
///
/// When the RTI cannot be started or reached.
pub(crate) fn round_trips(bench: &Bench, count: u64) -> io::Result<Vec<u64>> {
    let rti = Rti::start(&bench.ictus, 2)?;
    let (mut source, mut sink, start) = pair(rti.port)?;
    sink.say(&[ToRti::NextEventTag(start)])?;
    source.say(&[ToRti::NextEventTag(start)])?;
    let mut trips = Vec::new();
    for index in 1..=count {
        let tag = after(start, index * 1000);
        let begin = Instant::now();
        source.say(&[ToRti::NextEventTag(tag)])?;
        sink.until(|message| {
            let ToFederate::TagAdvanceGrant(granted) = message else {
                return None;
            };
            (*granted >= tag.latest_earlier()).then_some(())
        })?;
        trips.push(u64::try_from(begin.elapsed().as_nanos()).unwrap_or(u64::MAX));
        sink.say(&[ToRti::NextEventTag(tag)])?;
    }
    source.leave()?;
    sink.leave()?;
    rti.finish()?;
    trips.sort_unstable();
    Ok(trips)
}
