//! One channel in the hands of the thread that owns its session.

use std::io::{self, ErrorKind, Read as _, Write as _};
use std::sync::Arc;
use std::time::Duration;

use ssh2::{Channel, Error, ErrorCode};
use tokio::sync::{OwnedSemaphorePermit, oneshot};

use super::error::SshError;
use super::pipe::Pipe;
use super::worker::{Patience, Purpose, Refusal, Request};

/// Bytes of one write: what libssh2 puts into one packet.
const CHUNK: usize = 32_000;
/// How long a channel waits for the host to close its side.
const LINGER: Duration = Duration::from_secs(5);

/// libssh2's codes that matter here (libssh2.h).
const EAGAIN: i32 = -37;
const CHANNEL_FAILURE: i32 = -21;
const REQUEST_DENIED: i32 = -22;
const CHANNEL_CLOSED: i32 = -26;
const EOF_SENT: i32 = -27;

/// What one step brought.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Turn {
    /// Bytes moved or a state changed: another step may bring more.
    pub(super) moved: bool,
    /// It waits for room in the socket.
    pub(super) send: bool,
}

impl Turn {
    pub(super) fn moving() -> Self {
        Self {
            moved: true,
            send: false,
        }
    }

    pub(super) fn sending(send: bool) -> Self {
        Self { moved: false, send }
    }

    pub(super) fn and(self, other: Self) -> Self {
        Self {
            moved: self.moved || other.moved,
            send: self.send || other.send,
        }
    }
}

pub(super) fn would_block(error: &Error) -> bool {
    error.code() == ErrorCode::Session(EAGAIN)
}

/// Whether the session is over with it, and not only this channel.
pub(super) fn fatal(error: &Error) -> bool {
    let channel = [
        EAGAIN,
        CHANNEL_FAILURE,
        REQUEST_DENIED,
        CHANNEL_CLOSED,
        EOF_SENT,
    ];
    !channel
        .iter()
        .any(|code| error.code() == ErrorCode::Session(*code))
}

type Reply = oneshot::Sender<Result<Arc<Pipe>, Refusal>>;

enum Step {
    /// The command is being asked for.
    Starting(String, Option<Reply>),
    Flowing,
    Closing(Patience),
    Over,
}

/// What libssh2 may have begun to send for this channel, so that it must be called again before anything else.
#[derive(Clone, Copy, Debug, Default)]
struct Begun {
    /// A packet of the chunk.
    packet: bool,
    /// A widening of the window.
    window: bool,
}

/// A channel and where it is in its life.
pub(super) struct Slot {
    channel: Channel,
    pipe: Arc<Pipe>,
    host: String,
    step: Step,
    /// What libssh2 is writing: it must not change before it is through.
    chunk: Vec<u8>,
    written: usize,
    begun: Begun,
    eof_sent: bool,
    eof_seen: bool,
    _permit: OwnedSemaphorePermit,
}

impl Slot {
    pub(super) fn new(channel: Channel, pipe: Arc<Pipe>, request: Request, host: &str) -> Self {
        let step = match request.purpose {
            Purpose::Exec(command) => Step::Starting(command, Some(request.reply)),
            Purpose::Forward(..) => {
                answer(request.reply, &pipe);
                Step::Flowing
            }
        };
        Self {
            channel,
            pipe,
            host: host.to_owned(),
            step,
            chunk: Vec::new(),
            written: 0,
            begun: Begun::default(),
            eof_sent: false,
            eof_seen: false,
            _permit: request.permit,
        }
    }

    pub(super) fn is_over(&self) -> bool {
        matches!(self.step, Step::Over)
    }

    /// The session is lost.
    pub(super) fn fail(self, error: &SshError) {
        self.pipe.end(Err(error.clone()));
        if let Step::Starting(_, Some(reply)) = self.step {
            drop(reply.send(Err(Refusal::Failed(error.clone()))));
        }
    }

    /// Does what can be done without waiting. An error is the end of the session.
    pub(super) fn advance(&mut self, scratch: &mut [u8], writable: bool) -> Result<Turn, String> {
        match &mut self.step {
            Step::Starting(..) => self.start(writable),
            Step::Flowing => self.flow(scratch, writable),
            Step::Closing(patience) => {
                let late = patience.is_over();
                self.close(scratch, writable, late)
            }
            Step::Over => Ok(Turn::default()),
        }
    }

    fn start(&mut self, writable: bool) -> Result<Turn, String> {
        let Step::Starting(command, reply) = &mut self.step else {
            return Ok(Turn::default());
        };
        match self.channel.exec(command) {
            Ok(()) => {
                if let Some(reply) = reply.take() {
                    answer(reply, &self.pipe);
                }
                self.step = Step::Flowing;
            }
            Err(error) if would_block(&error) => return Ok(Turn::sending(!writable)),
            Err(error) if fatal(&error) => return Err(error.message().to_owned()),
            Err(error) => {
                let refused = SshError::Refused {
                    host: self.host.clone(),
                    what: format!("to run `{command}`"),
                    cause: error.message().to_owned(),
                };
                if let Some(reply) = reply.take() {
                    drop(reply.send(Err(Refusal::Failed(refused))));
                }
                self.step = Step::Closing(Patience::new(LINGER));
            }
        }
        Ok(Turn::moving())
    }

