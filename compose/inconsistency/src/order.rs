//! In which order the four messages of a sequence are handled.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Messages of a sequence.
pub(crate) const STEPS: usize = 4;
/// Orders in which they can come.
const ORDERS: usize = 24;
/// Sequences that may be open at once: an older one has lost a message.
const OPEN_MAX: usize = 1 << 12;

/// A message of a sequence; they are sent in this order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Step {
    /// State report: drive.
    Drive,
    /// Kinematic state: forward.
    Forward,
    /// State report: reverse.
    Reverse,
    /// Kinematic state: backward.
    Backward,
}

impl Step {
    /// All steps as they are sent.
    pub(crate) const ALL: [Self; STEPS] =
        [Self::Drive, Self::Forward, Self::Reverse, Self::Backward];

    /// The step of a number from 0 to 3.
    pub(crate) fn from_number(number: u8) -> Option<Self> {
        Self::ALL.get(usize::from(number)).copied()
    }

    /// Its place in the sequence, from 0 to 3.
    pub(crate) const fn number(self) -> u8 {
        match self {
            Self::Drive => 0,
            Self::Forward => 1,
            Self::Reverse => 2,
            Self::Backward => 3,
        }
    }

    /// Whether it is a state report, and not a kinematic state.
    pub(crate) const fn is_report(self) -> bool {
        matches!(self, Self::Drive | Self::Reverse)
    }

    const fn label(self) -> &'static str {
        match self {
            Self::Drive => "drive",
            Self::Forward => "+v",
            Self::Reverse => "reverse",
            Self::Backward => "-v",
        }
    }
}

/// One of the 24 orders, by its rank in the dictionary of permutations: 0 is the right one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Order(u8);

impl Order {
    /// The order in which the messages were sent.
    pub(crate) const RIGHT: Self = Self(0);

    /// The order of four different steps.
    ///
    /// Source: the Lehmer code: how many later elements are smaller, in factorial base.
    pub(crate) fn of(steps: [Step; STEPS]) -> Self {
        let smaller = |at: usize| (at + 1..STEPS).filter(move |&later| steps[later] < steps[at]);
        let rank = (0..STEPS).fold(0, |rank, at| rank * (STEPS - at) + smaller(at).count());
        Self(u8::try_from(rank).unwrap_or(u8::MAX))
    }

    /// The rank, from 0 to 23.
    pub(crate) const fn rank(self) -> u8 {
        self.0
    }

    /// The steps in this order.
    fn steps(self) -> [Step; STEPS] {
        let mut left = Step::ALL.to_vec();
        let mut rank = usize::from(self.0);
        let mut group = ORDERS;
        Step::ALL.map(|_| {
            group /= left.len();
            let step = left.remove((rank / group).min(left.len() - 1));
            rank %= group;
            step
        })
    }
}

/// What a planner counted: one line of JSON at its end.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Tally {
    /// Sequences of which all four messages came.
    pub(crate) sequences: u64,
    /// Those that came in a wrong order.
    pub(crate) errors: u64,
    /// Those in a wrong order without a tardy message: nobody was told.
    pub(crate) silent: u64,
    /// Tardy messages: STP violations.
    pub(crate) violations: u64,
    /// Sequences of which a message is missing.
    pub(crate) incomplete: u64,
    /// Complete sequences by order, such as `drive +v reverse -v`; those that never came are left out.
    pub(crate) orders: BTreeMap<String, u64>,
}

/// A sequence that has not come completely.
#[derive(Debug, Default)]
struct Open {
    came: Vec<Step>,
    tardy: bool,
}

/// Counts in which order the messages of each sequence come.
#[derive(Debug, Default)]
pub(crate) struct Orders {
    open: BTreeMap<u32, Open>,
    counts: [u64; ORDERS],
    silent: u64,
    violations: u64,
    lost: u64,
}

impl Orders {
    /// Notes a message; when it is the fourth of its sequence, the order in which they came, and whether one was tardy.
    /// A message that comes twice counts once.
    pub(crate) fn note(&mut self, sequence: u32, step: Step, tardy: bool) -> Option<(Order, bool)> {
        self.violations += u64::from(tardy);
        let open = self.open.entry(sequence).or_default();
        open.tardy |= tardy;
        if !open.came.contains(&step) {
            open.came.push(step);
        }
        let steps: Result<[Step; STEPS], _> = open.came.as_slice().try_into();
        let Ok(steps) = steps else {
            self.forget();
            return None;
        };
        let (order, tardy) = (Order::of(steps), open.tardy);
        self.open.remove(&sequence);
        self.counts[usize::from(order.rank())] += 1;
        self.silent += u64::from(order != Order::RIGHT && !tardy);
        Some((order, tardy))
    }

