//! `sweep`: every system over every period and STP offset, as CSV and SVG.

use crate::chart::{Chart, Curve};
#[cfg(feature = "mqtt")]
use crate::contrast::{available, run as mqtt};
use crate::harness::{Offset, Place, Ran, RunError, Setup, System};
use crate::order::Tally;
use clap::Args;
use std::io::{self, Write};
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// Run every system over periods and STP offsets; write the error rates as CSV and SVG
///
/// What else runs on this machine delays nodes beyond the bounds: `chrt -f 10` before the command keeps it away.
#[derive(Debug, Args)]
pub(crate) struct Sweep {
    /// The folder for `runs.csv`, `offset.svg` and `period.svg`
    #[arg(long, default_value = "inconsistency-results")]
    out: PathBuf,
    /// The most sequences of one run
    #[arg(long, default_value_t = 300_000)]
    sequences: u32,
    /// How long one run may send: fewer sequences are sent when they take longer
    #[arg(long, default_value = "5 s", value_parser = duration)]
    budget: Duration,
    /// Between two messages of a sequence
    #[arg(long, value_delimiter = ',', value_parser = duration,
        default_value = "1 ns,1 us,10 us,100 us,1 ms,10 ms,100 ms")]
    periods: Vec<Duration>,
    /// Between two sequences
    #[arg(long, default_value = "1 ms", value_parser = duration)]
    pause: Duration,
    /// The most that a node works on a message
    #[arg(long, default_value = "100 us", value_parser = duration)]
    work: Duration,
    /// STP offsets of the planner, beside the one that is solved from the manifest's bounds
    #[arg(long, value_delimiter = ',', value_parser = duration,
        default_value = "0 us,20 us,50 us,100 us,200 us,500 us,1 ms,2 ms")]
    offsets: Vec<Duration>,
    /// Which systems
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "centralized,decentralized,mqtt"
    )]
    systems: Vec<Kind>,
}

/// A family of systems.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Kind {
    Centralized,
    Decentralized,
    Mqtt,
}

/// The result of one run.
#[derive(Debug)]
struct Row {
    setup: Setup,
    ran: Ran,
    took: Duration,
}

impl Row {
    fn rate(&self) -> f64 {
        #[expect(clippy::cast_precision_loss, reason = "a rate needs few digits")]
        let rate = self.ran.tally.errors as f64 / self.ran.tally.sequences.max(1) as f64;
        rate
    }

    fn system(&self) -> String {
        match self.setup.system {
            System::Centralized => "centralized".to_owned(),
            System::Decentralized(Offset::Declared(_)) => "decentralized".to_owned(),
            System::Decentralized(Offset::Solved) => "decentralized solved".to_owned(),
            System::Mqtt { qos } => format!("mqtt qos {qos}"),
        }
    }

    /// A federation's error is always an STP violation: handled, and counted. With a grant there is none.
    fn keeps_the_law(&self) -> bool {
        let Tally {
            errors,
            silent,
            violations,
            ..
        } = &self.ran.tally;
        match self.setup.system {
            System::Centralized => *errors == 0 && self.ran.counted == 0,
            System::Decentralized(_) => *silent == 0 && *violations <= self.ran.counted,
            System::Mqtt { .. } => true,
        }
    }

    fn csv(&self) -> String {
        let Tally {
            sequences,
            errors,
            silent,
            violations,
            incomplete,
            orders,
        } = &self.ran.tally;
        let counted = self.ran.counted;
        let offset = self
            .ran
            .offset
            .map_or_else(String::new, |offset| offset.as_nanos().to_string());
        let orders: Vec<String> = orders
            .iter()
            .map(|(order, count)| format!("{order}: {count}"))
            .collect();
        format!(
            "{},{},{offset},{sequences},{errors},{:.6},{silent},{violations},{counted},{incomplete},{:.3},{}",
            self.system(),
            self.setup.period.as_nanos(),
            self.rate(),
            self.took.as_secs_f64(),
            orders.join("; ")
        )
    }
}

const HEADER: &str = "system,period_ns,stp_offset_ns,sequences,errors,error_rate,silent_errors,stp_handled,stp_counted,incomplete,seconds,orders";

