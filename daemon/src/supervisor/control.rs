//! The clients of a supervisor: request lines in, reply lines out, neither without bound.

use std::io::{self, Read, Write};
use std::os::unix::net::UnixStream;

use super::lines::Lines;
use super::protocol::{Reply, Request};

/// The longest request line.
const REQUEST_BYTES_MAX: usize = 4096;
/// What a client may leave unread before it is disconnected.
const UNREAD_BYTES_MAX: usize = 16 << 20;

/// One connection.
#[derive(Debug)]
pub(crate) struct Client {
    pub(crate) stream: UnixStream,
    /// Whether events are sent to it.
    pub(crate) subscribed: bool,
    lines: Lines,
    unsent: Vec<u8>,
}

/// The connection is of no more use: closed, broken or too slow.
#[derive(Debug)]
pub(crate) struct Closed;

impl Client {
    /// Takes a connection that was accepted.
    pub(crate) fn new(stream: UnixStream) -> io::Result<Self> {
        stream.set_nonblocking(true)?;
        let lines = Lines::new(REQUEST_BYTES_MAX);
        Ok(Self {
            stream,
            subscribed: false,
            lines,
            unsent: Vec::new(),
        })
    }

    /// Whether the socket should be watched for writing.
    pub(crate) fn has_unsent(&self) -> bool {
        !self.unsent.is_empty()
    }

    /// Reads what is there; lines that are no request are answered here.
    pub(crate) fn read(&mut self) -> Result<Vec<Request>, Closed> {
        let mut buffer = [0; REQUEST_BYTES_MAX];
        let count = match self.stream.read(&mut buffer) {
            Ok(0) => return Err(Closed),
            Ok(count) => count,
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => 0,
            Err(_) => return Err(Closed),
        };
        let mut requests = Vec::new();
        self.lines.push(&buffer[..count], |piece| {
            let whole = piece.whole && !piece.continued;
            requests.push(whole.then(|| serde_json::from_slice(piece.bytes)));
        });
        let mut understood = Vec::new();
        for request in requests {
            match request {
                Some(Ok(request)) => understood.push(request),
                Some(Err(error)) => self.send(&Reply::Refused {
                    why: error.to_string(),
                })?,
                None => return Err(Closed),
            }
        }
        Ok(understood)
    }

    /// Queues a reply and writes what the socket takes.
    pub(crate) fn send(&mut self, reply: &Reply) -> Result<(), Closed> {
        serde_json::to_writer(&mut self.unsent, reply).map_err(|_| Closed)?;
        self.unsent.push(b'\n');
        self.flush()
    }

    /// Writes what the socket takes.
    pub(crate) fn flush(&mut self) -> Result<(), Closed> {
        while !self.unsent.is_empty() {
            match self.stream.write(&self.unsent) {
                Ok(count) => {
                    self.unsent.drain(..count);
                }
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
                Err(_) => return Err(Closed),
            }
        }
        if self.unsent.len() > UNREAD_BYTES_MAX {
            Err(Closed)
        } else {
            Ok(())
        }
    }
}
