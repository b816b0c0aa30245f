//! What is wrong with a manifest: one [`Problem`] a mistake, with place, snippet and fix.

use std::fmt;
use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::document::{Node, Part, Site};

/// Mistakes beyond this many are only counted.
const MAX_PROBLEMS: usize = 200;
/// The widest piece of a line that a snippet shows, in characters.
const SNIPPET_WIDTH: usize = 96;

/// One mistake, at one place of the manifest.
///
/// Its `Display` is what a person reads:
/// ```text
/// federation.yaml:14:5: unknown key `clas` [F003]
///    |
/// 14 |     clas: A
///    |     ^^^^
/// fix: did you mean `class`?
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Problem {
    /// The stable code; [`explain`](crate::explain) tells more. `F...` are mistakes, `W...` warnings.
    pub code: &'static str,
    /// The manifest, as it was named.
    pub file: PathBuf,
    /// Line, from 1.
    pub line: u32,
    /// Column in characters, from 1.
    pub column: u32,
    /// Where in the document, such as `federates.camera.class`; empty for the document itself.
    pub path: String,
    /// What is wrong, lower-case, without full stop.
    pub message: String,
    /// The quoted line with a caret below; empty when the place is the whole file.
    pub snippet: String,
    /// What to do about it; empty when nothing better than the message is known.
    pub fix: String,
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            code,
            file,
            line,
            column,
            message,
            snippet,
            fix,
            path: _,
        } = self;
        write!(f, "{}:{line}:{column}: {message} [{code}]", file.display())?;
        if !snippet.is_empty() {
            write!(f, "\n{snippet}")?;
        }
        if !fix.is_empty() {
            write!(f, "\nfix: {fix}")?;
        }
        Ok(())
    }
}

/// Every mistake found in one manifest, in the order of its lines.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Problems(pub Vec<Problem>);

impl fmt::Display for Problems {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (position, problem) in self.0.iter().enumerate() {
            if position > 0 {
                writeln!(f, "\n")?;
            }
            write!(f, "{problem}")?;
        }
        Ok(())
    }
}

impl std::error::Error for Problems {}

/// Where a problem is.
#[derive(Clone, Debug)]
pub(crate) struct Place {
    path: Vec<String>,
    at: At,
}

#[derive(Clone, Copy, Debug)]
enum At {
    Part(Part),
    Site(Site),
}

impl Place {
    /// The key or the value that a path leads to.
    pub(crate) fn new<S: AsRef<str>>(path: &[S], part: Part) -> Self {
        Self {
            path: owned(path),
            at: At::Part(part),
        }
    }

    /// A key.
    pub(crate) fn key<S: AsRef<str>>(path: &[S]) -> Self {
        Self::new(path, Part::Key)
    }

    /// A value.
    pub(crate) fn value<S: AsRef<str>>(path: &[S]) -> Self {
        Self::new(path, Part::Value)
    }

    /// A place that the path alone does not find, such as the second of two equal keys.
    pub(crate) fn exact<S: AsRef<str>>(path: &[S], site: Site) -> Self {
        Self {
            path: owned(path),
            at: At::Site(site),
        }
    }
}

fn owned<S: AsRef<str>>(path: &[S]) -> Vec<String> {
    path.iter().map(|step| step.as_ref().to_owned()).collect()
}

/// Gathers problems and finds their places in the text.
#[derive(Debug)]
pub(crate) struct Report {
    file: PathBuf,
    lines: Vec<String>,
    root: Option<Node>,
    problems: Vec<Problem>,
    warnings: Vec<Problem>,
    /// Mistakes beyond the limit.
    dropped: usize,
}

impl Report {
    /// For a manifest's text; the tree comes later, when the text could be read.
    pub(crate) fn new(file: &Path, text: &str) -> Self {
        let lines = text.lines().map(printable).collect();
        let file = file.to_path_buf();
        Self {
            file,
            lines,
            root: None,
            problems: Vec::new(),
            warnings: Vec::new(),
            dropped: 0,
        }
    }

    /// The tree in which paths are looked up.
    pub(crate) fn set_root(&mut self, root: Node) {
        self.root = Some(root);
    }

    /// Adds a mistake.
    pub(crate) fn add(
        &mut self,
        code: &'static str,
        place: Place,
        message: impl Into<String>,
        fix: impl Into<String>,
    ) {
        if self.problems.len() >= MAX_PROBLEMS {
            self.dropped += 1;
            return;
        }
        let problem = self.problem(code, place, message.into(), fix.into());
        if !self.problems.contains(&problem) {
            self.problems.push(problem);
        }
    }

