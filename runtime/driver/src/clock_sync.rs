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
    /// Prepares what the plan asks for: for `on` the port of [`ClockSync::udp_port`], `port` or for 0 any. `rti`: its address, when there is one;
    /// `ours`: it is Ictus's.
    ///
    /// # Errors
    ///
    /// When no UDP socket can be opened.
    pub(crate) fn start(
        plan: &ClockPlan,
        (federate, port): (u16, u16),
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
                let socket = ProbeSocket::bind(here, port, stamps())?;
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::Clock;
    use ictus_clock::{HostClock, Skew};
    use ictus_coord::clock::{Exchange, Prober};
    use ictus_coord::report::ClockSource;
    use ictus_coord::topology::FederateId;
    use ictus_core::PhysicalTime;
    use std::net::Ipv4Addr;

    fn plan(sync: Mode) -> ClockPlan {
        ClockPlan {
            sync,
            period_ns: 1_000_000,
            ..ClockPlan::default()
        }
    }

    fn skewed() -> Arc<SystemClock> {
        Arc::new(SystemClock::of(HostClock::raw().with_skew(Skew {
            offset_ns: 50_000_000,
            drift_ppb: 50_000,
        })))
    }

    fn joining(reference: &HostClock, clock: &SystemClock) -> Interval {
        let t1 = reference.now();
        let (t2, t3) = (clock.base(), clock.base());
        let t4 = reference.now();
        Interval::of(&Exchange { t1, t2, t3, t4 }).unwrap()
    }

    /// How far a clock is from the reference, and how long it took to find out.
    fn apart(reference: &HostClock, clock: &SystemClock) -> (Duration, Duration) {
        let before = reference.now();
        let shown = clock.now();
        let after = reference.now();
        (shown.since(before), after.since(before))
    }

    #[test]
    fn a_wrong_clock_follows_the_probes() {
        let reference = HostClock::steady();
        let local = Ipv4Addr::LOCALHOST.into();
        let mut socket = ProbeSocket::bind(local, 0, Stamps::Kernel).unwrap();
        let rti = SocketAddr::new(local, socket.port().unwrap());
        let clock = skewed();
        let mut sync =
            ClockSync::start(&plan(Mode::On), (3, 0), clock.clone(), Some(rti), true).unwrap();
        sync.begin(joining(&reference, &clock)).unwrap();
        let federate = SocketAddr::new(local, sync.udp_port());
        let mut stranger = ProbeSocket::bind(local, 0, Stamps::Reader).unwrap();
        stranger.send(federate, &[21; 9]);
        socket.send(federate, &[1, 2, 3]);

        let mut prober = Prober::new(4, Duration::from_millis(1));
        prober.begin(PhysicalTime::from_nanos(0), FederateId::new(3), federate);
        while sync.status().probes_kept + sync.status().probes_dropped < 200 {
            prober.handle_timeout(reference.now());
            while let Some(arrival) = socket.receive().unwrap() {
                prober.receive(arrival.from, arrival.bytes(), arrival.came(&reference));
            }
            while let Some(transmit) = prober.poll_transmit(reference.now()) {
                socket.send(transmit.to, &transmit.bytes);
            }
            let status = sync.status();
            let (apart, took) = apart(&reference, &clock);
            let bound = Duration::from_nanos(status.bound_ns.unwrap());
            let far = apart.as_nanos().abs() - took.as_nanos();
            assert!(far <= bound.as_nanos(), "{far} ns off, {status:?}");
        }
        let status = sync.status();
        assert_eq!(status.source, ClockSource::Builtin);
        assert_eq!((status.strangers, status.steps), (2, 0));
        assert!((-51_000_000..-49_000_000).contains(&status.offset_ns));
    }

    #[test]
    fn exchanges_while_joining_are_enough_for_init() {
        let reference = HostClock::steady();
        let clock = skewed();
        let rti = Some(([127, 0, 0, 1], 1).into());
        let mut sync =
            ClockSync::start(&plan(Mode::Init), (0, 0), clock.clone(), rti, true).unwrap();
        assert_eq!(sync.udp_port(), 0);
        assert_eq!(sync.status().bound_ns, None);
        sync.begin(joining(&reference, &clock)).unwrap();
        let status = sync.status();
        assert!(
            status.synchronized && status.bound_ns.is_some(),
            "{status:?}"
        );
    }

    #[test]
    fn a_clock_that_is_not_known_well_enough_is_refused() {
        let clock = Arc::new(SystemClock::new());
        let strict = |sync, max_error_ns, on_exceed| ClockPlan {
            max_error_ns: Some(max_error_ns),
            on_exceed,
            ..plan(sync)
        };
        let start =
            |plan: &ClockPlan| ClockSync::start(plan, (0, 0), clock.clone(), None, true).unwrap();
        let most = Duration::from_nanos(1);
        let mut off = start(&strict(Mode::Off, 1, OnExceed::Warn));
        assert_eq!(off.check(), Err(ClockRefusal::Unknown { most }));
        assert!(!off.refuses());
        let mut init = start(&strict(Mode::Init, 1, OnExceed::Refuse));
        init.begin(joining(&HostClock::steady(), &clock)).unwrap();
        let refusal = init.check().unwrap_err();
        assert!(
            matches!(refusal, ClockRefusal::TooUncertain { .. }),
            "{refusal}"
        );
        assert!(init.refuses());
        let mut lenient = start(&strict(Mode::Init, 1_000_000_000, OnExceed::Refuse));
        lenient
            .begin(joining(&HostClock::steady(), &clock))
            .unwrap();
        assert_eq!(lenient.check(), Ok(()));
        assert_eq!(
            start(&plan(Mode::Off)).check(),
            Ok(()),
            "nothing is asked for"
        );
    }
}
