//! A federate as a state machine: the timeline joined with centralized coordination. Bytes in, bytes out, no I/O.
//!
//! The driver's loop, whose order matters (*mutate, then poll to `Wait`, then flush, then wait*):
//!
//! ```text
//! loop {
//!     federate.receive(now, bytes, executor)            // whatever has arrived; also schedule_physical, request_stop
//!     match federate.poll(now, executor) {
//!         Run       => federate.run_batch(executor)      // or run its nodes one by one and `finish` each
//!         Wait(at)  => { federate.flush(); write federate.output(); wait for bytes, an event or `at` }
//!         Ended     => break
//!     }
//! }
//! ```
//!
//! A federate without an RTI link is a program alone: the same loop, and nothing is ever asked.
//!
//! Source: sections 3, 5, 9 and 10 of the wire document; DESIGN section 4.

mod join;
mod link;
mod meeting;
mod peers;
mod stop;
mod timed;

use crate::clock::Interval;
use crate::measure::{LagNews, Measures};
use crate::mutants::Mutant;
use crate::payload::{FederateExecutor, PayloadError};
use crate::wire::{DecodeError, RejectReason};
use ictus_core::{
    ActionId, ActionKind, Admission, Delay, Duration, Effects, NodeId, NodeKind, OutputId,
    PhysicalTime, Program, Progress, Tag, Timeline, ValueId,
};
use join::Phase;
pub use link::{InputLink, LinkConfig, OutputLink};
use link::{Link, Permission};
pub use peers::PeerStream;
use std::collections::VecDeque;
use std::sync::Arc;
use thiserror::Error;

/// A stream that ended without goodbye is explained by the RTI within this time, or is itself what is wrong.
const LOSS_EXPLAINED_WITHIN: Duration = Duration::from_secs(5);

/// How long the RTI and senders may take to close after a federate has said its last word.
pub const LAST_WORDS_MAX: Duration = Duration::from_secs(5);

/// How a program runs.
#[derive(Clone, Debug, Default)]
pub struct FederateConfig {
    /// The stop tag is this long after the start tag.
    pub timeout: Option<Duration>,
    /// Run ahead of physical time.
    pub fast: bool,
    /// Go on when no event is left.
    pub keepalive: bool,
}

/// What the driver must do next.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Poll {
    /// Run the nodes of [`Federate::batch`].
    Run,
    /// Wait for bytes, a physical event, or this time; `None`: only bytes or an event can help.
    Wait(Option<PhysicalTime>),
    /// Nothing more will happen; [`Federate::outcome`] says why.
    Ended,
}

/// What the driver may want to tell the world.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum FederateEvent {
    /// The RTI accepted the join.
    Joined,
    /// The clock is off by so much: before anything else add what is in its middle to every later reading.
    ClockOffset(Interval),
    /// The start tag is agreed.
    Started(Tag),
    /// The first tag is completed.
    Running,
    /// A stop was requested by this program or by another.
    StopRequested,
    /// The stop tag is agreed.
    StopGranted(Tag),
    /// Another federate was lost; the federation stops.
    PeerLost(u16),
    /// The driver is to connect to another federate, and to say [`Federate::peer_connected`] or
    /// [`Federate::peer_unreachable`].
    Connect {
        /// The other federate.
        peer: u16,
        /// Its IPv4 address in network order.
        address: [u8; 4],
        /// Its TCP port.
        port: u16,
    },
    /// Somebody who connected was refused; why, in words.
    PeerRefused(String),
    /// A receiver that the federation may outlive is left behind; who, in words.
    PeerLeft(String),
    /// The federate falls behind physical time more and more, or has caught up.
    Lag(LagNews),
    /// A message came after its input had been decided at its tag: a sender's first, and then at every power of ten.
    StpViolation {
        /// The sender.
        upstream: u16,
        /// How long after its tag's time plus the offset it came, by this federate's clock.
        lateness: Duration,
        /// How many from this sender so far.
        count: u64,
    },
}

