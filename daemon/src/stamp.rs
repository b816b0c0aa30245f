//! Physical time as the daemon writes it: nanoseconds since the Unix epoch, and UTC text that sorts.

use std::time::{SystemTime, UNIX_EPOCH};

const NS_PER_SECOND: i64 = 1_000_000_000;
const SECONDS_PER_DAY: i64 = 86_400;

/// Reads the host's clock: nanoseconds since the Unix epoch; saturates in the year 2262.
#[must_use]
pub fn now_ns() -> i64 {
    SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .map_or(0, |since| {
            i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)
        })
}

/// Writes a time as `2026-11-22T03:14:07.123456Z`: UTC, microseconds, always 27 characters.
///
/// Law: for times from the year 1 to 9999, text order is time order. Times before 1970 are allowed.
#[must_use]
pub fn text(ns: i64) -> String {
    let seconds = ns.div_euclid(NS_PER_SECOND);
    let micros = ns.rem_euclid(NS_PER_SECOND) / 1000;
    let (year, month, day) = civil(seconds.div_euclid(SECONDS_PER_DAY));
    let second_of_day = seconds.rem_euclid(SECONDS_PER_DAY);
    let (hour, minute, second) = (
        second_of_day / 3600,
        second_of_day / 60 % 60,
        second_of_day % 60,
    );
    format!("{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}.{micros:06}Z")
}

/// Reads what [`text`] writes; absent for anything else.
#[must_use]
pub fn parse(text: &str) -> Option<i64> {
    let bytes = text.as_bytes();
    if bytes.len() != 27 || !text.is_ascii() || bytes[26] != b'Z' {
        return None;
    }
    let marks = [
        (4, b'-'),
        (7, b'-'),
        (10, b'T'),
        (13, b':'),
        (16, b':'),
        (19, b'.'),
    ];
    if marks.iter().any(|&(at, mark)| bytes[at] != mark) {
        return None;
    }
    let number = |from: usize, to: usize| text[from..to].parse::<i64>().ok().filter(|n| *n >= 0);
    let day = days(number(0, 4)?, number(5, 7)?, number(8, 10)?);
    let second = number(11, 13)? * 3600 + number(14, 16)? * 60 + number(17, 19)?;
    (day * SECONDS_PER_DAY + second)
        .checked_mul(NS_PER_SECOND)?
        .checked_add(number(20, 26)? * 1000)
}

/// The proleptic Gregorian date of a day count since 1970-01-01.
/// Source: Howard Hinnant, "chrono-compatible low-level date algorithms", `civil_from_days`.
fn civil(days: i64) -> (i64, i64, i64) {
    let shifted = days + 719_468;
    let era = shifted.div_euclid(146_097);
    let day_of_era = shifted.rem_euclid(146_097);
    let year_of_era =
        (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let month_from_march = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * month_from_march + 2) / 5 + 1;
    let month = if month_from_march < 10 {
        month_from_march + 3
    } else {
        month_from_march - 9
    };
    (year_of_era + era * 400 + i64::from(month <= 2), month, day)
}

/// The inverse of [`civil`].
fn days(year: i64, month: i64, day: i64) -> i64 {
    let year = year - i64::from(month <= 2);
    let era = year.div_euclid(400);
    let year_of_era = year.rem_euclid(400);
    let month_from_march = if month > 2 { month - 3 } else { month + 9 };
    let day_of_year = (153 * month_from_march + 2) / 5 + day - 1;
    let day_of_era = year_of_era * 365 + year_of_era / 4 - year_of_era / 100 + day_of_year;
    era * 146_097 + day_of_era - 719_468
}

#[cfg(test)]
mod tests {
    use super::{parse, text};

    #[test]
    fn text_is_utc() {
        assert_eq!(text(0), "1970-01-01T00:00:00.000000Z");
        assert_eq!(text(951_782_400_123_456_789), "2000-02-29T00:00:00.123456Z");
        assert_eq!(
            text(1_795_317_247_000_001_000),
            "2026-11-22T03:14:07.000001Z"
        );
    }

    #[test]
    fn parse_reads_what_text_writes() {
        for ns in [0, 1_000, 951_782_400_123_456_000, 4_102_444_799_999_999_000] {
            assert_eq!(parse(&text(ns)), Some(ns));
        }
        assert_eq!(parse("2026-11-22 03:14:07.000001Z"), None);
        assert_eq!(parse("2026-11-22T-3:14:07.000001Z"), None);
    }
}
