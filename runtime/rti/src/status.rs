//! What the RTI says of itself: status lines for supervisors, words for people.

use std::fs::File;
use std::io;
use std::time::{Duration, Instant};

use ictus_coord::report::RtiStatus;
use ictus_coord::rti::RtiEvent;
use ictus_core::PhysicalTime;

use crate::outlet::Outlet;

/// Past this many unwritten bytes, lines about refused connections, and words, are left out.
const BACKLOG: usize = 1 << 20;
/// How long the end waits for readers that are behind.
const LAST_WORDS: Duration = Duration::from_secs(2);

/// Where status lines and words go. Writing never blocks, but for a bounded time at the end.
#[derive(Debug, Default)]
pub struct Status {
    lines: Option<Outlet>,
    words: Option<Outlet>,
    /// Words left out since the last that were not.
    left_out: u64,
    start: Option<PhysicalTime>,
}

/// The descriptor of `--status-fd` cannot be written to.
#[derive(Debug, thiserror::Error)]
#[error("cannot write status lines to descriptor {descriptor}: {source}")]
pub struct StatusError {
    /// The descriptor's number.
    pub descriptor: u32,
    /// Why not.
    pub source: io::Error,
}

impl Status {
    /// Status lines to an inherited descriptor, words to standard error.
    ///
    /// # Errors
    ///
    /// When the descriptor is not open for writing.
    pub fn open(descriptor: Option<u32>) -> Result<Self, StatusError> {
        let reopen = |descriptor| {
            Outlet::reopen(descriptor).map_err(|source| StatusError { descriptor, source })
        };
        Ok(Self {
            lines: descriptor.map(reopen).transpose()?,
            words: Some(Outlet::stderr()),
            ..Self::default()
        })
    }

    /// No words, and status lines to a file; for tests and benches.
    #[must_use]
    pub fn to_file(lines: Option<File>) -> Self {
        Self {
            lines: lines.map(Outlet::new),
            ..Self::default()
        }
    }

    /// Says that the listener is open; when its address is nobody's choice, how to choose one: LF's RTI listens on all.
    pub(crate) fn listening(&mut self, port: u16, bind_is_default: bool) {
        let whose = if bind_is_default {
            " of 127.0.0.1, for this host alone (`--bind 0.0.0.0`: for all)"
        } else {
            ""
        };
        self.say(&format!("listening on port {port}{whose}"));
        self.line(&RtiStatus::Listening { port });
    }

    /// Says what happened.
    pub(crate) fn tell(&mut self, event: RtiEvent) {
        self.say(&words(&event));
        if let RtiEvent::Started { start } = event {
            self.start = Some(start);
        }
        match status_of(event) {
            Some(RtiStatus::Rejected { .. }) if pending(self.lines.as_ref()) > BACKLOG => {}
            Some(status) => self.line(&status),
            None => {}
        }
    }

    /// Says something to people.
    pub(crate) fn say(&mut self, words: &str) {
        if pending(self.words.as_ref()) > BACKLOG {
            self.left_out += 1;
        } else if let Some(outlet) = &mut self.words {
            tell_left_out(outlet, &mut self.left_out);
            outlet.push(&format!("ictus rti: {words}"));
        }
        self.flush();
    }

    fn line(&mut self, status: &RtiStatus) {
        let Some(outlet) = &mut self.lines else {
            return;
        };
        match serde_json::to_string(status) {
            Ok(line) => outlet.push(&line),
            Err(error) => self.say(&format!("a status line cannot be written: {error}")),
        }
        self.flush();
    }

    /// Writes what the descriptors take now.
    pub(crate) fn flush(&mut self) {
        if let Some(outlet) = &mut self.lines {
            outlet.flush();
        }
        if let Some(outlet) = &mut self.words {
            outlet.flush();
            if outlet.pending() == 0 && self.left_out > 0 {
                tell_left_out(outlet, &mut self.left_out);
                outlet.flush();
            }
        }
    }

    /// Writes what is left, as far as it is taken within a bounded time.
    pub(crate) fn finish(&mut self) {
        let deadline = Instant::now() + LAST_WORDS;
        self.flush();
        if let Some(outlet) = &mut self.lines {
            outlet.finish(deadline);
        }
        if let Some(outlet) = &mut self.words {
            tell_left_out(outlet, &mut self.left_out);
            outlet.finish(deadline);
        }
    }

    /// Whether a reader is behind.
    pub(crate) fn is_behind(&self) -> bool {
        pending(self.lines.as_ref()) > 0 || pending(self.words.as_ref()) > 0
    }
}

fn pending(outlet: Option<&Outlet>) -> usize {
    outlet.map_or(0, Outlet::pending)
}