/// How a federate ended.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum Outcome {
    /// The stop tag was completed: time-out, stop by request, or nothing left to do.
    #[error("ended at its stop tag")]
    Stopped,
    /// The stop tag was completed after another federate had failed.
    #[error("stopped because federate {0} was lost")]
    PeerLost(u16),
    /// The connection to the RTI ended before the federate did.
    #[error("the RTI was lost")]
    RtiLost,
    /// The RTI said FAILED.
    #[error("the RTI reported that the federation failed")]
    RtiFailed,
    /// The RTI, or whoever listens at its address, did not answer while joining.
    #[error("no answer for {} s while {phase}{hint}", join::ANSWER_MAX.as_nanos() / 1_000_000_000)]
    NotJoined {
        /// What was waited for.
        phase: &'static str,
        /// What may be the matter.
        hint: &'static str,
    },
    /// The RTI refused the join.
    #[error("the RTI refused the join: {0}")]
    Rejected(RejectReason),
    /// Another federate refused this one's hello.
    #[error("federate {peer} refused the connection: {reason}")]
    RejectedByPeer {
        /// The other federate.
        peer: u16,
        /// Its reason.
        reason: RejectReason,
    },
    /// Another federate said something that is not of the protocol.
    #[error("federate {peer} broke the protocol: {error}")]
    PeerProtocol {
        /// The other federate.
        peer: u16,
        /// What it did.
        error: ProtocolError,
    },
    /// The connection from another federate ended, though nobody says that it was lost.
    #[error("the connection from federate {0} was cut")]
    PeerCut(u16),
    /// A receiver takes nothing any more, and what is for it must not be lost.
    #[error("federate {0} takes nothing any more: what is for it waits in vain")]
    PeerStuck(u16),
    /// The plan's limit of STP violations was reached: this federate stopped the federation.
    #[error("stopped the federation after {0} STP violations")]
    TooManyViolations(u64),
    /// The RTI, or whoever listens at its address, has another federation id.
    #[error("the RTI did not prove that it knows the federation id")]
    RtiUnproven,
    /// The RTI said something that is not of the protocol.
    #[error("the RTI broke the protocol: {0}")]
    Protocol(#[from] ProtocolError),
    /// A message was not of its input's type.
    #[error(transparent)]
    Payload(#[from] PayloadError),
    /// Tag arithmetic left its range.
    #[error("a tag overflowed at {0}")]
    Overflow(Tag),
    /// The driver found the clock too uncertain to start.
    #[error("the clock is not good enough: {0}")]
    Clock(String),
    /// The program itself failed; see the driver's fault.
    #[error("the program failed")]
    Fault,
}

/// What a peer may not do. Fatal for this federate.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ProtocolError {
    /// The bytes are no message.
    #[error(transparent)]
    Decode(#[from] DecodeError),
    /// A message that does not belong here, by name.
    #[error("unexpected {message} while {phase}")]
    Unexpected {
        /// The message.
        message: &'static str,
        /// What the federate was doing.
        phase: &'static str,
    },
    /// A message for a port that this federate does not have.
    #[error("message for unknown port {0}")]
    UnknownPort(u16),
    /// A message for another federate.
    #[error("message for federate {0}")]
    WrongFederate(u16),
    /// A federate wrote to a port that another one feeds, or in another way than the plan says.
    #[error(
        "message for port {port}, which the plan does not let federate {peer} write to like this"
    )]
    NotItsPort {
        /// The port id.
        port: u16,
        /// The sender.
        peer: u16,
    },
    /// Centralized coordination promises that this cannot happen.
    #[error("message with tag {intended} for {input} arrived when the federate was at {current}")]
    Tardy {
        /// The message's tag.
        intended: Tag,
        /// Where the federate was.
        current: Tag,
        /// The input's path.
        input: String,
    },
}

/// Counters for status lines and metrics.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Tags completed.
    pub tags: u64,
    /// Nodes run.
    pub reactions: u64,
    /// Messages sent to other federates.
    pub sent: u64,
    /// Messages received from other federates.
    pub received: u64,
    /// Provisional grants received.
    pub provisional: u64,
    /// Announcements (NET) that DNET made needless.
    pub skipped_announcements: u64,
    /// Tags that had to wait because downstreams were too far behind.
    pub held_back: u64,
    /// Connections of strangers that were refused.
    pub refused: u64,
}

