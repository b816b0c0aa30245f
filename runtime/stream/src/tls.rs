//! TLS over a non-blocking socket.

use crate::Member;
use crate::credentials::owner;
use crate::stream::uninterrupted;
use rustls::{AlertDescription, CertificateError, Connection};
use std::fmt;
use std::io::{self, ErrorKind, Read, Write};
use thiserror::Error;

/// Bytes read from the socket at once.
const READ_BYTES: usize = 64 << 10;
/// Bytes encrypted at once; the next are taken when these have left.
const WRITE_BYTES: usize = 256 << 10;

/// In words: the end of a stream that nobody said.
const CUT: &str = "it was cut";

/// What TLS found wrong at the other end.
#[derive(Clone, PartialEq, Debug, Error)]
pub enum TlsError {
    /// It speaks something else.
    #[error("it does not speak TLS 1.3: `security` must be the same at both ends")]
    NotTls,
    /// It shows no certificate.
    #[error("it has no certificate")]
    NoCertificate,
    /// Its certificate was signed by another authority.
    #[error("its certificate is not of this run")]
    NotOfThisRun,
    /// Its certificate is another member's.
    #[error("its certificate is not {0}'s")]
    Another(Member),
    /// It has connected, and has the certificate of somebody who connects to nobody.
    #[error("its certificate is not a federate's")]
    NoFederate,
    /// It does not take what was shown to it.
    #[error("it refuses this end: {0}")]
    Refused(String),
    /// Anything else.
    #[error("TLS: {0}")]
    Other(rustls::Error),
}

impl TlsError {
    #[expect(
        clippy::wildcard_enum_match_arm,
        reason = "an enum that grows, and its own words for the rest"
    )]
    fn of(error: rustls::Error, expected: Option<Member>) -> Self {
        match error {
            rustls::Error::InvalidMessage(_) | rustls::Error::PeerIncompatible(_) => Self::NotTls,
            rustls::Error::NoCertificatesPresented => Self::NoCertificate,
            rustls::Error::InvalidCertificate(
                CertificateError::UnknownIssuer | CertificateError::BadSignature,
            ) => Self::NotOfThisRun,
            rustls::Error::InvalidCertificate(
                CertificateError::NotValidForName | CertificateError::NotValidForNameContext { .. },
            ) if expected.is_some() => expected.map_or(Self::NotOfThisRun, Self::Another),
            rustls::Error::AlertReceived(
                AlertDescription::ProtocolVersion | AlertDescription::HandshakeFailure,
            ) => Self::NotTls,
            rustls::Error::AlertReceived(alert) => Self::Refused(format!("{alert:?}")),
            error => Self::Other(error),
        }
    }
}

/// The state of TLS at one end.
pub(crate) struct Tls {
    connection: Connection,
    /// Whom we have connected to; nobody yet knows who was accepted.
    expected: Option<Member>,
    run: Box<str>,
    peer: Option<Member>,
    /// Read from the socket; `at..end` is not processed.
    incoming: Box<[u8]>,
    at: usize,
    end: usize,
    failure: Option<TlsError>,
    /// Whether the last read ended for another reason than that nothing was there.
    more: bool,
    owed: usize,
    finished: bool,
}

impl Tls {
    pub(crate) fn new(mut connection: Connection, expected: Option<Member>, run: &str) -> Self {
        // Ours bounds what is encrypted and waits.
        connection.set_buffer_limit(None);
        Self {
            connection,
            expected,
            run: run.into(),
            peer: None,
            incoming: vec![0; READ_BYTES].into(),
            at: 0,
            end: 0,
            failure: None,
            more: false,
            owed: 0,
            finished: false,
        }
    }

    pub(crate) fn is_open(&self) -> bool {
        self.peer.is_some()
    }

    pub(crate) const fn peer(&self) -> Option<Member> {
        self.peer
    }

    pub(crate) const fn failure(&self) -> Option<&TlsError> {
        self.failure.as_ref()
    }

    pub(crate) const fn has_more(&self) -> bool {
        self.more
    }

    pub(crate) fn owes(&self) -> bool {
        self.connection.wants_write()
    }

    pub(crate) fn owed(&self) -> usize {
        match self.owes() {
            // A last word counts as well.
            true => self.owed.max(1),
            false => 0,
        }
    }

