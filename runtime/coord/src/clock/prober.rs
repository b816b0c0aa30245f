//! The RTI's end of the probes.

use std::collections::VecDeque;
use std::net::SocketAddr;

use ictus_core::{Duration, PhysicalTime};

use super::{Datagram, Encoded, FromFederate};
use crate::topology::FederateId;

/// LF's patience for T3.
const PATIENCE: Duration = Duration::from_secs(1);
/// With one that repeats T1: what comes later is known to be late.
const PATIENCE_WITH_ECHO: Duration = Duration::from_millis(50);

/// A datagram to be sent at once.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Transmit {
    /// Where to.
    pub to: SocketAddr,
    /// What.
    pub bytes: Encoded,
    /// The federate whose T1 this is: [`Prober::left`] wants to know when it leaves.
    pub begins: Option<FederateId>,
}

/// Probes federates, each in its own rhythm: one that is silent keeps nobody waiting.
///
/// The driver's part: after every call, while [`Prober::poll_transmit`] gives a datagram, send it at once, and give each call a
/// reading of the clock taken just before.
#[derive(Clone, Debug)]
pub struct Prober {
    period: Duration,
    targets: Vec<Option<Target>>,
    outgoing: VecDeque<(FederateId, Outgoing)>,
    unanswered: u64,
    strangers: u64,
}

#[derive(Clone, Copy, Debug)]
struct Target {
    address: SocketAddr,
    state: State,
    /// It repeats the T1 that it answers.
    echoes: bool,
}

#[derive(Clone, Copy, Debug)]
enum State {
    /// The next exchange begins then.
    Resting {
        since: PhysicalTime,
        until: PhysicalTime,
    },
    /// T1 is about to be sent.
    Beginning,
    /// T1 says `t1`; it left then or later.
    Waiting {
        t1: PhysicalTime,
        left: Option<PhysicalTime>,
    },
}

#[derive(Clone, Copy, Debug)]
enum Outgoing {
    T1,
    T4 {
        came: PhysicalTime,
        t1: PhysicalTime,
        left: Option<PhysicalTime>,
    },
    CodedProbe {
        t4: PhysicalTime,
        sent: PhysicalTime,
    },
}

impl Prober {
    /// A prober of up to `federates` federates, each every `period` (at least 100 us).
    #[must_use]
    pub fn new(federates: u16, period: Duration) -> Self {
        Self {
            period: period.max(Duration::from_micros(100)),
            targets: vec![None; usize::from(federates)],
            outgoing: VecDeque::new(),
            unanswered: 0,
            strangers: 0,
        }
    }

    /// Exchanges that a federate did not answer within a second.
    #[must_use]
    pub const fn unanswered(&self) -> u64 {
        self.unanswered
    }

    /// Datagrams that no federate can have sent as an answer.
    #[must_use]
    pub const fn strangers(&self) -> u64 {
        self.strangers
    }

    /// From `first` on probes a federate at `address`.
    pub fn begin(&mut self, first: PhysicalTime, federate: FederateId, address: SocketAddr) {
        if let Some(target) = self.targets.get_mut(federate.index()) {
            let (since, until) = (PhysicalTime::NEVER, first);
            let state = State::Resting { since, until };
            let echoes = false;
            *target = Some(Target {
                address,
                state,
                echoes,
            });
        }
    }

    /// Probes a federate no more.
    pub fn end(&mut self, federate: FederateId) {
        if let Some(target) = self.targets.get_mut(federate.index()) {
            *target = None;
        }
    }

    /// When [`Prober::handle_timeout`] is due. O(federates).
    #[must_use]
    pub fn poll_timeout(&self) -> Option<PhysicalTime> {
        let due = |target: &Target| match target.state {
            State::Resting { until, .. } => Some(until),
            State::Waiting { t1, .. } => Some(t1 + self.patience(target)),
            State::Beginning => None,
        };
        self.targets.iter().flatten().filter_map(due).min()
    }

