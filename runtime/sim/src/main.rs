//! `cargo sim --seeds N [--seed 0x51f3]... [--decentralized] [--dump] [--clocks N] [--clock 0x51f3]... [--mutants]`: checks
//! seeds, prints what they showed.

use std::io::{self, Write};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::process::ExitCode;
use std::sync::atomic::{AtomicU64, Ordering};

use ictus_coord::mutants::Mutants;
use ictus_sim::coverage::Coverage;
use ictus_sim::observer::Violation;
use ictus_sim::scenario::{Kind, Verdict, check_seed_logged, describe};

mod clock_seeds;

/// Threads that check seeds.
const THREADS: u64 = 2;

/// One seed in so many is checked twice.
const TWICE: u64 = 50;

struct Options {
    seeds: u64,
    first: u64,
    single: Vec<u64>,
    clocks: clock_seeds::Options,
    mutants: bool,
    dump: bool,
    kind: Kind,
}

fn main() -> ExitCode {
    let mut out = io::stdout();
    match parse(std::env::args().skip(1)) {
        Ok(options) => match run(&options, &mut out) {
            Ok(true) => ExitCode::SUCCESS,
            Ok(false) | Err(_) => ExitCode::FAILURE,
        },
        Err(words) => {
            let usage = "cargo sim [--seeds N] [--from N] [--seed 0xN]... [--decentralized] [--dump] \
                [--clocks N] [--clock 0xN]... [--mutants]";
            drop(writeln!(io::stderr(), "{words}\nusage: {usage}"));
            ExitCode::from(2)
        }
    }
}

fn parse(arguments: impl Iterator<Item = String>) -> Result<Options, String> {
    let mut options = Options {
        seeds: 0,
        first: 1,
        single: Vec::new(),
        clocks: clock_seeds::Options::default(),
        mutants: false,
        dump: false,
        kind: Kind::Centralized,
    };
    let mut arguments = arguments.peekable();
    while let Some(argument) = arguments.next() {
        let mut number = || {
            let word = arguments.next().unwrap_or_default();
            let parsed = match word.strip_prefix("0x") {
                Some(digits) => u64::from_str_radix(digits, 16),
                None => word.parse(),
            };
            parsed.map_err(|e| format!("{argument} {word}: {e}"))
        };
        match argument.as_str() {
            "--seeds" => options.seeds = number()?,
            "--from" => options.first = number()?,
            "--seed" => options.single.push(number()?),
            "--clocks" => options.clocks.seeds = number()?,
            "--clock" => options.clocks.single.push(number()?),
            "--mutants" => options.mutants = true,
            "--dump" => options.dump = true,
            "--decentralized" => options.kind = Kind::Decentralized,
            "--" => {}
            _ => return Err(format!("unknown argument {argument}")),
        }
    }
    Ok(options)
}

fn run(options: &Options, out: &mut impl Write) -> io::Result<bool> {
    let mut good = true;
    for seed in &options.single {
        if options.dump {
            writeln!(out, "{}", describe(*seed, options.kind))?;
        }
        let (verdict, violation) = check(*seed, options.kind, Mutants::NONE, options.dump);
        if let Some(verdict) = verdict {
            write!(out, "{}", verdict.log.as_deref().unwrap_or_default())?;
            writeln!(
                out,
                "seed {seed:#x}: {:?}\n{} tags, hash {:x}",
                verdict.swarm, verdict.tags, verdict.hash
            )?;
            write!(out, "{}", verdict.coverage.table())?;
        }
        if let Some(violation) = violation {
            good = false;
            writeln!(out, "seed {seed:#x}: {violation}")?;
        }
    }
    if options.seeds > 0 {
        good &= run_seeds(options, out)?;
    }
    good &= clock_seeds::run(&options.clocks, out)?;
    if options.mutants {
        good &= mutants::run(options, out)?;
    }
    Ok(good)
}

