//! A federation in a simulated world: hosts with clocks, a network, the RTI, faults, an observer. One seed, no thread.
//!
//! Every federate is driven as the documentation of `Federate` says, and the RTI as that of `Rti`: what a real driver
//! does with sockets and waits, the world does with an event queue over true time.

mod host;
mod roads;
mod rti;

use crate::coverage::Feature;
use crate::executor::SimulatedExecutor;
use crate::observer::{Observer, Position, Violation};
use crate::seed::Rng;
use crate::swarm::{Ending, Swarm};
use host::Host;
use ictus_coord::federate::{FederateConfig, LinkConfig, Outcome};
use ictus_coord::mutants::Mutants;
use ictus_coord::plan::Plan;
use ictus_core::{Duration, NodeId, Program, Tag};
use roads::{Laws, Road};
use rti::RtiHost;
use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::sync::Arc;

/// A federate to be.
#[derive(Debug)]
pub struct Member<E> {
    /// Its program.
    pub program: Arc<Program>,
    /// Its place in the federation.
    pub link: LinkConfig,
    /// Its values and reaction bodies.
    pub executor: E,
    /// Whether it announces progress by LTC alone, as TypeScript sources do.
    pub legacy: bool,
}

/// How the world treats a federation.
#[derive(Clone, Debug)]
pub struct Conditions {
    /// Network, clocks, ending.
    pub swarm: Swarm,
    /// Time-out, fast, keepalive.
    pub config: FederateConfig,
    /// Rules that are wrong.
    pub mutants: Mutants,
}

/// No run takes longer (true time): whoever has not ended by then never will.
const LONGEST: i64 = 900_000_000_000;

/// No survivor may need longer after a crash (true time).
const LONGEST_AFTER_CRASH: i64 = 20_000_000_000;

/// More events than any run needs.
const MOST_EVENTS: u64 = 3_000_000;

/// The world.
#[derive(Debug)]
pub struct World<E> {
    conditions: Conditions,
    rng: Rng,
    now: i64,
    queue: BinaryHeap<Reverse<(i64, u64, Event)>>,
    sequence: u64,
    hosts: Vec<Host<E>>,
    rti: RtiHost,
    /// Connections from federate to federate.
    roads: Vec<Road>,
    laws: Laws,
    observer: Observer,
    wakes: Vec<i64>,
    crashed: Option<(i64, Victim)>,
    start_seen: bool,
    events: u64,
}

/// Who dies.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Victim {
    /// A federate, and whether the federation was running.
    Federate(usize),
    /// The RTI.
    Rti,
}

#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
enum Event {
    Connect(usize),
    Wake(usize),
    WakeRti,
    Done(usize, NodeId),
    Outside(usize),
    AskStop(usize),
    CrashFederate(usize),
    CrashRti,
}

/// What became of a run.
#[derive(Debug)]
pub struct Run<E> {
    /// Per federate: its executor, how it ended, its stop tag.
    pub members: Vec<Ended<E>>,
    /// The start tag, if the federation started.
    pub start: Option<Tag>,
    /// Who died.
    pub victim: Option<Victim>,
    /// What was seen.
    pub observer: Observer,
    /// True time at the end.
    pub duration: Duration,
    /// Under decentralized coordination: from this tag on, what ran may differ from the program alone.
    pub faithful: Option<Tag>,
}

/// How one federate ended.
#[derive(Debug)]
pub struct Ended<E> {
    /// Its executor.
    pub executor: E,
    /// How, if it ended by itself.
    pub outcome: Option<Outcome>,
    /// Its stop tag.
    pub stop: Tag,
    /// The last tag it completed.
    pub at: Tag,
    /// Tags completed.
    pub tags: u64,
}

impl<E> Run<E> {
    /// The first law that was broken.
    #[must_use]
    pub fn violation(&self) -> Option<&Violation> {
        self.observer.violation()
    }
}

impl<E: SimulatedExecutor> World<E> {
    /// A world in which nothing has happened yet.
    #[must_use]
    pub fn new(
        members: Vec<Member<E>>,
        plan: &Plan,
        observer: Observer,
        conditions: Conditions,
        rng: &Rng,
    ) -> Self {
        let draw = rng.fork(0xd0);
        let count = members.len();
        let hosts = members.into_iter().enumerate().map(|(index, member)| {
            let host_rng = rng.fork(0x100 + index as u64);
            Host::new(member, &conditions, host_rng)
        });
        let mut world = Self {
            hosts: hosts.collect(),
            rti: RtiHost::new(count, &conditions, rng.fork(0xd1)),
            rng: draw,
            now: 0,
            roads: Vec::new(),
            laws: Laws::of_plan(plan),
            queue: BinaryHeap::new(),
            sequence: 0,
            observer,
            wakes: Vec::new(),
            crashed: None,
            start_seen: false,
            events: 0,
            conditions,
        };
        for federate in 0..count {
            let at = world.rng.span(Duration::ZERO, Duration::from_millis(50));
            world.at(at.as_nanos(), Event::Connect(federate));
        }
        world.plan_partitions();
        world.plan_early_crash();
        world
    }

