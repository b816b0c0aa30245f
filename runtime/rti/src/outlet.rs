//! A descriptor that is written to without waiting for its reader.

use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::os::fd::AsFd;
use std::os::unix::fs::{FileTypeExt, OpenOptionsExt};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::OFlags;

/// What a descriptor that says it is ready takes without waiting (bytes): `PIPE_BUF`.
const ATOMIC: usize = 4096;

/// A descriptor and what it has not taken yet.
#[derive(Debug)]
pub(crate) struct Outlet {
    /// Gone once its reader is.
    file: Option<File>,
    unwritten: Vec<u8>,
}

impl Outlet {
    pub(crate) const fn new(file: File) -> Self {
        Self {
            file: Some(file),
            unwritten: Vec::new(),
        }
    }

    /// An inherited descriptor, opened anew, so that non-blocking mode stays ours alone.
    pub(crate) fn reopen(descriptor: u32) -> io::Result<Self> {
        let flags = OFlags::NONBLOCK.union(OFlags::NOCTTY).bits();
        OpenOptions::new()
            .write(true)
            .custom_flags(i32::try_from(flags).unwrap_or(0))
            .open(format!("/dev/fd/{descriptor}"))
            .map(Self::new)
    }

    /// Standard error; gone when it is closed.
    pub(crate) fn stderr() -> Self {
        let shared = io::stderr().as_fd().try_clone_to_owned().map(File::from);
        let kind = shared.as_ref().ok().and_then(|file| file.metadata().ok());
        // A file opened anew would be written from its start.
        let opened_anew = kind
            .map(|kind| kind.file_type())
            .filter(|kind| kind.is_fifo() || kind.is_char_device())
            .and_then(|_| Self::reopen(2).ok());
        opened_anew.unwrap_or_else(|| Self {
            file: shared.ok(),
            unwritten: Vec::new(),
        })
    }

    /// Bytes not yet written.
    pub(crate) const fn pending(&self) -> usize {
        self.unwritten.len()
    }

    /// Appends a line; [`Outlet::flush`] writes it.
    pub(crate) fn push(&mut self, line: &str) {
        if self.file.is_some() {
            self.unwritten.extend_from_slice(line.as_bytes());
            self.unwritten.push(b'\n');
        }
    }

    /// Writes what the descriptor takes now; a reader that is gone is forgotten.
    pub(crate) fn flush(&mut self) {
        while self.pending() > 0 && self.is_ready(Duration::ZERO) {
            let Some(file) = &mut self.file else { break };
            let next = &self.unwritten[..self.unwritten.len().min(ATOMIC)];
            match file.write(next) {
                Ok(written) => drop(self.unwritten.drain(..written)),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return,
                Err(_) => {
                    self.file = None;
                    self.unwritten.clear();
                }
            }
        }
    }

    /// As [`Outlet::flush`], and waits until `deadline` for a reader that is behind.
    pub(crate) fn finish(&mut self, deadline: Instant) {
        loop {
            self.flush();
            let left = deadline.saturating_duration_since(Instant::now());
            if self.pending() == 0 || left.is_zero() || !self.is_ready(left) {
                return;
            }
        }
    }

    fn is_ready(&self, patience: Duration) -> bool {
        let Some(file) = &self.file else { return false };
        let patience = Timespec::try_from(patience).ok();
        let mut waiting = [PollFd::new(file, PollFlags::OUT)];
        // An error is told by the write.
        match poll(&mut waiting, patience.as_ref()) {
            Ok(number) => number > 0,
            Err(error) => error == rustix::io::Errno::INTR && patience.is_some(),
        }
    }
}
