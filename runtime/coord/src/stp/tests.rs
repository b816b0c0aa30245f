//! Hand-checked systems and the solver's laws.

use proptest::prelude::*;

use super::*;
use crate::plan::Endpoint;

const US: i64 = 1_000;
const MS: i64 = 1_000_000;

/// A link with L, N, E and α in microseconds.
fn link(from: u16, to: u16, [l, n, e, after]: [i64; 4]) -> Link {
    Link {
        from: FederateId::new(from),
        to: FederateId::new(to),
        bounds: Some(Bounds {
            launch_lag_ns: l * US,
            latency_ns: n * US,
            clock_error_ns: e * US,
        }),
        after_ns: after * US,
        absent_after_ns: 0,
        declared_ns: None,
    }
}

fn offsets(links: &[Link], federates: usize) -> Vec<i64> {
    let solution = solve(links, &vec![None; federates]).unwrap();
    solution
        .federates
        .iter()
        .map(|one| one.used_ns / US)
        .collect()
}

/// lidar -> planner -> brake: 0; 0.2 + 0.6 + 0.1 = 0.9; 0.9 + 2 + 3 + 0.5 = 6.4.
#[test]
fn a_chain() {
    let links = [
        link(0, 1, [200, 600, 100, 0]),
        link(1, 2, [2000, 3000, 500, 0]),
    ];
    assert_eq!(offsets(&links, 3), [0, 900, 6400]);
    let solution = solve(&links, &[None; 3]).unwrap();
    assert_eq!(solution.federates[0].by, None);
    assert_eq!(solution.federates[2].by, Some(1));
    assert_eq!(solution.links[1].required_ns, Some(6400 * US));
}

/// a -> b -> d and a -> c -> d: b = 1 + 1 = 2, c = 1 + 4 - 3 = 2, so d takes the greater of 2 + 1 + 1 by b and
/// 2 + 5 + 1 - 6 by c.
#[test]
fn a_diamond() {
    let links = [
        link(0, 1, [1000, 1000, 0, 0]),
        link(0, 2, [1000, 4000, 0, 3000]),
        link(1, 3, [1000, 1000, 0, 0]),
        link(2, 3, [5000, 1000, 0, 6000]),
    ];
    assert_eq!(offsets(&links, 4), [0, 2000, 2000, 4000]);
    let solution = solve(&links, &[None; 4]).unwrap();
    assert_eq!(solution.federates[3].by, Some(2));
    assert_eq!(
        solution.links[3],
        LinkOffset {
            required_ns: Some(2000 * US),
            used_ns: 2000 * US
        }
    );
}

/// An `after` longer than everything else needs no offset; the requirement below 0 is told all the same.
#[test]
fn a_long_delay_needs_no_offset() {
    let links = [link(0, 1, [1000, 2000, 0, 10_000])];
    let solution = solve(&links, &[None; 2]).unwrap();
    assert_eq!(solution.federates[1].used_ns, 0);
    assert_eq!(
        solution.links[0],
        LinkOffset {
            required_ns: Some(-7 * MS),
            used_ns: 0
        }
    );
}

/// The terms of the cycle cancel: what enters it goes around once and no further.
#[test]
fn a_cycle_of_weight_zero() {
    let links = [
        link(0, 1, [1000, 0, 0, 0]),
        link(1, 2, [1000, 1000, 0, 0]),
        link(2, 1, [500, 500, 1000, 4000]),
    ];
    assert_eq!(offsets(&links, 3), [0, 1000, 3000]);
}

#[test]
fn a_positive_cycle_is_refused_and_named() {
    let links = [
        link(0, 2, [100, 100, 0, 0]),
        link(2, 1, [1000, 500, 100, 0]),
        link(1, 2, [1000, 500, 100, 0]),
    ];
    let names = ["lidar", "planner", "brake"].map(str::to_owned);
    let Err(SolveError::Cycle(cycle)) = solve(&links, &[None; 3]) else {
        panic!("the cycle was accepted");
    };
    assert_eq!(
        cycle.describe(&|id| names[id.index()].clone()),
        "planner -> brake -> planner grows by 3.2 ms each round: L 2 ms + N 1 ms + E 0.2 ms - after 0"
    );
    assert_eq!(cycle.links, [2, 1]);
    // Declared offsets hide it from nobody: a round still takes longer than it may.
    assert!(matches!(
        solve(&links, &[None, Some(MS), Some(MS)]),
        Err(SolveError::Cycle(_))
    ));
}

/// One nanosecond decides.
#[test]
fn the_least_positive_cycle_is_refused() {
    let mut links = [link(0, 1, [1000, 0, 0, 0]), link(1, 0, [0, 0, 0, 1000])];
    assert_eq!(offsets(&links, 2), [0, 1000]);
    links[1].after_ns -= 1;
    assert!(matches!(
        solve(&links, &[None; 2]),
        Err(SolveError::Cycle(_))
    ));
}