fn tell_left_out(outlet: &mut Outlet, left_out: &mut u64) {
    if *left_out > 0 {
        outlet.push(&format!(
            "ictus rti: {left_out} lines were left out here: nobody read"
        ));
        *left_out = 0;
    }
}

fn words(event: &RtiEvent) -> String {
    match event {
        RtiEvent::Joined { federate } => format!("federate {federate} joined"),
        RtiEvent::Started { start } => format!("all joined; start time {start:?}"),
        RtiEvent::StopRequested {
            federate: Some(federate),
        } => {
            format!("federate {federate} asks to stop")
        }
        RtiEvent::StopRequested { federate: None } => "asking all federates to stop".to_owned(),
        RtiEvent::StopUnanswered { federates } => {
            format!("no answer to the stop request from {federates:?}")
        }
        RtiEvent::StopAgreed { elapsed, microstep } => {
            format!("stop tag agreed: {elapsed} after the start, microstep {microstep}")
        }
        RtiEvent::Resigned { federate } => format!("federate {federate} resigned"),
        RtiEvent::Lost { federate, reason } => format!("federate {federate} is lost: {reason}"),
        RtiEvent::Rejected { peer, reason } => format!("refused {peer}: {reason}"),
        RtiEvent::Ended { code } => format!("all federates are gone; exit code {code}"),
    }
}

fn status_of(event: RtiEvent) -> Option<RtiStatus> {
    Some(match event {
        RtiEvent::Joined { federate } => RtiStatus::Joined {
            federate: federate.get(),
        },
        RtiEvent::Started { start } => RtiStatus::Start {
            start_ns: start.as_nanos(),
        },
        RtiEvent::StopRequested { federate } => RtiStatus::StopRequested {
            federate: federate.map(|federate| federate.get()),
        },
        RtiEvent::StopUnanswered { .. } => return None,
        RtiEvent::StopAgreed { elapsed, microstep } => RtiStatus::Stop {
            elapsed_ns: elapsed.as_nanos(),
            microstep,
        },
        RtiEvent::Resigned { federate } => RtiStatus::Resigned {
            federate: federate.get(),
        },
        RtiEvent::Lost { federate, reason } => RtiStatus::Failed {
            federate: federate.get(),
            reason,
        },
        RtiEvent::Rejected { peer, reason } => RtiStatus::Rejected { peer, reason },
        RtiEvent::Ended { code } => RtiStatus::Ended { code },
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Read;
    use std::os::fd::OwnedFd;

    #[test]
    fn words_that_nobody_reads_block_nobody() {
        let (mut reader, writer) = io::pipe().unwrap();
        let mut status = Status {
            words: Some(Outlet::new(File::from(OwnedFd::from(writer)))),
            ..Status::default()
        };
        for number in 0..100_000 {
            status.say(&format!("line {number:05}"));
        }
        assert!(status.is_behind());
        let reading = std::thread::spawn(move || {
            let mut text = String::new();
            reader.read_to_string(&mut text).unwrap();
            text
        });
        while status.is_behind() {
            status.flush();
        }
        status.say("the end");
        status.finish();
        drop(status);
        let text = reading.join().unwrap();
        let lines: Vec<&str> = text.lines().collect();
        let kept = lines.len() - 2;
        for (number, line) in lines[..kept].iter().enumerate() {
            assert_eq!(*line, format!("ictus rti: line {number:05}"));
        }
        let left_out = 100_000 - kept;
        assert!(left_out > 0);
        let told = format!("ictus rti: {left_out} lines were left out here: nobody read");
        assert_eq!(lines[kept..], [told.as_str(), "ictus rti: the end"]);
    }

    #[test]
    fn an_address_that_nobody_chose_is_named() {
        let (mut reader, writer) = io::pipe().unwrap();
        let mut status = Status {
            words: Some(Outlet::new(File::from(OwnedFd::from(writer)))),
            ..Status::default()
        };
        status.listening(7, true);
        status.listening(7, false);
        drop(status);
        let mut text = String::new();
        reader.read_to_string(&mut text).unwrap();
        let expected = "\
ictus rti: listening on port 7 of 127.0.0.1, for this host alone (`--bind 0.0.0.0`: for all)
ictus rti: listening on port 7
";
        assert_eq!(text, expected);
    }

    #[test]
    fn the_end_waits_for_a_reader_that_is_behind() {
        let (mut reader, writer) = io::pipe().unwrap();
        let mut status = Status::to_file(Some(File::from(OwnedFd::from(writer))));
        while !status.is_behind() {
            status.line(&RtiStatus::Ended { code: 0 });
        }
        let finishing = std::thread::spawn(move || status.finish());
        let mut text = String::new();
        reader.read_to_string(&mut text).unwrap();
        finishing.join().unwrap();
        assert!(text.ends_with('\n'));
    }
}