    fn flow(&mut self, scratch: &mut [u8], writable: bool) -> Result<Turn, String> {
        if self.pipe.is_abandoned() {
            self.step = Step::Closing(Patience::new(LINGER));
            return Ok(Turn::moving());
        }
        let turn = self.write(writable)?.and(self.read(scratch)?);
        if !self.eof_seen {
            return Ok(turn);
        }
        // The host has sent everything; the exit code comes until it closes.
        match self.channel.wait_close() {
            Ok(()) => {
                self.pipe.end(Ok(self.exit()));
                self.step = Step::Closing(Patience::new(LINGER));
                Ok(Turn::moving())
            }
            Err(error) if would_block(&error) => Ok(turn),
            Err(error) => Err(error.message().to_owned()),
        }
    }

    /// Exit code, or the signal: libssh2 gives code 0 for a command that a signal ended.
    fn exit(&self) -> (Option<i32>, Option<String>) {
        let signal = self
            .channel
            .exit_signal()
            .ok()
            .and_then(|signal| signal.exit_signal);
        let code = self.channel.exit_status().ok();
        (code.filter(|_| signal.is_none()), signal)
    }

    fn write(&mut self, writable: bool) -> Result<Turn, String> {
        let mut last = false;
        if self.chunk.is_empty() {
            last = self.pipe.take(&mut self.chunk, CHUNK);
        }
        if !self.chunk.is_empty() {
            return self.write_chunk();
        }
        if !last || self.eof_sent {
            return Ok(Turn::default());
        }
        if !writable {
            return Ok(Turn::sending(true));
        }
        match self.channel.send_eof() {
            Ok(()) => {
                self.eof_sent = true;
                Ok(Turn::moving())
            }
            Err(error) if would_block(&error) => Ok(Turn::sending(!writable)),
            Err(error) => Err(error.message().to_owned()),
        }
    }

    fn write_chunk(&mut self) -> Result<Turn, String> {
        match blocked(self.channel.write(&self.chunk[self.written..]))? {
            Some(count) if count > 0 => {
                self.begun.packet = false;
                self.written += count;
                if self.written == self.chunk.len() {
                    self.chunk.clear();
                    self.written = 0;
                }
                Ok(Turn::moving())
            }
            Some(_) | None => {
                // With the host's window closed nothing was begun: that waits for the host, not for the socket.
                self.begun.packet = self.channel.write_window().remaining > 0;
                Ok(Turn::sending(self.begun.packet))
            }
        }
    }

    fn read(&mut self, scratch: &mut [u8]) -> Result<Turn, String> {
        let mut turn = Turn::default();
        while let Some(count @ 1..) = blocked(self.channel.stderr().read(scratch))? {
            self.pipe.put_stderr(&scratch[..count]);
            turn.moved = true;
        }
        if self.eof_seen {
            return Ok(turn);
        }
        let room = self.pipe.room().min(scratch.len());
        if room == 0 {
            // Full: the transport is read all the same, into the windows of the channels.
            return match self.channel.wait_eof() {
                Ok(()) => Ok(turn),
                Err(error) if would_block(&error) => Ok(turn),
                Err(error) => Err(error.message().to_owned()),
            };
        }
        let read = blocked(self.channel.read(&mut scratch[..room]))?;
        self.begun.window = read.is_none();
        match read {
            Some(0) | None => {
                if self.channel.eof() {
                    self.eof_seen = true;
                    self.pipe.end_inbound();
                    turn.moved = true;
                }
            }
            Some(count) => {
                self.pipe.put(&scratch[..count]);
                turn.moved = true;
            }
        }
        Ok(turn)
    }

    fn close(&mut self, scratch: &mut [u8], writable: bool, late: bool) -> Result<Turn, String> {
        if self.begun.window {
            // One read to its end finishes what it may have begun; what comes is not wanted any more.
            self.begun.window = blocked(self.channel.read(scratch))?.is_none() && !writable;
            if self.begun.window {
                return Ok(Turn::sending(true));
            }
        }
        if self.begun.packet {
            return self.write_chunk();
        }
        if !writable && !late {
            return Ok(Turn::sending(true));
        }
        match self.channel.close() {
            Err(error) if would_block(&error) && !late => Ok(Turn::default()),
            Err(error) if fatal(&error) => Err(error.message().to_owned()),
            Ok(()) | Err(_) => {
                self.pipe.end(Ok((None, None)));
                self.step = Step::Over;
                Ok(Turn::moving())
            }
        }
    }
}

fn answer(reply: Reply, pipe: &Arc<Pipe>) {
    if reply.send(Ok(Arc::clone(pipe))).is_err() {
        // Who asked has gone.
        pipe.abandon();
    }
}

/// None when it would block; an error is the end of the session.
fn blocked(result: io::Result<usize>) -> Result<Option<usize>, String> {
    match result {
        Ok(count) => Ok(Some(count)),
        Err(error) if error.kind() == ErrorKind::WouldBlock => Ok(None),
        Err(error) => Err(error.to_string()),
    }
}
