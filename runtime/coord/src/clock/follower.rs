//! The federate's end of the probes.

use std::net::{IpAddr, SocketAddr};

use ictus_core::{Duration, PhysicalTime};

use super::{Datagram, Exchange, FromFederate};
use crate::mutants::{Mutant, Mutants};

/// A coded probe whose distance from T4 has changed by more met a queue, or left one. LF's guard band.
const SPACING_GUARD: Duration = Duration::from_micros(100);
/// T1s that are remembered, to know them again: networks duplicate datagrams.
const REMEMBERED: usize = 8;

/// What a datagram came to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Heard {
    /// Nothing to do.
    Nothing,
    /// Send this, then say when with [`Follower::answered`].
    Answer {
        /// Where to.
        to: SocketAddr,
        /// What.
        datagram: FromFederate,
    },
    /// An exchange is complete, and whether its coded probe kept its distance.
    Complete(Exchange, bool),
}

/// Answers the RTI's probes. Datagrams from anybody else, or of another form, are counted and forgotten.
#[derive(Clone, Debug)]
pub struct Follower {
    federate: u16,
    echoes: bool,
    reference: IpAddr,
    /// Where the last T1 came from.
    port: Option<u16>,
    /// An exchange with it was complete: probes come from nowhere else.
    settled: bool,
    state: State,
    remembered: [PhysicalTime; REMEMBERED],
    next: usize,
    strangers: u64,
    incomplete: u64,
    mutants: Mutants,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Idle,
    /// T1 came; T3 is about to be sent.
    Answering {
        t1: PhysicalTime,
        t2: PhysicalTime,
    },
    AwaitingT4 {
        t1: PhysicalTime,
        t2: PhysicalTime,
        t3: PhysicalTime,
        /// The coded probe has overtaken T4: what it says, and when it came.
        probe: Option<(PhysicalTime, PhysicalTime)>,
    },
    /// T4 came at `r4`.
    AwaitingProbe {
        exchange: Exchange,
        r4: PhysicalTime,
    },
}

impl Follower {
    /// The follower of federate `federate`; the RTI's probes come from `reference`. `echoes`: the RTI is ours.
    #[must_use]
    pub const fn new(federate: u16, reference: IpAddr, echoes: bool) -> Self {
        Self {
            federate,
            echoes,
            reference,
            port: None,
            settled: false,
            state: State::Idle,
            remembered: [PhysicalTime::NEVER; REMEMBERED],
            next: 0,
            strangers: 0,
            incomplete: 0,
            mutants: Mutants::NONE,
        }
    }

    /// With rules that are wrong.
    #[doc(hidden)]
    #[must_use]
    pub const fn with_mutants(mut self, mutants: Mutants) -> Self {
        self.mutants = mutants;
        self
    }

    /// Datagrams that no probe of the RTI's can have been.
    #[must_use]
    pub const fn strangers(&self) -> u64 {
        self.strangers
    }

    /// Exchanges that were begun and not ended: a datagram was lost, late or out of order.
    #[must_use]
    pub const fn incomplete(&self) -> u64 {
        self.incomplete
    }

    /// Takes what `from` sent; it came when the base clock showed `arrived` or before.
    pub fn receive(&mut self, from: SocketAddr, bytes: &[u8], arrived: PhysicalTime) -> Heard {
        let known = |datagram: &Datagram| {
            let begins = matches!(datagram, Datagram::T1(_)) && !self.settled;
            from.ip() == self.reference && (begins || self.port == Some(from.port()))
        };
        let datagram = Datagram::decode(bytes).filter(known);
        match datagram {
            None => {
                self.strangers += 1;
                Heard::Nothing
            }
            Some(Datagram::T1(t1)) => self.begin(from, t1, arrived),
            Some(Datagram::T4 { came, left }) => self.take_t4(came, left, arrived),
            Some(Datagram::CodedProbe(t5)) => self.take_probe(t5, arrived),
        }
    }

    /// T3 was sent when the base clock showed `t3` or later.
    pub fn answered(&mut self, t3: PhysicalTime) {
        if let State::Answering { t1, t2 } = self.state {
            let probe = None;
            self.state = State::AwaitingT4 { t1, t2, t3, probe };
        }
    }

    /// T3 left when the base clock showed `when` or later, as the kernel says afterwards.
    pub fn left(&mut self, when: PhysicalTime) {
        match &mut self.state {
            State::AwaitingT4 { t3, .. } => *t3 = when.max(*t3),
            State::AwaitingProbe { exchange, .. } => exchange.t3 = when.max(exchange.t3),
            State::Idle | State::Answering { .. } => {}
        }
    }

    fn begin(&mut self, from: SocketAddr, t1: PhysicalTime, t2: PhysicalTime) -> Heard {
        let again = self.remembered.contains(&t1);
        if again && !self.mutants.has(Mutant::ClockDuplicateTaken) {
            return Heard::Nothing;
        }
        self.port = Some(from.port());
        self.remembered[self.next] = t1;
        self.next = (self.next + 1) % REMEMBERED;
        self.give_up();
        self.state = State::Answering { t1, t2 };
        Heard::Answer {
            to: from,
            datagram: FromFederate {
                federate: self.federate,
                echo: self.echoes.then_some(t1),
            },
        }
    }

    fn take_t4(&mut self, t4: PhysicalTime, left: Option<PhysicalTime>, r4: PhysicalTime) -> Heard {
        let State::AwaitingT4 { t1, t2, t3, probe } = self.state else {
            return Heard::Nothing;
        };
        // One that answers an earlier T3 was sent before this T1.
        if t4 < t1 {
            return Heard::Nothing;
        }
        // When T1 left, not when it was written, if the RTI has learnt that since.
        let t1 = left.map_or(t1, |left| left.max(t1));
        let exchange = Exchange { t1, t2, t3, t4 };
        if !exchange.is_plausible() {
            self.give_up();
            return Heard::Nothing;
        }
        match probe {
            Some((t5, r5)) => self.complete(exchange, r4, t5, r5),
            None => {
                self.state = State::AwaitingProbe { exchange, r4 };
                Heard::Nothing
            }
        }
    }

    fn take_probe(&mut self, t5: PhysicalTime, r5: PhysicalTime) -> Heard {
        match &mut self.state {
            State::AwaitingProbe { exchange, r4 } => {
                let (exchange, r4) = (*exchange, *r4);
                self.complete(exchange, r4, t5, r5)
            }
            State::AwaitingT4 { t1, probe, .. } => {
                *probe = (t5 >= *t1).then_some((t5, r5));
                Heard::Nothing
            }
            State::Idle | State::Answering { .. } => Heard::Nothing,
        }
    }

    fn complete(
        &mut self,
        exchange: Exchange,
        r4: PhysicalTime,
        t5: PhysicalTime,
        r5: PhysicalTime,
    ) -> Heard {
        self.state = State::Idle;
        self.settled = true;
        let sent = t5.since(exchange.t4).as_nanos();
        let came = r5.since(r4).as_nanos();
        let survived = came.abs_diff(sent) < SPACING_GUARD.as_nanos().unsigned_abs();
        Heard::Complete(exchange, survived)
    }

    fn give_up(&mut self) {
        self.incomplete += u64::from(self.state != State::Idle);
        self.state = State::Idle;
    }
}
