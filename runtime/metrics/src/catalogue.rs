//! Every metric: name, type, unit, labels, help.
//!
//! Labels have closed sets of values: names of the plan, and words that stand beside the constants here.

/// What a metric's value does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Only grows, from 0.
    Counter,
    /// Is what it is.
    Gauge,
    /// Counts observations in buckets.
    Histogram,
}

/// What a metric's value is measured in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unit {
    /// A plain number.
    None,
    /// Seconds.
    Seconds,
    /// Bytes.
    Bytes,
    /// A share of 1.
    Ratio,
}

/// A metric.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Metric {
    /// Its name, prefix and unit included.
    pub name: &'static str,
    /// What its value does.
    pub kind: Kind,
    /// What its value is measured in.
    pub unit: Unit,
    /// The names of its labels.
    pub labels: &'static [&'static str],
    /// What it says, in one sentence.
    pub help: &'static str,
}

/// The upper bounds of every histogram's buckets, in nanoseconds: 1 us to 10 s in steps of 1, 2, 5.
pub const BOUNDS_NS: [i64; 22] = [
    1_000,
    2_000,
    5_000,
    10_000,
    20_000,
    50_000,
    100_000,
    200_000,
    500_000,
    1_000_000,
    2_000_000,
    5_000_000,
    10_000_000,
    20_000_000,
    50_000_000,
    100_000_000,
    200_000_000,
    500_000_000,
    1_000_000_000,
    2_000_000_000,
    5_000_000_000,
    10_000_000_000,
];

/// Values of the label `direction`.
pub const DIRECTIONS: [&str; 2] = ["received", "sent"];
/// Values of the label `result` of [`CLOCK_PROBES`].
pub const PROBE_RESULTS: [&str; 3] = ["kept", "dropped", "stranger"];

