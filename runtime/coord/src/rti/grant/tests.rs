use super::*;
use ictus_core::{Duration, LogicalTime};
use proptest::collection::vec;
use proptest::prelude::*;

type Edge = (u16, u16, Delay);

/// A federation of at most five federates in some state.
#[derive(Clone, Debug)]
struct Case {
    edges: Vec<Edge>,
    standings: Vec<Standing>,
}

const START: Tag = Tag::at(100);

fn tag() -> impl Strategy<Value = Tag> {
    prop_oneof![
        1 => Just(Tag::NEVER),
        1 => Just(Tag::FOREVER),
        6 => (100i64..112, 0u32..3).prop_map(|(t, m)| Tag::new(LogicalTime::from_nanos(t), m)),
    ]
}

fn standing() -> impl Strategy<Value = Standing> {
    (tag(), tag(), tag(), tag(), 0..16u8).prop_map(|(a, b, granted, provisional, kind)| {
        let presence = match kind % 8 {
            0 => Presence::Resigned,
            1 => Presence::Lost,
            _ => Presence::Present,
        };
        let next_event = if presence == Presence::Resigned {
            Tag::FOREVER
        } else {
            a.max(b)
        };
        Standing {
            presence,
            completed: a.min(b),
            next_event,
            granted,
            provisional,
            runs_ahead: kind >= 8,
        }
    })
}

fn delay() -> impl Strategy<Value = Delay> {
    (-1i64..4).prop_map(|nanos| Delay::after(Duration::from_nanos(nanos)))
}

fn case() -> impl Strategy<Value = Case> {
    (2u16..6).prop_flat_map(|federates| {
        let edge = (0..federates, 0..federates, delay());
        (vec(edge, 1..9), vec(standing(), usize::from(federates)))
            .prop_map(|(edges, standings)| Case { edges, standings })
    })
}

impl Case {
    fn topology(&self) -> Topology {
        let id = FederateId::new;
        Topology::new(
            self.standings.len(),
            self.edges.iter().map(|&(a, b, d)| (id(a), id(b), d)),
        )
    }

    fn view<'a>(&'a self, topology: &'a Topology) -> View<'a> {
        let (lost, mutants) = (LostRule::Limits, Mutants::NONE);
        View {
            topology,
            start: START,
            standings: &self.standings,
            lost,
            mutants,
        }
    }

    /// What `federate` may still send at the earliest.
    fn next(&self, federate: u16) -> Tag {
        match self.standings[usize::from(federate)].next_event {
            Tag::NEVER => START,
            tag => tag,
        }
    }

    /// The earliest arrival at `to` over all paths of at most `left` connections, by trying every one.
    fn earliest(&self, to: u16, left: usize) -> Tag {
        let arrivals = self
            .edges
            .iter()
            .filter(|edge| edge.1 == to)
            .map(|&(from, _, delay)| {
                let further = if left > 1 {
                    self.earliest(from, left - 1)
                } else {
                    Tag::FOREVER
                };
                self.next(from).min(further).delayed(delay)
            });
        arrivals.min().unwrap_or(Tag::FOREVER)
    }

    fn zero_delay_path(&self, from: u16, to: u16, left: usize) -> bool {
        self.edges.iter().any(|&(a, b, delay)| {
            a == from
                && delay == Delay::None
                && (b == to || left > 1 && self.zero_delay_path(b, to, left - 1))
        })
    }

    /// As [`Case::earliest`], not counting what the zero-delay cycle of `to` itself may send.
    fn earliest_from_outside(&self, to: u16) -> Tag {
        let n = self.standings.len();
        let outside = self.edges.iter().filter(|&&(from, b, _)| {
            b == to && !(self.zero_delay_path(from, to, n) && self.zero_delay_path(to, from, n))
        });
        outside
            .map(|&(from, _, delay)| self.next(from).min(self.earliest(from, n)).delayed(delay))
            .min()
            .unwrap_or(Tag::FOREVER)
    }

    /// Up to which tag nothing more can come over the immediate connections, as LTCs say.
    fn settled(&self, to: u16) -> Tag {
        let counts = |from: u16| self.standings[usize::from(from)].presence != Presence::Resigned;
        self.edges
            .iter()
            .filter(|&&(from, b, _)| b == to && counts(from))
            .map(|&(from, _, d)| {
                self.standings[usize::from(from)]
                    .completed
                    .delayed_strict(d)
            })
            .min()
            .unwrap_or(Tag::FOREVER)
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    #[test]
    fn earliest_incoming_is_the_least_over_all_paths(case in case()) {
        let topology = case.topology();
        let view = case.view(&topology);
        for id in 0..u16::try_from(case.standings.len()).unwrap() {
            let federate = FederateId::new(id);
            prop_assert_eq!(view.earliest_incoming(federate), case.earliest(id, 6));
            prop_assert_eq!(
                view.earliest_incoming_strict(federate),
                case.earliest_from_outside(id)
            );
        }
    }

    #[test]
    fn grants_are_safe(case in case()) {
        let topology = case.topology();
        let view = case.view(&topology);
        for id in 0..u16::try_from(case.standings.len()).unwrap() {
            match tag_advance_grant(&view, FederateId::new(id)) {
                None => {}
                Some(Grant::Full(tag)) => {
                    let announced = case.earliest(id, 6) > tag || tag == Tag::FOREVER;
                    prop_assert!(announced || case.settled(id) >= tag, "{id}: {tag}");
                }
                Some(Grant::Provisional(tag)) => {
                    prop_assert!(case.earliest(id, 6) >= tag);
                    prop_assert!(case.earliest_from_outside(id) > tag);
                    prop_assert!(case.zero_delay_path(id, id, 5));
                }
            }
        }
    }

    #[test]
    fn grants_are_as_large_as_they_can_be(case in case()) {
        let topology = case.topology();
        let view = case.view(&topology);
        for id in 0..u16::try_from(case.standings.len()).unwrap() {
            let federate = FederateId::new(id);
            let standing = &case.standings[federate.index()];
            let earliest = case.earliest(id, 6);
            let next = standing.next_event;
            let due = next > Tag::NEVER && earliest > next && !topology.upstream(federate).is_empty();
            let largest = Grant::Full(earliest.latest_earlier());
            if due && standing.admits(largest) {
                let Some(Grant::Full(tag)) = tag_advance_grant(&view, federate) else {
                    return Err(TestCaseError::fail(format!("{id} may have {largest:?}")));
                };
                prop_assert!(Grant::Full(tag) == largest || tag == case.settled(id));
            }
        }
    }

    #[test]
    fn raising_a_promise_never_lowers_a_grant(case in case(), who in 0usize..5, to in tag()) {
        let who = who % case.standings.len();
        let topology = case.topology();
        let mut raised = case.clone();
        let standing = &mut raised.standings[who];
        standing.next_event = to.max(standing.next_event).max(START);
        for id in 0..u16::try_from(case.standings.len()).unwrap() {
            let federate = FederateId::new(id);
            if federate.index() == who {
                continue;
            }
            let before = tag_advance_grant(&case.view(&topology), federate);
            let after = tag_advance_grant(&raised.view(&topology), federate);
            // A PTAG says as much of the tags before it as a TAG.
            let full = |grant| match grant {
                Some(Grant::Full(tag)) => tag,
                Some(Grant::Provisional(tag)) => tag.latest_earlier(),
                None => Tag::NEVER,
            };
            prop_assert!(full(before) <= full(after));
        }
    }
}
