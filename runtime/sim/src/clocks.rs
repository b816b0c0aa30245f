//! Clock synchronization in simulated time: one federate's servo against the RTI's prober, over a bad network.
//!
//! One seed draws offset, drift, wander, delays, asymmetry, jitter, loss, duplicates and steps of either clock (of 50 ms and
//! more: a step smaller than a round trip hides in it, and a queue takes up to 20 ms). Laws, checked at every event and between:
//!
//! - *bound*: the corrected clock is never further from the RTI's than the servo says, except between a step of a clock and
//!   the end of the first exchange that began after it; then the servo says that it is not synchronized.
//! - *tight*: while synchronized, the bound's median is at most 2 x (half the smallest round trip + drift bound x period).
//! - *settled*: on a symmetric path with 100 us of jitter the error's median is under 10 us after convergence.
//! - *monotone*: the corrected clock never goes back unless its host's did.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use ictus_coord::clock::{
    DRIFT_BOUND_PPB, Datagram, Exchange, Follower, Heard, Interval, Prober, Servo,
};
use ictus_coord::mutants::Mutants;
use ictus_coord::plan::ClockPlan;
use ictus_coord::topology::FederateId;
use ictus_core::{Duration, PhysicalTime};

use crate::observer::Violation;
use crate::seed::Rng;

mod path;
mod wandering;

pub use path::Path;
use wandering::Wandering;

/// Between two events the laws are looked at this often, in nanoseconds.
const LOOK_EVERY: i64 = 1_300_000;
/// What the median error must stay under on a symmetric path, in nanoseconds.
const ERROR_MAX: i64 = 10_000;
/// The federate's and the RTI's addresses.
const FEDERATE: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 40_000);
const RTI: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 15_061);

/// What is drawn from a seed.
#[derive(Clone, Debug)]
pub struct Weather {
    /// The time between two exchanges, in nanoseconds.
    pub period: i64,
    /// How long it goes on.
    pub duration: i64,
    /// From the RTI to the federate.
    pub there: Path,
    /// And back.
    pub back: Path,
    /// The clocks' first difference.
    pub offset: i64,
    /// Steps: when, of the RTI's clock or the federate's, by how much.
    pub steps: Vec<(i64, bool, i64)>,
}

/// What a seed showed.
#[derive(Clone, Debug)]
pub struct Verdict {
    /// What was drawn.
    pub weather: Weather,
    /// The first law that was broken.
    pub violation: Option<Violation>,
    /// The median of the absolute error after convergence, in nanoseconds.
    pub error_p50: i64,
    /// ... and its 99th percentile.
    pub error_p99: i64,
    /// The median of the bound while synchronized, in nanoseconds.
    pub bound_p50: i64,
    /// Half the smallest round trip.
    pub half_trip: i64,
    /// Steps made.
    pub made: u64,
    /// Steps noticed.
    pub steps: u64,
}

/// Checks the laws on what a seed draws.
#[must_use]
pub fn check_seed(seed: u64, mutants: Mutants) -> Verdict {
    let mut rng = Rng::new(seed);
    let weather = Weather::draw(&mut rng);
    Run::new(weather, rng, mutants).finish()
}

/// The same on a symmetric path with exponential jitter of 100 us each way, without faults.
#[must_use]
pub fn check_symmetric(seed: u64, mutants: Mutants) -> Verdict {
    let mut rng = Rng::new(seed).fork(100);
    let mut weather = Weather::draw(&mut rng);
    let path = Path {
        least: rng.between(50_000, 500_000).try_into().unwrap_or(0),
        jitter: 100_000,
        ..Path::default()
    };
    (weather.there, weather.back) = (path, path);
    weather.steps.clear();
    weather.period = ClockPlan::default().period_ns;
    weather.duration = 1_500 * weather.period;
    let mut verdict = Run::new(weather, rng, mutants).finish();
    if verdict.error_p50 > ERROR_MAX {
        let what = format!("the error's median is {} ns", verdict.error_p50);
        let checker = "settled";
        verdict.violation.get_or_insert(Violation { checker, what });
    }
    verdict
}

impl Weather {
    fn draw(rng: &mut Rng) -> Self {
        let draw = |rng: &mut Rng, low, high| {
            rng.span(Duration::from_nanos(low), Duration::from_nanos(high))
                .as_nanos()
        };
        let period = *rng.pick(&[5_000_000, 10_000_000, 20_000_000, 50_000_000, 100_000_000]);
        let duration = 600 * period;
        let least = draw(rng, 20_000, 500_000);
        let there = Path::draw(rng, least);
        let back = if rng.percent(50) {
            there
        } else {
            let least = draw(rng, least, 5 * least);
            Path::draw(rng, least)
        };
        let mut steps = Vec::new();
        if rng.percent(40) {
            for _ in 0..rng.between(1, 2) {
                let size = *rng.pick(&[50_000_000, 100_000_000, 1_000_000_000, 40_000_000_000]);
                let by = size + draw(rng, 0, size);
                let by = if rng.percent(50) { by } else { -by };
                steps.push((draw(rng, duration / 5, duration), rng.percent(70), by));
            }
        }
        steps.sort_unstable();
        Self {
            period,
            duration,
            there,
            back,
            offset: draw(rng, -1_000_000_000, 1_000_000_000),
            steps,
        }
    }
}

