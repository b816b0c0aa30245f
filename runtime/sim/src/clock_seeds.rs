//! `--clocks`: seeds of clock synchronization.

use ictus_coord::mutants::Mutants;
use ictus_sim::clocks::{Verdict, check_seed, check_symmetric};
use std::io::{self, Write};

/// What is asked for.
#[derive(Debug, Default)]
pub(super) struct Options {
    /// How many seeds.
    pub(super) seeds: u64,
    /// Single ones.
    pub(super) single: Vec<u64>,
}

pub(super) fn run(options: &Options, out: &mut impl Write) -> io::Result<bool> {
    let mut good = true;
    for seed in &options.single {
        for verdict in [check_seed, check_symmetric].map(|check| check(*seed, Mutants::NONE)) {
            writeln!(out, "clock seed {seed:#x}: {verdict:?}")?;
            good &= verdict.violation.is_none();
        }
    }
    if options.seeds == 0 {
        return Ok(good);
    }
    let (mut broken, mut symmetric, mut steps) = (0, Vec::new(), 0);
    for seed in 1..=options.seeds {
        let verdict = check_seed(seed, Mutants::NONE);
        steps += verdict.steps;
        broken += u64::from(report(seed, &verdict, out)?);
        let verdict = check_symmetric(seed, Mutants::NONE);
        broken += u64::from(report(seed, &verdict, out)?);
        symmetric.push((verdict.error_p50, verdict.error_p99));
    }
    symmetric.sort_unstable();
    let median = symmetric[symmetric.len() / 2].0;
    let worst = symmetric.last().map_or(0, |last| last.0);
    symmetric.sort_unstable_by_key(|errors| errors.1);
    let (p99, seeds) = (symmetric[symmetric.len() / 2].1, options.seeds);
    writeln!(
        out,
        "{seeds} clock seeds: {broken} broke a law, {steps} steps noticed\n\
         symmetric path, 100 us jitter: |error| after convergence, median over the seeds: p50 {median} ns, p99 {p99} ns; \
         worst seed's p50 {worst} ns"
    )?;
    Ok(good && broken == 0)
}

fn report(seed: u64, verdict: &Verdict, out: &mut impl Write) -> io::Result<bool> {
    let Some(violation) = &verdict.violation else {
        return Ok(false);
    };
    writeln!(out, "reproduce: cargo sim --clock {seed:#x}\n  {violation}")?;
    Ok(true)
}

/// The first seed that catches a mutant.
#[cfg(feature = "mutants")]
pub(super) fn hunt(mutant: ictus_coord::mutants::Mutant, seeds: u64) -> Option<(u64, String)> {
    (1..=seeds).find_map(|seed| {
        let mutants = Mutants::only(mutant);
        let verdict = check_seed(seed, mutants).violation;
        let violation = verdict.or_else(|| check_symmetric(seed, mutants).violation)?;
        let words = violation.to_string().chars().take(110).collect();
        Some((seed, words))
    })
}