    /// Begins the exchanges that are due, gives up those that are not answered. A clock that was stepped back delays none.
    pub fn handle_timeout(&mut self, now: PhysicalTime) {
        for index in 0..self.targets.len() {
            let Some(target) = self.targets[index] else {
                continue;
            };
            let begins = match target.state {
                State::Resting { since, until } => until <= now || since > now,
                State::Waiting { t1, .. } => {
                    let over = t1 + self.patience(&target) <= now || t1 > now;
                    self.unanswered += u64::from(over);
                    over
                }
                State::Beginning => false,
            };
            if begins {
                let state = State::Beginning;
                self.targets[index] = Some(Target { state, ..target });
                let federate = u16::try_from(index).unwrap_or(u16::MAX);
                self.outgoing
                    .push_back((FederateId::new(federate), Outgoing::T1));
            }
        }
    }

    /// Takes a datagram that came at `arrived` or before.
    pub fn receive(&mut self, from: SocketAddr, bytes: &[u8], arrived: PhysicalTime) {
        let Some((federate, echoes)) = self.answered(from, bytes) else {
            self.strangers += 1;
            return;
        };
        let Some(Some(target)) = self.targets.get_mut(federate.index()) else {
            return;
        };
        let State::Waiting { t1, left } = target.state else {
            return;
        };
        target.echoes = echoes;
        // Next to T1, not to now: the rhythm does not drift.
        target.state = State::Resting {
            since: arrived,
            until: t1 + self.period,
        };
        let t4 = Outgoing::T4 {
            came: arrived,
            t1,
            left,
        };
        self.outgoing.push_back((federate, t4));
    }

    /// T1 left when the clock showed `left` or later, as the kernel says afterwards.
    pub fn left(&mut self, federate: FederateId, when: PhysicalTime) {
        let target = self.targets.get_mut(federate.index());
        if let Some(Some(target)) = target
            && let State::Waiting { t1, left } = &mut target.state
            && when >= *t1
        {
            *left = Some(when);
        }
    }

    /// The next datagram to send, made when the clock shows `now`.
    ///
    /// T4 says when T3 came, to who repeats T1 also when that left; to others, who think that T1 left at once, that T3 came as much
    /// later: then both ways look alike. And the probe as much later as it leaves after T4: LF's federates compare the two.
    pub fn poll_transmit(&mut self, now: PhysicalTime) -> Option<Transmit> {
        loop {
            let (federate, outgoing) = self.outgoing.pop_front()?;
            let Some(Some(target)) = self.targets.get_mut(federate.index()) else {
                continue;
            };
            let mut begins = None;
            let datagram = match outgoing {
                Outgoing::T1 => {
                    let (t1, left) = (now, None);
                    target.state = State::Waiting { t1, left };
                    begins = Some(federate);
                    Datagram::T1(t1)
                }
                Outgoing::T4 { came, t1, left } => {
                    // Never before T1, whatever the clock did.
                    let came = came.max(t1);
                    let waited = left.map_or(Duration::ZERO, |left| left.since(t1));
                    let (came, left) = if target.echoes {
                        (came, left)
                    } else {
                        (came + waited, None)
                    };
                    let probe = Outgoing::CodedProbe {
                        t4: came,
                        sent: now,
                    };
                    self.outgoing.push_front((federate, probe));
                    Datagram::T4 { came, left }
                }
                Outgoing::CodedProbe { t4, sent } => {
                    Datagram::CodedProbe(t4.saturating_add(now.since(sent)))
                }
            };
            return Some(Transmit {
                to: target.address,
                bytes: datagram.encode(),
                begins,
            });
        }
    }

    fn patience(&self, target: &Target) -> Duration {
        if target.echoes {
            self.period.max(PATIENCE_WITH_ECHO).min(PATIENCE)
        } else {
            PATIENCE
        }
    }

    /// Whose answer to which T1 these bytes are.
    fn answered(&self, from: SocketAddr, bytes: &[u8]) -> Option<(FederateId, bool)> {
        let answer = FromFederate::decode(bytes)?;
        let federate = FederateId::new(answer.federate);
        let target = self.targets.get(federate.index())?.as_ref()?;
        let State::Waiting { t1, .. } = target.state else {
            return None;
        };
        let fits = target.address == from && answer.echo.is_none_or(|echo| echo == t1);
        fits.then_some((federate, answer.echo.is_some()))
    }
}