/// One federate: a timeline and, when it is not alone, its link to the RTI.
#[derive(Debug)]
pub struct Federate {
    config: FederateConfig,
    timeline: Timeline,
    link: Option<Link>,
    phase: Phase,
    /// When a step of joining must have been answered.
    answer_by: Option<PhysicalTime>,
    batch: Vec<NodeId>,
    effects: Effects,
    present: Vec<(ActionId, ValueId)>,
    events: VecDeque<FederateEvent>,
    outcome: Option<Outcome>,
    counters: Counters,
    physical_delay: Option<Duration>,
    stop: stop::Stop,
    measures: Measures,
    /// Since when a grant has been missing, under centralized coordination.
    asked: Option<PhysicalTime>,
    /// Receivers of messages that were written since the last poll, with the time from which their launch lag counts.
    launches: Vec<(u16, PhysicalTime)>,
    /// When the current tag was begun, or might have been: the end of its offset, if that is earlier.
    due: PhysicalTime,
    /// Everything that had come when the clock showed this has been received.
    looked_at: PhysicalTime,
    /// The clock at the last poll.
    now: PhysicalTime,
    /// A sender that is gone without goodbye, and until when the RTI may say that it was lost.
    unexplained: Option<(u16, PhysicalTime)>,
}

impl Federate {
    /// A program alone: it starts at the tag given to [`Federate::start`].
    #[must_use]
    pub fn alone(program: Arc<Program>, config: FederateConfig) -> Self {
        Self::new(program, config, None)
    }

    /// A federate that will join over a connection: [`Federate::connect`] begins.
    #[must_use]
    pub fn federated(program: Arc<Program>, config: FederateConfig, link: LinkConfig) -> Self {
        let link = Link::new(link, &program);
        Self::new(program, config, Some(link))
    }

    fn new(program: Arc<Program>, config: FederateConfig, link: Option<Link>) -> Self {
        Self {
            physical_delay: program.least_physical_delay(),
            timeline: Timeline::new(program),
            config,
            phase: Phase::Idle,
            answer_by: None,
            batch: Vec::new(),
            effects: Effects::default(),
            present: Vec::new(),
            events: VecDeque::new(),
            outcome: None,
            counters: Counters::default(),
            stop: stop::Stop::default(),
            measures: link.as_ref().map_or_else(Measures::default, Link::measures),
            asked: None,
            launches: Vec::new(),
            due: PhysicalTime::NEVER,
            looked_at: PhysicalTime::NEVER,
            now: PhysicalTime::NEVER,
            unexplained: None,
            link,
        }
    }

    /// The timeline, to look at.
    #[must_use]
    pub fn timeline(&self) -> &Timeline {
        &self.timeline
    }

    /// The counters.
    #[must_use]
    pub fn counters(&self) -> Counters {
        self.counters
    }

    /// What was measured so far.
    #[must_use]
    pub fn measures(&self) -> &Measures {
        &self.measures
    }

    /// What was measured so far, for the driver to add to.
    pub fn measures_mut(&mut self) -> &mut Measures {
        &mut self.measures
    }

    /// The nodes to run after [`Poll::Run`].
    #[must_use]
    pub fn batch(&self) -> &[NodeId] {
        &self.batch
    }

    /// How it ended, after [`Poll::Ended`].
    #[must_use]
    pub fn outcome(&self) -> Option<&Outcome> {
        self.outcome.as_ref()
    }

    /// How it ended, taken out of the federate.
    #[must_use]
    pub fn into_outcome(self) -> Option<Outcome> {
        self.outcome
    }

    /// The next event, in order.
    #[must_use]
    pub fn poll_event(&mut self) -> Option<FederateEvent> {
        self.events.pop_front()
    }

    /// Starts a program alone at `start`.
    pub fn start(&mut self, start: Tag) {
        let stop = self.config.timeout.map_or(Tag::FOREVER, |timeout| {
            if timeout <= Duration::ZERO {
                start
            } else {
                start.delayed(Delay::Time(timeout))
            }
        });
        self.timeline.start(start, stop);
        self.phase = Phase::Running;
        self.events.push_back(FederateEvent::Started(start));
    }

