//! Runs reactors in this process, as fast as they go, with a clock that the test moves.

use ictus::value::digest_of;
use ictus::{Assembly, AssemblyError, Class, Clock, Counters, Fault, Observation, Value};
use ictus_coord::FederateExecutor;
use ictus_coord::plan::{ConnectionPlan, Endpoint, FederatePlan, Plan};
use ictus_core::{
    Duration, Effects, Executor, LogicalTime, NodeId, PhysicalTime, Progress, Tag, Timeline,
};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};

/// The start tag of every test.
pub const START: Tag = Tag::at(1_000_000_000);

/// A clock that stands still until it is moved.
#[derive(Debug, Default)]
pub struct TestClock(AtomicI64);

impl TestClock {
    pub fn set(&self, after_start: Duration) {
        let time = START.time.as_nanos() + after_start.as_nanos();
        self.0.store(time, Ordering::Relaxed);
    }
}

impl Clock for TestClock {
    fn now(&self) -> PhysicalTime {
        PhysicalTime::from_nanos(self.0.load(Ordering::Relaxed))
    }
}

/// A plan in the making: federates by name, connections by `federate.port[channel]`.
pub struct World {
    plan: Plan,
    classes: Vec<Class>,
    pub clock: Arc<TestClock>,
    stop_after: Option<Duration>,
}

/// What a run left behind.
pub struct Ran {
    pub fault: Option<Fault>,
    pub end: Tag,
    pub deadlines_missed: u64,
    pub counters: Counters,
    /// Per federate, in the order of the plan: the trace without its last line.
    pub traces: Vec<String>,
}

impl World {
    pub fn new(classes: &[Class]) -> Self {
        let clock = Arc::new(TestClock::default());
        clock.set(Duration::ZERO);
        Self {
            plan: Plan {
                federation: "test".to_owned(),
                extensions: true,
                ..Plan::default()
            },
            classes: classes.to_vec(),
            clock,
            stop_after: None,
        }
    }

    /// One instance, named `main`, of one class.
    pub fn of(class: Class) -> Self {
        Self::new(&[class]).federate("main", class.name(), "{}")
    }

    pub fn federate(mut self, name: &str, class: &str, parameters: &str) -> Self {
        self.plan.federates.push(FederatePlan {
            name: name.to_owned(),
            class: Some(class.to_owned()),
            parameters: serde_json::from_str(parameters).unwrap(),
            ..FederatePlan::default()
        });
        self
    }

    pub fn connect(mut self, from: &str, to: &str, after: Option<Duration>) -> Self {
        let port_id = u16::try_from(self.plan.connections.len()).unwrap();
        self.plan.connections.push(ConnectionPlan {
            from: self.endpoint(from),
            to: self.endpoint(to),
            after_ns: after.map(Duration::as_nanos),
            port_id,
            ..ConnectionPlan::default()
        });
        self
    }

    /// Makes the connection added last a physical one.
    pub fn physical(mut self) -> Self {
        self.plan.connections.last_mut().unwrap().physical = true;
        self
    }

    pub fn fast(mut self) -> Self {
        self.plan.fast = true;
        self
    }

    fn endpoint(&self, text: &str) -> Endpoint {
        let (federate, port) = text.split_once('.').unwrap();
        let (port, channel) = port.split_once('[').map_or((port, 0), |(port, rest)| {
            (port, rest.trim_end_matches(']').parse().unwrap())
        });
        let index = self.plan.federates.iter().position(|f| f.name == federate);
        Endpoint {
            federate: u16::try_from(index.unwrap()).unwrap(),
            port: port.to_owned(),
            channel,
        }
    }

    pub fn timeout(mut self, after: Duration) -> Self {
        self.stop_after = Some(after);
        self
    }

    pub fn assemble(&self) -> Result<Assembly, AssemblyError> {
        let mine: Vec<u16> = (0..u16::try_from(self.plan.federates.len()).unwrap()).collect();
        self.assemble_some(&mine)
    }

    pub fn assemble_some(&self, mine: &[u16]) -> Result<Assembly, AssemblyError> {
        let clock = Arc::clone(&self.clock);
        Assembly::new(&self.plan, mine, &self.classes, clock)
    }

    pub fn run(&self) -> Ran {
        let mut assembly = self.assemble().unwrap_or_else(|error| panic!("{error}"));
        self.run_assembly(&mut assembly)
    }

