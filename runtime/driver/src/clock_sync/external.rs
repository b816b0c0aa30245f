//! What the host's own time service says, asked once a second by a thread that may wait for it.

use super::lock;
use ictus_clock::{Discipline, Sources};
use ictus_coord::report::ClockStatus;
use std::io;
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// The time between two questions.
const EVERY: Duration = Duration::from_secs(1);

/// The last answer, shared.
pub(super) type Shared = Arc<Mutex<Option<Discipline>>>;

/// A running thread; it ends soon after this is dropped.
#[derive(Debug)]
pub(super) struct External {
    latest: Shared,
    _alive: Sender<()>,
}

impl External {
    /// Asks for the first time, and then again and again.
    pub(super) fn start(sources: Sources) -> io::Result<Self> {
        let latest = Arc::new(Mutex::new(sources.read()));
        let (alive, ended) = channel();
        let shared = Arc::clone(&latest);
        std::thread::Builder::new()
            .name("clock-source".to_owned())
            .spawn(move || {
                while ended.recv_timeout(EVERY) == Err(RecvTimeoutError::Timeout) {
                    let found = sources.read();
                    *lock(&shared) = found;
                }
            })?;
        Ok(Self {
            latest,
            _alive: alive,
        })
    }

    pub(super) fn shared(&self) -> Shared {
        Arc::clone(&self.latest)
    }

    pub(super) fn status(&self) -> ClockStatus {
        let latest = *lock(&self.latest);
        latest.map_or_else(ClockStatus::default, |found| found.status())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ictus_coord::report::ClockSource;

    #[test]
    fn a_host_without_a_service_has_its_kernel() {
        let nowhere = Sources {
            chrony: ([127, 0, 0, 1], 9).into(),
            ptp4l: "/nowhere".into(),
            timesyncd: "/nowhere".into(),
        };
        let status = External::start(nowhere).unwrap().status();
        assert_eq!(status.source, ClockSource::Kernel);
        assert!(status.bound_ns.is_some());
    }
}
