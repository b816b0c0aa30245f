//! Running: the loop around a [`Federate`], and the program's `main`.
//!
//! One thread per federate: it executes reactions, reads and writes its one socket, and waits in one place, so that
//! nothing stands between a message and the reaction it triggers.

use crate::args::{self, Command, RunArgs, USAGE};
use crate::assembly::{Assembly, words};
use crate::bodies::Bodies;
use crate::class::Class;
use crate::clock::{Clock, SystemClock};
use crate::clock_sync::{ClockRefusal, ClockSync};
use crate::observe::Observation;
use crate::outside::OutsideEvent;
use crate::peers::Peers;
use crate::status::Status;
use crate::transport::{self, Awaited, Connection, Signals, Waker};
use ictus_clock::Lookout;
use ictus_coord::FederateExecutor as _;
use ictus_coord::clock::Interval;
use ictus_coord::federate::{Federate, FederateConfig, FederateEvent, LinkConfig, Outcome, Poll};
use ictus_coord::measure::LagNews;
use ictus_coord::plan::Plan;
use ictus_coord::report::{FederateStatus, exit};
use ictus_core::{Duration, PhysicalTime, Tag};
use ictus_stream::{Credentials, Member};
use std::io::{self, Write};
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::process::ExitCode;
use std::sync::Arc;

mod begin;
mod error;
mod lookout;
mod report;

use begin::{
    connect, default_federation, lock_memory, named_federates, nonce, read_plan, resolve, status_of,
};
pub use error::RunError;

/// Written bytes leave at once beyond this many, although the federate is not about to wait.
const FLUSH_BYTES: usize = 32 << 10;
/// ... or when they are this old.
const FLUSH_AGE: Duration = Duration::from_micros(200);
/// More unwritten bytes than this and no further tag is begun until the socket has taken some.
const BACKLOG_BYTES: usize = 4 << 20;
/// How often it is looked whether the socket still takes some.
const BACKLOG_LOOK: Duration = Duration::from_secs(1);
/// A federate that never waits still looks at its socket after so many steps.
const STEPS_PER_LOOK: u32 = 64;
/// How long the RTI may take to close after RESIGN or FAILED.
const DRAIN_FOR: Duration = Duration::from_secs(5);
/// How long a receiver may take nothing of the last messages for it.
const TAKEN_WITHIN: Duration = Duration::from_secs(30);
/// How often progress is reported, and trace and timing files are brought up to date.
const PROGRESS_EVERY: Duration = Duration::from_secs(1);

/// The `main` of a program that has these classes; [`program!`](crate::program) writes the call.
#[must_use]
pub fn main_with(classes: &[Class]) -> ExitCode {
    panics_are_one_line();
    let command = match args::parse(std::env::args().skip(1)) {
        Ok(command) => command,
        Err(error) => return complain(&format!("{error}\n{USAGE}"), exit::USAGE),
    };
    match command {
        Command::Help => {
            let written = io::stdout().write_all(USAGE.as_bytes());
            if written.is_ok() {
                ExitCode::SUCCESS
            } else {
                ExitCode::FAILURE
            }
        }
        Command::Describe(file) => crate::describe::describe_main(classes, file.as_deref()),
        Command::Run(run) => match run_plan(&run, classes) {
            Ok(code) => ExitCode::from(code),
            Err(error) => complain(&error.to_string(), error.exit_code()),
        },
    }
}

/// A panic is one line; `ICTUS_BACKTRACE=1` brings the stack with it.
fn panics_are_one_line() {
    if std::env::var_os("ICTUS_BACKTRACE").is_some_and(|value| value == "1") {
        return;
    }
    std::panic::set_hook(Box::new(|panic| {
        let place = panic
            .location()
            .map_or_else(String::new, |l| format!(" at {l}"));
        let words = words(panic.payload()).replace(['\n', '\r'], " ");
        drop(writeln!(io::stderr(), "ictus: panicked{place}: {words}"));
    }));
}

fn complain(message: &str, code: u8) -> ExitCode {
    // Nobody reads standard error: the exit code still tells.
    drop(writeln!(io::stderr(), "ictus: {message}"));
    ExitCode::from(code)
}