impl Sweep {
    /// Runs everything and writes the results; says each run as it ends.
    ///
    /// # Errors
    ///
    /// When a run fails or a file cannot be written.
    pub(crate) fn run(&self) -> Result<(), RunError> {
        let temporary = tempfile::tempdir().map_err(file("a temporary directory"))?;
        let program = std::env::current_exe().map_err(file("this program"))?;
        std::fs::create_dir_all(&self.out).map_err(file(&self.out))?;
        let place = Place {
            directory: temporary.path(),
            program: &program,
        };
        let systems = self.systems();
        let mut rows = Vec::new();
        say(&format!(
            "{:<21} {:>8} {:>8} {:>9} {:>9} {:>9} {:>7} {:>10} {:>7}",
            "SYSTEM",
            "PERIOD",
            "OFFSET",
            "SEQUENCES",
            "ERRORS",
            "RATE %",
            "SILENT",
            "VIOLATIONS",
            "MISSING"
        ));
        for period in &self.periods {
            for system in &systems {
                let row = self.row(&place, *period, *system)?;
                say(&line(&row));
                rows.push(row);
            }
        }
        self.write(&rows)?;
        let broken = rows.iter().filter(|row| !row.keeps_the_law()).count();
        if broken > 0 {
            return Err(RunError::Law(broken));
        }
        Ok(())
    }

    fn systems(&self) -> Vec<System> {
        let mut systems = Vec::new();
        if self.systems.contains(&Kind::Centralized) {
            systems.push(System::Centralized);
        }
        if self.systems.contains(&Kind::Decentralized) {
            let declared = self.offsets.iter().copied().map(Offset::Declared);
            let offsets = declared.chain([Offset::Solved]);
            systems.extend(offsets.map(System::Decentralized));
        }
        if self.systems.contains(&Kind::Mqtt) {
            match available() {
                Ok(()) => systems.extend([0, 1].map(|qos| System::Mqtt { qos })),
                Err(why) => say(&format!("without MQTT: {why}")),
            }
        }
        systems
    }

    fn row(&self, place: &Place<'_>, period: Duration, system: System) -> Result<Row, RunError> {
        let mut setup = Setup {
            system,
            period,
            pause: self.pause,
            work: self.work,
            sequences: 1,
        };
        let fit = self.budget.as_nanos() / setup.cycle().as_nanos().max(1);
        setup.sequences = u32::try_from(fit)
            .unwrap_or(u32::MAX)
            .clamp(1, self.sequences.max(1));
        let begin = Instant::now();
        let ran = match system {
            System::Centralized | System::Decentralized(_) => place.federated(&setup)?,
            System::Mqtt { qos } => Ran {
                tally: mqtt(place, &setup, qos)?,
                ..Ran::default()
            },
        };
        Ok(Row {
            setup,
            ran,
            took: begin.elapsed(),
        })
    }

    fn write(&self, rows: &[Row]) -> Result<(), RunError> {
        let lines: Vec<String> = rows.iter().map(Row::csv).collect();
        let csv = format!("{HEADER}\n{}\n", lines.join("\n"));
        let charts = [
            ("runs.csv", csv),
            ("offset.svg", over_offsets(rows).to_string()),
            ("period.svg", over_periods(rows).to_string()),
        ];
        for (name, text) in charts {
            let path = self.out.join(name);
            std::fs::write(&path, text).map_err(file(&path))?;
            say(&format!("wrote {}", path.display()));
        }
        Ok(())
    }
}

/// Whether MQTT can be run: not without the feature.
#[cfg(not(feature = "mqtt"))]
fn available() -> Result<(), &'static str> {
    Err("build with `--features mqtt`")
}

#[cfg(not(feature = "mqtt"))]
fn mqtt(_: &Place<'_>, _: &Setup, _: u8) -> Result<Tally, RunError> {
    Ok(Tally::default())
}

/// Error rate over the STP offset, a curve for each period.
fn over_offsets(rows: &[Row]) -> Chart {
    let mut offsets: Vec<Duration> = rows.iter().filter_map(|row| row.ran.offset).collect();
    offsets.sort_unstable();
    offsets.dedup();
    let solved = rows
        .iter()
        .find(|row| row.setup.system == System::Decentralized(Offset::Solved));
    let solved = solved.and_then(|row| row.ran.offset);
    let tick = |offset: &Duration| match solved {
        Some(solved) if solved == *offset => format!("{} solved", short(*offset)),
        _ => short(*offset),
    };
    let mut curves = Curves::default();
    for row in rows {
        let setting = row
            .ran
            .offset
            .and_then(|offset| offsets.binary_search(&offset).ok());
        if let Some(setting) = setting {
            curves.add(
                &format!("period {}", short(row.setup.period)),
                setting,
                row.rate(),
            );
        }
    }
    Chart {
        title: "Decentralized: sequences in a wrong order over the STP offset".to_owned(),
        x_label: "STP offset of the planner".to_owned(),
        ticks: offsets.iter().map(tick).collect(),
        curves: curves.0,
    }
}

