//! Carrying out one plan: what may begin now, what a failure means, what is undone.

use std::collections::BTreeSet;
use std::time::Duration;

use super::outcome::Cause;
use super::plan::Plan;
use super::step::{Operation, Step, StepId};

/// How long a call may take that takes something back.
const UNDO_LIMIT_MS: u64 = 30_000;

/// The rank of a step that was not answered: what others say about it is a consequence, what a host says itself is not.
const UNANSWERED_RANK: u8 = 1;

/// A point in time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Moment {
    /// Since any fixed moment, by a clock that is never set.
    pub elapsed: Duration,
    /// Nanoseconds since the Unix epoch.
    pub wall_ns: i64,
}

/// What a step came to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// It is done.
    Done,
    /// The lease was given, and this run is there.
    Leased {
        /// Its id; absent only when the host says that there is none.
        run: Option<String>,
    },
    /// It failed, or it is not known whether it was done.
    Failed {
        /// What happened, in words, with the fix.
        what: String,
        /// How likely it is a consequence of another failure: 0 is a cause.
        rank: u8,
        /// When the host says it happened, nanoseconds since the Unix epoch; absent: now.
        at_ns: Option<i64>,
    },
    /// Somebody else holds the lease, or has held it since.
    Held {
        /// Who, or that the number is not the last one, in the host's words.
        what: String,
    },
}

/// How far it is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Phase {
    /// Leases are taken; nothing was changed.
    Leasing,
    /// Files are sent, what ran is stopped, parts are prepared.
    Preparing,
    /// Parts are started.
    Committing,
    /// Before the first commit something failed; what was prepared is undone.
    Undoing,
    /// After the first commit something failed; all parts are stopped in order.
    Stopping,
    /// Everything is done: it is healthy, or it is down.
    Done,
    /// Nothing of the new run is left.
    Undone {
        /// The first cause; absent after an interrupt.
        cause: Option<Cause>,
        /// Whether the run that was there has been stopped for it.
        old_stopped: bool,
        /// Whether nothing was begun because somebody else holds a lease.
        held: bool,
    },
    /// It was started and has been stopped, or something could not be undone.
    Failed {
        /// The first cause; absent after an interrupt.
        cause: Option<Cause>,
        /// Hosts on which something of the new run may be left, or that were to be cleared and were not.
        left: BTreeSet<String>,
    },
    /// Somebody else took over: nothing more was done and nothing undone.
    TakenOver {
        /// The host that said so.
        host: String,
        /// Who, or that the number is not the last one, in the host's words.
        what: String,
    },
}

impl Phase {
    /// Whether nothing more will be done.
    #[must_use]
    pub fn is_over(&self) -> bool {
        match self {
            Self::Leasing | Self::Preparing | Self::Committing | Self::Undoing | Self::Stopping => {
                false
            }
            Self::Done | Self::Undone { .. } | Self::Failed { .. } | Self::TakenOver { .. } => true,
        }
    }
}

/// Carries out one plan.
///
/// After every `handle_…`, take all steps that [`Apply::poll_step`] gives and begin them; then wait for an answer, an
/// interrupt or [`Apply::poll_timeout`], whichever is first. When the phase is over, drop everything: also the streams
/// of parts that are not healthy.
#[derive(Clone, Debug)]
pub struct Apply {
    plan: Plan,
    /// The new run.
    run: String,
    phase: Phase,
    tasks: Vec<Task>,
    causes: Vec<Cause>,
    interrupted: bool,
    held: bool,
}

/// A step and how far it is.
#[derive(Clone, Debug)]
struct Task {
    step: Step,
    state: State,
    /// Whether it takes something back: it waits until what it needs is settled, not until it is done.
    undoes: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Waits,
    Runs { until: Duration },
    Done,
    Failed,
    Skipped,
}

impl State {
    fn settled(self) -> bool {
        match self {
            Self::Waits | Self::Runs { .. } => false,
            Self::Done | Self::Failed | Self::Skipped => true,
        }
    }
}

impl Apply {
    /// Begins; `run` is the new run's id, random, never used before.
    #[must_use]
    pub fn new(plan: Plan, run: String) -> Self {
        let task = |step: &Step| Task {
            step: step.clone(),
            state: State::Waits,
            undoes: false,
        };
        let mut apply = Self {
            tasks: plan.steps.iter().map(task).collect(),
            plan,
            run,
            phase: Phase::Leasing,
            causes: Vec::new(),
            interrupted: false,
            held: false,
        };
        apply.conclude();
        apply
    }