/// What a federate declares, its receivers reckon with, be it more or less than is required.
#[test]
fn declared_offsets_replace_solved_ones() {
    let links = [link(0, 1, [1000, 0, 0, 0]), link(1, 2, [1000, 0, 0, 0])];
    for (declared, expected) in [(5000, 6000), (0, 1000)] {
        let solution = solve(&links, &[None, Some(declared * US), None]).unwrap();
        assert_eq!(solution.federates[1].required_ns, Some(MS));
        assert_eq!(solution.federates[1].used_ns, declared * US);
        assert_eq!(solution.federates[2].used_ns, expected * US);
    }
    // One that waits for nobody has nothing to decide, whatever it declares.
    let solution = solve(&links, &[Some(9 * MS), None, None]).unwrap();
    assert_eq!(
        (
            solution.federates[0].decided_ns,
            solution.federates[1].used_ns
        ),
        (0, MS)
    );
}

/// A link's own offset replaces its receiver's, and its `absent_after` delays what the receiver sends.
#[test]
fn links_have_offsets_of_their_own() {
    let mut links = [link(0, 1, [1000, 0, 0, 0]), link(1, 2, [1000, 0, 0, 0])];
    links[0].declared_ns = Some(3 * MS);
    links[0].absent_after_ns = 2 * MS;
    let solution = solve(&links, &[None; 3]).unwrap();
    assert_eq!(solution.links[0].used_ns, 3 * MS);
    assert_eq!(solution.federates[1].decided_ns, 5 * MS);
    assert_eq!(solution.federates[2].used_ns, 6 * MS);
}

#[test]
fn links_without_bounds_need_an_offset() {
    let mut links = [link(0, 1, [1000, 0, 0, 0])];
    links[0].bounds = None;
    assert_eq!(solve(&links, &[None; 2]), Err(SolveError::Unbounded(0)));
    let solution = solve(&links, &[None, Some(0)]).unwrap();
    assert_eq!(solution.federates[1].required_ns, None);
    links[0].to = FederateId::new(7);
    assert_eq!(
        solve(&links, &[None; 2]),
        Err(SolveError::UnknownFederate(0))
    );
}

#[test]
fn sums_beyond_the_range_are_errors() {
    let far = i64::MAX / US;
    let links = [link(0, 1, [far, far, 0, 0]), link(1, 2, [far, 0, 0, 0])];
    assert_eq!(
        solve(&links, &[None; 3]),
        Err(SolveError::TooLong(FederateId::new(1)))
    );
}

#[test]
fn physical_connections_and_those_inside_a_federate_take_no_part() {
    let wire = |from, to, physical| ConnectionPlan {
        from: Endpoint {
            federate: from,
            ..Endpoint::default()
        },
        to: Endpoint {
            federate: to,
            ..Endpoint::default()
        },
        physical,
        ..ConnectionPlan::default()
    };
    assert_eq!(Link::of(&wire(0, 0, false)), None);
    assert_eq!(Link::of(&wire(0, 1, true)), None);
    assert_eq!(Link::of(&wire(0, 1, false)).unwrap().to, FederateId::new(1));
}

#[test]
fn milliseconds_are_exact() {
    let shown = [0, 2 * MS, 200 * US, -1, 1_500 * MS, i64::MIN].map(milliseconds);
    assert_eq!(
        shown,
        [
            "0",
            "2",
            "0.2",
            "-0.000001",
            "1500",
            "-9223372036854.775808"
        ]
    );
}

/// Links among `count` federates; half of the systems have no cycle, the others may have positive ones.
fn systems() -> impl Strategy<Value = (usize, Vec<Link>)> {
    (1_u16..7, any::<bool>()).prop_flat_map(|(count, forward)| {
        let one = (
            0..count,
            0..count,
            [0_i64..9, 0_i64..9, 0_i64..9, 0_i64..30],
        );
        prop::collection::vec(one, 0..12).prop_map(move |all| {
            let kept = all
                .into_iter()
                .filter(|(from, to, _)| from != to && (!forward || from < to));
            (
                usize::from(count),
                kept.map(|(from, to, terms)| link(from, to, terms))
                    .collect(),
            )
        })
    })
}