    /// Ends at once: no further tag is entered, and others are told that this federate failed.
    pub fn fail(&mut self) {
        self.end_with(Outcome::Fault);
    }

    fn end_with(&mut self, outcome: Outcome) {
        if self.outcome.is_none() {
            if let Some(link) = &mut self.link {
                link.fail();
            }
            self.outcome = Some(outcome);
        }
        self.phase = Phase::Ended;
    }

    /// Queues an event from outside, stamped by the physical clock, and returns its tag.
    ///
    /// The tag is never before what was announced to others, so that no promise is broken.
    pub fn schedule_physical(
        &mut self,
        stamp: PhysicalTime,
        action: ActionId,
        value: ValueId,
    ) -> Tag {
        let floor = self.link.as_ref().map_or(Tag::NEVER, Link::announced);
        self.timeline.schedule_physical(stamp, action, value, floor)
    }

    /// Decides what can be done at physical time `now`.
    pub fn poll(&mut self, now: PhysicalTime, executor: &mut impl FederateExecutor) -> Poll {
        self.launch(now);
        self.now = now;
        while let Some((action, value)) = self.timeline.pop_released() {
            executor.release(action, value);
        }
        match self.phase {
            Phase::Running => self.poll_until_explained(now, executor),
            Phase::Meeting => self.meet(now),
            Phase::Ended => Poll::Ended,
            Phase::Authenticating(_) | Phase::AwaitingAck | Phase::Synchronizing(_) => {
                self.await_answer(now)
            }
            // The others may join as late as they like.
            Phase::Idle | Phase::AwaitingStart => Poll::Wait(None),
            Phase::Draining { since, .. } => self.drain(now, since),
        }
    }

    /// After the last words: waits for the others to close, but not for ever.
    fn drain(&mut self, now: PhysicalTime, since: PhysicalTime) -> Poll {
        let until = since.saturating_add(LAST_WORDS_MAX);
        if now < until {
            return Poll::Wait(Some(until));
        }
        self.phase = Phase::Ended;
        Poll::Ended
    }

    /// Waits no longer than a sender's silent end may stay unexplained.
    #[inline]
    fn poll_until_explained(
        &mut self,
        now: PhysicalTime,
        executor: &mut impl FederateExecutor,
    ) -> Poll {
        let poll = self.poll_running(now, executor);
        match (poll, self.unexplained) {
            (Poll::Wait(until), Some((_, explained))) => {
                Poll::Wait(Some(until.map_or(explained, |until| until.min(explained))))
            }
            (poll, _) => poll,
        }
    }

    fn poll_running(&mut self, now: PhysicalTime, executor: &mut impl FederateExecutor) -> Poll {
        loop {
            if self.timeline.current().is_some() {
                self.batch.clear();
                match self.timeline.ready(&mut self.batch) {
                    Progress::Batch => return Poll::Run,
                    Progress::InFlight => {
                        self.send_absents();
                        return Poll::Wait(None);
                    }
                    Progress::Blocked if self.stop.gives_up(self.timeline.at()) => {
                        self.timeline.abandon();
                    }
                    Progress::Blocked => {
                        // Others may wait for what has become certain since, before they tell what we wait for.
                        self.send_absents();
                        if !self.is_decentralized() {
                            return Poll::Wait(None);
                        }
                        if let Some(next) = self.decide_absent(now) {
                            return Poll::Wait(Some(next));
                        }
                    }
                    // Begun ahead: all inputs have spoken, but others may still count on this tag being open.
                    Progress::TagDone if self.is_ahead() => return Poll::Wait(None),
                    Progress::TagDone => self.complete(),
                }
            } else if self.timeline.overflowed() {
                self.end_with(Outcome::Overflow(self.timeline.at()));
                return Poll::Ended;
            } else if self.timeline.finished() {
                return self.leave();
            } else if self.cut_off(now) {
                return Poll::Ended;
            } else if let Err(poll) = self.enter_next(now, executor) {
                return poll;
            }
        }
    }

