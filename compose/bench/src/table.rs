//! What `ictus bench` prints: medians of several runs, each line beside its floor.

use crate::harness::{Bench, Case, Results};
use crate::{floor, rti};
use serde_json::json;
use std::io::{self, Write};
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

/// Runs every line and prints the table; arguments: `--ictus PATH`, `--runs N`, `--scale PERCENT`, names of lines.
pub(crate) fn main() -> ExitCode {
    let mut settings = match Settings::parse(std::env::args().skip(1)) {
        Ok(settings) => settings,
        Err(message) => return complain(&message),
    };
    match settings.run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => complain(&error.to_string()),
    }
}

fn complain(message: &str) -> ExitCode {
    // Nobody reads standard error: the exit code still tells.
    drop(writeln!(io::stderr(), "bench: {message}"));
    ExitCode::FAILURE
}

struct Settings {
    ictus: PathBuf,
    runs: usize,
    scale: u64,
    only: Vec<String>,
}

impl Settings {
    fn parse(args: impl Iterator<Item = String>) -> Result<Self, String> {
        let beside = std::env::current_exe().map(|exe| exe.with_file_name("ictus"));
        let ictus = beside.map_err(|error| error.to_string())?;
        let mut settings = Self {
            ictus,
            runs: 5,
            scale: 100,
            only: Vec::new(),
        };
        let mut args = args;
        while let Some(arg) = args.next() {
            let mut value = || args.next().ok_or_else(|| format!("{arg} needs a value"));
            let number = |text: String| {
                text.parse::<u64>()
                    .map_err(|_| format!("{text:?} is no number"))
            };
            match arg.as_str() {
                "--ictus" => settings.ictus = value()?.into(),
                "--runs" => {
                    settings.runs = usize::try_from(number(value()?)?.clamp(1, 99)).unwrap_or(1);
                }
                "--scale" => settings.scale = number(value()?)?.clamp(1, 10_000),
                _ if arg.starts_with('-') => return Err(format!("unknown option {arg}")),
                _ => settings.only.push(arg),
            }
        }
        Ok(settings)
    }

    fn wants(&self, name: &str) -> bool {
        self.only.is_empty() || self.only.iter().any(|only| name.starts_with(only.as_str()))
    }

    fn count(&self, full: u64) -> u64 {
        (full * self.scale / 100).max(100)
    }

    fn run(&mut self) -> io::Result<()> {
        let directory = std::env::temp_dir().join(format!("ictus-bench-{}", std::process::id()));
        std::fs::create_dir_all(&directory)?;
        let bench = Bench {
            ictus: self.ictus.clone(),
            program: std::env::current_exe()?,
            directory: directory.clone(),
        };
        let result = self.lines(&bench);
        std::fs::remove_dir_all(directory)?;
        result
    }

    fn lines(&self, bench: &Bench) -> io::Result<()> {
        let mut out = io::stdout();
        writeln!(
            out,
            "{:<26} {:>12} {:>26} {:>14}",
            "", "ictus", "floor", "peak MiB"
        )?;
        for case in [
            source_sink,
            source_sink_under_tls,
            decentralized,
            pipeline,
            two_sources,
        ] {
            self.throughput(bench, &mut out, case)?;
        }
        if self.wants("rti") {
            let messages = self.count(2_000_000);
            let rate = self.median(|| rti::flood(bench, messages))?;
            let floor = self.median(|| floor::tcp(messages, true))?;
            row(
                &mut out,
                "rti alone, msg/s",
                &mega(rate),
                &format!("tcp 64 KB {}", mega(floor)),
                "",
            )?;
            let trips = rti::round_trips(bench, self.count(20_000))?;
            let floor = floor::relay_trip(self.count(20_000))?;
            row(
                &mut out,
                "rti NET -> TAG p50/p99, us",
                &quantiles(&trips),
                &format!("tcp relay {}", quantiles(&floor)),
                "",
            )?;
        }
        if self.wants("latency") {
            self.latency(bench, &mut out, (None, false))?;
            self.latency(bench, &mut out, (None, true))?;
            self.latency(bench, &mut out, (Some(Duration::ZERO), false))?;
        }
        self.in_process(bench, &mut out)
    }

