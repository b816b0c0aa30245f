//! Scenarios on test hosts: `cargo test -p ictus-tests --test deploy [-- PART_OF_A_NAME...]`.
//!
//! All share one rig, one after the other, and each must leave the hosts as it found them: what the leak checker still sees
//! after it is a failure. After a failure the hosts' logs are gathered and the next scenario gets a rig of its own.

mod deployments;
mod hosts;
mod images;
mod installation;
mod killed;
mod losses;
mod network;
mod operator;
mod rows;
mod secrets;
mod system;
mod tls;
mod verbs;

use ictus_tests::rig::{self, Rig, Snapshot};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::process::ExitCode;
use std::time::Instant;

/// How many hosts the rig has.
const HOSTS: u8 = 3;

/// A test: its name, and what it does to the rig.
type Scenario = (&'static str, fn(&Rig));

/// Every scenario of these modules, in order.
const SCENARIOS: &[&[Scenario]] = &[
    hosts::SCENARIOS,
    deployments::SCENARIOS,
    network::SCENARIOS,
    secrets::SCENARIOS,
    killed::SCENARIOS,
    rows::SCENARIOS,
    images::SCENARIOS,
    installation::SCENARIOS,
    losses::SCENARIOS,
    tls::SCENARIOS,
    system::SCENARIOS,
    verbs::SCENARIOS,
];

#[expect(clippy::print_stdout, reason = "a test's report")]
fn main() -> ExitCode {
    let arguments = Arguments::parse(std::env::args().skip(1));
    let all = SCENARIOS.iter().copied().flatten();
    let chosen: Vec<Scenario> = all
        .filter(|(name, _)| arguments.wants(name))
        .copied()
        .collect();
    if arguments.list {
        for (name, _) in chosen {
            println!("{name}: test");
        }
        return ExitCode::SUCCESS;
    }
    if chosen.is_empty() {
        println!("no scenario is called so");
        return ExitCode::FAILURE;
    }
    if let Some(reason) = rig::missing() {
        println!("test hosts: {} scenarios skipped: {reason}", chosen.len());
        let ci = std::env::var_os("CI").is_some_and(|value| value == "true");
        return ExitCode::from(u8::from(ci));
    }
    rig::sweep_on_signal();
    let started = Instant::now();
    let failed = run_all(&chosen);
    for name in &failed {
        println!("failed: {name}");
    }
    println!(
        "{} passed, {} failed; {:.1} s in all",
        chosen.len() - failed.len(),
        failed.len(),
        started.elapsed().as_secs_f64()
    );
    ExitCode::from(u8::from(!failed.is_empty()))
}

/// Brings hosts up, runs one scenario after the other, and returns the names of those that failed.
#[expect(clippy::print_stdout, reason = "a test's report")]
fn run_all(chosen: &[Scenario]) -> Vec<&'static str> {
    let mut failed = Vec::new();
    let mut scenarios = chosen.iter().peekable();
    while scenarios.peek().is_some() {
        let began = Instant::now();
        let rig = Rig::new(HOSTS);
        let before = rig.snapshots();
        let seconds = began.elapsed().as_secs_f64();
        println!("{HOSTS} test hosts are ready ({seconds:.1} s)");
        for (name, scenario) in scenarios.by_ref() {
            let began = Instant::now();
            let outcome = run(&rig, &before, *scenario);
            let seconds = began.elapsed().as_secs_f64();
            let Err(why) = outcome else {
                println!("test {name} ... ok ({seconds:.1} s)");
                continue;
            };
            let logs = rig.gather_logs(name);
            println!("test {name} ... FAILED ({seconds:.1} s)\n{why}");
            println!("the logs of the test hosts are in {}", logs.display());
            failed.push(*name);
            // The next ones get other hosts: these are in a state that nobody knows.
            break;
        }
    }
    failed
}

/// Runs one scenario, heals the rig, and says what is wrong: its panic, or what it left behind.
fn run(rig: &Rig, before: &[Snapshot], scenario: fn(&Rig)) -> Result<(), String> {
    let checked = || {
        scenario(rig);
        rig.heal();
        rig.leaks(before)
    };
    match catch_unwind(AssertUnwindSafe(checked)) {
        Ok(left) if left.is_empty() => Ok(()),
        Ok(left) => Err(left),
        Err(panic) => Err(said(&*panic)),
    }
}

/// A panic's message.
fn said(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    let text = text.or_else(|| panic.downcast_ref::<&str>().copied());
    text.unwrap_or("a panic without a message").to_owned()
}

/// What the command line asks for; options of the usual harness that mean nothing here are ignored.
#[derive(Debug, Default)]
struct Arguments {
    parts: Vec<String>,
    list: bool,
    exact: bool,
}

impl Arguments {
    fn parse(arguments: impl Iterator<Item = String>) -> Self {
        let mut parsed = Self::default();
        for argument in arguments {
            match argument.as_str() {
                "--list" => parsed.list = true,
                "--exact" => parsed.exact = true,
                option if option.starts_with('-') => {}
                _ => parsed.parts.push(argument),
            }
        }
        parsed
    }

    fn wants(&self, name: &str) -> bool {
        let fits = |part: &String| {
            if self.exact {
                name == part
            } else {
                name.contains(part.as_str())
            }
        };
        self.parts.is_empty() || self.parts.iter().any(fits)
    }
}
