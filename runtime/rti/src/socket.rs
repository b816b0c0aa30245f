//! One connection: bytes in to the state machine, bytes out of its output.

use std::io::ErrorKind;
use std::net::{IpAddr, Shutdown, SocketAddr};
use std::os::fd::{AsFd, BorrowedFd};

use ictus_clock::{HostClock, other_host};
use ictus_coord::rti::{Closing, ConnectionId, Disconnect, Output, Rti};
use ictus_stream::{Member, Stream};
use mio::net::TcpStream;

/// The most that is read from one socket before others have their turn (bytes).
pub(crate) const READ: usize = 256 << 10;
/// Leftovers up to this size are moved to the front of the shared buffer rather than read behind (bytes).
const SMALL: usize = 64 << 10;
/// The most that is read from a peer that we have taken leave of (bytes): it may be writing before it reads that.
const FAREWELL: usize = 4 << 20;

/// A connection's socket and what it has sent of an incomplete message.
#[derive(Debug)]
pub(crate) struct Socket {
    stream: Stream<TcpStream>,
    /// The federate whose certificate it has shown, once the state machine knows.
    certified: Option<u16>,
    /// The peer's host, when it is another one.
    host: Option<IpAddr>,
    leftover: Vec<u8>,
    /// More may be read without waiting for an event.
    pub(crate) readable: bool,
    /// The peer has closed its half, or the connection is broken: read to the end.
    pub(crate) read_to_end: bool,
    writing: Writing,
    /// The state machine takes leave of the peer.
    leaving: bool,
    /// Bytes read since then.
    farewell: usize,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Writing {
    Open,
    /// We have closed our half.
    Shut,
    /// The peer takes nothing any more; what comes from it still counts.
    Broken,
}

/// What a read came to.
pub(crate) enum Received {
    /// The connection goes on.
    Open,
    /// Everything up to its end was taken.
    Ended(Disconnect),
}

/// What a flush came to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Flushed {
    /// The connection goes on.
    Open,
    /// It is to be closed at once.
    Close,
}

impl Socket {
    pub(crate) fn new(stream: Stream<TcpStream>, peer: SocketAddr) -> Self {
        Self {
            host: other_host(stream.tcp().local_addr(), peer),
            stream,
            certified: None,
            leftover: Vec::new(),
            readable: true,
            read_to_end: false,
            writing: Writing::Open,
            leaving: false,
            farewell: 0,
        }
    }

    /// What is watched: the peer's host, when it is another one, and the socket.
    pub(crate) fn watched(&self) -> Option<(IpAddr, BorrowedFd<'_>)> {
        self.host.map(|host| (host, self.stream.tcp().as_fd()))
    }

    pub(crate) const fn stream_mut(&mut self) -> &mut TcpStream {
        self.stream.tcp_mut()
    }

    /// Reads once, at most [`READ`] bytes, and hands complete messages to the state machine with the time after
    /// that, by which clocks are compared. A peer that goes on sending
    /// after [`FAREWELL`] is read no more; the connection ends as soon as all is written.
    pub(crate) fn receive(
        &mut self,
        rti: &mut Rti,
        clock: &HostClock,
        id: ConnectionId,
        buffer: &mut [u8],
    ) -> Received {
        self.leaving = rti.output(id).closing() != Closing::Open;
        if self.farewell >= FAREWELL {
            self.readable = false;
            return match self.writing {
                Writing::Open => Received::Open,
                Writing::Shut | Writing::Broken => Received::Ended(Disconnect::Eof),
            };
        }
        if self.leftover.len() > SMALL {
            return self.receive_behind(rti, clock, id);
        }
        let kept = self.leftover.len();
        buffer[..kept].copy_from_slice(&self.leftover);
        let room = buffer.len() - kept;
        let result = self.stream.read(&mut buffer[kept..]);
        self.certify(rti, id);
        match self.judge(result, room) {
            Ok(0) => Received::Open,
            Ok(read) => {
                let bytes = &buffer[..kept + read];
                let taken = rti.receive(clock.now(), id, bytes);
                self.leftover.clear();
                self.leftover.extend_from_slice(&bytes[taken..]);
                Received::Open
            }
            Err(end) => Received::Ended(end),
        }
    }