#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Event {
    ToFederate(Vec<u8>),
    ToRti(Vec<u8>),
    Rti,
    Step,
    Look,
}

struct Run {
    weather: Weather,
    rng: Rng,
    now: i64,
    sequence: u64,
    events: BinaryHeap<Reverse<(i64, u64, Event)>>,
    rti: Wandering,
    base: Wandering,
    prober: Prober,
    follower: Follower,
    servo: Servo,
    /// A step was made and no exchange that began after it is complete: the T1s since.
    excused: Option<Vec<PhysicalTime>>,
    /// How many steps the servo had noticed before.
    noticed: u64,
    /// A step was ever made.
    disturbed: bool,
    made: u64,
    shown: PhysicalTime,
    errors: Vec<i64>,
    bounds: Vec<i64>,
    least_trip: i64,
    violation: Option<Violation>,
}

impl Run {
    fn new(weather: Weather, mut rng: Rng, mutants: Mutants) -> Self {
        let plan = ClockPlan {
            period_ns: weather.period,
            ..ClockPlan::default()
        };
        let epoch = 1_700_000_000_000_000_000;
        let mut run = Self {
            rti: Wandering::draw(&mut rng, epoch + weather.offset),
            base: Wandering::draw(&mut rng, epoch),
            prober: Prober::new(1, Duration::from_nanos(weather.period)),
            follower: Follower::new(0, RTI.ip(), true).with_mutants(mutants),
            servo: Servo::new(&plan).with_mutants(mutants),
            now: 0,
            sequence: 0,
            events: BinaryHeap::new(),
            excused: None,
            noticed: 0,
            disturbed: false,
            made: 0,
            shown: PhysicalTime::NEVER,
            errors: Vec::new(),
            bounds: Vec::new(),
            least_trip: i64::MAX,
            violation: None,
            weather,
            rng,
        };
        run.join(plan.trials);
        run.prober
            .begin(run.rti.reading(run.now), FederateId::new(0), FEDERATE);
        for (at, ..) in run.weather.steps.clone() {
            run.at(run.now + at, Event::Step);
        }
        run.at(run.now, Event::Rti);
        run.at(run.now, Event::Look);
        run
    }

    /// The exchanges over TCP: nothing is lost there.
    fn join(&mut self, trials: u32) {
        let mut exchanges = Vec::new();
        for _ in 0..trials {
            let t1 = self.rti.reading(self.now);
            let delay = self.weather.there.delay(&mut self.rng);
            self.pass(delay);
            let t2 = self.base.reading(self.now);
            self.pass(20_000);
            let t3 = self.base.reading(self.now);
            let delay = self.weather.back.delay(&mut self.rng);
            self.pass(delay);
            let t4 = self.rti.reading(self.now);
            self.pass(50_000);
            let exchange = Exchange { t1, t2, t3, t4 };
            self.least_trip = self.least_trip.min(exchange.round_trip().as_nanos());
            exchanges.push(exchange);
        }
        if let Some(interval) = Interval::of_all(&exchanges) {
            self.servo.begin(self.base.reading(self.now), interval);
        }
    }

    fn pass(&mut self, nanos: i64) {
        self.now += nanos.max(0);
        self.rti.advance(self.now, &mut self.rng);
        self.base.advance(self.now, &mut self.rng);
    }

    /// A program needs some microseconds.
    fn spend(&mut self, least: i64, most: i64) {
        let spent = self
            .rng
            .span(Duration::from_micros(least), Duration::from_micros(most));
        self.pass(spent.as_nanos());
    }

    fn at(&mut self, when: i64, event: Event) {
        self.sequence += 1;
        self.events.push(Reverse((when, self.sequence, event)));
    }

    fn finish(mut self) -> Verdict {
        let end = self.now + self.weather.duration;
        while let Some(Reverse((when, _, event))) = self.events.pop() {
            if when > end || self.violation.is_some() {
                break;
            }
            self.pass(when - self.now);
            self.handle(event);
            self.check();
        }
        self.verdict()
    }

    fn handle(&mut self, event: Event) {
        match event {
            Event::Look => {
                let next = self.now + LOOK_EVERY;
                self.at(next, Event::Look);
            }
            Event::Rti => self.run_prober(),
            Event::ToRti(bytes) => {
                let arrived = self.rti.reading(self.now);
                self.prober.receive(FEDERATE, &bytes, arrived);
                self.transmit();
            }
            Event::ToFederate(bytes) => self.hear(&bytes),
            Event::Step => {
                let (_, rti, by) = self.weather.steps.remove(0);
                let clock = if rti { &mut self.rti } else { &mut self.base };
                clock.step(by);
                self.disturbed = true;
                // Two within one exchange are one.
                if self.excused.is_none() {
                    self.made += 1;
                    self.noticed = self.servo.status(self.base.reading(self.now)).steps;
                }
                self.excused = Some(Vec::new());
                self.shown = PhysicalTime::NEVER;
            }
        }
    }

