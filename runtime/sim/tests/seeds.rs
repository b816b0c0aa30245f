//! A few dozen seeds, and every seed that once failed, by name.
#![allow(clippy::unwrap_used, missing_docs, reason = "a test")]

use ictus_coord::mutants::Mutants;
use ictus_sim::coverage::Coverage;
use ictus_sim::scenario::{Kind, check_seed};

fn check(seeds: impl IntoIterator<Item = u64>, kind: Kind) -> Coverage {
    let mut coverage = Coverage::default();
    for seed in seeds {
        let verdict = check_seed(seed, kind, Mutants::NONE);
        let wrong = verdict.violation.map(|violation| violation.to_string());
        assert_eq!(wrong, None, "reproduce: cargo sim --seed {seed:#x}");
        coverage.merge(&verdict.coverage);
    }
    coverage
}

#[test]
fn some_seeds_hold() {
    let _coverage = check(1..=40, Kind::Centralized);
}

#[test]
fn some_decentralized_seeds_hold() {
    let _coverage = check(1..=40, Kind::Decentralized);
}

#[test]
fn equal_seeds_give_equal_runs() {
    for seed in [3, 17, 29, 31, 44] {
        for kind in [Kind::Centralized, Kind::Decentralized] {
            let run = || check_seed(seed, kind, Mutants::NONE).hash;
            assert_eq!(run(), run(), "seed {seed:#x}, {kind:?}");
        }
    }
}

#[cfg(feature = "mutants")]
#[test]
fn every_mutant_is_caught() {
    use ictus_coord::mutants::Mutant;
    for mutant in Mutant::ALL {
        let kind = if mutant.is_of_time() {
            Kind::Decentralized
        } else {
            Kind::Centralized
        };
        let caught = (1..=300).any(|seed| {
            let run = || check_seed(seed, kind, Mutants::only(*mutant));
            let verdict = std::panic::catch_unwind(run);
            verdict.map_or(true, |verdict| verdict.violation.is_some())
        });
        assert!(caught, "{mutant:?} lives");
    }
}