/// Error rate over the period, a curve for each system.
fn over_periods(rows: &[Row]) -> Chart {
    let mut periods: Vec<Duration> = rows.iter().map(|row| row.setup.period).collect();
    periods.sort_unstable();
    periods.dedup();
    let mut curves = Curves::default();
    for row in rows {
        let name = match row.setup.system {
            System::Decentralized(Offset::Declared(offset)) if offset.is_zero() => {
                "decentralized, offset 0".to_owned()
            }
            System::Decentralized(Offset::Declared(_)) => continue,
            System::Decentralized(Offset::Solved) => "decentralized, solved".to_owned(),
            System::Centralized | System::Mqtt { .. } => row.system(),
        };
        if let Ok(setting) = periods.binary_search(&row.setup.period) {
            curves.add(&name, setting, row.rate());
        }
    }
    Chart {
        title: "Sequences in a wrong order, by system".to_owned(),
        x_label: "between two messages of a sequence".to_owned(),
        ticks: periods.iter().copied().map(short).collect(),
        curves: curves.0,
    }
}

/// Curves in the order in which their names come first.
#[derive(Default)]
struct Curves(Vec<Curve>);

impl Curves {
    fn add(&mut self, name: &str, setting: usize, rate: f64) {
        let at = self.0.iter().position(|curve| curve.name == name);
        let at = at.unwrap_or_else(|| {
            self.0.push(Curve {
                name: name.to_owned(),
                points: Vec::new(),
            });
            self.0.len() - 1
        });
        let points = &mut self.0[at].points;
        points.push((setting, rate));
        points.sort_unstable_by_key(|(setting, _)| *setting);
    }
}

fn line(row: &Row) -> String {
    let tally = &row.ran.tally;
    format!(
        "{:<21} {:>8} {:>8} {:>9} {:>9} {:>9.3} {:>7} {:>10} {:>7}",
        row.system(),
        short(row.setup.period),
        row.ran.offset.map_or_else(|| "-".to_owned(), short),
        tally.sequences,
        tally.errors,
        row.rate() * 100.0,
        tally.silent,
        row.ran.counted,
        tally.incomplete
    )
}

fn say(line: &str) {
    // Nobody reads: the files are written all the same.
    drop(writeln!(io::stdout(), "{line}"));
}

fn file(path: impl Into<PathBuf>) -> impl FnOnce(io::Error) -> RunError {
    let path = path.into();
    |source| RunError::File { path, source }
}

const UNITS: [(&str, u128); 4] = [
    ("s", 1_000_000_000),
    ("ms", 1_000_000),
    ("us", 1_000),
    ("ns", 1),
];

/// The time in the largest unit in which it is whole.
fn short(time: Duration) -> String {
    let nanos = time.as_nanos();
    let whole = UNITS
        .iter()
        .find(|(_, factor)| nanos > 0 && nanos.is_multiple_of(*factor));
    whole.map_or_else(
        || "0".to_owned(),
        |(unit, factor)| format!("{} {unit}", nanos / factor),
    )
}

