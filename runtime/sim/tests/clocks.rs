//! Clock synchronization: some seeds, and every mutant.
#![allow(clippy::unwrap_used, missing_docs, reason = "a test")]

use ictus_coord::mutants::Mutants;
use ictus_sim::clocks::{check_seed, check_symmetric};

#[test]
fn some_clock_seeds_hold() {
    // 0x83: the second step undoes the first.
    for seed in (1..=30).chain([0x83]) {
        for check in [check_seed, check_symmetric] {
            let wrong = check(seed, Mutants::NONE).violation;
            let wrong = wrong.map(|violation| violation.to_string());
            assert_eq!(wrong, None, "reproduce: cargo sim --clock {seed:#x}");
        }
    }
}

#[test]
fn steps_are_noticed_and_counted() {
    let seeds = (1..=30).map(|seed| check_seed(seed, Mutants::NONE));
    let (made, noticed) = seeds.fold((0, 0), |(made, noticed), verdict| {
        (made + verdict.made, noticed + verdict.steps)
    });
    assert!(made > 5 && noticed >= made, "{noticed} of {made}");
}

#[cfg(feature = "mutants")]
#[test]
fn every_clock_mutant_is_caught() {
    use ictus_coord::mutants::Mutant;
    for mutant in Mutant::CLOCK {
        let mutants = Mutants::only(*mutant);
        let caught = (1..=200).any(|seed| {
            check_seed(seed, mutants).violation.is_some()
                || check_symmetric(seed, mutants).violation.is_some()
        });
        assert!(caught, "{mutant:?} lives");
    }
}