    /// Whether further mistakes are only counted, so that nothing need be said of them.
    pub(crate) fn is_full(&self) -> bool {
        self.problems.len() >= MAX_PROBLEMS
    }

    /// Adds a warning.
    pub(crate) fn warn(
        &mut self,
        code: &'static str,
        place: Place,
        message: impl Into<String>,
        fix: impl Into<String>,
    ) {
        if self.warnings.len() < MAX_PROBLEMS {
            let problem = self.problem(code, place, message.into(), fix.into());
            self.warnings.push(problem);
        }
    }

    /// The line of a place, for a message about another one.
    pub(crate) fn line<S: AsRef<str>>(&self, path: &[S]) -> u32 {
        self.root
            .as_ref()
            .map_or(1, |root| root.site_of(path, Part::Key).line)
    }

    /// Whether anything was reported at a path or below it.
    pub(crate) fn is_broken<S: AsRef<str>>(&self, path: &[S]) -> bool {
        let path = dotted(&owned(path));
        self.problems.iter().any(|problem| {
            problem
                .path
                .strip_prefix(&path)
                .is_some_and(|rest| rest.is_empty() || rest.starts_with(['.', '[']))
        })
    }

    /// The mistakes and the warnings, each in the order of the text.
    pub(crate) fn finish(mut self) -> (Problems, Vec<Problem>) {
        let order =
            |a: &Problem, b: &Problem| (a.line, a.column, a.code).cmp(&(b.line, b.column, b.code));
        self.problems.sort_by(order);
        self.warnings.sort_by(order);
        if self.dropped > 0 {
            let message = format!("{} more mistakes are not shown", self.dropped);
            let place = Place::exact::<&str>(&[], Site::default());
            self.problems
                .push(self.problem("F000", place, message, String::new()));
        }
        (Problems(self.problems), self.warnings)
    }

    fn problem(&self, code: &'static str, place: Place, message: String, fix: String) -> Problem {
        let site = match (place.at, &self.root) {
            (At::Site(site), _) => site,
            (At::Part(part), Some(root)) => root.site_of(&place.path, part),
            (At::Part(_), None) => Site::default(),
        };
        Problem {
            code,
            file: self.file.clone(),
            line: site.line.max(1),
            column: site.column.max(1),
            path: dotted(&place.path),
            message: one_line(&message),
            snippet: self.snippet(site),
            fix,
        }
    }

    /// The line of a site with carets below, cut to a readable width.
    fn snippet(&self, site: Site) -> String {
        let Some(row) = usize::try_from(site.line)
            .ok()
            .and_then(|line| line.checked_sub(1))
        else {
            return String::new();
        };
        let Some(line) = self.lines.get(row) else {
            return String::new();
        };
        let column = usize::try_from(site.column).unwrap_or(1).saturating_sub(1);
        let skip = column.saturating_sub(SNIPPET_WIDTH * 2 / 3);
        let shown: String = line.chars().skip(skip).take(SNIPPET_WIDTH).collect();
        let room = shown
            .trim_end()
            .chars()
            .count()
            .saturating_sub(column - skip)
            .max(1);
        let carets = usize::try_from(site.length).unwrap_or(1).clamp(1, room);
        let number = site.line.to_string();
        let margin = " ".repeat(number.len());
        let indent = " ".repeat(column - skip);
        let (shown, carets) = (shown.trim_end(), "^".repeat(carets));
        format!("{margin} |\n{number} | {shown}\n{margin} | {indent}{carets}")
    }
}

/// A path as people write it: `connections[0].from`.
fn dotted(path: &[String]) -> String {
    let mut text = String::new();
    for step in path {
        if step.bytes().all(|byte| byte.is_ascii_digit()) && !step.is_empty() {
            text.push_str(&format!("[{step}]"));
        } else {
            if !text.is_empty() {
                text.push('.');
            }
            text.push_str(step);
        }
    }
    printable(&text)
}

/// A line without control characters, so that a manifest cannot drive a terminal.
pub(crate) fn printable(line: &str) -> String {
    line.chars()
        .map(|c| if c.is_control() { ' ' } else { c })
        .collect()
}

/// A message whose lines, if several, are indented and printable.
fn one_line(message: &str) -> String {
    let lines: Vec<String> = message.lines().map(printable).collect();
    lines.join("\n    ")
}
