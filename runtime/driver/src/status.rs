//! Status lines for whoever started this process (`--status-fd`).

use ictus_coord::measure::Measures;
use ictus_coord::report::{self, FederateStatus};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::OFlags;
use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType, connect, socket_with};
use std::collections::VecDeque;
use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// How often it is looked whether somebody listens on the socket.
const LOOK_EVERY: Duration = Duration::from_millis(500);
/// Lines that wait for a reader that does not read; later ones are dropped.
const WAITING_MAX: usize = 1024;
/// How long the last line may wait for each bit of room.
const LAST_ROOM_MAX: Timespec = Timespec {
    tv_sec: 1,
    tv_nsec: 0,
};

/// Writes lines to an inherited descriptor without ever blocking: what does not fit waits; what is told again in a second
/// (progress, measures, the clock) is dropped. Only the last line, when nothing runs any more, waits for room for a while.
#[derive(Debug)]
pub(crate) struct Status {
    pipe: Option<File>,
    socket: Option<Socket>,
    waiting: VecDeque<Vec<u8>>,
    /// Bytes of the first waiting line that were written already.
    written: usize,
}

/// A Unix socket on which somebody may listen, now or later.
#[derive(Debug)]
struct Socket {
    path: PathBuf,
    /// When to look again.
    again: Instant,
}

