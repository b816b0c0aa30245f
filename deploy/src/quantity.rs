//! Durations and sizes as people write them: a number and a unit.

use ictus_core::Duration;

/// Units of time in nanoseconds, as Lingua Franca knows them.
const TIME: &[(&str, i64)] = &[
    ("ns", 1),
    ("nsec", 1),
    ("us", 1_000),
    ("usec", 1_000),
    ("ms", 1_000_000),
    ("msec", 1_000_000),
    ("s", 1_000_000_000),
    ("sec", 1_000_000_000),
    ("min", 60_000_000_000),
    ("h", 3_600_000_000_000),
];

/// Units of size in bytes.
const SIZE: &[(&str, i64)] = &[
    ("B", 1),
    ("kB", 1_000),
    ("KiB", 1 << 10),
    ("MB", 1_000_000),
    ("MiB", 1 << 20),
    ("GB", 1_000_000_000),
    ("GiB", 1 << 30),
];

/// Why a text is not a quantity.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum QuantityError {
    /// A number alone.
    #[error("`{0}` has no unit")]
    NoUnit(String),
    /// The text does not start with a number.
    #[error("`{0}` is not a number with a unit")]
    NoNumber(String),
    /// The unit is not known.
    #[error("unknown unit `{0}`")]
    UnknownUnit(String),
    /// More digits than the smallest unit can show, or beyond 64 bits.
    #[error("`{0}` cannot be represented exactly")]
    Inexact(String),
}

/// Reads a duration such as `10 ms`, `1.5 s`, `0 s`. Never negative.
pub(crate) fn duration(text: &str) -> Result<Duration, QuantityError> {
    parse(text, TIME).map(Duration::from_nanos)
}

/// Reads a duration that may have a sign: `-50 ms`.
pub(crate) fn signed_duration(text: &str) -> Result<Duration, QuantityError> {
    let text = text.trim();
    let (sign, rest) = match text.strip_prefix('-') {
        Some(rest) => (-1, rest),
        None => (1, text.strip_prefix('+').unwrap_or(text)),
    };
    parse(rest, TIME).map(|nanos| Duration::from_nanos(sign * nanos))
}

/// Reads a size in bytes such as `10 MiB`.
pub(crate) fn size(text: &str) -> Result<u64, QuantityError> {
    parse(text, SIZE).map(i64::unsigned_abs)
}

fn parse(text: &str, units: &[(&str, i64)]) -> Result<i64, QuantityError> {
    let text = text.trim();
    let split = text
        .find(|c: char| !c.is_ascii_digit() && c != '.')
        .unwrap_or(text.len());
    let (number, unit) = (text[..split].trim(), text[split..].trim());
    let (whole, fraction) = number.split_once('.').unwrap_or((number, ""));
    if whole.is_empty() || fraction.contains('.') {
        return Err(QuantityError::NoNumber(text.to_owned()));
    }
    if unit.is_empty() {
        return Err(QuantityError::NoUnit(text.to_owned()));
    }
    let Some(&(_, scale)) = units.iter().find(|(name, _)| *name == unit) else {
        return Err(QuantityError::UnknownUnit(unit.to_owned()));
    };
    exact(whole, fraction, scale).ok_or_else(|| QuantityError::Inexact(text.to_owned()))
}

/// `whole.fraction * scale`, when that is an integer of 63 bits.
fn exact(whole: &str, fraction: &str, scale: i64) -> Option<i64> {
    let fraction = fraction.trim_end_matches('0');
    let mut divisor: i128 = 1;
    for _ in fraction.bytes() {
        divisor = divisor.checked_mul(10)?;
    }
    let digits: i128 = format!("{whole}{fraction}").parse().ok()?;
    let product = digits.checked_mul(i128::from(scale))?;
    (product % divisor == 0)
        .then(|| i64::try_from(product / divisor).ok())
        .flatten()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantities() {
        let nanos = |text: &str| {
            duration(text)
                .map(Duration::as_nanos)
                .map_err(|e| e.to_string())
        };
        assert_eq!(nanos("10 ms"), Ok(10_000_000));
        assert_eq!(nanos("1.5s"), Ok(1_500_000_000));
        assert_eq!(nanos("0 s"), Ok(0));
        assert_eq!(nanos("10"), Err("`10` has no unit".into()));
        assert_eq!(nanos("ms"), Err("`ms` is not a number with a unit".into()));
        assert_eq!(
            nanos("-1 ms"),
            Err("`-1 ms` is not a number with a unit".into())
        );
        assert_eq!(nanos("3 parsecs"), Err("unknown unit `parsecs`".into()));
        assert_eq!(
            nanos("0.5 ns"),
            Err("`0.5 ns` cannot be represented exactly".into())
        );
        assert_eq!(
            nanos("99999999999 h"),
            Err("`99999999999 h` cannot be represented exactly".into())
        );
        let signed = |text: &str| signed_duration(text).ok().map(Duration::as_nanos);
        assert_eq!(signed("-50 ms"), Some(-50_000_000));
        assert_eq!(signed("+1 ns"), Some(1));
        assert_eq!(signed("--1 ns"), None);
        assert_eq!(size("10 MiB"), Ok(10 << 20));
        assert_eq!(size("1.5 kB"), Ok(1500));
    }
}
