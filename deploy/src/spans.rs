//! What is wrong with a duration at a key of the manifest, and how to mend it.

use crate::quantity;

/// The longest offset, and the longest term of one, in nanoseconds: an hour.
pub(crate) const LONGEST_NS: i64 = 3_600_000_000_000;

/// How long a host may be silent, in nanoseconds: kernels ask once a second at most.
const FAILURE_NS: std::ops::RangeInclusive<i64> = 1_000_000_000..=LONGEST_NS;

/// What people write for a time without end.
const INFINITE: [&str; 5] = ["forever", "inf", "infinite", "infinity", "never"];

/// Keys whose value is an offset or a term of one.
const TERMS: [&str; 5] = [
    "stp_offset",
    "absent_after",
    "launch_lag",
    "latency",
    "clock_error",
];

/// Whether a text is a duration of this format that its key can have; else what is wrong and what to write.
pub(crate) fn check(key: &str, text: &str, format: &str) -> Result<(), (String, String)> {
    let text = text.trim();
    let auto = format == "ictus-offset";
    if auto && text == "auto" {
        return Ok(());
    }
    let offset = key == "stp_offset";
    let what = if offset {
        "an offset".to_owned()
    } else {
        format!("`{key}`")
    };
    let fix = match (offset, auto) {
        (true, true) => "write it as `5 ms`, or `auto` to have it solved from the bounds",
        (true, false) => "write it as `5 ms`, or leave it out: auto",
        (false, _) => "write it as `10 ms`; units are ns, us, ms, s, min, h",
    };
    let read = match format {
        "ictus-signed-duration" => quantity::signed_duration(text),
        _ => quantity::duration(text),
    };
    let error = match read {
        Ok(span) if TERMS.contains(&key) && span.as_nanos() > LONGEST_NS => {
            return Err((format!("{what} is at most 1 h: `{text}`"), fix.to_owned()));
        }
        Ok(span) if key == "failure_timeout" && !FAILURE_NS.contains(&span.as_nanos()) => {
            let message = format!("`failure_timeout` is at least 1 s and at most 1 h: `{text}`");
            return Err((message, "write it as `10 s`".to_owned()));
        }
        Ok(_) => return Ok(()),
        Err(error) => error,
    };
    let bare = text.trim_start_matches(['+', '-']);
    let infinite = INFINITE.contains(&bare.to_lowercase().trim_start_matches('.'));
    if offset && text == "auto" {
        let message = "the offset of a connection is a duration: `auto`".to_owned();
        return Err((message, "leave it out: auto".to_owned()));
    }
    if infinite {
        let why = match TERMS.contains(&key) {
            true => format!(": with `{text}`, one lost message would stop everything"),
            false => format!(": `{text}`"),
        };
        let fix = match key {
            "timeout" => "leave it out to run without end",
            _ => fix,
        };
        return Err((format!("{what} is finite{why}"), fix.to_owned()));
    }
    if let Some(rest) = text.strip_prefix('+').filter(|rest| is_span(rest)) {
        let rest = rest.trim();
        return Err((
            format!("{what} has no sign: `{text}`"),
            format!("write `{rest}`"),
        ));
    }
    if text.starts_with('-') && (is_span(bare) || bare.parse::<f64>().is_ok()) {
        return Err((format!("{what} is not negative: `{text}`"), fix.to_owned()));
    }
    let general = offset && !text.starts_with(|c: char| c.is_ascii_digit());
    Err((
        error.to_string(),
        if general {
            fix.to_owned()
        } else {
            self::fix(text)
        },
    ))
}

/// What to write for a number without a unit, or with a wrong one.
pub(crate) fn fix(text: &str) -> String {
    let number: String = text
        .trim()
        .chars()
        .take_while(|c| c.is_ascii_digit() || *c == '.')
        .collect();
    if !is_span(&format!("{number} ms")) {
        return "write it as `10 ms`; units are ns, us, ms, s, min, h".to_owned();
    }
    format!("write `{number} ms` or `{number} s`; units are ns, us, ms, s, min, h")
}

fn is_span(text: &str) -> bool {
    quantity::duration(text).is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Key, text, format; what is said and what is offered, `-` for nothing.
    const TABLE: &str = "\
stp_offset | auto | ictus-offset | - | -
stp_offset | 1 h | ictus-offset | - | -
stp_offset | 3601 s | ictus-offset | an offset is at most 1 h: `3601 s` | write it as `5 ms`, or `auto` to have it solved from the bounds
stp_offset | 2 h | ictus-duration | an offset is at most 1 h: `2 h` | write it as `5 ms`, or leave it out: auto
stp_offset | auto | ictus-duration | the offset of a connection is a duration: `auto` | leave it out: auto
stp_offset | .inf | ictus-duration | an offset is finite: with `.inf`, one lost message would stop everything | write it as `5 ms`, or leave it out: auto
stp_offset | +5 ms | ictus-duration | an offset has no sign: `+5 ms` | write `5 ms`
stp_offset | +5 ms | ictus-offset | an offset has no sign: `+5 ms` | write `5 ms`
latency | .inf | ictus-duration | `latency` is finite: with `.inf`, one lost message would stop everything | write it as `10 ms`; units are ns, us, ms, s, min, h
latency | 2 h | ictus-duration | `latency` is at most 1 h: `2 h` | write it as `10 ms`; units are ns, us, ms, s, min, h
absent_after | -1 ms | ictus-duration | `absent_after` is not negative: `-1 ms` | write it as `10 ms`; units are ns, us, ms, s, min, h
after | -1 ms | ictus-duration | `after` is not negative: `-1 ms` | write it as `10 ms`; units are ns, us, ms, s, min, h
after | -1 | ictus-duration | `after` is not negative: `-1` | write it as `10 ms`; units are ns, us, ms, s, min, h
after | 2 h | ictus-duration | - | -
after | . | ictus-duration | `.` is not a number with a unit | write it as `10 ms`; units are ns, us, ms, s, min, h
after | 1.2.3 | ictus-duration | `1.2.3` is not a number with a unit | write it as `10 ms`; units are ns, us, ms, s, min, h
timeout | forever | ictus-duration | `timeout` is finite: `forever` | leave it out to run without end
failure_timeout | 1 s | ictus-duration | - | -
failure_timeout | 999 ms | ictus-duration | `failure_timeout` is at least 1 s and at most 1 h: `999 ms` | write it as `10 s`
failure_timeout | 61 min | ictus-duration | `failure_timeout` is at least 1 s and at most 1 h: `61 min` | write it as `10 s`
test_offset | -5 ms | ictus-signed-duration | - | -
";

    #[test]
    fn texts() {
        for line in TABLE.lines() {
            let cells: Vec<&str> = line.split(" | ").collect();
            let [key, text, format, message, fix] = cells.as_slice() else {
                panic!("{line}")
            };
            let said = check(key, text, format);
            let (said, offered) = said.err().unwrap_or(("-".to_owned(), "-".to_owned()));
            assert_eq!(
                (said.as_str(), offered.as_str()),
                (*message, *fix),
                "{line}"
            );
        }
    }
}