    fn forget(&mut self) {
        if self.open.len() > OPEN_MAX {
            self.open.pop_first();
            self.lost += 1;
        }
    }

    /// What was counted so far.
    pub(crate) fn tally(&self) -> Tally {
        let sequences = self.counts.iter().sum();
        let labelled = (0..).map(Order).zip(self.counts);
        let seen = labelled.filter(|(_, count)| *count > 0);
        Tally {
            sequences,
            errors: sequences - self.counts[usize::from(Order::RIGHT.rank())],
            silent: self.silent,
            violations: self.violations,
            incomplete: self.lost + u64::try_from(self.open.len()).unwrap_or(u64::MAX),
            orders: seen
                .map(|(order, count)| (order.steps().map(Step::label).join(" "), count))
                .collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use proptest::sample::subsequence;
    use std::collections::{BTreeSet, VecDeque};

    #[test]
    fn ranks_name_every_order_once() {
        let orders: Vec<_> = (0..24).map(|rank| Order(rank).steps()).collect();
        assert_eq!(orders[0], Step::ALL);
        assert_eq!(orders.iter().collect::<BTreeSet<_>>().len(), 24);
        assert!(orders.is_sorted(), "as in a dictionary");
        for (rank, steps) in (0..).zip(orders) {
            assert_eq!(Order::of(steps).rank(), rank);
        }
    }

    #[test]
    fn each_order_is_counted_under_its_name() {
        use Step::{Backward, Drive, Forward, Reverse};
        let mut orders = Orders::default();
        for step in Step::ALL {
            orders.note(7, step, false);
        }
        for step in [Forward, Drive, Reverse, Backward] {
            orders.note(8, step, step == Drive);
        }
        for step in [Drive, Reverse, Backward, Forward] {
            orders.note(9, step, false);
        }
        orders.note(10, Drive, false);
        let tally = orders.tally();
        assert_eq!((tally.sequences, tally.errors, tally.silent), (3, 2, 1));
        assert_eq!((tally.violations, tally.incomplete), (1, 1));
        let names: Vec<_> = tally.orders.keys().map(String::as_str).collect();
        let expected = [
            "+v drive reverse -v",
            "drive +v reverse -v",
            "drive reverse -v +v",
        ];
        assert_eq!(names, expected);
    }

    #[test]
    fn an_unending_loss_holds_a_bounded_number_of_sequences() {
        let mut orders = Orders::default();
        let many = u32::try_from(OPEN_MAX).unwrap() + 10;
        for sequence in 0..many {
            assert_eq!(orders.note(sequence, Step::Drive, false), None);
        }
        assert_eq!(orders.open.len(), OPEN_MAX);
        assert_eq!(orders.tally().incomplete, u64::from(many));
    }

    proptest! {
        /// Sequences may interleave and messages come twice: each sequence has the order of its own messages.
        #[test]
        fn sequences_are_told_apart(
            ranks in prop::collection::vec(0..24_u8, 1..8),
            mixed in prop::collection::vec(any::<prop::sample::Index>(), 64),
            twice in subsequence((0..32_usize).collect::<Vec<_>>(), 0..32),
        ) {
            let mut left: Vec<_> = ranks.iter().map(|rank| VecDeque::from(Order(*rank).steps())).collect();
            let mut orders = Orders::default();
            let mut found = BTreeMap::new();
            for (turn, pick) in mixed.iter().cycle().enumerate() {
                let waiting: Vec<_> = (0..left.len()).filter(|at| !left[*at].is_empty()).collect();
                let Some(&at) = waiting.get(pick.index(waiting.len().max(1))) else { break };
                let step = left[at].pop_front().unwrap();
                let sequence = u32::try_from(at).unwrap();
                if twice.contains(&turn) && !left[at].is_empty() {
                    prop_assert_eq!(orders.note(sequence, step, false), None);
                }
                if let Some((order, _)) = orders.note(sequence, step, false) {
                    prop_assert_eq!(found.insert(at, order.rank()), None);
                }
            }
            let expected: BTreeMap<_, _> = ranks.iter().copied().enumerate().collect();
            prop_assert_eq!(found, expected);
            let tally = orders.tally();
            prop_assert_eq!(tally.incomplete, 0);
            prop_assert_eq!(tally.sequences, u64::try_from(ranks.len()).unwrap());
            prop_assert_eq!(tally.errors, tally.silent, "none was tardy");
        }
    }
}