    /// Runs to the end, or to the first violation.
    #[must_use]
    pub fn run(mut self) -> Run<E> {
        while let Some(Reverse((at, _, event))) = self.queue.pop() {
            self.now = at;
            self.observer.now = at;
            self.events += 1;
            self.handle(event);
            if self.observer.violation().is_some() || self.all_ended() {
                break;
            }
            self.check_liveness();
        }
        if !self.all_ended() {
            let stuck = self.describe_stuck();
            self.observer.blame("liveness", stuck);
        }
        self.check_laws();
        for host in &self.hosts {
            let counters = host.counters();
            let coverage = &mut self.observer.coverage;
            coverage.add(Feature::SkippedAnnouncement, counters.skipped_announcements);
            coverage.add(Feature::FlowControlWait, counters.held_back);
        }
        Run {
            start: self.observer.start(),
            faithful: self.laws.faithful,
            members: self.hosts.into_iter().map(Host::into_ended).collect(),
            victim: self.crashed.map(|c| c.1),
            duration: Duration::from_nanos(self.now),
            observer: self.observer,
        }
    }

    fn check_liveness(&mut self) {
        let limit = self.crashed.map_or(LONGEST, |(at, _)| {
            at + LONGEST_AFTER_CRASH + self.slowness()
        });
        if self.now > limit || self.events > MOST_EVENTS {
            let stuck = self.describe_stuck();
            self.observer.blame("liveness", stuck);
        }
    }

    /// What slow networks, partitions and reactions may add to any bound.
    fn slowness(&self) -> i64 {
        let network = &self.conditions.swarm.network;
        let partitions = i64::try_from(network.partitions).unwrap_or(0);
        2_000 * network.delay_max.as_nanos() + partitions * network.partition.as_nanos()
    }

    fn describe_stuck(&self) -> String {
        let waiting: Vec<String> = self
            .hosts
            .iter()
            .enumerate()
            .filter(|(_, host)| !host.is_over())
            .map(|(index, host)| format!("{index} at {:?}", host.position()))
            .collect();
        let rti = if self.rti.is_over() {
            "over"
        } else {
            "not over"
        };
        format!(
            "after {} events, at {} ns, not ended: {}; RTI {rti}",
            self.events,
            self.now,
            waiting.join(", ")
        )
    }

    fn all_ended(&self) -> bool {
        self.rti.is_over() && self.hosts.iter().all(Host::is_over)
    }

    fn at(&mut self, at: i64, event: Event) {
        self.sequence += 1;
        self.queue.push(Reverse((at, self.sequence, event)));
    }

    fn handle(&mut self, event: Event) {
        match event {
            Event::Connect(federate) => self.connect(federate),
            Event::Wake(federate) => {
                if self.hosts[federate].woken(self.now) {
                    self.drive(federate);
                }
            }
            Event::WakeRti => {
                if self.rti.woken(self.now) {
                    self.drive_rti();
                }
            }
            Event::Done(federate, node) => self.node_done(federate, node),
            Event::Outside(federate) => self.outside(federate),
            Event::AskStop(federate) => self.ask_stop(federate),
            Event::CrashFederate(federate) => self.crash_federate(federate),
            Event::CrashRti => self.crash_rti(),
        }
    }

    /// Makes sure that the federate is looked at by `at`.
    fn wake(&mut self, federate: usize, at: i64) {
        if self.hosts[federate].wants_wake(at) {
            self.at(at.max(self.now), Event::Wake(federate));
        }
    }

    fn wake_rti(&mut self, at: i64) {
        if self.rti.wants_wake(at) {
            self.at(at.max(self.now), Event::WakeRti);
        }
    }

    /// Bytes are on their way to the RTI: it will look at them a little after they arrive.
    fn wake_rti_for_arrivals(&mut self) {
        let mut wakes = std::mem::take(&mut self.wakes);
        for at in wakes.drain(..) {
            let at = at + self.rti.dawdle();
            self.at(at, Event::WakeRti);
        }
        self.wakes = wakes;
    }

