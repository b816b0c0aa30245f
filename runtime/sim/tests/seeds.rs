//! A few dozen seeds, and every seed that once failed, by name.
#![allow(clippy::unwrap_used, missing_docs, reason = "a test")]

use ictus_coord::mutants::Mutants;
use ictus_sim::coverage::Coverage;
use ictus_sim::scenario::check_seed;

fn check(seeds: impl IntoIterator<Item = u64>) -> Coverage {
    let mut coverage = Coverage::default();
    for seed in seeds {
        let verdict = check_seed(seed, Mutants::NONE);
        let wrong = verdict.violation.map(|violation| violation.to_string());
        assert_eq!(wrong, None, "reproduce: cargo sim --seed {seed:#x}");
        coverage.merge(&verdict.coverage);
    }
    coverage
}

#[test]
fn some_seeds_hold() {
    let _coverage = check(1..=40);
}

#[test]
fn equal_seeds_give_equal_runs() {
    for seed in [3, 17, 29, 31, 44] {
        let (first, second) = (
            check_seed(seed, Mutants::NONE),
            check_seed(seed, Mutants::NONE),
        );
        assert_eq!(first.hash, second.hash, "seed {seed:#x}");
    }
}

#[cfg(feature = "mutants")]
#[test]
fn every_mutant_is_caught() {
    use ictus_coord::mutants::Mutant;
    for mutant in Mutant::ALL {
        let caught = (1..=300).any(|seed| {
            let verdict = std::panic::catch_unwind(|| check_seed(seed, Mutants::only(*mutant)));
            verdict.map_or(true, |verdict| verdict.violation.is_some())
        });
        assert!(caught, "{mutant:?} lives");
    }
}
