//! The only printer: results to standard output, everything else to standard error.

use std::io::{self, IsTerminal, Write};
use std::process::ExitCode;

use serde::Serialize;

use crate::args::{Global, Output};
use crate::error::{CliError, Kind};

/// What the user sees.
#[derive(Debug)]
pub(crate) struct Ui {
    output: Output,
    quiet: bool,
    screen: Screen,
    /// Whether the terminal's current line is a progress line that may be overwritten.
    unfinished: bool,
}

/// What standard error is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Screen {
    /// A file or a pipe: every line stays.
    None,
    /// A terminal, on which a line may be rewritten.
    Plain,
    /// One on which colours are welcome, too.
    Coloured,
}

/// Columns of text, aligned; the first row is the head.
#[derive(Debug, Default)]
pub(crate) struct Table(Vec<Vec<String>>);

impl Ui {
    pub(crate) fn new(global: Global) -> Self {
        let terminal = io::stderr().is_terminal();
        let plain = std::env::var_os("NO_COLOR").is_some_and(|value| !value.is_empty());
        Self {
            output: global.output,
            quiet: global.quiet,
            screen: match (terminal, plain) {
                (false, _) => Screen::None,
                (true, true) => Screen::Plain,
                (true, false) => Screen::Coloured,
            },
            unfinished: false,
        }
    }

    /// One that says nothing, for work within other work.
    pub(crate) fn silent() -> Self {
        Self {
            output: Output::Table,
            quiet: true,
            screen: Screen::None,
            unfinished: false,
        }
    }

    /// Whether results are for programs.
    pub(crate) fn json(&self) -> bool {
        self.output == Output::Json
    }

    /// Whether standard output is a terminal that can be cleared.
    pub(crate) fn can_redraw(&self) -> bool {
        io::stdout().is_terminal() && self.output == Output::Table
    }

    /// Prints a result: as one JSON value, or as text for people.
    pub(crate) fn result(
        &mut self,
        value: &impl Serialize,
        text: impl FnOnce() -> String,
    ) -> Result<(), CliError> {
        let text = if self.json() {
            serde_json::to_string(value).map_err(CliError::failed)?
        } else {
            text()
        };
        let text = text.trim_end();
        if text.is_empty() {
            Ok(())
        } else {
            self.print(text)
        }
    }

    /// Prints a line of results.
    pub(crate) fn print(&mut self, line: &str) -> Result<(), CliError> {
        self.finish_line();
        let mut out = io::stdout().lock();
        writeln!(out, "{line}")
            .and_then(|()| out.flush())
            .map_err(out_error)
    }

    /// Clears the terminal before a redraw.
    pub(crate) fn clear(&mut self) -> Result<(), CliError> {
        let mut out = io::stdout().lock();
        write!(out, "\x1b[H\x1b[2J").map_err(out_error)
    }

    /// Says that a stage is reached: one line that stays.
    pub(crate) fn stage(&mut self, stage: &str, detail: &str) {
        if !self.quiet {
            self.err(&format!("{stage:<10} {detail}"), true);
        }
    }

    /// Says how far a stage is: on a terminal the next line overwrites it, elsewhere it is not printed.
    pub(crate) fn progress(&mut self, stage: &str, detail: &str) {
        if !self.quiet && self.screen != Screen::None {
            self.err(&format!("{stage:<10} {detail}"), false);
        }
    }

    /// Says how many federates have reached a stage, once and for all when everybody has; tells whether that is so.
    pub(crate) fn counted(&mut self, stage: &str, reached: usize, of: usize) -> bool {
        let detail = format!("{reached}/{of} federates");
        let all = reached >= of;
        if all {
            self.stage(stage, &detail);
        } else {
            self.progress(stage, &detail);
        }
        all
    }

    /// Says something.
    pub(crate) fn message(&mut self, text: &str) {
        if !self.quiet {
            self.err(text, true);
        }
    }

    /// Says what may be wrong.
    pub(crate) fn warning(&mut self, text: &str) {
        let label = self.paint("warning:", "33");
        self.err(&format!("{label} {text}"), true);
    }

    /// Says why a command failed and gives its exit code.
    pub(crate) fn fail(&mut self, error: &CliError) -> ExitCode {
        if !matches!(error.kind, Kind::BrokenPipe | Kind::Changes) {
            let label = self.paint("error:", "31");
            self.err(&format!("{label} {error}"), true);
            for hint in &error.hints {
                self.err(&format!("hint: {hint}"), true);
            }
        }
        ExitCode::from(error.code())
    }

    fn paint(&self, text: &str, colour: &str) -> String {
        if self.screen == Screen::Coloured {
            format!("\x1b[1;{colour}m{text}\x1b[0m")
        } else {
            text.to_owned()
        }
    }