    /// Whether a sender is gone and nobody has said why in time.
    fn cut_off(&mut self, now: PhysicalTime) -> bool {
        match self.unexplained {
            Some((peer, until)) if now >= until => {
                self.end_with(Outcome::PeerCut(peer));
                true
            }
            Some(_) | None => false,
        }
    }

    /// Whether the current tag was begun before it was granted, and is not yet.
    fn is_ahead(&self) -> bool {
        let at = self.timeline.at();
        let ahead = |link: &Link| link.is_ahead(at);
        self.link.as_ref().is_some_and(ahead) && !self.stop.gives_up(at)
    }

    /// Enters the next tag, or says how long to wait.
    #[inline]
    fn enter_next(
        &mut self,
        now: PhysicalTime,
        executor: &mut impl FederateExecutor,
    ) -> Result<(), Poll> {
        let Some(next) = self.next_tag() else {
            return Err(Poll::Wait(None));
        };
        if self.stop.only_shutdown(next) {
            // Ordinary messages may still come up to the limit: it must be passed as any tag.
            if let Some(gate) = self.stop.gate() {
                self.permit(now, gate.min(self.timeline.stop_tag()))?;
                self.wait_until_due(now, self.timeline.stop_tag())?;
            }
            self.timeline.begin_shutdown_only(&mut self.present);
        } else {
            let next = self.permit(now, next)?;
            self.timeline.begin(next, &mut self.present);
        }
        executor.begin(self.timeline.at());
        self.note_begun(now);
        let program = self.timeline.program();
        for (action, value) in &self.present {
            executor.arrive(*action, program.action_slot(*action), *value);
        }
        self.present.clear();
        if let Some(link) = &mut self.link {
            link.confirm_too_early(self.timeline.at());
        }
        self.send_absents();
        Ok(())
    }

    /// Notes the lag of the tag just begun, and what time has decided about its inputs.
    fn note_begun(&mut self, now: PhysicalTime) {
        let offset = self.link.as_ref().map(|link| link.config.stp_offset);
        let time = self.timeline.at().time.as_physical();
        self.due = now.min(time.saturating_add(offset.unwrap_or(Duration::ZERO)));
        if !self.config.fast {
            let news = self.measures.tag_begun(now, self.timeline.at());
            self.events.extend(news.map(FederateEvent::Lag));
        }
        if self.is_decentralized() {
            self.decide_absent(now);
        }
    }

    /// The next tag to execute, unless a stop in progress bars it.
    #[inline]
    fn next_tag(&mut self) -> Option<Tag> {
        let mut next = self.timeline.next_tag();
        if let Some(link) = &self.link {
            next = next.min(link.provisional_tag(self.timeline.at()));
        }
        self.stop.allows(next).then_some(next)
    }

    /// Asks the clock and the link whether `next` may be entered; the answer may be a tag, because starving gives one.
    #[inline]
    fn permit(&mut self, now: PhysicalTime, next: Tag) -> Result<Tag, Poll> {
        if self.is_decentralized() {
            let next = self.permit_by_time(now, next)?;
            self.wait_until_due(now, next)?;
            return Ok(next);
        }
        if let Some(link) = &mut self.link {
            let promise = match self.physical_delay {
                // Nothing from outside can come before the start.
                Some(delay)
                    if !self.config.fast
                        && !link.config.mutants.has(Mutant::PhysicalPromiseDropped) =>
                {
                    now.saturating_add(delay)
                        .max(self.timeline.start_tag().time.as_physical())
                }
                Some(_) | None => PhysicalTime::FOREVER,
            };
            let permission = link.permit(now, next, promise);
            if let Permission::Wait(until) = permission {
                self.asked.get_or_insert(now);
                self.counters.skipped_announcements = link.skipped();
                self.counters.held_back = link.held_back();
                return Err(Poll::Wait(until));
            }
        }
        if next == Tag::FOREVER {
            return self.starve().ok_or(Poll::Wait(None));
        }
        if let Some(asked) = self.asked.take() {
            self.note_granted(now, asked, next);
        }
        self.wait_until_due(now, next)?;
        Ok(next)
    }