    fn throughput(
        &self,
        bench: &Bench,
        out: &mut impl Write,
        case: fn(u64) -> Case,
    ) -> io::Result<()> {
        let messages = self.count(1_000_000);
        let case = case(messages);
        if !self.wants(case.name) {
            return Ok(());
        }
        let mut peaks = Results::default();
        let rate = self.median(|| {
            let results = bench.federated(&case)?;
            let rate = results
                .number("rate")
                .ok_or_else(|| io::Error::other("no result"))?;
            peaks = results;
            Ok(rate)
        })?;
        let buffered = self.median(|| floor::tcp(messages, true))?;
        let single = self.median(|| floor::tcp(messages / 4, false))?;
        let floor = format!("tcp {} / 64 KB {}", mega(single), mega(buffered));
        let peak = peaks.largest("peak_kib").unwrap_or(0.0) / 1024.0;
        let rti = peaks.rti_peak_kib / 1024;
        let name = format!("{}, msg/s", case.name);
        row(
            out,
            &name,
            &mega(rate),
            &floor,
            &format!("{peak:.0}, rti {rti}"),
        )
    }

    fn latency(
        &self,
        bench: &Bench,
        out: &mut impl Write,
        (stp_offset, tls): (Option<Duration>, bool),
    ) -> io::Result<()> {
        let count = self.count(2000);
        let case = Case {
            name: "latency",
            federates: vec![
                ("source", "Paced", json!({"count": count})),
                ("sink", "LatencySink", json!({})),
            ],
            connections: vec![((0, "out", 0), (1, "input", 0), None)],
            fast: false,
            stp_offset,
            tls,
        };
        let results = bench.federated(&case)?;
        let micros = |key| results.number(key).unwrap_or(f64::NAN) / 1000.0;
        let ours = format!("{:.1} / {:.1}", micros("p50_ns"), micros("p99_ns"));
        let floor = floor::relay_latency(
            usize::try_from(count).unwrap_or(100),
            Duration::from_millis(1),
        )?;
        row(
            out,
            match (stp_offset, tls) {
                (Some(_), _) => "1 kHz decentralized, us",
                (None, true) => "1 kHz one way TLS, us",
                (None, false) => "1 kHz one way p50/p99, us",
            },
            &ours,
            &format!("tcp relay {}", quantiles(&floor)),
            "",
        )
    }

    fn in_process(&self, bench: &Bench, out: &mut impl Write) -> io::Result<()> {
        let rounds = self.count(5_000_000);
        let ping_pong = Case {
            name: "ping-pong",
            federates: vec![
                ("ping", "Ping", json!({"count": rounds})),
                ("pong", "Pong", json!({})),
            ],
            connections: vec![
                ((0, "out", 0), (1, "input", 0), None),
                ((1, "out", 0), (0, "input", 0), None),
            ],
            fast: true,
            stp_offset: None,
            tls: false,
        };
        let mut fan_out = Case {
            name: "fan-out",
            federates: vec![("fan", "Fan", json!({"count": self.count(2_000_000)}))],
            connections: Vec::new(),
            fast: true,
            stp_offset: None,
            tls: false,
        };
        const SINKS: [&str; 10] = ["s0", "s1", "s2", "s3", "s4", "s5", "s6", "s7", "s8", "s9"];
        for (index, sink) in (1..).zip(SINKS) {
            fan_out.federates.push((sink, "FanSink", json!({})));
            fan_out
                .connections
                .push(((0, "out", 0), (index, "input", 0), None));
        }
        for (case, title, fan) in [
            (ping_pong, "ping-pong, tags/s", 1),
            (fan_out, "fan-out 1 -> 10, react/s", 10),
        ] {
            if !self.wants(case.name) {
                continue;
            }
            let rate = self.median(|| {
                let results = bench.alone(&case)?;
                results
                    .number("rate")
                    .ok_or_else(|| io::Error::other("no result"))
            })?;
            let floor = self.median(|| Ok(floor::heap(rounds, fan)))?;
            row(
                out,
                title,
                &mega(rate),
                &format!("heap {}", mega(floor)),
                "",
            )?;
        }
        Ok(())
    }