fn run_plan(args: &RunArgs, classes: &[Class]) -> Result<u8, RunError> {
    if args.lock_memory {
        lock_memory().map_err(RunError::LockMemory)?;
    }
    let plan = read_plan(args)?;
    let ids = named_federates(&plan, &args.federates)?;
    match &args.rti {
        None if ids.len() < plan.federates.len() => Err(RunError::NeedsRti),
        None => Ok(run_one(
            &Job {
                plan: &plan,
                args,
                classes,
                name: &plan.federation,
            },
            &ids,
            None,
        )?),
        Some(rti) => {
            let address = resolve(rti)?;
            run_each(&plan, args, classes, &ids, address)
        }
    }
}

/// Every named federate on a thread of its own; the worst exit code wins.
fn run_each(
    plan: &Plan,
    args: &RunArgs,
    classes: &[Class],
    ids: &[u16],
    address: SocketAddr,
) -> Result<u8, RunError> {
    let run = |id: &u16| {
        let name = &plan.federates[usize::from(*id)].name;
        run_one(
            &Job {
                plan,
                args,
                classes,
                name,
            },
            &[*id],
            Some(address),
        )
    };
    if let [id] = ids {
        return run(id);
    }
    let results: Vec<Result<u8, RunError>> = std::thread::scope(|scope| {
        let threads: Vec<_> = ids.iter().map(|id| scope.spawn(move || run(id))).collect();
        threads
            .into_iter()
            .map(|thread| thread.join().unwrap_or(Ok(exit::FAILED)))
            .collect()
    });
    let mut worst = exit::OK;
    for result in results {
        worst = worst.max(result?);
    }
    Ok(worst)
}

/// What is to be run.
struct Job<'a> {
    plan: &'a Plan,
    args: &'a RunArgs,
    classes: &'a [Class],
    name: &'a str,
}

fn run_one(job: &Job<'_>, ids: &[u16], rti: Option<SocketAddr>) -> Result<u8, RunError> {
    let clock = Arc::new(clock_of(job.plan, ids, rti));
    let sync = keep_clock(job, ids, rti, &clock)?;
    let mut assembly = Assembly::new(job.plan, ids, job.classes, clock.clone())?;
    let observation = Observation {
        trace: job.args.trace.clone(),
        timing: job.args.timing.clone(),
    };
    assembly
        .bodies
        .observe(&observation)
        .map_err(RunError::Observe)?;
    let config = FederateConfig {
        timeout: job.plan.timeout_ns.map(Duration::from_nanos),
        fast: job.plan.fast,
        keepalive: job.plan.keepalive,
    };
    let program = Arc::clone(&assembly.program);
    let failure_timeout = Duration::from_nanos(job.plan.failure_timeout_ns);
    let federate = match (rti, ids) {
        (Some(_), [id]) => {
            let mut link =
                LinkConfig::from_plan(job.plan, *id, &assembly.inputs, &assembly.outputs);
            link.federation = job
                .args
                .federation_id
                .clone()
                .unwrap_or_else(default_federation);
            link.authentication = job.plan.authentication.then(nonce).transpose()?;
            link.clock_port = sync.udp_port();
            link.data_address = job.args.data_address.map(|address| address.octets());
            if job.args.data_address.is_some() {
                // There are other hosts, and the RTI may see one vanish later than this federate does.
                link.found_later = failure_timeout + failure_timeout + failure_timeout;
            }
            Federate::federated(program, config, link)
        }
        (Some(_) | None, _) => Federate::alone(program, config),
    };
    let credentials = credentials(job, ids)?;
    let connection = rti.map(|rti| connect(rti, credentials.as_ref()));
    let connection = connection.transpose()?;
    if let Some(connection) = &connection {
        connection.watch(failure_timeout).map_err(RunError::Io)?;
    }
    let allow = job.args.allow.clone();
    let runner = Runner {
        io: Io {
            connection,
            peers: Peers::allowing(allow, credentials, failure_timeout),
            waker: Waker::new().map_err(RunError::Io)?,
            signals: Signals::new().map_err(RunError::Io)?,
            lookout: Lookout::new(failure_timeout),
        },
        name: job.name,
        plan: job.plan,
        clock,
        sync,
        federate,
        bodies: assembly.bodies,
        status: status_of(job.args).map_err(RunError::Status)?,
        start: Tag::NEVER,
        outside: Vec::new(),
        data_address: job.args.data_address,
        data_port: job.args.data_port,
        signals: 0,
        written_at: PhysicalTime::NEVER,
        reported_at: PhysicalTime::NEVER,
    };
    transport::precise_waits();
    runner.run()
}

