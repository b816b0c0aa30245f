//! The thread that answers probes and owns the servo.

use super::external::Shared;
use super::lock;
use crate::clock::SystemClock;
use crate::transport;
use ictus_clock::{Arrival, ProbeSocket, Sent};
use ictus_coord::clock::{Correction, Follower, Heard, Interval, Servo, Taken};
use ictus_coord::report::ClockStatus;
use ictus_core::{Duration, PhysicalTime};
use rustix::event::{EventfdFlags, PollFd, PollFlags, eventfd, poll};
use rustix::io::Errno;
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;

/// What the thread works with.
pub(super) struct Task {
    pub(super) socket: ProbeSocket,
    pub(super) follower: Follower,
    pub(super) servo: Servo,
    pub(super) clock: Arc<SystemClock>,
    pub(super) external: Option<Shared>,
    /// The last T3.
    pub(super) answer: Option<Sent>,
}

/// A running thread.
#[derive(Debug)]
pub(super) struct Probed {
    known: Arc<Mutex<Known>>,
    stop: Arc<OwnedFd>,
    thread: Option<JoinHandle<()>>,
}

/// What the thread knew after the last datagram.
#[derive(Clone, Debug)]
struct Known {
    status: ClockStatus,
    correction: Correction,
    interval: Option<Interval>,
    step: Option<Duration>,
}

impl Probed {
    pub(super) fn start(task: Task) -> io::Result<Self> {
        let stop = Arc::new(eventfd(0, EventfdFlags::CLOEXEC)?);
        let known = Arc::new(Mutex::new(task.known(None)));
        let (stopped, publish) = (Arc::clone(&stop), Arc::clone(&known));
        let thread = std::thread::Builder::new()
            .name("clock".to_owned())
            .spawn(move || task.run(&stopped, &publish))?;
        Ok(Self {
            known,
            stop,
            thread: Some(thread),
        })
    }

    /// What is known when the base clock shows `base`.
    pub(super) fn status(&self, base: PhysicalTime) -> ClockStatus {
        let known = lock(&self.known).clone();
        let now = Servo::status_of(base, &known.correction, known.interval.as_ref());
        ClockStatus {
            source: known.status.source,
            probes_kept: known.status.probes_kept,
            probes_dropped: known.status.probes_dropped,
            strangers: known.status.strangers,
            steps: known.status.steps,
            ..now
        }
    }

    pub(super) fn take_step(&self) -> Option<Duration> {
        lock(&self.known).step.take()
    }
}

impl Drop for Probed {
    fn drop(&mut self) {
        // A thread that does not hear it is waiting for nothing else, and ends with the process.
        if rustix::io::write(&*self.stop, &1_u64.to_ne_bytes()).is_ok()
            && let Some(thread) = self.thread.take()
        {
            // One that has panicked has ended as well.
            drop(thread.join());
        }
    }
}

impl Task {
    /// Until `stop` is written to, or the socket fails: then the bound grows, and tells.
    fn run(mut self, stop: &OwnedFd, known: &Mutex<Known>) {
        transport::precise_waits();
        loop {
            let mut fds = [
                PollFd::from_borrowed_fd(self.socket.as_fd(), PollFlags::IN),
                PollFd::from_borrowed_fd(stop.as_fd(), PollFlags::IN),
            ];
            match poll(&mut fds, None) {
                Ok(_) | Err(Errno::INTR) => {}
                Err(_) => return,
            }
            if !fds[1].revents().is_empty() {
                return;
            }
            self.hear_departures();
            loop {
                match self.socket.receive() {
                    Ok(Some(arrival)) => self.take(&arrival, known),
                    Ok(None) => break,
                    Err(_) => return,
                }
            }
        }
    }

    fn take(&mut self, arrival: &Arrival, known: &Mutex<Known>) {
        let came = arrival.came(self.clock.host());
        let incomplete = self.follower.incomplete();
        let heard = self.follower.receive(arrival.from, arrival.bytes(), came);
        let mut step = None;
        match heard {
            Heard::Nothing => {}
            Heard::Answer { to, datagram } => {
                let bytes = datagram.encode();
                let t3 = self.clock.base();
                self.answer = self.socket.send(to, &bytes);
                self.follower.answered(t3);
                self.hear_departures();
            }
            Heard::Complete(exchange, survived) => {
                self.servo.trust(self.external_offset());
                let base = self.clock.base();
                if let Taken::Step(by) = self.servo.take(base, exchange, survived) {
                    step = Some(by);
                }
                self.clock.correct(self.servo.correction());
            }
        }
        self.servo.missed(self.follower.incomplete() - incomplete);
        let mut known = lock(known);
        let step = step.or(known.step);
        *known = self.known(step);
    }

    /// What the kernel says of when T3 left.
    fn hear_departures(&mut self) {
        while let Some(departure) = self.socket.departed(self.clock.host()) {
            if Some(departure.sent) == self.answer {
                self.follower.left(departure.when);
            }
        }
    }

    /// What the host's time service says must be added to the base clock, and how far that may be off.
    fn external_offset(&self) -> Option<(Duration, Duration)> {
        let found = (*lock(self.external.as_ref()?)).filter(|found| found.synchronized)?;
        let offset = self.clock.host().behind_system() + found.offset;
        Some((offset, found.bound))
    }

    fn known(&self, step: Option<Duration>) -> Known {
        let base = self.clock.base();
        let mut status = self.servo.status(base);
        let external = self.external.as_ref().and_then(|found| *lock(found));
        if let Some(found) = external.filter(|_| self.servo.is_external(base)) {
            status.source = found.source;
        }
        status.strangers = self.follower.strangers();
        Known {
            status,
            correction: self.servo.correction(),
            interval: self.servo.interval(),
            step,
        }
    }
}