    fn err(&mut self, text: &str, finished: bool) {
        let clear = if self.unfinished { "\r\x1b[2K" } else { "" };
        let end = if finished { "\n" } else { "" };
        self.unfinished = !finished;
        // Nobody reads it: there is nobody to tell either.
        write!(io::stderr(), "{clear}{text}{end}").ok();
    }

    fn finish_line(&mut self) {
        if self.unfinished {
            self.unfinished = false;
            write!(io::stderr(), "\r\x1b[2K").ok();
        }
    }
}

impl Table {
    pub(crate) fn new(head: &[&str]) -> Self {
        Self(vec![head.iter().map(|cell| (*cell).to_owned()).collect()])
    }

    pub(crate) fn row(&mut self, cells: impl IntoIterator<Item = String>) {
        self.0.push(cells.into_iter().collect());
    }

    /// The rows with columns aligned: numbers to the right, everything else to the left.
    pub(crate) fn text(&self) -> String {
        let columns = self.0.iter().map(Vec::len).max().unwrap_or(0);
        let width = |column: usize| {
            self.0
                .iter()
                .filter_map(|row| row.get(column))
                .map(|it| it.chars().count())
                .max()
        };
        let widths: Vec<_> = (0..columns)
            .map(|column| width(column).unwrap_or(0))
            .collect();
        let numeric: Vec<_> = (0..columns)
            .map(|column| {
                let cells = self.0.iter().skip(1).filter_map(|row| row.get(column));
                cells.clone().count() > 0 && cells.into_iter().all(|cell| is_number(cell))
            })
            .collect();
        let line = |row: &Vec<String>| {
            let cells = row
                .iter()
                .zip(&widths)
                .zip(&numeric)
                .map(|((cell, &width), &numeric)| {
                    if numeric {
                        format!("{cell:>width$}")
                    } else {
                        format!("{cell:<width$}")
                    }
                });
            cells.collect::<Vec<_>>().join("  ").trim_end().to_owned()
        };
        self.0.iter().map(line).collect::<Vec<_>>().join("\n")
    }
}

fn is_number(cell: &str) -> bool {
    cell == "-"
        || cell
            .chars()
            .next()
            .is_some_and(|first| first.is_ascii_digit())
}

fn out_error(error: io::Error) -> CliError {
    let gone = error.kind() == io::ErrorKind::BrokenPipe;
    let kind = if gone { Kind::BrokenPipe } else { Kind::Failed };
    CliError::new(kind, error)
}

/// A text from elsewhere on one line: control characters escaped, cut where nobody reads on.
pub(crate) fn one_line(text: &str) -> String {
    const LONGEST: usize = 160;
    let mut line = String::new();
    for (index, part) in text
        .lines()
        .filter(|part| !part.trim().is_empty())
        .enumerate()
    {
        line.push_str(if index == 0 { "" } else { " / " });
        for c in part.trim().chars() {
            if c.is_control() {
                line.extend(c.escape_default());
            } else {
                line.push(c);
            }
        }
    }
    match line.char_indices().nth(LONGEST) {
        Some((end, _)) => format!("{}...", &line[..end]),
        None => line,
    }
}

/// Writes nanoseconds as people read them: `1.234 s`, `12.3 ms`.
pub(crate) fn nanoseconds(ns: i64) -> String {
    let magnitude = ns.unsigned_abs();
    let (unit, divisor) = match magnitude {
        0 => return "0 s".to_owned(),
        1..1_000 => return format!("{ns} ns"),
        1_000..1_000_000 => ("us", 1_000),
        1_000_000..1_000_000_000 => ("ms", 1_000_000),
        _ => ("s", 1_000_000_000),
    };
    let sign = if ns < 0 { "-" } else { "" };
    let (whole, rest) = (magnitude / divisor, magnitude % divisor * 1000 / divisor);
    format!("{sign}{whole}.{rest:03} {unit}")
}

#[cfg(test)]
mod tests {
    use super::{Table, nanoseconds, one_line};

    #[test]
    fn what_programs_say_stays_on_one_line() {
        assert_eq!(
            one_line("three\nlines\n\n of\u{1b}it"),
            "three / lines / of\\u{1b}it"
        );
        assert_eq!(one_line(&"x".repeat(500)).len(), 163);
    }

    #[test]
    fn columns_are_aligned() {
        let mut table = Table::new(&["NAME", "TAGS"]);
        table.row(["a".to_owned(), "10".to_owned()]);
        table.row(["longer".to_owned(), "-".to_owned()]);
        assert_eq!(table.text(), "NAME    TAGS\na         10\nlonger     -");
    }

    #[test]
    fn times_are_readable() {
        assert_eq!(nanoseconds(1_234_567_890), "1.234 s");
        assert_eq!(nanoseconds(-12_300_000), "-12.300 ms");
        assert_eq!(nanoseconds(999), "999 ns");
    }
}