    pub(crate) fn read(
        &mut self,
        tcp: &mut (impl Read + Write),
        buffer: &mut [u8],
    ) -> io::Result<usize> {
        let mut filled = 0;
        while filled < buffer.len() {
            match self.pull(tcp, &mut buffer[filled..]) {
                Ok(count @ 1..) => filled += count,
                end if filled == 0 => {
                    self.more = false;
                    return end;
                }
                end => {
                    // The end is told by the next call.
                    let nothing = |error: &io::Error| error.kind() == ErrorKind::WouldBlock;
                    self.more = !end.as_ref().is_err_and(nothing);
                    return Ok(filled);
                }
            }
        }
        self.more = true;
        Ok(filled)
    }

    /// Gives what is decrypted, or reads until something is.
    fn pull(&mut self, tcp: &mut (impl Read + Write), buffer: &mut [u8]) -> io::Result<usize> {
        loop {
            match self.connection.reader().read(buffer) {
                Err(error) if error.kind() == ErrorKind::WouldBlock => {}
                Err(error) if error.kind() == ErrorKind::UnexpectedEof => {
                    return Err(io::Error::new(ErrorKind::UnexpectedEof, CUT));
                }
                result => return result,
            }
            if let Some(failure) = &self.failure {
                return Err(io::Error::new(ErrorKind::InvalidData, failure.clone()));
            }
            self.feed(tcp)?;
        }
    }

    /// Hands bytes of the socket to TLS, and writes what it answers.
    fn feed(&mut self, tcp: &mut (impl Read + Write)) -> io::Result<()> {
        if self.at == self.end {
            let read = uninterrupted(|| tcp.read(&mut self.incoming))?;
            (self.at, self.end) = (0, read);
        }
        let mut rest = &self.incoming[self.at..self.end];
        // No bytes: the end of the stream.
        self.connection.read_tls(&mut rest)?;
        self.at = self.end - rest.len();
        if let Err(error) = self.connection.process_new_packets() {
            self.failure = Some(TlsError::of(error, self.expected));
        } else if self.peer.is_none() && !self.connection.is_handshaking() {
            self.meet();
        }
        // What the socket does not take now waits; whether it broke, reading tells.
        let _later = self.flush(tcp);
        Ok(())
    }

    /// Notes who the other end is.
    fn meet(&mut self) {
        let shown = self.connection.peer_certificates();
        let owner = shown.and_then(|shown| owner(shown.first()?));
        let member = owner.filter(|(_, run)| **run == *self.run);
        match (self.expected, member) {
            (None, Some((member @ Member::Federate(_), _))) => self.peer = Some(member),
            (Some(expected), Some((member, _))) if member == expected => self.peer = Some(member),
            (None, _) => self.failure = Some(TlsError::NoFederate),
            (Some(expected), _) => self.failure = Some(TlsError::Another(expected)),
        }
    }

    pub(crate) fn write(
        &mut self,
        tcp: &mut (impl Read + Write),
        bytes: &[u8],
    ) -> io::Result<usize> {
        if self.failure.is_some() {
            return Err(ErrorKind::BrokenPipe.into());
        }
        self.flush(tcp)?;
        if self.peer.is_none() {
            return Err(ErrorKind::WouldBlock.into());
        }
        let taken = &bytes[..bytes.len().min(WRITE_BYTES)];
        let taken = self.connection.writer().write(taken)?;
        self.owed = taken;
        match self.flush(tcp) {
            Err(error) if error.kind() != ErrorKind::WouldBlock => Err(error),
            Ok(()) | Err(_) => Ok(taken),
        }
    }

    pub(crate) fn flush(&mut self, tcp: &mut impl Write) -> io::Result<()> {
        while self.connection.wants_write() {
            if uninterrupted(|| self.connection.write_tls(tcp))? == 0 {
                return Err(ErrorKind::WriteZero.into());
            }
        }
        self.owed = 0;
        Ok(())
    }

    pub(crate) fn finish(&mut self, tcp: &mut impl Write) -> io::Result<()> {
        if !self.finished {
            self.finished = true;
            self.connection.send_close_notify();
        }
        self.flush(tcp)
    }
}

impl fmt::Debug for Tls {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Tls")
            .field("expected", &self.expected)
            .field("peer", &self.peer)
            .field("failure", &self.failure)
            .finish_non_exhaustive()
    }
}