/// The clock that one federate's plan asks for; several in one process have one host's.
fn clock_of(plan: &Plan, ids: &[u16], rti: Option<SocketAddr>) -> SystemClock {
    match (rti, ids) {
        (Some(_), [id]) => SystemClock::of_plan(&plan.clock, &plan.federates[usize::from(*id)]),
        (Some(_) | None, _) => SystemClock::new(),
    }
}

fn keep_clock(
    job: &Job<'_>,
    ids: &[u16],
    rti: Option<SocketAddr>,
    clock: &Arc<SystemClock>,
) -> Result<ClockSync, RunError> {
    let (plan, port) = (job.plan, job.args.data_port);
    let id = ids.first().copied().unwrap_or_default();
    let clock = Arc::clone(clock);
    let mut sync = ClockSync::start(&plan.clock, (id, port), clock, rti, plan.extensions)
        .map_err(RunError::Io)?;
    let compared = matches!(
        plan.clock.sync,
        ictus_coord::plan::ClockSync::Init | ictus_coord::plan::ClockSync::On
    );
    if rti.is_some() && !compared {
        check_clock(&mut sync, &plan.federates[usize::from(id)].name)?;
    }
    Ok(sync)
}

/// Refuses a clock that is not good enough, or only says so, as the plan wants it.
fn check_clock(sync: &mut ClockSync, name: &str) -> Result<(), ClockRefusal> {
    match sync.check() {
        Err(refusal) if !sync.refuses() => {
            drop(writeln!(io::stderr(), "ictus: federate {name}: {refusal}"));
            Ok(())
        }
        result => result,
    }
}

/// What a federate shows, if it is to show anything.
fn credentials(job: &Job<'_>, ids: &[u16]) -> Result<Option<Credentials>, RunError> {
    let (Some(directory), [id]) = (&job.args.tls, ids) else {
        return Ok(None);
    };
    let credentials = Credentials::load(directory, Member::Federate(*id));
    let credentials = credentials.map_err(|source| RunError::Credentials {
        directory: directory.clone(),
        source,
    })?;
    Ok(Some(credentials))
}

#[derive(Debug)]
struct Io {
    connection: Option<Connection>,
    peers: Peers,
    waker: Waker,
    signals: Signals,
    /// Whether other hosts still answer.
    lookout: Lookout<Option<usize>>,
}

/// One federate with everything around it.
struct Runner<'a> {
    io: Io,
    name: &'a str,
    plan: &'a Plan,
    clock: Arc<SystemClock>,
    sync: ClockSync,
    federate: Federate,
    bodies: Bodies,
    status: Status,
    start: Tag,
    outside: Vec<OutsideEvent>,
    data_address: Option<Ipv4Addr>,
    data_port: u16,
    signals: usize,
    written_at: PhysicalTime,
    reported_at: PhysicalTime,
}

