//! `ictus bench clock`: two federates whose clocks are made wrong, against the RTI's, all of one host.
//!
//! The host's clock is the truth: the RTI's is that one, and every federate reads both at once, a thousand times a second.

use crate::harness::{Bench, FEDERATION, Rti, finish};
use ictus::prelude::*;
use serde_json::{Value, json};
use std::io::{self, Write};
use std::process::ExitCode;
use std::time::{SystemTime, UNIX_EPOCH};

/// How wrong: nanoseconds, and parts per 10^9.
const WRONG: [(&str, i64, i64); 2] = [("fast", 50_000_000, 50_000), ("slow", -50_000_000, -50_000)];
/// Until then the servo may settle.
const SETTLED: i64 = 5_000_000_000;
/// Two readings of the host's clock further apart than this say too little of what was between them.
const BRACKET: i64 = 1_000;

/// Compares its clock with the host's.
#[reactor]
pub(crate) struct Watcher {
    #[timer(offset = 0.ms(), period = 1.ms())]
    tick: Timer,
    errors: Vec<i64>,
}

#[reactions]
impl Watcher {
    #[reaction]
    fn look(&mut self, ctx: &mut Ctx, _tick: &Timer) {
        let before = host();
        let shown = ctx.physical_time().as_nanos();
        let after = host();
        if after - before < BRACKET && ctx.elapsed().as_nanos() > SETTLED {
            self.errors.push((shown - before.midpoint(after)).abs());
        }
    }

    #[reaction]
    fn end(&mut self, _: &Shutdown) {
        self.errors.sort_unstable();
        let errors = &self.errors;
        let quantile = |part: usize| errors.get(errors.len().saturating_sub(1) * part / 1000);
        let result = json!({
            "readings": errors.len(), "p50_ns": quantile(500), "p99_ns": quantile(990), "max_ns": errors.last()
        });
        // The harness reads to the end of the stream; without a reader there is nobody to tell.
        drop(writeln!(io::stdout(), "{result}"));
    }
}

/// Runs both federates with the kernel's stamps and without; arguments: `--ictus PATH`, `--seconds N`, `--period NS`.
pub(crate) fn main(args: impl Iterator<Item = String>) -> ExitCode {
    match Settings::parse(args).and_then(|settings| settings.run().map_err(|e| e.to_string())) {
        Ok(()) => ExitCode::SUCCESS,
        Err(message) => {
            // Nobody reads standard error: the exit code still tells.
            drop(writeln!(io::stderr(), "bench clock: {message}"));
            ExitCode::FAILURE
        }
    }
}

struct Settings {
    bench: Bench,
    seconds: i64,
    period: i64,
}

impl Settings {
    fn parse(mut args: impl Iterator<Item = String>) -> Result<Self, String> {
        let program = std::env::current_exe().map_err(|error| error.to_string())?;
        let directory = std::env::temp_dir().join(format!("ictus-bench-{}", std::process::id()));
        let mut settings = Self {
            bench: Bench {
                ictus: program.with_file_name("ictus"),
                program,
                directory,
            },
            seconds: 20,
            period: 10_000_000,
        };
        while let Some(arg) = args.next() {
            let value = args.next().ok_or_else(|| format!("{arg} needs a value"))?;
            let number = || value.parse().map_err(|_| format!("{value:?} is no number"));
            match arg.as_str() {
                "--ictus" => settings.bench.ictus = value.into(),
                "--seconds" => settings.seconds = number()?,
                "--period" => settings.period = number()?,
                _ => return Err(format!("unknown option {arg}")),
            }
        }
        Ok(settings)
    }

    fn run(&self) -> io::Result<()> {
        std::fs::create_dir_all(&self.bench.directory)?;
        let mut out = io::stdout();
        writeln!(
            out,
            "clocks made wrong by 50 ms and 50 ppm each way, a comparison every {} ms, readings after {} s; in us\n\
             {:<8} {:<9} {:>9} {:>9} {:>9} {:>12} {:>6} {:>8} {:>9}",
            self.period / 1_000_000,
            SETTLED / 1_000_000_000,
            "stamps",
            "federate",
            "error p50",
            "error p99",
            "error max",
            "bound median",
            "kept",
            "dropped",
            "readings",
        )?;
        for stamps in ["kernel", "reader"] {
            for ((name, ..), said) in WRONG.iter().zip(self.federation(stamps)?) {
                writeln!(out, "{stamps:<8} {name:<9} {}", row(&said))?;
            }
        }
        std::fs::remove_dir_all(&self.bench.directory)
    }

    /// What each federate said.
    fn federation(&self, stamps: &str) -> io::Result<Vec<Vec<Value>>> {
        let plan = self.bench.directory.join("clock.json");
        std::fs::write(&plan, self.plan().to_string())?;
        let period = self.period.to_string();
        let rti = Rti::start_with(
            &self.bench.ictus,
            WRONG.len(),
            &["--clock-stamps", stamps, "-c", "on", "period", &period],
        )?;
        let address = format!("127.0.0.1:{}", rti.port);
        let start = |(name, ..): &(&str, i64, i64)| {
            let mut command = self.bench.federate(&plan);
            command
                .args(["--federate", name, "--rti", &address, "-i", FEDERATION])
                .args(["--status-fd", "1"])
                .env("ICTUS_CLOCK_STAMPS", stamps)
                .spawn()
        };
        let children: io::Result<Vec<_>> = WRONG.iter().map(start).collect();
        let said: io::Result<Vec<_>> = children?.into_iter().map(finish).collect();
        rti.finish()?;
        said
    }

    fn plan(&self) -> Value {
        let federate = |(name, offset, drift): &(&str, i64, i64)| {
            json!({
                "name": name, "class": "Watcher", "program": "bench",
                "test_clock_offset_ns": offset, "test_clock_drift_ppb": drift
            })
        };
        json!({
            "ictus": "v1", "federation": "clock", "coordination": "centralized", "extensions": true,
            "timeout_ns": self.seconds * 1_000_000_000,
            "clock": {"sync": "on", "period_ns": self.period},
            "federates": WRONG.iter().map(federate).collect::<Vec<_>>(), "connections": []
        })
    }
}

fn row(said: &[Value]) -> String {
    let number = |key: &str| {
        said.iter()
            .find_map(|line| line[key].as_i64())
            .unwrap_or(-1)
    };
    let clocks: Vec<&Value> = said
        .iter()
        .filter(|line| line["event"] == "clock")
        .collect();
    let mut bounds: Vec<i64> = clocks
        .iter()
        .filter_map(|line| line["clock"]["bound_ns"].as_i64())
        .collect();
    bounds.sort_unstable();
    let bound = bounds.get(bounds.len() / 2).copied().unwrap_or(-1);
    let last = |key: &str| {
        clocks
            .last()
            .and_then(|line| line["clock"][key].as_i64())
            .unwrap_or(-1)
    };
    let micros = |nanos: i64| format!("{}.{:02}", nanos / 1_000, nanos % 1_000 / 10);
    format!(
        "{:>9} {:>9} {:>9} {:>12} {:>6} {:>8} {:>9}",
        micros(number("p50_ns")),
        micros(number("p99_ns")),
        micros(number("max_ns")),
        micros(bound),
        last("probes_kept"),
        last("probes_dropped"),
        number("readings"),
    )
}

/// The host's clock in nanoseconds since the Unix epoch.
fn host() -> i64 {
    let since_epoch = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .unwrap_or_default();
    i64::try_from(since_epoch.as_nanos()).unwrap_or(0)
}
