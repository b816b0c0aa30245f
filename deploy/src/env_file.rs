//! Files of environment variables: lines `KEY=VALUE`, values quoted or not, comments after `#`.
//!
//! A value may be secret, so no message shows one.

use std::collections::BTreeMap;

/// What is wrong with a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum LineFault {
    /// The line has no `=`.
    #[error("the line is not `KEY=VALUE`")]
    NoValue,
    /// It is meant for a shell.
    #[error("`export` belongs to a shell: remove it")]
    Export,
    /// What stands before `=` cannot be a variable.
    #[error("before `=` there is a letter or `_`, then letters, digits and `_`, without spaces")]
    Name,
    /// The key was there before.
    #[error("the key stands already in line {0}")]
    Twice(usize),
    /// A quote is not closed in its line.
    #[error("the value begins with a quote that is not closed in this line")]
    Open,
    /// Something follows the closing quote.
    #[error("after the closing quote there is only a comment")]
    After,
    /// A backslash in double quotes that means nothing.
    #[error("in double quotes, a backslash stands before one of `n`, `r`, `t`, `\"`, `\\` and `$`")]
    Escape,
    /// A zero byte, which no environment can hold.
    #[error("the value has a character of code 0")]
    Zero,
}

/// Reads a file's text: the variables, and each wrong line with its number from 1.
pub(crate) fn parse(text: &str) -> (BTreeMap<String, String>, Vec<(usize, LineFault)>) {
    let mut variables = BTreeMap::new();
    let mut lines: BTreeMap<&str, usize> = BTreeMap::new();
    let mut faults = Vec::new();
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    for (number, line) in (1..).zip(text.lines()) {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        match entry(line) {
            Ok((key, value)) => match lines.insert(key, number) {
                Some(before) => faults.push((number, LineFault::Twice(before))),
                None => drop(variables.insert(key.to_owned(), value)),
            },
            Err(fault) => faults.push((number, fault)),
        }
    }
    (variables, faults)
}

/// Whether a text can be the name of an environment variable.
pub(crate) fn is_variable(text: &str) -> bool {
    let letter = |byte: u8| byte.is_ascii_alphabetic() || byte == b'_';
    text.bytes().next().is_some_and(letter)
        && text
            .bytes()
            .all(|byte| letter(byte) || byte.is_ascii_digit())
}

fn entry(line: &str) -> Result<(&str, String), LineFault> {
    let (key, value) = line.split_once('=').ok_or(LineFault::NoValue)?;
    if key.starts_with("export ") {
        return Err(LineFault::Export);
    }
    if !is_variable(key) {
        return Err(LineFault::Name);
    }
    let value = value.trim_start();
    let value = match value.chars().next() {
        Some('\'') => single(&value[1..])?,
        Some('"') => double(&value[1..])?,
        Some(_) | None => bare(value).to_owned(),
    };
    if value.contains('\0') {
        return Err(LineFault::Zero);
    }
    Ok((key, value))
}

/// A value without quotes: up to a `#` at its beginning or after a space.
fn bare(text: &str) -> &str {
    let comment = |(at, c): &(usize, char)| {
        *c == '#' && (*at == 0 || text[..*at].ends_with(char::is_whitespace))
    };
    let end = text.char_indices().find(comment);
    text[..end.map_or(text.len(), |(at, _)| at)].trim_end()
}

/// A value in single quotes, after the first: every character is itself.
fn single(text: &str) -> Result<String, LineFault> {
    let (value, after) = text.split_once('\'').ok_or(LineFault::Open)?;
    only_comment(after)?;
    Ok(value.to_owned())
}

/// A value in double quotes, after the first.
fn double(text: &str) -> Result<String, LineFault> {
    let mut value = String::new();
    let mut chars = text.chars();
    loop {
        let c = match chars.next().ok_or(LineFault::Open)? {
            '"' => break,
            '\\' => match chars.next().ok_or(LineFault::Open)? {
                'n' => '\n',
                'r' => '\r',
                't' => '\t',
                c @ ('"' | '\\' | '$') => c,
                _ => return Err(LineFault::Escape),
            },
            c => c,
        };
        value.push(c);
    }
    only_comment(chars.as_str())?;
    Ok(value)
}

fn only_comment(after: &str) -> Result<(), LineFault> {
    let rest = after.trim_start();
    match rest.is_empty() || (rest.starts_with('#') && rest.len() < after.len()) {
        true => Ok(()),
        false => Err(LineFault::After),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Line, then the value or what is wrong.
    const TABLE: &[(&str, Result<&str, LineFault>)] = &[
        ("A=1", Ok("1")),
        ("  A=1  ", Ok("1")),
        ("A=", Ok("")),
        ("A= b c ", Ok("b c")),
        ("A=b=c", Ok("b=c")),
        ("A=b # c", Ok("b")),
        ("A=b#c", Ok("b#c")),
        ("A=#c", Ok("")),
        ("A=$HOME `id`", Ok("$HOME `id`")),
        ("A='b # \\n'", Ok("b # \\n")),
        ("A='b' # c", Ok("b")),
        ("A=\"b\\n\\\"c\\\" \\$d\" # e", Ok("b\n\"c\" $d")),
        ("A=it's", Ok("it's")),
        ("A", Err(LineFault::NoValue)),
        ("export A=1", Err(LineFault::Export)),
        ("A =1", Err(LineFault::Name)),
        ("1A=1", Err(LineFault::Name)),
        ("A-B=1", Err(LineFault::Name)),
        ("=1", Err(LineFault::Name)),
        ("A='b", Err(LineFault::Open)),
        ("A=\"b", Err(LineFault::Open)),
        ("A=\"b\\", Err(LineFault::Open)),
        ("A='b'c", Err(LineFault::After)),
        ("A='b'#c", Err(LineFault::After)),
        ("A=\"b\\x\"", Err(LineFault::Escape)),
        ("A=b\0c", Err(LineFault::Zero)),
    ];

    #[test]
    fn lines() {
        for (line, expected) in TABLE {
            let (variables, faults) = parse(&format!("# a comment\n\n{line}\r\n"));
            let read = match faults.as_slice() {
                [] => Ok(variables["A"].as_str()),
                [(3, fault)] => Err(*fault),
                other => panic!("{line:?}: {other:?}"),
            };
            assert_eq!(read, *expected, "{line:?}");
        }
        let (variables, faults) = parse("\u{feff}A=1\nB=2\nA=3\n");
        assert_eq!(variables["A"], "1");
        assert_eq!(faults, [(3, LineFault::Twice(1))]);
    }

    proptest! {
        /// Any text is read or refused line by line, and no refusal shows what stands there.
        #[test]
        fn any_text_is_read(text in "[A-Za-z_= \"'\\\\#\n\r\u{e9}-]{0,200}") {
            let (variables, faults) = parse(&text);
            prop_assert!(variables.len() + faults.len() <= text.lines().count());
            prop_assert!(variables.keys().all(|key| is_variable(key)));
        }

        /// What is written in double quotes with escapes comes back.
        #[test]
        fn quoted_values_come_back(value in "[ -~\n\t]{0,40}") {
            let quoted = value.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n");
            let (variables, faults) = parse(&format!("A=\"{quoted}\"\n"));
            prop_assert_eq!(faults, []);
            prop_assert_eq!(&variables["A"], &value);
        }
    }
}