    /// As [`Socket::receive`], for a message too long to be moved about.
    fn receive_behind(&mut self, rti: &mut Rti, clock: &HostClock, id: ConnectionId) -> Received {
        let kept = self.leftover.len();
        self.leftover.resize(kept + READ, 0);
        let result = self.stream.read(&mut self.leftover[kept..]);
        self.certify(rti, id);
        let judged = self.judge(result, READ);
        self.leftover
            .truncate(kept + judged.as_ref().map_or(0, |&read| read));
        match judged {
            Ok(0) => Received::Open,
            Ok(_) => {
                let taken = rti.receive(clock.now(), id, &self.leftover);
                self.leftover.drain(..taken);
                if self.leftover.len() <= SMALL {
                    self.leftover.shrink_to(SMALL);
                }
                Received::Open
            }
            Err(end) => Received::Ended(end),
        }
    }

    /// Tells the state machine who is there, before anything that it says. What waited for that is written.
    fn certify(&mut self, rti: &mut Rti, id: ConnectionId) {
        if let (None, Some(Member::Federate(federate))) = (self.certified, self.stream.peer()) {
            self.certified = Some(federate);
            rti.certify(id, federate);
            // Whether it is to be closed is found again when its turn to be written comes.
            let _later = self.flush(rti.output(id));
        }
    }

    /// Whether more can be read at once; 0 bytes: not now. A short read has emptied the socket, unless its end is near.
    fn judge(&mut self, result: std::io::Result<usize>, room: usize) -> Result<usize, Disconnect> {
        match result {
            Ok(0) => Err(Disconnect::Eof),
            Ok(read) => {
                self.readable = read == room || self.read_to_end || self.stream.has_more();
                if self.leaving {
                    self.farewell += read;
                }
                Ok(read)
            }
            Err(error) if error.kind() == ErrorKind::Interrupted => Ok(0),
            Err(error) if error.kind() == ErrorKind::WouldBlock => {
                self.readable = false;
                Ok(0)
            }
            Err(error) if error.kind() == ErrorKind::ConnectionReset => Err(Disconnect::Reset),
            Err(error) if error.kind() == ErrorKind::UnexpectedEof => Err(Disconnect::Cut),
            Err(error) if self.stream.failure().is_some() => {
                Err(Disconnect::Unfit(error.to_string()))
            }
            Err(error) => Err(Disconnect::Error(error.to_string())),
        }
    }

    /// Writes what the socket takes, one whole chunk a call, then closes as the state machine wants it.
    pub(crate) fn flush(&mut self, output: &mut Output) -> Flushed {
        if output.closing() == Closing::Now {
            return Flushed::Close;
        }
        while !output.chunk().is_empty() {
            if self.writing == Writing::Broken {
                output.advance(output.chunk().len());
                continue;
            }
            match self.stream.write(output.chunk()) {
                Ok(written) => output.advance(written),
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) if error.kind() == ErrorKind::WouldBlock => return Flushed::Open,
                Err(_) => self.give_up_writing(),
            }
        }
        if self.writing != Writing::Open {
            return Flushed::Open;
        }
        let last = output.closing() == Closing::AfterFlush;
        let left = match last {
            true => self.stream.finish(),
            false => self.stream.flush(),
        };
        match left {
            Err(error) if error.kind() == ErrorKind::WouldBlock => return Flushed::Open,
            Ok(()) if last => self.writing = Writing::Shut,
            Ok(()) => return Flushed::Open,
            Err(_) => self.give_up_writing(),
        }
        // A peer that is gone already needs no farewell.
        let _gone = self.stream.tcp().shutdown(Shutdown::Write);
        if last && self.farewell >= FAREWELL {
            return Flushed::Close;
        }
        Flushed::Open
    }

    /// What the peer sent before it went still counts: it is read on, to the end.
    const fn give_up_writing(&mut self) {
        self.writing = Writing::Broken;
        self.readable = true;
        self.read_to_end = true;
    }
}