    fn median(&self, mut measure: impl FnMut() -> io::Result<f64>) -> io::Result<f64> {
        let mut rates = (0..self.runs)
            .map(|_| measure())
            .collect::<io::Result<Vec<f64>>>()?;
        rates.sort_by(f64::total_cmp);
        Ok(rates[rates.len() / 2])
    }
}

fn source_sink(messages: u64) -> Case {
    Case {
        name: "S1 source -> sink",
        federates: vec![
            ("source", "Flood", json!({"count": messages})),
            ("sink", "Sink", json!({"count": messages})),
        ],
        connections: vec![((0, "out", 0), (1, "input", 0), None)],
        fast: true,
        stp_offset: None,
        tls: false,
    }
}

fn source_sink_under_tls(messages: u64) -> Case {
    Case {
        name: "S1 under TLS",
        tls: true,
        ..source_sink(messages)
    }
}

/// From federate to federate, tags 100 ns apart and never ahead of physical time: the sink needs no offset, because a
/// message says that none before it is missing.
fn decentralized(messages: u64) -> Case {
    Case {
        name: "S1 decentralized",
        federates: vec![
            (
                "source",
                "Flood",
                json!({"count": messages, "gap": "100 ns"}),
            ),
            ("sink", "Sink", json!({"count": messages})),
        ],
        fast: false,
        stp_offset: Some(Duration::ZERO),
        ..source_sink(messages)
    }
}

fn pipeline(messages: u64) -> Case {
    Case {
        name: "S2 pipeline",
        federates: vec![
            ("source", "Flood", json!({"count": messages})),
            ("relay", "Relay", json!({})),
            ("sink", "Sink", json!({"count": messages})),
        ],
        connections: vec![
            ((0, "out", 0), (1, "input", 0), None),
            ((1, "out", 0), (2, "input", 0), None),
        ],
        fast: true,
        stp_offset: None,
        tls: false,
    }
}

fn two_sources(messages: u64) -> Case {
    Case {
        name: "S3 two sources",
        federates: vec![
            ("first", "Flood", json!({"count": messages / 2})),
            ("second", "Flood", json!({"count": messages / 2})),
            ("sink", "Merge", json!({"count": messages / 2})),
        ],
        connections: vec![
            ((0, "out", 0), (2, "first", 0), None),
            ((1, "out", 0), (2, "second", 0), None),
        ],
        fast: true,
        stp_offset: None,
        tls: false,
    }
}

fn row(out: &mut impl Write, name: &str, ours: &str, floor: &str, peak: &str) -> io::Result<()> {
    writeln!(out, "{name:<26} {ours:>12} {floor:>26} {peak:>14}")
}

fn mega(rate: f64) -> String {
    if rate >= 1e6 {
        format!("{:.2} M", rate / 1e6)
    } else {
        format!("{:.0} k", rate / 1e3)
    }
}

fn quantiles(sorted_ns: &[u64]) -> String {
    let micros = |index: usize| {
        #[expect(clippy::cast_precision_loss, reason = "microseconds to one digit")]
        let nanos = sorted_ns.get(index).copied().unwrap_or(0) as f64;
        nanos / 1000.0
    };
    format!(
        "{:.1} / {:.1}",
        micros(sorted_ns.len() / 2),
        micros(sorted_ns.len() * 99 / 100)
    )
}
