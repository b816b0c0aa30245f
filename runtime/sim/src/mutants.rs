//! Every mutant, against the seeds until one catches it.

use super::{Options, check, clock_seeds};
use ictus_coord::mutants::{Mutant, Mutants};
use ictus_sim::scenario::Kind;
use std::io::{self, Write};
use std::sync::atomic::{AtomicU64, Ordering};

/// Seeds tried when none are asked for.
const SEEDS: u64 = 2_000;

pub(super) fn run(options: &Options, out: &mut impl Write) -> io::Result<bool> {
    let seeds = if options.seeds == 0 {
        SEEDS
    } else {
        options.seeds
    };
    let all: Vec<Mutant> = [Mutant::ALL, Mutant::CLOCK].concat();
    let quiet = std::panic::take_hook();
    std::panic::set_hook(Box::new(|_| {}));
    let next = AtomicU64::new(0);
    let work = || {
        let mut rows = Vec::new();
        loop {
            let index = usize::try_from(next.fetch_add(1, Ordering::Relaxed)).unwrap_or(0);
            let Some(mutant) = all.get(index) else {
                return rows;
            };
            rows.push((index, hunt(*mutant, seeds)));
        }
    };
    let mut rows: Vec<_> = std::thread::scope(|scope| {
        let hunters: Vec<_> = (0..super::THREADS).map(|_| scope.spawn(work)).collect();
        let joined = hunters.into_iter().map(|hunter| hunter.join());
        joined
            .flat_map(|rows| rows.expect("hunters do not panic"))
            .collect()
    });
    std::panic::set_hook(quiet);
    rows.sort_unstable_by_key(|row| row.0);
    writeln!(
        out,
        "{:<26} {:>9} {:>6}  caught by",
        "mutant", "seed", "tried"
    )?;
    let mut caught = 0;
    for (index, row) in &rows {
        let mutant = all[*index];
        match row {
            Some((seed, words)) => {
                caught += 1;
                let name = format!("{mutant:?}");
                writeln!(out, "{name:<26} {seed:>#9x} {seed:>6}  {words}")?;
            }
            None => writeln!(
                out,
                "{:<26} {:>9} {seeds:>6}  -",
                format!("{mutant:?}"),
                "-"
            )?,
        }
    }
    writeln!(out, "{caught} of {} mutants caught", rows.len())?;
    Ok(caught == rows.len())
}

fn hunt(mutant: Mutant, seeds: u64) -> Option<(u64, String)> {
    if Mutant::CLOCK.contains(&mutant) {
        return clock_seeds::hunt(mutant, seeds);
    }
    (1..=seeds).find_map(|seed| {
        let kind = if mutant.is_of_time() {
            Kind::Decentralized
        } else {
            Kind::Centralized
        };
        let (_, violation) = check(seed, kind, Mutants::only(mutant), false);
        violation.map(|violation| {
            let words: String = violation.to_string().chars().take(110).collect();
            (seed, words)
        })
    })
}
