//! The command line, and who carries it out.

use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use clap::error::ErrorKind;
use clap::{Args, Parser, Subcommand, ValueEnum};
use ictusd::supervisor::shim;

use crate::commands;
use crate::error::{CliError, USAGE};
use crate::ui::Ui;

const EXIT_CODES: &str = "Exit codes: 0 done, 1 failed, 2 `plan`: there are changes, 3 the manifest has mistakes, 4 a host cannot be reached, \
     5 somebody else is at it, 6 not in time, 8 done on some hosts only, 9 a saved plan is out of date, 64 wrong usage";

/// Run federations of deterministic reactors from one manifest
#[derive(Debug, Parser)]
#[command(
    name = "ictus",
    version,
    max_term_width = 100,
    subcommand_required = true
)]
#[command(after_help = EXIT_CODES)]
pub(crate) struct Cli {
    #[command(flatten)]
    pub(crate) global: Global,
    #[command(subcommand)]
    command: Command,
}

/// What every command takes.
#[derive(Clone, Copy, Debug, Args)]
pub(crate) struct Global {
    /// How results are printed: for people, or for programs as one JSON value (for streams, one a line)
    #[arg(short, long, global = true, value_enum, default_value_t = Output::Table)]
    pub(crate) output: Output,
    /// Say only what went wrong
    #[arg(short, long, global = true)]
    pub(crate) quiet: bool,
}

/// How results are printed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Output {
    Table,
    Json,
}

#[derive(Debug, Subcommand)]
enum Command {
    Init(commands::init::Init),
    Check(commands::check::Check),
    Plan(commands::plan::PlanCommand),
    Up(commands::up::Up),
    Compose(commands::compose::ComposeCommand),
    Ps(commands::ps::Ps),
    Logs(commands::logs::Logs),
    Events(commands::events::Events),
    Metrics(commands::metrics::Metrics),
    Timing(commands::timing::Timing),
    Stop(commands::stop::Stop),
    Down(commands::down::Down),
    Verify(commands::verify::Verify),
    History(commands::history::History),
    Rollback(commands::history::Rollback),
    Host(commands::host::Host),
    Lock(commands::lock::Lock),
    /// Measure throughput and latency beside the floors of this machine
    Bench(PassedOn),
    /// Print the manifest's JSON Schema
    Schema,
    Explain(commands::explain::Explain),
    /// Run an RTI with the options of Lingua Franca's
    #[command(disable_help_flag = true)]
    Rti(PassedOn),
    /// Serve the API; `up` starts it when it is needed
    Daemon,
    #[command(hide = true)]
    DialStdio(commands::dial_stdio::DialStdio),
    /// Have the program that was sent beside this one take its place, if it comes up
    #[command(hide = true)]
    Swap,
    #[command(hide = true)]
    Collect(commands::collect::Collect),
    #[command(hide = true)]
    Health(commands::health::Health),
    #[command(hide = true)]
    Supervise(commands::supervise::Supervise),
}

/// Arguments that another program understands.
#[derive(Debug, Args)]
struct PassedOn {
    /// Passed on as they are
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    args: Vec<OsString>,
}

/// A manifest and what is changed in it.
#[derive(Debug, Args)]
pub(crate) struct ManifestArgs {
    /// The manifest, or the directory of a `federation.yaml`
    #[arg(default_value = "federation.yaml")]
    pub(crate) manifest: PathBuf,
    /// Give a name of the manifest's `let` another value
    #[arg(long = "set", value_name = "NAME=VALUE", value_parser = assignment)]
    pub(crate) set: Vec<(String, String)>,
}

/// Carries out a command line, the program's name included.
pub(crate) fn dispatch(args: Vec<OsString>) -> ExitCode {
    let name = args
        .first()
        .and_then(|program| Path::new(program).file_name());
    let first = args.get(1).map(OsString::as_os_str);
    if name == Some(OsStr::new("ictus-rti")) {
        return ictus_rti::run(args.into_iter().skip(1));
    }
    // LF's options are not ours to parse; and nothing may be allocated that the shim does not need.
    if first == Some(OsStr::new("rti")) {
        return ictus_rti::run(args.into_iter().skip(2));
    }
    if first == Some(OsStr::new(shim::COMMAND)) {
        return shim::exec(args.into_iter().skip(2));
    }
    // By that name it is the daemon, unless a command says otherwise.
    let command = first.is_some_and(|first| !first.as_encoded_bytes().starts_with(b"-"));
    let args = if name == Some(OsStr::new("ictusd")) && !command {
        vec![OsString::from("ictusd"), OsString::from("daemon")]
            .into_iter()
            .chain(args.into_iter().skip(1))
            .collect()
    } else {
        args
    };
    match Cli::try_parse_from(args) {
        Ok(cli) => run(cli),
        Err(error) => usage(&error),
    }
}

