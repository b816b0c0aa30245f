//! Status lines for whoever started this process (`--status-fd`).

use ictus_coord::report::FederateStatus;
use rustix::fs::OFlags;
use std::collections::VecDeque;
use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt;

/// Writes lines to an inherited descriptor without ever blocking: what does not fit waits, `progress` is dropped.
#[derive(Debug)]
pub(crate) struct Status {
    pipe: Option<File>,
    waiting: VecDeque<Vec<u8>>,
}

impl Status {
    /// Status for descriptor `fd`; `None` says nothing.
    pub(crate) fn new(fd: Option<u32>) -> io::Result<Self> {
        let open = |fd| {
            let flags = i32::try_from(OFlags::NONBLOCK.bits()).unwrap_or(0);
            OpenOptions::new()
                .write(true)
                .custom_flags(flags)
                .open(format!("/proc/self/fd/{fd}"))
        };
        Ok(Self {
            pipe: fd.map(open).transpose()?,
            waiting: VecDeque::new(),
        })
    }

    /// Whether anybody listens.
    pub(crate) fn enabled(&self) -> bool {
        self.pipe.is_some()
    }

    pub(crate) fn say(&mut self, status: &FederateStatus) {
        let droppable = matches!(status, FederateStatus::Progress { .. });
        if self.pipe.is_none() || (droppable && !self.waiting.is_empty()) {
            return;
        }
        if let Ok(mut line) = serde_json::to_vec(status) {
            line.push(b'\n');
            self.waiting.push_back(line);
        }
        self.flush();
        if droppable {
            self.waiting.clear();
        }
    }

    /// Tries to write what waits. Lines are shorter than a pipe's atomic size, so they go whole or not at all.
    fn flush(&mut self) {
        let Some(pipe) = &mut self.pipe else { return };
        while let Some(line) = self.waiting.front() {
            match pipe.write(line) {
                Ok(_) => {
                    self.waiting.pop_front();
                }
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return,
                Err(_) => {
                    self.pipe = None;
                    return;
                }
            }
        }
    }
}
