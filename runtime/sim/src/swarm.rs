//! Swarm options: which features a run uses. Drawn first, so that rare combinations get runs of their own.

use crate::seed::Rng;
use ictus_core::{Duration, DurationExt as _};

/// What one run is made of.
#[derive(Clone, Debug)]
pub struct Swarm {
    /// The number of federates.
    pub federates: usize,
    /// How the program looks.
    pub shape: Shape,
    /// How the run is driven.
    pub mode: Mode,
    /// What ends it.
    pub ending: Ending,
    /// How bad the network is.
    pub network: Network,
    /// How bad the hosts' clocks are.
    pub clocks: Clocks,
}

/// How the program looks.
#[derive(Clone, Copy, Debug)]
#[expect(
    clippy::struct_excessive_bools,
    reason = "features are drawn independently"
)]
pub struct Shape {
    /// Connections that close cycles.
    pub cycles: bool,
    /// Legal cycles without delay.
    pub zero_delay_cycles: bool,
    /// Connections with `after 0`.
    pub microsteps: bool,
    /// Connections with `after d`.
    pub delays: bool,
    /// Physical actions.
    pub physical: bool,
}

/// How the run is driven.
#[derive(Clone, Copy, Debug)]
#[expect(
    clippy::struct_excessive_bools,
    reason = "features are drawn independently"
)]
pub struct Mode {
    /// Ahead of physical time.
    pub fast: bool,
    /// Reactions are in flight together and complete in random order.
    pub parallel: bool,
    /// Reactions take this long at most.
    pub reaction: Duration,
    /// Flow control.
    pub max_lead: Option<Duration>,
    /// Clocks are compared while joining.
    pub clock_sync: bool,
    /// The RTI sends DNET.
    pub dnet: bool,
    /// Sources yield after this many batches.
    pub slice: usize,
    /// Federates and RTI use our extensions.
    pub extensions: bool,
    /// Where nothing else depends on it, sources announce progress by LTC alone, as TypeScript ones do.
    pub legacy_sources: bool,
    /// Nothing is slow: whatever is late is late for no good reason.
    pub calm: bool,
    /// Time and STP offsets decide, instead of the RTI; and what the offsets are.
    pub offsets: Option<Offsets>,
}

/// STP offsets under decentralized coordination.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Offsets {
    /// Solved from bounds that hold mostly.
    Solved,
    /// Zero.
    Zero,
    /// Any, different per connection.
    Random,
}

/// What ends the run.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Ending {
    /// The time-out.
    Timeout,
    /// A reaction asks, before the time-out.
    ReactionStop,
    /// One or more federates are asked from outside.
    OutsideStop {
        /// How many.
        askers: usize,
    },
    /// No event is left.
    Starvation,
    /// A federate's process dies.
    FederateCrash,
    /// The RTI dies.
    RtiCrash,
}

/// How bad the network is.
#[derive(Clone, Copy, Debug)]
pub struct Network {
    /// The least one-way delay.
    pub delay_min: Duration,
    /// The largest ordinary one-way delay.
    pub delay_max: Duration,
    /// Percent of writes that are cut into pieces.
    pub cut: u64,
    /// Percent of writes that hit a clog of up to twenty times the largest delay.
    pub clog: u64,
    /// The number of partitions, each between one federate and the RTI.
    pub partitions: usize,
    /// How long a partition lasts at most.
    pub partition: Duration,
}

/// How bad the hosts' clocks are.
#[derive(Clone, Copy, Debug)]
pub struct Clocks {
    /// The largest offset from true time.
    pub offset: Duration,
    /// The largest drift, parts per million.
    pub drift: i64,
}