fn run(cli: Cli) -> ExitCode {
    let mut ui = Ui::new(cli.global);
    let result = match cli.command {
        Command::Init(it) => it.run(&mut ui),
        Command::Check(it) => it.run(&mut ui),
        Command::Plan(it) => it.run(&mut ui),
        Command::Up(it) => it.run(&mut ui),
        Command::Compose(it) => it.run(&mut ui),
        Command::Ps(it) => it.run(&mut ui),
        Command::Logs(it) => it.run(&mut ui),
        Command::Events(it) => it.run(&mut ui),
        Command::Metrics(it) => it.run(&mut ui),
        Command::Timing(it) => it.run(&mut ui),
        Command::Stop(it) => it.run(&mut ui),
        Command::Down(it) => it.run(&mut ui),
        Command::Verify(it) => it.run(&mut ui),
        Command::History(it) => it.run(&mut ui),
        Command::Rollback(it) => it.run(&mut ui),
        Command::Host(it) => it.run(&mut ui),
        Command::Lock(it) => it.run(&mut ui),
        Command::Bench(it) => commands::bench::run(&it.args),
        Command::Schema => commands::schema::run(&mut ui),
        Command::Explain(it) => it.run(&mut ui),
        Command::Rti(it) => return ictus_rti::run(it.args),
        Command::Daemon => commands::daemon::run(),
        Command::DialStdio(it) => commands::dial_stdio::run(&it),
        Command::Swap => commands::swap::run(),
        Command::Collect(it) => it.run(),
        Command::Health(it) => it.run(),
        Command::Supervise(it) => it.run(),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => ui.fail(&error),
    }
}

/// Clap's own messages, with our exit code for wrong usage.
fn usage(error: &clap::Error) -> ExitCode {
    // Nothing can be done about a terminal that is gone.
    error.print().ok();
    if matches!(
        error.kind(),
        ErrorKind::DisplayHelp | ErrorKind::DisplayVersion
    ) {
        return ExitCode::SUCCESS;
    }
    ExitCode::from(USAGE)
}

pub(crate) fn assignment(text: &str) -> Result<(String, String), String> {
    let (name, value) = text
        .split_once('=')
        .ok_or("expected NAME=VALUE, such as half=\"5 ms\"")?;
    Ok((name.trim().to_owned(), value.trim().to_owned()))
}

/// Reads `300`, `5m`, `30 s`, `500ms`: a plain number counts seconds.
pub(crate) fn duration(text: &str) -> Result<Duration, String> {
    let text = text.trim();
    let digits = text
        .find(|c: char| !c.is_ascii_digit())
        .unwrap_or(text.len());
    let (number, unit) = text.split_at(digits);
    let number: u64 = number
        .parse()
        .map_err(|_| "expected a time such as 30s or 5m")?;
    let seconds = |factor: u64| number.checked_mul(factor).map(Duration::from_secs);
    let duration = match unit.trim() {
        "" | "s" => seconds(1),
        "ms" => Some(Duration::from_millis(number)),
        "m" | "min" => seconds(60),
        "h" => seconds(3600),
        _ => return Err("the unit is ms, s, m or h".to_owned()),
    };
    duration.ok_or_else(|| "the time is too long".to_owned())
}

impl ManifestArgs {
    /// The manifest's path: a directory stands for its `federation.yaml`.
    pub(crate) fn path(&self) -> Result<PathBuf, CliError> {
        let given = &self.manifest;
        let path = if given.is_dir() {
            given.join("federation.yaml")
        } else {
            given.clone()
        };
        if path.is_file() {
            return Ok(path);
        }
        let message = format!("there is no manifest at {}", path.display());
        Err(CliError::failed(message).hint("`ictus init DIR` writes a small one to start from"))
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use clap::CommandFactory;

    use super::{Cli, duration};

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn times_have_units() {
        assert_eq!(duration("5m"), Ok(Duration::from_secs(300)));
        assert_eq!(duration("30 s"), Ok(Duration::from_secs(30)));
        assert_eq!(duration("7"), Ok(Duration::from_secs(7)));
        assert_eq!(duration("250ms"), Ok(Duration::from_millis(250)));
        assert!(duration("soon").is_err());
        assert!(duration("5 fortnights").is_err());
        assert!(duration("99999999999999999999h").is_err());
    }
}