/// Checks one seed; a panic is a violation too.
fn check(
    seed: u64,
    kind: Kind,
    mutants: Mutants,
    log: bool,
) -> (Option<Verdict>, Option<Violation>) {
    match catch_unwind(AssertUnwindSafe(|| {
        check_seed_logged(seed, kind, mutants, log)
    })) {
        Ok(verdict) => {
            let violation = verdict.violation.clone();
            (Some(verdict), violation)
        }
        Err(cause) => {
            let words = cause
                .downcast_ref::<String>()
                .cloned()
                .or_else(|| cause.downcast_ref::<&str>().map(ToString::to_string));
            let what = words.unwrap_or_else(|| "a panic without words".to_owned());
            let checker = "panic";
            (None, Some(Violation { checker, what }))
        }
    }
}

#[derive(Default)]
struct Tally {
    coverage: Coverage,
    tags: Vec<u64>,
    federates: Vec<usize>,
    failures: Vec<(u64, String)>,
}

impl Tally {
    fn take(&mut self, seed: u64, kind: Kind) {
        let (verdict, violation) = check(seed, kind, Mutants::NONE, false);
        if let Some(violation) = violation {
            let options = verdict.as_ref().map(|v| format!("{:?}", v.swarm));
            let options = options.unwrap_or_default();
            self.failures
                .push((seed, format!("{violation}\n  options: {options}")));
        }
        let Some(verdict) = verdict else { return };
        if seed.is_multiple_of(TWICE)
            && check_seed_logged(seed, kind, Mutants::NONE, false).hash != verdict.hash
        {
            let what = "the same seed gave two different runs".to_owned();
            self.failures.push((seed, what));
        }
        self.tags.push(verdict.tags);
        self.federates.push(verdict.swarm.federates);
        self.coverage.merge(&verdict.coverage);
    }

    fn merge(&mut self, other: Self) {
        self.coverage.merge(&other.coverage);
        self.tags.extend(other.tags);
        self.federates.extend(other.federates);
        self.failures.extend(other.failures);
    }
}

fn run_seeds(options: &Options, out: &mut impl Write) -> io::Result<bool> {
    let next = AtomicU64::new(options.first);
    let end = options.first + options.seeds;
    let quiet = std::panic::take_hook();
    std::panic::set_hook(Box::new(|_| {}));
    let tallies = std::thread::scope(|scope| {
        let work = || {
            let mut tally = Tally::default();
            loop {
                let seed = next.fetch_add(1, Ordering::Relaxed);
                if seed >= end || tally.failures.len() > 20 {
                    return tally;
                }
                tally.take(seed, options.kind);
            }
        };
        let workers: Vec<_> = (0..THREADS).map(|_| scope.spawn(work)).collect();
        workers
            .into_iter()
            .map(|worker| worker.join().expect("workers catch panics"))
            .collect::<Vec<_>>()
    });
    std::panic::set_hook(quiet);
    let mut total = Tally::default();
    for tally in tallies {
        total.merge(tally);
    }
    report(&mut total, options.kind, out)
}

fn report(total: &mut Tally, kind: Kind, out: &mut impl Write) -> io::Result<bool> {
    total.tags.sort_unstable();
    total.federates.sort_unstable();
    total.failures.sort_unstable();
    let median = |count: usize| count / 2;
    writeln!(
        out,
        "{} seeds: median {} federates, {} tags; {} failed",
        total.tags.len(),
        total
            .federates
            .get(median(total.federates.len()))
            .unwrap_or(&0),
        total.tags.get(median(total.tags.len())).unwrap_or(&0),
        total.failures.len()
    )?;
    write!(out, "{}", total.coverage.table())?;
    for (seed, what) in &total.failures {
        let option = match kind {
            Kind::Centralized => "",
            Kind::Decentralized => " --decentralized",
        };
        writeln!(
            out,
            "reproduce: cargo sim{option} --seed {seed:#x}\n  {what}"
        )?;
    }
    let missing: Vec<_> = total.coverage.missing(kind).collect();
    // A handful of seeds cannot show everything.
    let enough = total.tags.len() < 1_000 || missing.is_empty();
    if !enough {
        writeln!(out, "never happened: {}", missing.join(", "))?;
    }
    Ok(enough && total.failures.is_empty())
}

#[cfg(not(feature = "mutants"))]
mod mutants {
    use super::Options;
    use std::io::{self, Write};

    pub(super) fn run(_options: &Options, out: &mut impl Write) -> io::Result<bool> {
        writeln!(out, "build with --features mutants")?;
        Ok(false)
    }
}

#[cfg(feature = "mutants")]
mod mutants;