    fn run_prober(&mut self) {
        let now = self.rti.reading(self.now);
        self.prober.handle_timeout(now);
        self.transmit();
        let next = self
            .prober
            .poll_timeout()
            .map_or(self.weather.period, |at| {
                at.since(now).as_nanos().clamp(1_000, self.weather.period)
            });
        let lateness = self
            .rng
            .span(Duration::ZERO, Duration::from_micros(60))
            .as_nanos();
        let when = self.now + next + lateness;
        self.at(when, Event::Rti);
    }

    fn transmit(&mut self) {
        while let Some(transmit) = self.prober.poll_transmit(self.rti.reading(self.now)) {
            for delay in self.weather.there.copies(&mut self.rng) {
                let when = self.now + delay;
                self.at(when, Event::ToFederate(transmit.bytes.to_vec()));
            }
            // One system call after the other.
            self.spend(2, 9);
            let sent = Datagram::decode(&transmit.bytes);
            if let (Some(since), Some(Datagram::T1(t1))) = (&mut self.excused, sent) {
                since.push(t1);
            }
        }
    }

    fn hear(&mut self, bytes: &[u8]) {
        let arrived = self.base.reading(self.now);
        let missed = self.follower.incomplete();
        match self.follower.receive(RTI, bytes, arrived) {
            Heard::Nothing => {}
            Heard::Answer { datagram, .. } => {
                self.spend(2, 30);
                self.follower.answered(self.base.reading(self.now));
                let bytes = datagram.encode();
                for delay in self.weather.back.copies(&mut self.rng) {
                    let when = self.now + delay;
                    self.at(when, Event::ToRti(bytes.to_vec()));
                }
            }
            Heard::Complete(exchange, survived) => {
                let base = self.base.reading(self.now);
                if exchange.round_trip() > Duration::ZERO && !self.disturbed {
                    self.least_trip = self.least_trip.min(exchange.round_trip().as_nanos());
                }
                let _ = self.servo.take(base, exchange, survived);
                self.excuse_ends(&exchange);
            }
        }
        self.servo.missed(self.follower.incomplete() - missed);
    }

    /// The first exchange that began after the step has ended: the servo must know by now.
    fn excuse_ends(&mut self, exchange: &Exchange) {
        if !self
            .excused
            .as_ref()
            .is_some_and(|since| since.contains(&exchange.t1))
        {
            return;
        }
        self.excused = None;
        let base = self.base.reading(self.now);
        let noticed = self.servo.status(base).steps > self.noticed;
        let error = self.error(self.servo.correction().reading(base));
        // A second step may have undone the first.
        let astray = error > exchange.round_trip().as_nanos();
        if !noticed || (astray && self.servo.is_synchronized(base)) {
            self.violate("step", "the servo has not noticed it".to_owned());
        }
    }

    fn check(&mut self) {
        let base = self.base.reading(self.now);
        let shown = self.servo.correction().reading(base);
        if shown < self.shown {
            let back = self.shown.since(shown);
            self.violate(
                "monotone",
                format!("the corrected clock went back by {back}"),
            );
        }
        self.shown = shown;
        if self.excused.is_some() {
            return;
        }
        let error = self.error(shown);
        let bound = self.servo.bound(base).map_or(i64::MAX, Duration::as_nanos);
        if error > bound {
            let at = self.now;
            self.violate(
                "bound",
                format!("at {at} ns the error is {error} ns, the bound {bound} ns"),
            );
        }
        if self.servo.is_synchronized(base) {
            self.bounds.push(bound);
        }
        if !self.disturbed && self.now > self.weather.duration / 3 {
            self.errors.push(error);
        }
    }

    /// How far a reading is from the RTI's.
    fn error(&self, shown: PhysicalTime) -> i64 {
        shown.since(self.rti.reading(self.now)).as_nanos().abs()
    }

    fn violate(&mut self, checker: &'static str, what: String) {
        self.violation.get_or_insert(Violation { checker, what });
    }

    fn verdict(mut self) -> Verdict {
        self.errors.sort_unstable();
        self.bounds.sort_unstable();
        let quantile = |sorted: &[i64], part: usize| {
            sorted
                .get((sorted.len().saturating_sub(1)) * part / 100)
                .copied()
                .unwrap_or(0)
        };
        let bound_p50 = quantile(&self.bounds, 50);
        let half_trip = self.least_trip / 2;
        let drift = i128::from(DRIFT_BOUND_PPB) * i128::from(self.weather.period) / 1_000_000_000;
        let most = 2 * (half_trip + i64::try_from(drift).unwrap_or(i64::MAX));
        if bound_p50 > most {
            let what = format!("the bound's median is {bound_p50} ns, more than {most} ns");
            self.violate("tight", what);
        }
        Verdict {
            error_p50: quantile(&self.errors, 50),
            error_p99: quantile(&self.errors, 99),
            bound_p50,
            half_trip,
            made: self.made,
            steps: self.servo.status(self.base.reading(self.now)).steps,
            violation: self.violation,
            weather: self.weather,
        }
    }
}