/// Whether some simple cycle is positive, by trying all of them.
fn brute_positive(links: &[Link], count: usize) -> bool {
    fn walk(links: &[Link], start: usize, at: usize, seen: &mut Vec<bool>, sum: i128) -> bool {
        links
            .iter()
            .filter(|one| one.from.index() == at)
            .any(|one| {
                let (to, sum) = (one.to.index(), sum + weight(one).unwrap());
                if to == start {
                    return sum > 0;
                }
                if seen[to] {
                    return false;
                }
                seen[to] = true;
                let found = walk(links, start, to, seen, sum);
                seen[to] = false;
                found
            })
    }
    (0..count).any(|start| {
        let mut seen = vec![false; count];
        seen[start] = true;
        walk(links, start, start, &mut seen, 0)
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    /// A system is refused exactly when a cycle is positive, and the cycle named is one.
    #[test]
    fn positive_cycles_are_refused_and_only_they((count, links) in systems()) {
        match solve(&links, &vec![None; count]) {
            Ok(_) => prop_assert!(!brute_positive(&links, count)),
            Err(SolveError::Cycle(cycle)) => {
                prop_assert!(brute_positive(&links, count));
                let sum: i128 = cycle.links.iter().map(|index| weight(&links[*index]).unwrap()).sum();
                prop_assert!(sum > 0);
                prop_assert_eq!(sum, i128::from(cycle.growth_ns()));
                let next = cycle.links.iter().cycle().skip(1);
                for (one, next) in cycle.links.iter().zip(next) {
                    prop_assert_eq!(links[*one].to, links[*next].from);
                }
            }
            Err(other) => prop_assert!(false, "{}", other),
        }
    }

    /// Every inequality holds, and every offset is 0 or tight along a path that begins at an offset of 0.
    #[test]
    fn the_solution_suffices_and_is_least((count, links) in systems()) {
        let Ok(solution) = solve(&links, &vec![None; count]) else { return Ok(()); };
        let s: Vec<i64> = solution.federates.iter().map(|one| one.used_ns).collect();
        let sum = |one: &Link| s[one.from.index()] + i64::try_from(weight(one).unwrap()).unwrap();
        for (one, offset) in links.iter().zip(&solution.links) {
            prop_assert!(s[one.to.index()] >= sum(one));
            prop_assert_eq!(offset.required_ns, Some(sum(one)));
            prop_assert_eq!(offset.used_ns, sum(one).max(0));
        }
        let mut grounded: Vec<bool> = s.iter().map(|offset| *offset == 0).collect();
        for _ in 0..count {
            for one in &links {
                let tight = grounded[one.from.index()] && s[one.to.index()] == sum(one);
                grounded[one.to.index()] |= tight;
            }
        }
        prop_assert!(grounded.iter().all(|it| *it), "{s:?}");
        for (offset, federate) in solution.federates.iter().zip(&s) {
            let by = offset.by.map(|index| solution.links[index].used_ns);
            prop_assert_eq!(by.unwrap_or(0), *federate);
        }
    }

    /// No offset falls when a bound grows; what only a larger bound refuses was accepted before.
    #[test]
    fn offsets_are_monotone_in_every_bound((count, links) in systems(), at in any::<u8>(), more in [0_i64..5, 0_i64..5, 0_i64..5]) {
        prop_assume!(!links.is_empty());
        let mut larger = links.clone();
        let index = usize::from(at) % links.len();
        let bounds = larger[index].bounds.as_mut().unwrap();
        bounds.launch_lag_ns += more[0];
        bounds.latency_ns += more[1];
        bounds.clock_error_ns += more[2];
        let free = vec![None; count];
        match (solve(&links, &free), solve(&larger, &free)) {
            (Ok(one), Ok(other)) => {
                for (one, other) in one.federates.iter().zip(&other.federates) {
                    prop_assert!(one.used_ns <= other.used_ns);
                }
            }
            (one, other) => prop_assert!(other.is_err(), "{:?}", one),
        }
    }

    /// Declared offsets and gaps in the bounds never hang the solver, and what is used is what was declared.
    #[test]
    fn declared_offsets_are_used(
        (count, mut links) in systems(),
        declared in prop::collection::vec(prop::option::of(0_i64..20_000), 7),
        own in prop::collection::vec((prop::option::of(0_i64..20_000), 0_i64..3, any::<bool>()), 12),
    ) {
        for (link, (declared, absent, bounded)) in links.iter_mut().zip(own) {
            link.declared_ns = declared;
            link.absent_after_ns = absent;
            link.bounds = link.bounds.filter(|_| bounded);
        }
        if let Ok(solution) = solve(&links, &declared[..count]) {
            for (link, offset) in links.iter().zip(&solution.links) {
                let given = link.declared_ns.or(declared[link.to.index()]);
                prop_assert!(given.is_none_or(|given| given == offset.used_ns));
                let until = offset.used_ns + link.absent_after_ns;
                prop_assert!(solution.federates[link.to.index()].decided_ns >= until);
            }
        }
    }
}