/// Reads `10 us`, `1ms`, `5 s`, `0`.
fn duration(text: &str) -> Result<Duration, String> {
    let text = text.trim();
    let digits = text
        .find(|c: char| !c.is_ascii_digit())
        .unwrap_or(text.len());
    let (number, unit) = text.split_at(digits);
    let number: u64 = number.parse().map_err(|_| "expected a time such as 10us")?;
    let factor = match (unit.trim(), number) {
        ("", 0) => 1,
        (unit, _) => {
            let known = UNITS.iter().find(|(name, _)| *name == unit);
            known.ok_or("the unit is ns, us, ms or s")?.1
        }
    };
    let nanos = u128::from(number)
        .checked_mul(factor)
        .and_then(|nanos| u64::try_from(nanos).ok());
    nanos
        .map(Duration::from_nanos)
        .ok_or_else(|| "the time is too long".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(system: System, period: u64, offset: Option<u64>, errors: u64) -> Row {
        Row {
            setup: Setup {
                system,
                period: Duration::from_nanos(period),
                pause: Duration::from_micros(500),
                work: Duration::from_micros(100),
                sequences: 1000,
            },
            ran: Ran {
                tally: Tally {
                    sequences: 1000,
                    errors,
                    violations: errors,
                    orders: [("+v drive reverse -v".to_owned(), errors)].into(),
                    ..Tally::default()
                },
                offset: offset.map(Duration::from_nanos),
                counted: if errors > 0 { errors + 1 } else { 0 },
            },
            took: Duration::from_millis(1500),
        }
    }

    fn rows() -> Vec<Row> {
        let declared = |ns| System::Decentralized(Offset::Declared(Duration::from_nanos(ns)));
        vec![
            row(System::Centralized, 1, None, 0),
            row(declared(0), 1, Some(0), 700),
            row(declared(1000), 1, Some(1000), 500),
            row(System::Decentralized(Offset::Solved), 1, Some(500), 1),
            row(System::Mqtt { qos: 1 }, 1, None, 600),
            row(declared(0), 1000, Some(0), 300),
            row(System::Centralized, 1000, None, 0),
        ]
    }

    #[test]
    fn a_run_is_one_line_of_csv() {
        let rows = rows();
        assert_eq!(
            rows[2].csv(),
            "decentralized,1,1000,1000,500,0.500000,0,500,501,0,1.500,+v drive reverse -v: 500"
        );
        assert_eq!(
            rows[4].csv(),
            "mqtt qos 1,1,,1000,600,0.600000,0,600,601,0,1.500,+v drive reverse -v: 600"
        );
        let columns = HEADER.split(',').count();
        assert!(
            rows.iter()
                .all(|row| row.csv().split(',').count() == columns)
        );
    }

    #[test]
    fn an_error_that_nobody_was_told_of_breaks_the_law() {
        assert!(rows().iter().all(Row::keeps_the_law));
        let declared = System::Decentralized(Offset::Declared(Duration::ZERO));
        let mut silent = row(declared, 1, Some(0), 5);
        silent.ran.tally.silent = 1;
        let mut uncounted = row(declared, 1, Some(0), 5);
        uncounted.ran.counted = 4;
        let wrong = row(System::Centralized, 1, None, 5);
        assert!(
            [silent, uncounted, wrong]
                .iter()
                .all(|row| !row.keeps_the_law())
        );
    }

    #[test]
    fn offsets_are_sorted_and_the_solved_one_is_named() {
        let chart = over_offsets(&rows());
        assert_eq!(chart.ticks, ["0", "500 ns solved", "1 us"]);
        let names: Vec<_> = chart
            .curves
            .iter()
            .map(|curve| curve.name.as_str())
            .collect();
        assert_eq!(names, ["period 1 ns", "period 1 us"]);
        assert_eq!(chart.curves[0].points, [(0, 0.7), (1, 0.001), (2, 0.5)]);
    }

    #[test]
    fn every_system_has_a_curve_over_the_periods() {
        let chart = over_periods(&rows());
        assert_eq!(chart.ticks, ["1 ns", "1 us"]);
        let names: Vec<_> = chart
            .curves
            .iter()
            .map(|curve| curve.name.as_str())
            .collect();
        let expected = [
            "centralized",
            "decentralized, offset 0",
            "decentralized, solved",
            "mqtt qos 1",
        ];
        assert_eq!(names, expected);
        assert_eq!(chart.curves[1].points, [(0, 0.7), (1, 0.3)]);
    }

    #[test]
    fn times_have_units() {
        assert_eq!(duration("10 us"), Ok(Duration::from_micros(10)));
        assert_eq!(duration("1ns"), Ok(Duration::from_nanos(1)));
        assert_eq!(duration("0"), Ok(Duration::ZERO));
        assert!(
            duration("7").is_err()
                && duration("1 day").is_err()
                && duration("99999999999 s").is_err()
        );
        assert_eq!(
            [0, 1, 1500, 10_000_000].map(|ns| short(Duration::from_nanos(ns))),
            ["0", "1 ns", "1500 ns", "10 ms"]
        );
    }
}