/// What is added to the host's clock, or what an external source says it is off by.
pub const CLOCK_OFFSET: Metric = Metric {
    name: "ictus_clock_offset_seconds",
    kind: Kind::Gauge,
    unit: Unit::Seconds,
    labels: &["federation", "federate", "source"],
    help: "What is added to the host's clock, or what an external source says it is off by.",
};
/// How far the federate's clock may be from its reference; absent while nothing is known.
pub const CLOCK_ERROR_BOUND: Metric = Metric {
    name: "ictus_clock_error_bound_seconds",
    kind: Kind::Gauge,
    unit: Unit::Seconds,
    labels: &["federation", "federate", "source"],
    help: "How far the federate's clock may be from its reference; absent while nothing is known.",
};
/// The declared clock.max_error.
pub const CLOCK_ERROR_LIMIT: Metric = Metric {
    name: "ictus_clock_error_limit_seconds",
    kind: Kind::Gauge,
    unit: Unit::Seconds,
    labels: &["federation"],
    help: "The declared clock.max_error.",
};
/// 1 while the source says that the clock is synchronized.
pub const CLOCK_SYNCHRONIZED: Metric = Metric {
    name: "ictus_clock_synchronized",
    kind: Kind::Gauge,
    unit: Unit::None,
    labels: &["federation", "federate", "source"],
    help: "1 while the source says that the clock is synchronized.",
};
/// How much faster than its reference the host's clock runs.
pub const CLOCK_FREQUENCY_ERROR: Metric = Metric {
    name: "ictus_clock_frequency_error_ratio",
    kind: Kind::Gauge,
    unit: Unit::Ratio,
    labels: &["federation", "federate", "source"],
    help: "How much faster than its reference the host's clock runs.",
};
/// Clock steps noticed, of the federate's host or of the RTI's.
pub const CLOCK_STEPS: Metric = Metric {
    name: "ictus_clock_steps_total",
    kind: Kind::Counter,
    unit: Unit::None,
    labels: &["federation", "federate"],
    help: "Clock steps noticed, of the federate's host or of the RTI's.",
};
/// Probe exchanges kept and dropped, and datagrams of strangers.
pub const CLOCK_PROBES: Metric = Metric {
    name: "ictus_clock_probes_total",
    kind: Kind::Counter,
    unit: Unit::None,
    labels: &["federation", "federate", "result"],
    help: "Probe exchanges kept and dropped, and datagrams of strangers.",
};
/// Messages that came after their input had been decided at their tag.
pub const STP_VIOLATIONS: Metric = Metric {
    name: "ictus_stp_violations_total",
    kind: Kind::Counter,
    unit: Unit::None,
    labels: &["federation", "federate", "upstream"],
    help: "Messages that came after their input had been decided at their tag.",
};
/// By how much tardy messages were late.
pub const STP_VIOLATION_LATENESS: Metric = Metric {
    name: "ictus_stp_violation_lateness_seconds",
    kind: Kind::Histogram,
    unit: Unit::Seconds,
    labels: &["federation", "federate"],
    help: "By how much tardy messages were late.",
};
/// How long before they would have been late messages came.
pub const STP_SLACK: Metric = Metric {
    name: "ictus_stp_slack_seconds",
    kind: Kind::Histogram,
    unit: Unit::Seconds,
    labels: &["federation", "federate", "upstream"],
    help: "How long before they would have been late messages came.",
};
/// The STP offset of the plan, declared or solved.
pub const STP_OFFSET: Metric = Metric {
    name: "ictus_stp_offset_seconds",
    kind: Kind::Gauge,
    unit: Unit::Seconds,
    labels: &["federation", "federate"],
    help: "The STP offset of the plan, declared or solved.",
};
/// The STP offset that the declared bounds require, given the senders' offsets.
pub const STP_OFFSET_REQUIRED: Metric = Metric {
    name: "ictus_stp_offset_required_seconds",
    kind: Kind::Gauge,
    unit: Unit::Seconds,
    labels: &["federation", "federate"],
    help: "The STP offset that the declared bounds require, given the senders' offsets.",
};
/// Deadlines missed.
pub const DEADLINE_MISSES: Metric = Metric {
    name: "ictus_deadline_misses_total",
    kind: Kind::Counter,
    unit: Unit::None,
    labels: &["federation", "federate"],
    help: "Deadlines missed.",
};
/// By how much deadlines were missed.
pub const DEADLINE_LATENESS: Metric = Metric {
    name: "ictus_deadline_lateness_seconds",
    kind: Kind::Histogram,
    unit: Unit::Seconds,
    labels: &["federation", "federate"],
    help: "By how much deadlines were missed.",
};
/// Watchdogs that fired.
pub const WATCHDOGS_FIRED: Metric = Metric {
    name: "ictus_watchdogs_fired_total",
    kind: Kind::Counter,
    unit: Unit::None,
    labels: &["federation", "federate"],
    help: "Watchdogs that fired.",
};
/// Physical minus logical time when a tag is begun.
pub const TAG_LAG: Metric = Metric {
    name: "ictus_tag_lag_seconds",
    kind: Kind::Histogram,
    unit: Unit::Seconds,
    labels: &["federation", "federate"],
    help: "Physical minus logical time when a tag is begun.",
};
/// 1 while the lag keeps growing and is over 100 ms.
pub const FALLING_BEHIND: Metric = Metric {
    name: "ictus_federate_falling_behind",
    kind: Kind::Gauge,
    unit: Unit::None,
    labels: &["federation", "federate"],
    help: "1 while the lag keeps growing and is over 100 ms.",
};
/// Times the federate began to fall behind.
pub const FELL_BEHIND: Metric = Metric {
    name: "ictus_federate_fell_behind_total",
    kind: Kind::Counter,
    unit: Unit::None,
    labels: &["federation", "federate"],
    help: "Times the federate began to fall behind.",
};
/// Tags completed.
pub const TAGS_COMPLETED: Metric = Metric {
    name: "ictus_tags_completed_total",
    kind: Kind::Counter,
    unit: Unit::None,
    labels: &["federation", "federate"],
    help: "Tags completed.",
};
/// Reactions run.
pub const REACTIONS_EXECUTED: Metric = Metric {
    name: "ictus_reactions_executed_total",
    kind: Kind::Counter,
    unit: Unit::None,
    labels: &["federation", "federate"],
    help: "Reactions run.",
};
/// How long tags waited for the RTI's grant.
pub const GRANT_WAIT: Metric = Metric {
    name: "ictus_rti_grant_wait_seconds",
    kind: Kind::Histogram,
    unit: Unit::Seconds,
    labels: &["federation", "federate"],
    help: "How long tags that were not granted at once waited for nothing but the RTI's grant.",
};
/// Messages sent to a federate.
pub const MESSAGES_SENT: Metric = Metric {
    name: "ictus_messages_sent_total",
    kind: Kind::Counter,
    unit: Unit::None,
    labels: &["federation", "federate", "peer"],
    help: "Messages sent to a federate.",
};
/// Messages received from a federate.
pub const MESSAGES_RECEIVED: Metric = Metric {
    name: "ictus_messages_received_total",
    kind: Kind::Counter,
    unit: Unit::None,
    labels: &["federation", "federate", "peer"],
    help: "Messages received from a federate.",
};
/// Payload bytes sent to and received from a federate.
pub const MESSAGE_BYTES: Metric = Metric {
    name: "ictus_message_bytes_total",
    kind: Kind::Counter,
    unit: Unit::Bytes,
    labels: &["federation", "federate", "peer", "direction"],
    help: "Payload bytes sent to and received from a federate.",
};
/// From the time at which the sender might begin a tag to the arrival of its message, over both clocks: read it with their error bounds.
pub const MESSAGE_LATENCY: Metric = Metric {
    name: "ictus_message_latency_seconds",
    kind: Kind::Histogram,
    unit: Unit::Seconds,
    labels: &["federation", "federate", "upstream"],
    help: "From the time at which the sender might begin a tag to the arrival of its message, over both clocks: read it with their error bounds.",
};
/// From the time at which the sender might begin a tag to the leaving of its message.
pub const LAUNCH_LAG: Metric = Metric {
    name: "ictus_message_launch_lag_seconds",
    kind: Kind::Histogram,
    unit: Unit::Seconds,
    labels: &["federation", "federate", "peer"],
    help: "From the time at which the sender might begin a tag to the leaving of its message.",
};
/// 1 while the federate's process runs.
pub const FEDERATE_UP: Metric = Metric {
    name: "ictus_federate_up",
    kind: Kind::Gauge,
    unit: Unit::None,
    labels: &["federation", "federate"],
    help: "1 while the federate's process runs.",
};
/// 1 for the state that the federate is in.
pub const FEDERATE_STATE: Metric = Metric {
    name: "ictus_federate_state",
    kind: Kind::Gauge,
    unit: Unit::None,
    labels: &["federation", "federate", "state"],
    help: "1 for the state that the federate is in.",
};
/// Ends of the federate's process.
pub const FEDERATE_EXITS: Metric = Metric {
    name: "ictus_federate_exits_total",
    kind: Kind::Counter,
    unit: Unit::None,
    labels: &["federation", "federate", "reason"],
    help: "Ends of the federate's process.",
};
/// Starts of the federate's process after the first.
pub const FEDERATE_RESTARTS: Metric = Metric {
    name: "ictus_federate_restarts_total",
    kind: Kind::Counter,
    unit: Unit::None,
    labels: &["federation", "federate"],
    help: "Starts of the federate's process after the first.",
};
/// 1 while the RTI's process runs.
pub const RTI_UP: Metric = Metric {
    name: "ictus_rti_up",
    kind: Kind::Gauge,
    unit: Unit::None,
    labels: &["federation"],
    help: "1 while the RTI's process runs.",
};
/// Federates in a state.
pub const RTI_FEDERATES: Metric = Metric {
    name: "ictus_rti_federates",
    kind: Kind::Gauge,
    unit: Unit::None,
    labels: &["federation", "state"],
    help: "Federates in a state.",
};
/// 1, with the daemon's version.
pub const DAEMON_BUILD_INFO: Metric = Metric {
    name: "ictus_daemon_build_info",
    kind: Kind::Gauge,
    unit: Unit::None,
    labels: &["version"],
    help: "1, with the daemon's version.",
};

/// All of them.
pub const ALL: [Metric; 33] = [
    CLOCK_OFFSET,
    CLOCK_ERROR_BOUND,
    CLOCK_ERROR_LIMIT,
    CLOCK_SYNCHRONIZED,
    CLOCK_FREQUENCY_ERROR,
    CLOCK_STEPS,
    CLOCK_PROBES,
    STP_VIOLATIONS,
    STP_VIOLATION_LATENESS,
    STP_SLACK,
    STP_OFFSET,
    STP_OFFSET_REQUIRED,
    DEADLINE_MISSES,
    DEADLINE_LATENESS,
    WATCHDOGS_FIRED,
    TAG_LAG,
    FALLING_BEHIND,
    FELL_BEHIND,
    TAGS_COMPLETED,
    REACTIONS_EXECUTED,
    GRANT_WAIT,
    MESSAGES_SENT,
    MESSAGES_RECEIVED,
    MESSAGE_BYTES,
    MESSAGE_LATENCY,
    LAUNCH_LAG,
    FEDERATE_UP,
    FEDERATE_STATE,
    FEDERATE_EXITS,
    FEDERATE_RESTARTS,
    RTI_UP,
    RTI_FEDERATES,
    DAEMON_BUILD_INFO,
];