impl Socket {
    /// Connects without waiting.
    fn connect(&mut self) -> Option<File> {
        self.again = Instant::now() + LOOK_EVERY;
        let address = SocketAddrUnix::new(&self.path).ok()?;
        let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
        let socket = socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None).ok()?;
        connect(&socket, &address).ok()?;
        Some(File::from(socket))
    }
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
            socket: None,
            waiting: VecDeque::new(),
            written: 0,
        })
    }

    /// Status for whoever listens on a Unix socket; looked for again while nobody does.
    pub(crate) fn to_socket(path: &Path) -> Self {
        let mut socket = Socket {
            path: path.to_path_buf(),
            again: Instant::now(),
        };
        Self {
            pipe: socket.connect(),
            socket: Some(socket),
            waiting: VecDeque::new(),
            written: 0,
        }
    }

    /// Whether anybody listens, or may.
    pub(crate) fn enabled(&self) -> bool {
        self.pipe.is_some() || self.socket.is_some()
    }

    pub(crate) fn say(&mut self, status: &FederateStatus) {
        let line = || serde_json::to_vec(status).ok();
        match status {
            FederateStatus::Progress { .. }
            | FederateStatus::Measures { .. }
            | FederateStatus::Upstream { .. }
            | FederateStatus::Downstream { .. }
            | FederateStatus::Clock { .. } => {
                if self.has_room()
                    && let Some(mut line) = line()
                {
                    line.push(b'\n');
                    self.offer(line);
                }
            }
            FederateStatus::Joined { .. }
            | FederateStatus::Start { .. }
            | FederateStatus::Running { .. }
            | FederateStatus::StpViolation { .. }
            | FederateStatus::FallingBehind { .. }
            | FederateStatus::CaughtUp { .. }
            | FederateStatus::ClockStep { .. } => self.keep(line()),
            FederateStatus::Ended { .. } => {
                self.keep(line());
                self.finish();
            }
        }
    }

    /// Says all measures, as far as there is room.
    pub(crate) fn say_measures(&mut self, federate: &str, measures: &Measures) {
        if !self.has_room() {
            return;
        }
        for line in report::lines(federate, measures) {
            self.offer(line);
        }
    }

    /// Whether somebody listens and reads.
    fn has_room(&mut self) -> bool {
        self.look_for_listener();
        self.flush();
        self.pipe.is_some() && self.waiting.is_empty()
    }

    /// Finds somebody on the socket again.
    fn look_for_listener(&mut self) {
        if let (None, Some(socket)) = (&self.pipe, &mut self.socket)
            && socket.again <= Instant::now()
        {
            self.pipe = socket.connect();
        }
    }

    /// Writes a line if there is room now, and forgets it otherwise; a line that was begun is written to its end.
    fn offer(&mut self, line: Vec<u8>) {
        if !self.has_room() {
            return;
        }
        self.waiting.push_back(line);
        self.flush();
        if self.written == 0 {
            self.waiting.clear();
        }
    }

    /// Writes a line when there is room for it.
    fn keep(&mut self, line: Option<Vec<u8>>) {
        if self.pipe.is_none() {
            return;
        }
        if let Some(mut line) = line
            && self.waiting.len() < WAITING_MAX
        {
            line.push(b'\n');
            self.waiting.push_back(line);
        }
        self.flush();
    }

    /// Waits until everything is written, or the reader has not read for a while.
    fn finish(&mut self) {
        while let (Some(pipe), false) = (&self.pipe, self.waiting.is_empty()) {
            let mut fds = [PollFd::new(pipe, PollFlags::OUT)];
            match poll(&mut fds, Some(&LAST_ROOM_MAX)) {
                Ok(0) => return,
                Ok(_) => {
                    let before = (self.waiting.len(), self.written);
                    self.flush();
                    if before == (self.waiting.len(), self.written) {
                        // Room, but not for this line.
                        return;
                    }
                }
                Err(rustix::io::Errno::INTR) => {}
                Err(_) => return,
            }
        }
    }

    /// Tries to write what waits. Lines are shorter than a pipe's atomic size, so they go whole or not at all;
    /// should one be longer, its rest goes next.
    fn flush(&mut self) {
        let Some(pipe) = &mut self.pipe else { return };
        while let Some(line) = self.waiting.front() {
            match pipe.write(line.get(self.written..).unwrap_or_default()) {
                Ok(count) => {
                    self.written += count;
                    if self.written >= line.len() {
                        self.written = 0;
                        self.waiting.pop_front();
                    }
                }
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(_) => {
                    self.pipe = None;
                    self.waiting.clear();
                    self.written = 0;
                    return;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::Status;
    use ictus_coord::measure::Measures;
    use ictus_coord::report::FederateStatus;
    use ictus_core::Duration;
    use std::io::Read;
    use std::os::fd::AsRawFd;

    fn pipe() -> (std::io::PipeReader, Status) {
        let (reader, writer) = std::io::pipe().unwrap();
        let fd = u32::try_from(writer.as_raw_fd()).unwrap();
        let status = Status::new(Some(fd)).unwrap();
        (reader, status)
    }

    fn running() -> FederateStatus {
        FederateStatus::Running {
            federate: "x".to_owned(),
        }
    }

    /// Twelve peers with wide histograms: far more than 4 KiB.
    fn measures() -> Measures {
        let mut measures = Measures::default();
        for peer in 0..12 {
            for shift in 10..30 {
                measures.slack(peer, Duration::from_nanos(1 << shift));
                measures.launch_lag(peer, Duration::from_nanos(1 << shift));
            }
        }
        measures
    }

    /// Who listens on the socket may come late, go away and come again.
    #[test]
    fn a_socket_is_found_whenever_somebody_listens() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("status");
        let mut status = Status::to_socket(&path);
        assert!(status.enabled());
        status.say(&running());
        for _ in 0..2 {
            let listener = std::os::unix::net::UnixListener::bind(&path).unwrap();
            // As if half a second had passed.
            status.socket.as_mut().unwrap().again = std::time::Instant::now();
            status.say_measures("x", &measures());
            let (mut stream, _) = listener.accept().unwrap();
            let mut byte = [0];
            assert_eq!((stream.read(&mut byte).unwrap(), byte), (1, *b"{"));
            drop((listener, stream));
            std::fs::remove_file(&path).unwrap();
            // The first write after that finds out.
            status.say(&running());
            assert!(status.pipe.is_none());
        }
    }

    #[test]
    fn nobody_reads_and_nothing_blocks_and_lines_stay_whole() {
        let (mut reader, mut status) = pipe();
        for _ in 0..100 {
            status.say_measures("x", &measures());
        }
        // There is no room any more; what must be said waits.
        for _ in 0..200 {
            status.say(&running());
        }
        let mut bytes = vec![0; 1 << 20];
        let count = reader.read(&mut bytes).unwrap();
        status.say_measures("x", &measures());
        status.say(&FederateStatus::Ended {
            federate: "x".to_owned(),
            elapsed_ns: 0,
            microstep: 0,
            code: 0,
            reason: "over".to_owned(),
        });
        drop(status);
        bytes.truncate(count);
        reader.read_to_end(&mut bytes).unwrap();
        let text = String::from_utf8(bytes).unwrap();
        let events: Vec<FederateStatus> = text
            .lines()
            .map(|line| serde_json::from_str(line).unwrap())
            .collect();
        let runs = events.iter().filter(|event| **event == running()).count();
        assert_eq!(runs, 200);
        assert!(matches!(events.last(), Some(FederateStatus::Ended { .. })));
        assert!(text.ends_with('\n'));
    }

    #[test]
    fn the_end_of_the_reader_is_the_end_of_saying() {
        let (reader, mut status) = pipe();
        drop(reader);
        status.say(&running());
        assert!(!status.enabled());
        status.say_measures("x", &measures());
    }
}