impl Swarm {
    /// Draws the options of a run.
    #[must_use]
    pub fn draw(rng: &mut Rng) -> Self {
        let ending = draw_ending(rng);
        let physical = rng.percent(20) && ending != Ending::Starvation;
        let swarm = Self {
            federates: rng.between(2, 12),
            shape: Shape {
                cycles: rng.percent(60),
                zero_delay_cycles: rng.percent(50),
                microsteps: rng.percent(60),
                delays: rng.percent(75),
                physical,
            },
            mode: draw_mode(physical, rng),
            ending,
            network: draw_network(rng),
            clocks: Clocks {
                offset: *rng.pick(&[Duration::ZERO, 100.us(), 20.ms(), 2.secs()]),
                drift: *rng.pick(&[0, 50, 500]),
            },
        };
        if rng.percent(12) {
            swarm.calmed()
        } else {
            swarm
        }
    }

    /// Draws the options of a run under decentralized coordination.
    #[must_use]
    pub fn draw_decentralized(rng: &mut Rng) -> Self {
        let mut swarm = Self::draw(rng);
        swarm.mode.offsets = Some(*rng.pick(&[
            Offsets::Solved,
            Offsets::Solved,
            Offsets::Zero,
            Offsets::Random,
        ]));
        swarm.mode.fast = false;
        swarm.mode.max_lead = None;
        swarm.mode.legacy_sources = false;
        swarm.mode.extensions = true;
        swarm.mode.calm = false;
        swarm.federates = swarm.federates.min(8);
        // In a cycle each waits for the other's end.
        if swarm.ending == Ending::Starvation {
            swarm.ending = Ending::Timeout;
        }
        if rng.percent(40) {
            swarm.mode.reaction = Duration::ZERO;
            swarm.network.clog = 0;
            swarm.network.partitions = 0;
        }
        swarm.clocks.offset = swarm.clocks.offset.min(20.ms());
        swarm
    }

    /// Without anything that takes time, and without cycles.
    fn calmed(mut self) -> Self {
        self.shape.cycles = false;
        self.shape.zero_delay_cycles = false;
        self.shape.physical = false;
        self.mode.fast = false;
        self.mode.reaction = Duration::ZERO;
        self.mode.max_lead = None;
        if self.mode.legacy_sources {
            self.federates = 2 + self.federates % 2;
        }
        self.mode.calm = true;
        self.ending = Ending::Timeout;
        self.network = Network {
            delay_min: 10.us(),
            delay_max: 11.us(),
            cut: 20,
            clog: 0,
            partitions: 0,
            partition: Duration::ZERO,
        };
        self.clocks = Clocks {
            offset: Duration::ZERO,
            drift: 0,
        };
        self
    }
}

fn draw_mode(physical: bool, rng: &mut Rng) -> Mode {
    Mode {
        fast: !physical && rng.percent(20),
        parallel: rng.percent(50),
        reaction: *rng.pick(&[Duration::ZERO, 20.us(), 500.us(), 3.ms()]),
        max_lead: rng.percent(35).then(|| rng.span(1.ms(), 8.ms())),
        clock_sync: rng.percent(30),
        dnet: rng.percent(85),
        slice: rng.between(1, 40),
        extensions: rng.percent(75),
        legacy_sources: rng.percent(30),
        calm: false,
        offsets: None,
    }
}

fn draw_ending(rng: &mut Rng) -> Ending {
    match rng.below(100) {
        0..52 => Ending::Timeout,
        52..62 => Ending::ReactionStop,
        62..74 => Ending::OutsideStop {
            askers: rng.between(1, 3),
        },
        74..80 => Ending::Starvation,
        80..94 => Ending::FederateCrash,
        _ => Ending::RtiCrash,
    }
}

fn draw_network(rng: &mut Rng) -> Network {
    let delay_min = *rng.pick(&[10.us(), 50.us(), 300.us(), 2.ms()]);
    let jitter = *rng.pick(&[1.us(), 200.us(), 3.ms(), 15.ms()]);
    Network {
        delay_min,
        delay_max: delay_min + jitter,
        cut: *rng.pick(&[0, 20, 80]),
        clog: *rng.pick(&[0, 0, 2]),
        partitions: if rng.percent(25) {
            rng.between(1, 3)
        } else {
            0
        },
        partition: rng.span(1.ms(), 120.ms()),
    }
}