    /// Notes how long a tag that was asked for waited for nothing but its grant.
    fn note_granted(&mut self, now: PhysicalTime, asked: PhysicalTime, tag: Tag) {
        let due = tag.time.as_physical();
        let ready = if self.config.fast {
            asked
        } else {
            asked.max(due)
        };
        self.measures.grant_wait(now.since(ready));
    }

    #[inline]
    fn wait_until_due(&self, now: PhysicalTime, tag: Tag) -> Result<(), Poll> {
        let due = tag.time.as_physical();
        if !self.config.fast && now < due {
            return Err(Poll::Wait(Some(due)));
        }
        Ok(())
    }

    /// Nothing is left and nothing can come: the stop tag is the next microstep, unless told to keep alive.
    ///
    /// What is written there stays here, because FOREVER was announced.
    fn starve(&mut self) -> Option<Tag> {
        if self.config.keepalive || self.may_wake() {
            return None;
        }
        self.timeline.stop_at(self.timeline.at().successor());
        if let Some(link) = &mut self.link {
            link.fall_silent();
        }
        Some(self.timeline.stop_tag())
    }

    /// Whether something may come from outside: of a physical action, or over a physical connection whose sender is there.
    fn may_wake(&self) -> bool {
        let kinds = self.timeline.program().actions();
        let inputs = self.timeline.program().network_inputs().iter();
        let of_inputs: Vec<ActionId> = inputs.filter(|i| i.physical).map(|i| i.action).collect();
        let inside = kinds.iter().enumerate().any(|(index, kind)| {
            matches!(kind, ActionKind::Physical { .. })
                || (matches!(kind, ActionKind::PhysicalConnection { .. })
                    && !of_inputs.contains(&ActionId::new(index)))
        });
        let senders = |link: &Link| !link.peers.all_gone();
        inside || (!of_inputs.is_empty() && self.link.as_ref().is_none_or(senders))
    }

    fn complete(&mut self) {
        self.send_absents();
        let network_inputs_ran = self.timeline.complete();
        let tag = self.timeline.at();
        if self.counters.tags == 0 {
            self.events.push_back(FederateEvent::Running);
        }
        self.counters.tags += 1;
        self.measures.tag_completed();
        if let Some(link) = &mut self.link {
            link.completed(tag, network_inputs_ran);
        }
    }

    /// Runs the batch node by node and takes what it did; alone, where nobody waits for what was sent, the rest of
    /// the tag with it.
    #[inline]
    pub fn run_batch(&mut self, executor: &mut impl FederateExecutor) {
        let mut batch = std::mem::take(&mut self.batch);
        let tag = self.timeline.at();
        if self.link.is_none() {
            self.run_tag(tag, &mut batch, executor);
        } else if self.timeline.any_tardy() {
            // What a tardy node triggers is tardy too: each is finished by itself.
            for node in &batch {
                self.run_node(*node, tag, executor);
                self.finish(&[*node], executor);
            }
        } else {
            for node in &batch {
                self.run_node(*node, tag, executor);
            }
            self.finish(&batch, executor);
        }
        self.batch = batch;
    }

    #[inline]
    fn run_tag(&mut self, tag: Tag, batch: &mut Vec<NodeId>, executor: &mut impl FederateExecutor) {
        loop {
            self.counters.reactions += batch.len() as u64;
            for node in batch.iter() {
                executor.run(*node, tag, &mut self.effects);
            }
            self.timeline.finish(batch, &mut self.effects);
            self.take_effects(executor);
            batch.clear();
            match self.timeline.ready(batch) {
                Progress::Batch => {}
                Progress::TagDone => return self.complete(),
                Progress::InFlight | Progress::Blocked => return,
            }
        }
    }

