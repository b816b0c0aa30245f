//! What the runs have exercised: a feature that never happens is a feature that is not tested.

use crate::scenario::Kind;
use std::fmt::Write as _;

macro_rules! features {
    ($($name:ident => $words:literal,)*) => {
        /// Something that runs must show now and then.
        #[derive(Clone, Copy, PartialEq, Eq, Debug)]
        pub enum Feature {
            $(#[doc = $words] $name,)*
        }

        impl Feature {
            /// All of them with their names for people.
            pub const ALL: &[(Self, &str)] = &[$((Self::$name, $words),)*];
        }
    };
}

features! {
    ProvisionalGrant => "PTAG",
    FullGrant => "TAG",
    Absent => "port absent",
    IntoCurrentTag => "message into the current tag",
    MicrostepDelay => "message over `after 0`",
    TimeDelay => "message over `after d`",
    Collision => "collision of messages at a tag",
    InTransitLowersNext => "in-transit tag below a NET",
    DownstreamNextEvent => "DNET",
    SkippedAnnouncement => "NET skipped for a DNET",
    SelfContained => "federate connected to itself",
    Alone => "federate without neighbours",
    AnsweringPair => "p -> q -> out beside r",
    Cycle => "cycle with delay",
    TwoZeroDelayCycles => "two zero-delay cycles in a row",
    PhysicalAction => "physical action",
    PhysicalDeferred => "physical event deferred to keep a promise",
    OutOfOrder => "reactions completed out of order",
    RunsAhead => "tag begun before its inputs are known",
    FlowControlWait => "wait for flow control",
    StopByReaction => "stop by a reaction",
    StopFromOutside => "stop from outside",
    StopRace => "two stop requests at once",
    Starvation => "end because no event is left",
    CrashWhileJoining => "federate crash while joining",
    Crash => "federate crash while running",
    PromiseLimit => "federate limited by a lost one's promise",
    RtiCrash => "RTI crash",
    Partition => "partition",
    SplitMessage => "message split between reads",
    ClockOffset => "clock corrected while joining",
    Foreign => "federates without our extensions",
    LegacySource => "source that announces by LTC alone",
    Calm => "run in which nothing may be late",
    Fast => "run ahead of physical time",
    Decentralized => "decentralized coordination",
    StpViolation => "STP violation",
    WithinBounds => "run with all messages within their bounds",
}

/// What only runs under decentralized coordination show.
const OF_TIME: &[Feature] = &[
    Feature::Decentralized,
    Feature::StpViolation,
    Feature::WithinBounds,
];

/// What both kinds of runs show.
const EVERYWHERE: &[Feature] = &[
    Feature::Absent,
    Feature::MicrostepDelay,
    Feature::TimeDelay,
    Feature::Cycle,
    Feature::PhysicalAction,
    Feature::OutOfOrder,
    Feature::StopByReaction,
    Feature::StopFromOutside,
    Feature::CrashWhileJoining,
    Feature::Crash,
    Feature::RtiCrash,
    Feature::Partition,
    Feature::ClockOffset,
];

/// Counts per feature.
#[derive(Clone, Debug)]
pub struct Coverage {
    counts: Vec<u64>,
}

impl Default for Coverage {
    fn default() -> Self {
        Self {
            counts: vec![0; Feature::ALL.len()],
        }
    }
}

impl Coverage {
    /// Counts one more.
    pub fn hit(&mut self, feature: Feature) {
        self.counts[feature as usize] += 1;
    }

    /// Counts `times` more.
    pub fn add(&mut self, feature: Feature, times: u64) {
        self.counts[feature as usize] += times;
    }

    /// How often it happened.
    #[must_use]
    pub fn count(&self, feature: Feature) -> u64 {
        self.counts[feature as usize]
    }

    /// Adds the other's counts.
    pub fn merge(&mut self, other: &Self) {
        for (a, b) in self.counts.iter_mut().zip(&other.counts) {
            *a += b;
        }
    }

    /// The features that runs of this kind must show and that never happened.
    pub fn missing(&self, kind: Kind) -> impl Iterator<Item = &'static str> {
        let wanted = move |feature: &Feature| match kind {
            Kind::Centralized => !OF_TIME.contains(feature),
            Kind::Decentralized => OF_TIME.contains(feature) || EVERYWHERE.contains(feature),
        };
        Feature::ALL
            .iter()
            .filter(move |(feature, _)| wanted(feature) && self.count(*feature) == 0)
            .map(|(_, words)| *words)
    }

    /// One line per feature.
    #[must_use]
    pub fn table(&self) -> String {
        let mut table = String::new();
        for (feature, words) in Feature::ALL {
            let _ = writeln!(table, "  {words:<44} {:>12}", self.count(*feature));
        }
        table
    }
}
