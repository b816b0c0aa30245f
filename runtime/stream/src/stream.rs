//! The two kinds of connection, used alike.

use crate::Member;
use crate::tls::{Tls, TlsError};
use std::io::{self, ErrorKind, Read, Write};

/// A non-blocking connection.
///
/// It is read and written as `T` is, but for this: under TLS bytes may wait in here for the socket to be writable
/// ([`Stream::owes`]), or be readable although the socket is not ([`Stream::has_more`]); and nothing is taken before both
/// ends have shown who they are, which reading brings about.
#[derive(Debug)]
pub struct Stream<T> {
    tcp: T,
    tls: Option<Box<Tls>>,
}

impl<T> Stream<T> {
    /// In the clear.
    pub const fn plain(tcp: T) -> Self {
        Self { tcp, tls: None }
    }

    pub(crate) fn secure(tcp: T, tls: Tls) -> Self {
        let tls = Some(Box::new(tls));
        Self { tcp, tls }
    }

    /// The socket.
    pub const fn tcp(&self) -> &T {
        &self.tcp
    }

    /// The socket, to be registered or set up; reading or writing it breaks the connection.
    pub const fn tcp_mut(&mut self) -> &mut T {
        &mut self.tcp
    }

    /// Whether both ends may write: in the clear always, else when they have shown who they are.
    #[must_use]
    pub fn is_open(&self) -> bool {
        self.tls.as_ref().is_none_or(|tls| tls.is_open())
    }

    /// Who is at the other end, once it has shown that; in the clear nobody knows.
    #[must_use]
    pub fn peer(&self) -> Option<Member> {
        self.tls.as_ref().and_then(|tls| tls.peer())
    }

    /// Why the connection failed, when it did by what TLS found.
    #[must_use]
    pub fn failure(&self) -> Option<&TlsError> {
        self.tls.as_ref().and_then(|tls| tls.failure())
    }

    /// Whether bytes, or the end, can be read although the socket has nothing.
    #[must_use]
    pub fn has_more(&self) -> bool {
        self.tls.as_ref().is_some_and(|tls| tls.has_more())
    }

    /// Whether something waits in here for the socket to be writable.
    #[must_use]
    pub fn owes(&self) -> bool {
        self.tls.as_ref().is_some_and(|tls| tls.owes())
    }

    /// Bytes that were taken by [`Stream::write`] and have perhaps not left; 0 when [`Stream::owes`] is false.
    #[must_use]
    pub fn owed(&self) -> usize {
        self.tls.as_ref().map_or(0, |tls| tls.owed())
    }
}

impl<T: Read + Write> Stream<T> {
    /// Reads what is there; 0 bytes: the other end says that nothing more comes. Under TLS less than `buffer` holds means
    /// that the socket is empty, unless [`Stream::has_more`].
    ///
    /// # Errors
    ///
    /// As the socket's. Under TLS [`ErrorKind::UnexpectedEof`]: the end came unsaid, perhaps from somebody in between;
    /// [`ErrorKind::InvalidData`] with a [`TlsError`]: the other end is not who it should be, or the bytes are not its.
    pub fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        match &mut self.tls {
            None => self.tcp.read(buffer),
            Some(tls) => tls.read(&mut self.tcp, buffer),
        }
    }

    /// Writes what is taken, at least a byte. What is taken leaves with this call or a later one of [`Stream::flush`].
    ///
    /// # Errors
    ///
    /// As the socket's; [`ErrorKind::WouldBlock`] also while [`Stream::is_open`] is false.
    pub fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match &mut self.tls {
            None => self.tcp.write(bytes),
            Some(tls) => tls.write(&mut self.tcp, bytes),
        }
    }

    /// Writes what waits in here.
    ///
    /// # Errors
    ///
    /// As the socket's; [`ErrorKind::WouldBlock`]: not all of it.
    pub fn flush(&mut self) -> io::Result<()> {
        match &mut self.tls {
            None => Ok(()),
            Some(tls) => tls.flush(&mut self.tcp),
        }
    }

    /// Says that nothing more will be written, after all that was; then the socket may be shut for writing.
    ///
    /// # Errors
    ///
    /// As [`Stream::flush`]: call it again when the socket is writable.
    pub fn finish(&mut self) -> io::Result<()> {
        match &mut self.tls {
            None => Ok(()),
            Some(tls) => tls.finish(&mut self.tcp),
        }
    }
}

/// Does it again when a signal came between.
pub(crate) fn uninterrupted<R>(mut call: impl FnMut() -> io::Result<R>) -> io::Result<R> {
    loop {
        match call() {
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            result => return result,
        }
    }
}
