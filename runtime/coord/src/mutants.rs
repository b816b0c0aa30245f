//! Rules that a test build can switch to wrong, one at a time, so that the simulator can prove it would notice.
//!
//! Without the feature `mutants` the set has no size, [`Mutants::has`] is always false and every check compiles away.

/// One rule made wrong.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Mutant {
    /// RTI: TAG is granted when EIMT equals NET, not only when it exceeds it.
    EimtNotStrict,
    /// RTI: messages on their way to a federate do not lower its NET.
    InTransitIgnored,
    /// RTI: a connection with `after 0` counts as one without delay.
    AfterZeroAsNone,
    /// RTI: PTAG is granted without asking what outside the zero-delay cycle may still send.
    StrictEimtDropped,
    /// RTI: LTC grants nothing.
    LtcRuleDropped,
    /// RTI: TAG is sent where PTAG is due.
    FullInsteadOfProvisional,
    /// RTI: the stop tag is the first proposal, not the largest.
    StopMaximumIgnored,
    /// RTI: a PTAG is not passed on to the other members of the cycle.
    ProvisionalFanOutDropped,
    /// RTI: a federate that has resigned keeps the NET it had.
    ResignedKeepsNext,
    /// RTI: DNET is the NET of the downstream, path delay not taken off.
    DownstreamNextTooLate,
    /// RTI: a grant is written before the messages that it vouches for.
    GrantBeforeMessage,
    /// RTI: a grant is the EIMT itself, not the tag before it.
    GrantOneTooFar,
    /// RTI: a lost federate counts as resigned.
    LostAsResigned,
    /// RTI: the LTC rule takes the delay as it is, not one step less.
    LtcDelayNotStrict,
    /// Federate: a PTAG is taken for a TAG.
    ProvisionalAsFull,
    /// Federate: reactions wait for unknown inputs by level, not by their own cone.
    AbsentsByLevel,
    /// Federate: NET is announced past what a physical action may still bring.
    PhysicalPromiseDropped,
    /// Federate: a skipped NET is not sent when a DNET asks for it.
    SkippedNextForgotten,
    /// Federate: LTC is sent before the tag's messages.
    ConfirmedBeforeMessages,
    /// Federate: ordinary tags run past a lost federate's promise.
    PromiseIgnored,
    /// Federate: absent outputs of a zero-delay cycle are not reported.
    AbsentsDropped,
    /// Federate: a tag begun before its inputs are known is completed without its grant.
    AheadCompletes,
    /// Federate: the stop tag is answered as asked, though it has passed.
    StopReplyTooEarly,
    /// Decentralized: a tag is begun at its time, whatever may still come.
    EntersEarly,
    /// Decentralized: an input is taken for absent at its tag's time.
    DecidesEarly,
    /// Decentralized: absence is decided by the clock without looking at what has come.
    DecidesUnlooked,
    /// Decentralized: a message says nothing about earlier tags on its connection.
    OrderIgnored,
    /// Decentralized: STP violations are not counted.
    TardyUncounted,
    /// Decentralized: the end of a lost sender's stream is taken for its regular end.
    LossAsEnd,
    /// Clock: the bound does not grow with the age of what it rests on.
    ClockBoundWithoutDrift,
    /// Clock: an exchange that contradicts the earlier ones is thrown away, not they.
    ClockStepIgnored,
    /// Clock: the latest exchange is believed, not the fastest.
    ClockUnfiltered,
    /// Clock: the bound is that of the clock as it should be, not as it is while it slews.
    ClockSlewNotInBound,
    /// Clock: the bound assumes that both ways take equally long.
    ClockAsymmetryForgotten,
    /// Clock: a T1 that comes twice is answered twice.
    ClockDuplicateTaken,
}

impl Mutant {
    /// Whether it is a rule of decentralized coordination.
    #[must_use]
    pub const fn is_of_time(self) -> bool {
        matches!(
            self,
            Self::EntersEarly
                | Self::DecidesEarly
                | Self::DecidesUnlooked
                | Self::OrderIgnored
                | Self::TardyUncounted
                | Self::LossAsEnd
        )
    }

    /// Those of coordination.
    pub const ALL: &[Self] = &[
        Self::EimtNotStrict,
        Self::InTransitIgnored,
        Self::AfterZeroAsNone,
        Self::StrictEimtDropped,
        Self::LtcRuleDropped,
        Self::FullInsteadOfProvisional,
        Self::StopMaximumIgnored,
        Self::ProvisionalFanOutDropped,
        Self::ResignedKeepsNext,
        Self::DownstreamNextTooLate,
        Self::GrantBeforeMessage,
        Self::GrantOneTooFar,
        Self::LostAsResigned,
        Self::LtcDelayNotStrict,
        Self::ProvisionalAsFull,
        Self::AbsentsByLevel,
        Self::PhysicalPromiseDropped,
        Self::SkippedNextForgotten,
        Self::ConfirmedBeforeMessages,
        Self::PromiseIgnored,
        Self::AbsentsDropped,
        Self::AheadCompletes,
        Self::StopReplyTooEarly,
        Self::EntersEarly,
        Self::DecidesEarly,
        Self::DecidesUnlooked,
        Self::OrderIgnored,
        Self::TardyUncounted,
        Self::LossAsEnd,
    ];

    /// Those of clock synchronization, which has a simulation of its own.
    pub const CLOCK: &[Self] = &[
        Self::ClockBoundWithoutDrift,
        Self::ClockStepIgnored,
        Self::ClockUnfiltered,
        Self::ClockSlewNotInBound,
        Self::ClockAsymmetryForgotten,
        Self::ClockDuplicateTaken,
    ];
}

/// The set of rules that are wrong; empty but in tests.
#[derive(Clone, Copy, Default, PartialEq, Eq, Debug)]
pub struct Mutants {
    #[cfg(feature = "mutants")]
    bits: u64,
}

impl Mutants {
    /// No rule is wrong.
    pub const NONE: Self = Self {
        #[cfg(feature = "mutants")]
        bits: 0,
    };

    /// This one rule is wrong.
    #[cfg(feature = "mutants")]
    #[must_use]
    pub const fn only(mutant: Mutant) -> Self {
        Self {
            bits: 1 << mutant as u32,
        }
    }

    /// Whether `mutant` is in the set.
    #[must_use]
    #[inline]
    pub const fn has(self, mutant: Mutant) -> bool {
        #[cfg(feature = "mutants")]
        {
            self.bits & (1 << mutant as u32) != 0
        }
        #[cfg(not(feature = "mutants"))]
        {
            let _ = mutant;
            false
        }
    }
}