impl Runner<'_> {
    fn run(mut self) -> Result<u8, RunError> {
        let waker = self.io.waker.clone();
        self.bodies
            .outside()
            .on_event(Box::new(move || waker.wake()));
        let mut now = self.clock.now();
        self.listen()?;
        self.federate.connect();
        if self.io.connection.is_none() {
            self.federate.start(Tag::new(now.as_logical(), 0));
            self.events();
        }
        let looks_at_clock = !self.plan.fast;
        let mut steps = 0;
        loop {
            steps += 1;
            if looks_at_clock || steps % STEPS_PER_LOOK == 0 {
                now = self.clock.now();
            }
            self.guard(now);
            if steps % STEPS_PER_LOOK == 0 {
                self.look(now);
                // A program that never waits still hears signals.
                if self.io.signals.pending() {
                    self.take_signals()?;
                }
            }
            match self.federate.poll(now, &mut self.bodies) {
                Poll::Run => self.execute(now)?,
                Poll::Wait(until) => {
                    if self.federate.resigned() {
                        break;
                    }
                    self.wait(now, until)?;
                    now = self.clock.now();
                    self.look(now);
                    // The clock may just have been corrected.
                    now = self.clock.now();
                }
                Poll::Ended => break,
            }
        }
        self.events();
        self.leave()
    }

    /// Listens for other federates at the data address, or else where this host reaches the RTI.
    fn listen(&mut self) -> Result<(), RunError> {
        if let Some(connection) = &self.io.connection {
            let here = match self.data_address {
                Some(address) => IpAddr::V4(address),
                None => connection.local().map_err(RunError::Io)?.ip(),
            };
            let address = SocketAddr::new(here, self.data_port);
            let peers = &mut self.io.peers;
            peers
                .listen(address, &mut self.federate)
                .map_err(|source| RunError::Listen { address, source })?;
        }
        Ok(())
    }

    #[inline]
    fn execute(&mut self, now: PhysicalTime) -> Result<(), RunError> {
        self.federate.run_batch(&mut self.bodies);
        if self.bodies.fault().is_some() {
            self.federate.fail();
        }
        let pending = self.pending();
        if pending > FLUSH_BYTES || (pending > 0 && now.since(self.written_at) > FLUSH_AGE) {
            self.write(now);
            let mut now = now;
            while self.pending() > BACKLOG_BYTES && self.federate.outcome().is_none() {
                self.wait(now, Some(now + BACKLOG_LOOK))?;
                now = self.clock.now();
                self.guard(now);
                self.look(now);
                self.write(now);
                self.io.peers.give_up(now, &mut self.federate);
            }
        }
        Ok(())
    }

    /// Bytes that wait to be written, of the fullest connection.
    #[inline]
    fn pending(&mut self) -> usize {
        let rti = self.federate.output().map_or(0, |out| out.len());
        if self.io.peers.is_empty() {
            return rti;
        }
        rti.max(self.io.peers.backlog(&mut self.federate))
    }

    /// Everything that came from outside: bytes, events, signals; then what the federate wants known.
    fn look(&mut self, now: PhysicalTime) {
        self.look_out();
        let mut drained = true;
        if let Some(connection) = &mut self.io.connection
            && !connection.closed()
        {
            drained = connection.read();
            // Clocks are compared by when a message was there, not by when it was looked for.
            let joining = self.start == Tag::NEVER;
            let now = if joining { self.clock.now() } else { now };
            let used = self
                .federate
                .receive(now, connection.bytes(), &mut self.bodies);
            connection.take(used);
            if connection.closed() {
                self.federate.handle_disconnect();
            }
        }
        if !self.io.peers.is_empty() {
            let Io { peers, .. } = &mut self.io;
            drained &= peers.read(now, &mut self.federate, &mut self.bodies);
            peers.tidy(&self.federate);
        }
        if drained {
            self.federate.looked(now);
        }
        self.bodies.drain_outside(&mut self.outside);
        for event in self.outside.drain(..) {
            let tag = self
                .federate
                .schedule_physical(event.stamp, event.action, event.value);
            self.bodies.note_physical(event.action, tag);
        }
        self.events();
        self.report_progress(now);
    }

    fn wait(&mut self, now: PhysicalTime, until: Option<PhysicalTime>) -> Result<(), RunError> {
        self.federate.flush();
        self.write(now);
        let wants_write = self.federate.output().is_some_and(|out| !out.is_empty());
        let progress = self
            .status
            .enabled()
            .then(|| self.reported_at + PROGRESS_EVERY);
        let until = until
            .into_iter()
            .chain(progress)
            .chain(self.watchdog())
            .min();
        let timeout = until.map(|until| until.since(self.clock.now()));
        let timeout = timeout.into_iter().chain(self.io.patience()).min();
        if self.sleep(wants_write, timeout)? {
            self.take_signals()?;
        }
        Ok(())
    }

    /// Waits for anything; says whether a signal came.
    fn sleep(&mut self, wants_write: bool, timeout: Option<Duration>) -> Result<bool, RunError> {
        let Io {
            connection,
            peers,
            waker,
            signals,
            ..
        } = &self.io;
        let rti = connection.iter();
        let rti = rti.map(|connection| Awaited::Connection(connection, wants_write));
        let signal = if peers.is_empty() {
            transport::wait(rti, waker, signals, timeout)
        } else {
            let peers = peers.awaited(&mut self.federate);
            transport::wait(rti.chain(peers), waker, signals, timeout)
        };
        signal.map_err(RunError::Io)
    }

    /// When a watchdog expires; none does once the last tag is completed.
    #[inline]
    fn watchdog(&self) -> Option<PhysicalTime> {
        let due = self.bodies.next_watchdog()?;
        (!self.federate.timeline().finished()).then_some(due)
    }

    /// Runs the watchdogs that have expired.
    #[inline]
    fn guard(&mut self, now: PhysicalTime) {
        if self.watchdog().is_some_and(|due| due <= now) {
            self.fire_watchdogs(now);
        }
    }

    #[cold]
    fn fire_watchdogs(&mut self, now: PhysicalTime) {
        let fired = self.bodies.fire_watchdogs(now);
        if fired.stop {
            self.federate.request_stop(now);
        }
        if self.bodies.fault().is_some() {
            self.federate.fail();
        }
        // The events that the handlers made.
        self.look(now);
    }

    fn take_signals(&mut self) -> Result<(), RunError> {
        for _ in 0..self.io.signals.take() {
            self.signals += 1;
            match self.signals {
                1 if self.start != Tag::NEVER => self.federate.request_stop(self.clock.now()),
                _ => return Err(RunError::Interrupted),
            }
        }
        Ok(())
    }

    fn write(&mut self, now: PhysicalTime) {
        self.written_at = now;
        if let (Some(connection), Some(out)) = (&mut self.io.connection, self.federate.output())
            && (!out.is_empty() || connection.owed() > 0)
        {
            connection.write(out);
        }
        if !self.io.peers.is_empty() {
            self.io.peers.write(now, &mut self.federate);
        }
    }

    fn events(&mut self) {
        while let Some(event) = self.federate.poll_event() {
            let federate = self.name.to_owned();
            match event {
                FederateEvent::Joined => self.status.say(&FederateStatus::Joined { federate }),
                FederateEvent::ClockOffset(interval) => self.begin_clock(interval),
                FederateEvent::Started(start) => {
                    self.start = start;
                    self.bodies.start(start);
                    let start_ns = start.time.as_nanos();
                    self.status
                        .say(&FederateStatus::Start { federate, start_ns });
                }
                FederateEvent::Running => self.status.say(&FederateStatus::Running { federate }),
                FederateEvent::StopGranted(tag) => self.bodies.note_stop(tag),
                FederateEvent::StopRequested | FederateEvent::PeerLost(_) => {}
                FederateEvent::Connect {
                    peer,
                    address,
                    port,
                } => {
                    let now = self.clock.now();
                    let peers = &mut self.io.peers;
                    let words = peers.connect(&mut self.federate, now, peer, (address, port));
                    if let Some(words) = words {
                        drop(writeln!(
                            io::stderr(),
                            "ictus: federate {federate}: {words}"
                        ));
                    }
                }
                FederateEvent::PeerRefused(words) | FederateEvent::PeerLeft(words) => {
                    drop(writeln!(
                        io::stderr(),
                        "ictus: federate {federate}: {words}"
                    ));
                }
                FederateEvent::StpViolation {
                    upstream,
                    lateness,
                    count,
                } => self.status.say(&FederateStatus::StpViolation {
                    federate,
                    upstream,
                    lateness_ns: lateness.as_nanos(),
                    count,
                }),
                FederateEvent::Lag(LagNews::FallingBehind { lag }) => {
                    let lag_ns = lag.as_nanos();
                    let status = FederateStatus::FallingBehind { federate, lag_ns };
                    self.status.say(&status);
                }
                FederateEvent::Lag(LagNews::CaughtUp { lag }) => {
                    let lag_ns = lag.as_nanos();
                    self.status
                        .say(&FederateStatus::CaughtUp { federate, lag_ns });
                }
            }
        }
    }

    /// The exchanges while joining are done: the clock is corrected, and may be refused.
    fn begin_clock(&mut self, interval: Interval) {
        // What was noted by the clock as it was says nothing now.
        (self.written_at, self.reported_at) = (PhysicalTime::NEVER, PhysicalTime::NEVER);
        if let Err(error) = self.sync.begin(interval) {
            self.federate.refuse_clock(error.to_string());
        }
        if let Err(refusal) = check_clock(&mut self.sync, self.name) {
            self.federate.refuse_clock(refusal.to_string());
        }
    }

    fn elapsed_ns(&self, tag: Tag) -> i64 {
        tag.time.since(self.start.time).as_nanos()
    }

    /// After the last tag: the last bytes, the trace's end, the last status line, the exit code.
    fn leave(mut self) -> Result<u8, RunError> {
        self.bodies.outside().close();
        let at = self.federate.timeline().at();
        let (mut code, mut reason) = self.verdict();
        self.bodies
            .note_end(at, &reason)
            .map_err(RunError::Observe)?;
        let left = self.drain()?;
        if left > 0 && code == exit::OK {
            code = exit::FAILED;
            reason = format!("{left} bytes of the last messages were not taken by their receiver");
        }
        self.report();
        let started = self.start != Tag::NEVER;
        self.status.say(&FederateStatus::Ended {
            federate: self.name.to_owned(),
            elapsed_ns: if started { self.elapsed_ns(at) } else { 0 },
            microstep: at.microstep,
            code,
            reason: reason.clone(),
        });
        if code != exit::OK {
            drop(writeln!(
                io::stderr(),
                "ictus: federate {}: {reason}",
                self.name
            ));
        }
        Ok(code)
    }

    /// Writes what is left, half-closes, and reads to the end: a socket closed with unread bytes would lose them.
    ///
    /// Returns how many bytes nobody took.
    fn drain(&mut self) -> Result<usize, RunError> {
        if self.io.connection.is_none() {
            return Ok(0);
        }
        let (mut since, mut left) = (self.clock.now(), usize::MAX);
        let (mut finished, mut told) = (false, false);
        loop {
            let now = self.clock.now();
            self.write(now);
            let empty = self.federate.output().is_none_or(|out| out.is_empty());
            let waiting = self.io.peers.backlog(&mut self.federate);
            if waiting < left {
                (since, left) = (now, waiting);
            }
            let Io {
                connection, peers, ..
            } = &mut self.io;
            let Some(connection) = connection else {
                return Ok(waiting);
            };
            // Last: who reads what was sent to it may still need the RTI to count this federate as here.
            if empty && waiting == 0 && !finished {
                finished = connection.finish();
            }
            connection.read();
            let count = connection.bytes().len();
            connection.take(count);
            let closed = connection.closed();
            if closed && !std::mem::replace(&mut told, true) {
                self.federate.handle_disconnect();
            }
            // What senders still bring is too late, and counted.
            peers.read(now, &mut self.federate, &mut self.bodies);
            peers.tidy(&self.federate);
            let ended = self.federate.poll(now, &mut self.bodies) == Poll::Ended;
            let until = since + if waiting > 0 { TAKEN_WITHIN } else { DRAIN_FOR };
            if (closed && waiting == 0 && ended) || now > until {
                return Ok(waiting);
            }
            if self.sleep(!empty, Some(until.since(now)))? {
                self.take_signals()?;
            }
        }
    }

    fn verdict(&self) -> (u8, String) {
        if let Some(fault) = self.bodies.fault() {
            let elapsed = Duration::from_nanos(self.elapsed_ns(fault.tag));
            let reason = format!(
                "reaction {} of {} panicked at tag ({elapsed}, {}): {}",
                fault.reaction, fault.path, fault.tag.microstep, fault.message
            );
            return (exit::FAILED, reason);
        }
        match self.federate.outcome() {
            None | Some(Outcome::Stopped) => (exit::OK, Outcome::Stopped.to_string()),
            Some(Outcome::PeerLost(id)) => {
                let name = self
                    .plan
                    .federates
                    .get(usize::from(*id))
                    .map_or("?", |f| &f.name);
                (
                    exit::PEER_FAILED,
                    format!("stopped because federate {name} was lost"),
                )
            }
            Some(outcome @ Outcome::RtiLost) => self.rti_lost(outcome),
            Some(outcome @ Outcome::RtiFailed) => (exit::PEER_FAILED, outcome.to_string()),
            Some(
                outcome @ (Outcome::Rejected(_)
                | Outcome::NotJoined { .. }
                | Outcome::RtiUnproven
                | Outcome::RejectedByPeer { .. }),
            ) => (exit::NOT_JOINED, outcome.to_string()),
            Some(outcome @ Outcome::TooManyViolations(_)) => {
                (exit::STP_VIOLATIONS, outcome.to_string())
            }
            Some(outcome @ Outcome::Clock(_)) => (exit::CLOCK, outcome.to_string()),
            Some(outcome) => (exit::FAILED, outcome.to_string()),
        }
    }

    fn rti_lost(&self, outcome: &Outcome) -> (u8, String) {
        let rti = self.rti_name();
        let failure = self.io.connection.as_ref().and_then(Connection::failure);
        match failure {
            Some(why) if self.start == Tag::NEVER => {
                (exit::NOT_JOINED, format!("cannot join the RTI{rti}: {why}"))
            }
            Some(why) => (exit::RTI_LOST, format!("{outcome}{rti}: {why}")),
            None => (exit::RTI_LOST, format!("{outcome}{rti}")),
        }
    }
}