    fn wake_for_arrivals(&mut self, federate: usize) {
        let mut wakes = std::mem::take(&mut self.wakes);
        for at in wakes.drain(..) {
            self.at(at, Event::Wake(federate));
        }
        self.wakes = wakes;
    }

    fn plan_partitions(&mut self) {
        let network = self.conditions.swarm.network;
        for _ in 0..network.partitions {
            let victim = self.rng.below(self.hosts.len());
            let from = self
                .rng
                .span(Duration::ZERO, Duration::from_millis(700))
                .as_nanos();
            let to = from + network.partition.as_nanos();
            let host = &mut self.hosts[victim];
            // Asymmetric now and then.
            let which = self.rng.below(4);
            if which != 0 {
                host.up.partition(from, to);
            }
            if which != 1 {
                host.down.partition(from, to);
            }
            self.observer.coverage.hit(Feature::Partition);
        }
    }

    fn plan_early_crash(&mut self) {
        if self.conditions.swarm.ending == Ending::FederateCrash && self.rng.percent(12) {
            let victim = self.rng.below(self.hosts.len());
            let at = self.rng.span(Duration::ZERO, Duration::from_millis(60));
            self.at(at.as_nanos(), Event::CrashFederate(victim));
        }
    }

    /// Once the start tag is known: what is to happen during the run.
    fn plan_run(&mut self, start: i64) {
        if std::mem::replace(&mut self.start_seen, true) {
            return;
        }
        let swarm = self.conditions.swarm.clone();
        let length = if swarm.mode.fast {
            swarm.network.delay_max.as_nanos() * 30
        } else {
            self.conditions.config.timeout.map_or(0, Duration::as_nanos)
        };
        let from = if swarm.mode.fast { self.now } else { start };
        let within = Duration::from_nanos(length);
        match swarm.ending {
            Ending::OutsideStop { askers } => {
                let first = self.rng.span(Duration::ZERO, within).as_nanos();
                for _ in 0..askers {
                    let asker = self.rng.below(self.hosts.len());
                    let spread = *self.rng.pick(&[0, 100_000, 3_000_000]);
                    let later = self.rng.span(Duration::ZERO, Duration::from_nanos(spread));
                    self.at(from + first + later.as_nanos(), Event::AskStop(asker));
                }
            }
            Ending::FederateCrash => {
                let victim = self.rng.below(self.hosts.len());
                let at = from + self.rng.span(Duration::ZERO, within).as_nanos();
                self.at(at, Event::CrashFederate(victim));
            }
            Ending::RtiCrash => {
                let at = from + self.rng.span(Duration::ZERO, within).as_nanos();
                self.at(at, Event::CrashRti);
            }
            Ending::Timeout | Ending::ReactionStop | Ending::Starvation => {}
        }
        if swarm.shape.physical {
            for federate in 0..self.hosts.len() {
                let later = self.rng.span(Duration::ZERO, Duration::from_millis(20));
                self.at(from + later.as_nanos(), Event::Outside(federate));
            }
        }
    }

    fn crash_federate(&mut self, federate: usize) {
        if self.crashed.is_some() || self.hosts[federate].is_over() {
            return;
        }
        let running = self.observer.start().is_some();
        self.observer.coverage.hit(if running {
            Feature::Crash
        } else {
            Feature::CrashWhileJoining
        });
        self.crashed = Some((self.now, Victim::Federate(federate)));
        self.observer.lose();
        let lose = self.rng.percent(50);
        let now = self.now;
        self.hosts[federate].die(now, lose, &mut self.wakes);
        self.wake_rti_for_arrivals();
        self.break_roads(federate, lose);
        self.end_of_faith();
        if !self.rti.knows(federate) {
            self.rti.give_up(now);
            self.wake_rti(now);
        }
    }

    fn crash_rti(&mut self) {
        if self.crashed.is_some() || self.rti.is_over() {
            return;
        }
        self.observer.coverage.hit(Feature::RtiCrash);
        self.crashed = Some((self.now, Victim::Rti));
        self.observer.lose();
        self.rti.die();
        self.end_of_faith();
        for federate in 0..self.hosts.len() {
            let lose = self.rng.percent(50);
            let now = self.now;
            self.hosts[federate]
                .down
                .break_off(now, lose, &mut self.wakes);
            self.wake_for_arrivals(federate);
        }
    }

    /// Where every federate truly is.
    fn truth(&self) -> Vec<Position> {
        self.hosts.iter().map(Host::position).collect()
    }
}