    /// Runs to the stop tag, or until nothing is left.
    pub fn run_assembly(&self, assembly: &mut Assembly) -> Ran {
        let dir = tempfile::tempdir().unwrap();
        let bodies = &mut assembly.bodies;
        bodies
            .observe(&Observation {
                trace: Some(dir.path().to_owned()),
                timing: None,
            })
            .unwrap();
        bodies.start(START);
        let stop = self.stop_after.map_or(Tag::FOREVER, |after| {
            Tag::new(START.time.saturating_add(after), 0)
        });
        let mut timeline = Timeline::new(Arc::clone(&assembly.program));
        timeline.start(START, stop);
        drive(&mut timeline, bodies, &self.clock);
        let end = timeline.at();
        bodies.note_end(end, "test").unwrap();
        Ran {
            fault: bodies.fault().cloned(),
            end,
            deadlines_missed: bodies.counters().deadlines_missed,
            counters: bodies.counters(),
            traces: self
                .plan
                .federates
                .iter()
                .map(|f| trace(dir.path(), &f.name))
                .collect(),
        }
    }
}

/// The loop of one process, without waiting.
fn drive(timeline: &mut Timeline, bodies: &mut ictus::Bodies, clock: &TestClock) {
    loop {
        let mut stop = bodies.fire_watchdogs(clock.now()).stop;
        take_outside(timeline, bodies);
        let mut tag = timeline.next_tag();
        if tag == Tag::FOREVER {
            // Starvation: without keepalive, the tag after the last one is the stop tag.
            tag = timeline.at().next_microstep().unwrap();
            stop = true;
        }
        if stop {
            timeline.stop_at(tag);
        }
        run_tag(timeline, bodies, clock);
        if timeline.finished() || bodies.fault().is_some() {
            return;
        }
    }
}

/// Schedules what threads and handlers sent.
pub fn take_outside(timeline: &mut Timeline, bodies: &mut ictus::Bodies) {
    let mut events = Vec::new();
    bodies.drain_outside(&mut events);
    for event in events {
        let tag = timeline.schedule_physical(event.stamp, event.action, event.value, Tag::NEVER);
        bodies.note_physical(event.action, tag);
    }
    while let Some((action, value)) = timeline.pop_released() {
        bodies.release(action, value);
    }
}

/// Runs the next tag.
pub fn run_tag(timeline: &mut Timeline, bodies: &mut ictus::Bodies, clock: &TestClock) {
    let program = Arc::clone(timeline.program());
    let tag = timeline.next_tag();
    let (mut batch, mut present) = (Vec::<NodeId>::new(), Vec::new());
    let mut effects = Effects::default();
    bodies.begin(tag);
    timeline.begin(tag, &mut present);
    for (action, value) in present {
        bodies.arrive(action, program.action_slot(action), value);
    }
    while timeline.ready(&mut batch) == Progress::Batch {
        for node in batch.drain(..) {
            match timeline.tardy(node) {
                None => bodies.run(node, tag, &mut effects),
                Some(intended) => bodies.run_tardy(node, tag, intended, &mut effects),
            }
            timeline.finish(&[node], &mut effects);
        }
        for (action, value) in effects.physical.drain(..) {
            let tag = timeline.schedule_physical(clock.now(), action, value, Tag::NEVER);
            bodies.note_physical(action, tag);
        }
        if std::mem::take(&mut effects.stop) {
            timeline.stop_at(tag.next_microstep().unwrap());
        }
    }
    timeline.complete();
}

fn trace(directory: &Path, federate: &str) -> String {
    let text = std::fs::read_to_string(directory.join(format!("{federate}.trace"))).unwrap();
    let lines: Vec<&str> = text.lines().collect();
    let (last, lines) = lines.split_last().unwrap();
    assert!(last.starts_with("# end "), "{last}");
    lines.iter().map(|line| format!("{line}\n")).collect()
}

/// A tag so long after the start.
pub fn at(after_start: Duration, microstep: u32) -> Tag {
    let time = START.time.saturating_add(after_start);
    Tag::new(LogicalTime::from_nanos(time.as_nanos()), microstep)
}

/// One line of a trace: when, which reaction, what it did.
pub fn line(when: (Duration, u32), reaction: (&str, u32), effects: &[(&str, u64)]) -> String {
    record(when, reaction, "body", effects)
}

/// As [`line`] for a deadline handler.
pub fn late(when: (Duration, u32), reaction: (&str, u32), effects: &[(&str, u64)]) -> String {
    record(when, reaction, "deadline", effects)
}

/// As [`line`] for an STP handler.
pub fn stp(when: (Duration, u32), reaction: (&str, u32), effects: &[(&str, u64)]) -> String {
    record(when, reaction, "stp", effects)
}

fn record(
    (time, microstep): (Duration, u32),
    (path, index): (&str, u32),
    kind: &str,
    effects: &[(&str, u64)],
) -> String {
    let effects: Vec<_> = effects
        .iter()
        .map(|(name, d)| format!("{name}={d:016x}"))
        .collect();
    let effects = match effects.as_slice() {
        [] => "-".to_owned(),
        some => some.join(","),
    };
    let time = time.as_nanos();
    format!("{time}\t{microstep}\t{path}\t{index}\t{kind}\t{effects}\n")
}

/// The digest of a value.
pub fn d<T: Value>(value: T) -> u64 {
    digest_of(&value).unwrap()
}
