//! Keeping a federate's clock: answers the RTI's probes, steers the correction, knows the bound.
//!
//! Probes are answered by a thread of their own, because the federate's may be busy with a reaction for as long as it likes;
//! the two meet in the [`SystemClock`] only, which takes no lock.

use crate::clock::SystemClock;
use ictus_clock::{ProbeSocket, Sources, Stamps, StepWatch};
use ictus_coord::clock::{Correction, Follower, Interval, Servo};
use ictus_coord::plan::{ClockPlan, ClockSync as Mode, OnExceed};
use ictus_coord::report::ClockStatus;
use ictus_coord::wire::NO_CLOCK_SYNC;
use ictus_core::Duration;
use std::io;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, PoisonError};
use thiserror::Error;

mod external;
mod probed;

use external::External;
use probed::{Probed, Task};

/// The clock of one federate, and who keeps it. Dropped, it is corrected no more.
#[derive(Debug)]
pub(crate) struct ClockSync {
    plan: ClockPlan,
    clock: Arc<SystemClock>,
    /// What to probe with, until the exchanges while joining are done.
    waiting: Option<(ProbeSocket, Follower)>,
    port: u16,
    probed: Option<Probed>,
    external: Option<External>,
    /// Exchanges while joining, when there are no others.
    joining: Option<Interval>,
    watch: StepWatch,
    steps: u64,
}

/// Why a federate's clock may not be used. Fatal for the federate, before the start.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum ClockRefusal {
    /// The bound is greater than the plan allows.
    #[error("the clock may be off by {bound}, more than `clock.max_error` ({most}) allows")]
    TooUncertain {
        /// How far it may be off.
        bound: Duration,
        /// How far it may be.
        most: Duration,
    },
    /// There is no bound at all.
    #[error("nothing is known of the clock's error, and `clock.max_error` allows {most}")]
    Unknown {
        /// How far it may be off.
        most: Duration,
    },
}

impl ClockSync {
    /// Prepares what the plan asks for: for `on` the port of [`ClockSync::udp_port`]. `rti`: its address, when there is one;
    /// `ours`: it is Ictus's.
    ///
    /// # Errors
    ///
    /// When no UDP socket can be opened.
    pub(crate) fn start(
        plan: &ClockPlan,
        federate: u16,
        clock: Arc<SystemClock>,
        rti: Option<SocketAddr>,
        ours: bool,
    ) -> io::Result<Self> {
        let mut sync = Self {
            plan: *plan,
            clock,
            waiting: None,
            port: NO_CLOCK_SYNC,
            probed: None,
            external: None,
            joining: None,
            watch: StepWatch::new(),
            steps: 0,
        };
        if matches!(plan.sync, Mode::External | Mode::On) {
            sync.external = Some(External::start(Sources::default())?);
        }
        let Some(rti) = rti else { return Ok(sync) };
        match plan.sync {
            Mode::Off | Mode::External => {}
            Mode::Init => sync.port = 0,
            Mode::On => {
                // What can reach the RTI can be reached by it: on loopback nobody else can.
                let here = local_address(rti)?;
                let socket = ProbeSocket::bind(here, 0, stamps())?;
                sync.port = socket.port()?;
                let follower = Follower::new(federate, rti.ip(), ours);
                sync.waiting = Some((socket, follower));
            }
        }
        Ok(sync)
    }

    /// What UDP_PORT says: where probes are answered, 0 for none, 65535 for no exchanges at all.
    pub(crate) const fn udp_port(&self) -> u16 {
        self.port
    }

    /// The exchanges while joining are done: steps the clock into the middle of what they say, and from now on follows the
    /// RTI's by slewing.
    ///
    /// # Errors
    ///
    /// When no thread can be made.
    pub(crate) fn begin(&mut self, joining: Interval) -> io::Result<()> {
        let base = self.clock.base();
        let Some((socket, follower)) = self.waiting.take() else {
            let offset = joining.middle(base);
            self.clock.step(Correction::constant(base, offset));
            self.joining = Some(joining);
            return Ok(());
        };
        let mut servo = Servo::new(&self.plan);
        servo.begin(base, joining);
        self.clock.step(servo.correction());
        self.probed = Some(Probed::start(Task {
            socket,
            follower,
            servo,
            clock: Arc::clone(&self.clock),
            external: self.external.as_ref().map(External::shared),
            answer: None,
        })?);
        Ok(())
    }

    /// What is known of the clock now.
    pub(crate) fn status(&mut self) -> ClockStatus {
        let base = self.clock.base();
        let mut status = match (&self.probed, &self.joining, &self.external) {
            (Some(probed), ..) => probed.status(base),
            (None, Some(joining), _) => {
                let correction = self.clock.correction();
                Servo::status_of(base, &correction, Some(joining))
            }
            (None, None, Some(external)) => external.status(),
            (None, None, None) => ClockStatus::default(),
        };
        status.steps += self.steps;
        status
    }

    /// A step of either clock that was noticed since the last call: how far forward.
    pub(crate) fn take_step(&mut self) -> Option<Duration> {
        let host = self.watch.look();
        self.steps += u64::from(host.is_some());
        host.or_else(|| self.probed.as_ref().and_then(Probed::take_step))
    }

    /// Whether the clock is good enough to start, as the plan sees it.
    ///
    /// # Errors
    ///
    /// When it is not; whether that is a warning or the end says [`ClockPlan::on_exceed`].
    pub(crate) fn check(&mut self) -> Result<(), ClockRefusal> {
        let Some(most) = self.plan.max_error_ns.map(Duration::from_nanos) else {
            return Ok(());
        };
        match self.status().bound_ns.map(Duration::from_nanos) {
            Some(bound) if bound <= most => Ok(()),
            Some(bound) => Err(ClockRefusal::TooUncertain { bound, most }),
            None => Err(ClockRefusal::Unknown { most }),
        }
    }

    /// Whether a clock that is not good enough ends the federate.
    pub(crate) fn refuses(&self) -> bool {
        self.plan.on_exceed == OnExceed::Refuse
    }
}

/// The address by which this host reaches another.
fn local_address(remote: SocketAddr) -> io::Result<std::net::IpAddr> {
    let any = match remote {
        SocketAddr::V4(_) => std::net::IpAddr::from(std::net::Ipv4Addr::UNSPECIFIED),
        SocketAddr::V6(_) => std::net::Ipv6Addr::UNSPECIFIED.into(),
    };
    // Connecting a UDP socket sends nothing: it asks for the route.
    let socket = std::net::UdpSocket::bind((any, 0))?;
    socket.connect(remote)?;
    Ok(socket.local_addr()?.ip())
}

/// Kernel stamps, unless a measurement wants to know what they bring.
fn stamps() -> Stamps {
    if std::env::var_os("ICTUS_CLOCK_STAMPS").is_some_and(|value| value == "reader") {
        Stamps::Reader
    } else {
        Stamps::Kernel
    }
}

/// What two threads share; a thread that panicked while it held it has left it whole: all is written at once.
fn lock<T>(shared: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    shared.lock().unwrap_or_else(PoisonError::into_inner)
}