    /// Runs one node of the batch; its effects are taken by the next [`Federate::finish`].
    #[inline]
    pub fn run_node(&mut self, node: NodeId, tag: Tag, executor: &mut impl FederateExecutor) {
        self.counters.reactions += 1;
        match self.timeline.program().node(node) {
            NodeKind::Send { output } => self.send(node, output, executor),
            NodeKind::Reaction | NodeKind::Forward { .. } => match self.timeline.tardy(node) {
                None => executor.run(node, tag, &mut self.effects),
                Some(intended) => executor.run_tardy(node, tag, intended, &mut self.effects),
            },
        }
    }

    /// Takes the effects of nodes that are done.
    #[inline]
    pub fn finish(&mut self, nodes: &[NodeId], executor: &mut impl FederateExecutor) {
        self.timeline.finish(nodes, &mut self.effects);
        self.take_effects(executor);
        self.send_absents();
    }

    /// What the timeline leaves: values set over physical connections of this program, and the wish to stop.
    #[inline]
    fn take_effects(&mut self, executor: &mut impl FederateExecutor) {
        if !self.effects.physical.is_empty() {
            let mut physical = std::mem::take(&mut self.effects.physical);
            for (action, value) in physical.drain(..) {
                let tag = self.schedule_physical(self.now, action, value);
                executor.note_physical(action, tag);
            }
            self.effects.physical = physical;
        }
        if std::mem::take(&mut self.effects.stop) {
            self.request_stop_at_current();
        }
    }

    fn send(&mut self, node: NodeId, output: OutputId, executor: &mut impl FederateExecutor) {
        let Some(link) = &mut self.link else { return };
        let sent = link.send(node, output, &self.timeline, |out| {
            executor.encode(output, out);
        });
        let Some(bytes) = sent else { return };
        self.counters.sent += 1;
        let receiver = link.config.outputs[output.index()].federate;
        self.measures.sent(receiver, bytes);
        if !self.config.fast {
            self.launches.push((receiver, self.due));
        }
    }

    /// Notes how long after it may have been begun the last messages left: the driver has written them, or is about to.
    #[inline]
    fn launch(&mut self, now: PhysicalTime) {
        if self.launches.is_empty() {
            return;
        }
        for (receiver, due) in self.launches.drain(..) {
            self.measures.launch_lag(receiver, now.since(due));
        }
    }

    /// In a zero-delay cycle: says of every output that cannot be set any more that it is absent.
    #[inline]
    fn send_absents(&mut self) {
        if let Some(link) = &mut self.link
            && link.in_cycle()
        {
            link.send_absents(&self.timeline);
        }
    }

    /// Moves pending LTC and NET behind the messages they vouch for. Before every wait.
    pub fn flush(&mut self) {
        if let Some(link) = &mut self.link {
            link.flush();
        }
    }

    /// Bytes for the RTI, in order; the driver takes what it has written from the front. `None` for a program alone.
    pub fn output(&mut self) -> Option<&mut Vec<u8>> {
        self.link.as_mut().map(Link::output)
    }

    fn admit(
        &mut self,
        message: &Incoming<'_>,
        executor: &mut impl FederateExecutor,
    ) -> Result<(), Outcome> {
        self.counters.received += 1;
        if let Some(link) = &self.link {
            let upstream = link.config.inputs[message.input.index()].federate;
            self.measures.arrived(upstream, message.payload.len());
        }
        if self.stop.over(self.timeline.at()) {
            return Ok(());
        }
        let value = executor.decode(message.input, message.payload)?;
        match self.timeline.admit(message.input, message.tag, value) {
            Admission::Queued { .. } => Ok(()),
            Admission::IntoCurrentTag => {
                let program = self.timeline.program();
                let action = program.network_inputs()[message.input.index()].action;
                executor.arrive(action, program.action_slot(action), value);
                Ok(())
            }
            Admission::Tardy { intended, .. } => {
                let program = self.timeline.program();
                let port = program.network_inputs()[message.input.index()].port;
                let error = ProtocolError::Tardy {
                    intended,
                    current: self.timeline.at(),
                    input: program.port_path(port),
                };
                Err(error.into())
            }
        }
    }
}

/// A tagged message for one of our inputs.
struct Incoming<'a> {
    input: ictus_core::InputId,
    tag: Tag,
    payload: &'a [u8],
}