    /// How far it is.
    #[must_use]
    pub const fn phase(&self) -> &Phase {
        &self.phase
    }

    /// What is carried out.
    #[must_use]
    pub const fn plan(&self) -> &Plan {
        &self.plan
    }

    /// The new run's id.
    #[must_use]
    pub fn run(&self) -> &str {
        &self.run
    }

    /// A step that may begin now and counts as begun; call it until there is none.
    pub fn poll_step(&mut self, now: Moment) -> Option<Step> {
        loop {
            if self.phase.is_over() {
                return None;
            }
            let index = (0..self.tasks.len()).find(|index| self.may_begin(*index))?;
            let step = self.tasks[index].step.clone();
            if step.operation == Operation::Release && !self.leased(&step.host) {
                self.tasks[index].state = State::Skipped;
                self.conclude();
                continue;
            }
            let until = now.elapsed + Duration::from_millis(step.limit_ms);
            self.tasks[index].state = State::Runs { until };
            self.advance(&step.operation);
            return Some(step);
        }
    }

    /// When [`Apply::handle_timeout`] is due, in [`Moment::elapsed`]; absent when nothing is waited for.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Duration> {
        if self.phase.is_over() {
            return None;
        }
        let until = self.tasks.iter().filter_map(|task| match task.state {
            State::Runs { until } => Some(until),
            State::Waits | State::Done | State::Failed | State::Skipped => None,
        });
        until.min()
    }

    /// A step came to its end. What comes after it was given up is not heard.
    pub fn handle_done(&mut self, now: Moment, id: StepId, outcome: Outcome) {
        let Some(task) = self.tasks.get_mut(id.0) else {
            return;
        };
        if self.phase.is_over() || !matches!(task.state, State::Runs { .. }) {
            return;
        }
        let (host, operation) = (task.step.host.clone(), task.step.operation.clone());
        match outcome {
            Outcome::Done => task.state = State::Done,
            Outcome::Leased { run } => {
                task.state = State::Done;
                self.check_run(now, &host, run);
            }
            // A lease that is not given back ends by itself.
            Outcome::Failed { .. } | Outcome::Held { .. } if operation == Operation::Release => {
                task.state = State::Done;
            }
            Outcome::Failed { what, rank, at_ns } => {
                task.state = State::Failed;
                let at_ns = at_ns.unwrap_or(now.wall_ns);
                self.fail(now, &host, &operation, (rank, at_ns, what));
            }
            Outcome::Held { what } if operation == Operation::Lease => {
                task.state = State::Failed;
                self.held = true;
                self.fail(now, &host, &operation, (0, now.wall_ns, what));
            }
            Outcome::Held { what } => self.handle_fenced(host, what),
        }
        self.conclude();
    }

    /// A part failed, or is out of sight, although nobody waits for its health at this time: the others are not waited for
    /// either, and this is among the causes. Once every part is healthy it changes nothing.
    pub fn handle_lost(&mut self, now: Moment, host: &str, outcome: Outcome) {
        let Outcome::Failed { what, rank, at_ns } = outcome else {
            return;
        };
        let during = matches!(self.phase, Phase::Committing | Phase::Stopping);
        if !during || self.healthy() {
            return;
        }
        for task in &mut self.tasks {
            let awaits = task.step.operation == Operation::AwaitHealthy && task.step.host == host;
            if awaits && !task.state.settled() {
                task.state = State::Failed;
            }
        }
        let at_ns = at_ns.unwrap_or(now.wall_ns);
        self.fail(now, host, &Operation::AwaitHealthy, (rank, at_ns, what));
        self.conclude();
    }

    /// A host said, for instance when the lease was renewed, that somebody else has taken it since. Once every part is
    /// healthy, or the lease is given back, that is as it should be.
    pub fn handle_fenced(&mut self, host: String, what: String) {
        let healthy = self.phase == Phase::Committing && self.healthy();
        let mut releases = self
            .tasks
            .iter()
            .filter(|task| task.step.operation == Operation::Release && task.step.host == host);
        let released = releases.any(|task| match task.state {
            State::Runs { .. } | State::Done | State::Failed => true,
            State::Waits | State::Skipped => false,
        });
        if !self.phase.is_over() && !healthy && !released {
            self.phase = Phase::TakenOver { host, what };
        }
    }

    /// Whoever started it wants it to end: undoes what was prepared, stops what was started. The second time nothing
    /// more is waited for. Once every part is healthy it changes nothing.
    pub fn handle_interrupt(&mut self, now: Moment) {
        match self.phase {
            Phase::Leasing | Phase::Preparing => {
                self.interrupted = true;
                self.undo(now, Phase::Undoing);
            }
            Phase::Committing if !self.healthy() => {
                self.interrupted = true;
                self.undo(now, Phase::Stopping);
            }
            Phase::Undoing | Phase::Stopping => {
                for task in &mut self.tasks {
                    if !task.state.settled() {
                        task.state = State::Skipped;
                    }
                }
            }
            Phase::Committing
            | Phase::Done
            | Phase::Undone { .. }
            | Phase::Failed { .. }
            | Phase::TakenOver { .. } => {}
        }
        self.conclude();
    }

    /// Gives up what took too long.
    pub fn handle_timeout(&mut self, now: Moment) {
        for index in 0..self.tasks.len() {
            let task = &self.tasks[index];
            let late = matches!(task.state, State::Runs { until } if until <= now.elapsed);
            if late {
                let seconds = task.step.limit_ms.div_ceil(1000);
                let outcome = Outcome::Failed {
                    what: format!("no answer within {seconds} s"),
                    rank: UNANSWERED_RANK,
                    at_ns: None,
                };
                self.handle_done(now, StepId(index), outcome);
            }
        }
    }

    fn may_begin(&self, index: usize) -> bool {
        let task = &self.tasks[index];
        let done = |id: &StepId| match self.tasks[id.0].state {
            State::Done => true,
            state @ (State::Waits | State::Runs { .. } | State::Failed | State::Skipped) => {
                task.undoes && state.settled()
            }
        };
        task.state == State::Waits && task.step.needs.iter().all(done)
    }

    fn leased(&self, host: &str) -> bool {
        self.tasks.iter().any(|task| {
            task.step.operation == Operation::Lease
                && task.step.host == host
                && task.state == State::Done
        })
    }

    /// Whether all parts are healthy.
    fn healthy(&self) -> bool {
        let mut waits = self.tasks.iter();
        waits
            .all(|task| task.step.operation != Operation::AwaitHealthy || task.state == State::Done)
    }

    /// The phase that the begin of a step leads to.
    fn advance(&mut self, operation: &Operation) {
        let next = match operation {
            Operation::CommitRti | Operation::Commit => Phase::Committing,
            Operation::SendBlob { .. }
            | Operation::SendImage { .. }
            | Operation::StopOld { .. }
            | Operation::RemoveOld { .. }
            | Operation::Prepare { .. } => Phase::Preparing,
            Operation::Lease
            | Operation::AwaitHealthy
            | Operation::RemovePart { .. }
            | Operation::StopPart { .. }
            | Operation::Release => return,
        };
        self.phase = next;
    }

    /// A host that moved on between observing and leasing is not touched.
    fn check_run(&mut self, now: Moment, host: &str, found: Option<String>) {
        let planned = self.plan.runs.get(host).cloned().flatten();
        if planned != found {
            let words = |run: &Option<String>| match run {
                Some(run) => format!("run {run}"),
                None => "no run".to_owned(),
            };
            let (planned, found) = (words(&planned), words(&found));
            let what = format!(
                "it has moved on: the plan was made for {planned}, and {found} is there; plan again"
            );
            self.fail(now, host, &Operation::Lease, (0, now.wall_ns, what));
        }
    }

    fn fail(
        &mut self,
        now: Moment,
        host: &str,
        operation: &Operation,
        (rank, at_ns, what): (u8, i64, String),
    ) {
        let cause = Cause {
            host: host.to_owned(),
            step: operation.to_string(),
            what,
            rank,
            at_ns,
        };
        let undoes = matches!(
            operation,
            Operation::RemovePart { .. } | Operation::StopPart { .. }
        );
        // What cannot be undone is no cause of it.
        if !undoes {
            self.causes.push(cause);
        }
        match self.phase {
            Phase::Leasing | Phase::Preparing => self.undo(now, Phase::Undoing),
            Phase::Committing => self.undo(now, Phase::Stopping),
            Phase::Undoing
            | Phase::Stopping
            | Phase::Done
            | Phase::Undone { .. }
            | Phase::Failed { .. }
            | Phase::TakenOver { .. } => {}
        }
    }

    /// Begins nothing more of the plan, takes back what was begun (answered or not), and gives the leases back.
    fn undo(&mut self, now: Moment, phase: Phase) {
        let stopping = phase == Phase::Stopping;
        self.phase = phase;
        let give_up = now.elapsed + Duration::from_millis(self.plan.stop_limit_ms);
        for task in &mut self.tasks {
            match &mut task.state {
                state @ State::Waits => *state = State::Skipped,
                // A part that is stopped says soon that it has ended.
                State::Runs { until } if task.step.operation == Operation::AwaitHealthy => {
                    *until = (*until).min(give_up);
                }
                State::Runs { .. } | State::Done | State::Failed | State::Skipped => {}
            }
        }
        let mut undone = Vec::new();
        for host in self.begun(|operation| matches!(operation, Operation::Prepare { .. })) {
            let run = self.run.clone();
            let (operation, limit_ms) = match stopping {
                true => (Operation::StopPart { run }, self.plan.stop_limit_ms),
                false => (Operation::RemovePart { run }, UNDO_LIMIT_MS),
            };
            let needs = self.on_its_way(&host);
            undone.push(self.take_back(host, operation, needs, limit_ms));
        }
        for host in self.begun(|operation| *operation == Operation::Lease) {
            let mut needs = self.on_its_way(&host);
            needs.extend(&undone);
            self.take_back(host, Operation::Release, needs, UNDO_LIMIT_MS);
        }
    }

    /// The hosts that were asked, answered or not.
    fn begun(&self, asked: impl Fn(&Operation) -> bool) -> BTreeSet<String> {
        let begun = self.tasks.iter().filter(|task| {
            let begun = match task.state {
                State::Runs { .. } | State::Done | State::Failed => true,
                State::Waits | State::Skipped => false,
            };
            begun && asked(&task.step.operation)
        });
        begun.map(|task| task.step.host.clone()).collect()
    }

    /// What a host was asked and has not answered: what takes it back must not overtake it.
    fn on_its_way(&self, host: &str) -> Vec<StepId> {
        let on_its_way = self.tasks.iter().filter(|task| {
            let runs = matches!(task.state, State::Runs { .. });
            runs && task.step.host == host && task.step.operation != Operation::AwaitHealthy
        });
        on_its_way.map(|task| task.step.id).collect()
    }

    fn take_back(
        &mut self,
        host: String,
        operation: Operation,
        needs: Vec<StepId>,
        limit_ms: u64,
    ) -> StepId {
        let id = StepId(self.tasks.len());
        let step = Step {
            id,
            host,
            operation,
            cause: "it is undone".to_owned(),
            needs,
            limit_ms,
        };
        self.tasks.push(Task {
            step,
            state: State::Waits,
            undoes: true,
        });
        id
    }

    /// Ends it when nothing is left to do.
    fn conclude(&mut self) {
        if self.phase.is_over() || !self.tasks.iter().all(|task| task.state.settled()) {
            return;
        }
        let first = Cause::first(self.causes.drain(..));
        let cause = first.filter(|_| !self.interrupted);
        let left = self.left();
        self.phase = match self.phase {
            Phase::Undoing if left.is_empty() => Phase::Undone {
                cause,
                old_stopped: self.tasks.iter().any(|task| {
                    matches!(task.step.operation, Operation::StopOld { .. })
                        && task.state == State::Done
                }),
                held: self.held,
            },
            Phase::Undoing | Phase::Stopping => Phase::Failed { cause, left },
            Phase::Leasing
            | Phase::Preparing
            | Phase::Committing
            | Phase::Done
            | Phase::Undone { .. }
            | Phase::Failed { .. }
            | Phase::TakenOver { .. } => Phase::Done,
        };
    }

    /// Where undoing or stopping was not confirmed, and, when nothing new was to run, what was begun to be taken down.
    fn left(&self) -> BTreeSet<String> {
        let mut kinds = self.tasks.iter().map(|task| &task.step.operation);
        let starts = kinds.any(|operation| matches!(operation, Operation::Prepare { .. }));
        let ends = !starts
            && !self
                .begun(|it| matches!(it, Operation::StopOld { .. } | Operation::RemoveOld { .. }))
                .is_empty();
        let left = self.tasks.iter().filter(|task| {
            let undoes = match task.step.operation {
                Operation::RemovePart { .. } | Operation::StopPart { .. } => true,
                Operation::StopOld { .. } | Operation::RemoveOld { .. } => ends,
                Operation::Lease
                | Operation::SendBlob { .. }
                | Operation::SendImage { .. }
                | Operation::Prepare { .. }
                | Operation::CommitRti
                | Operation::Commit
                | Operation::AwaitHealthy
                | Operation::Release => false,
            };
            undoes && task.state != State::Done
        });
        left.map(|task| task.step.host.clone()).collect()
    }
}
