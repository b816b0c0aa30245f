//! Durations as text: `100 ms`, `1.5 s`, `0`.

use super::Duration;
use std::str::FromStr;
use thiserror::Error;

/// Why a text is not a duration.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error(
    "`{text}` is not a duration; write a number and a unit: ns, us, ms, s, min or h, such as `100 ms`"
)]
pub struct ParseDurationError {
    /// The text.
    pub text: String,
}

const UNITS: [(&str, i64); 6] = [
    ("ns", 1),
    ("us", 1_000),
    ("ms", 1_000_000),
    ("s", 1_000_000_000),
    ("min", 60_000_000_000),
    ("h", 3_600_000_000_000),
];

impl FromStr for Duration {
    type Err = ParseDurationError;

    /// Reads a number, whole or decimal, and a unit; only `0` may go without. Nothing finer than a nanosecond.
    fn from_str(text: &str) -> Result<Self, ParseDurationError> {
        parse(text.trim()).ok_or_else(|| ParseDurationError {
            text: text.to_owned(),
        })
    }
}

fn parse(text: &str) -> Option<Duration> {
    if text == "0" {
        return Some(Duration::ZERO);
    }
    let (negative, text) = text.strip_prefix('-').map_or((false, text), |t| (true, t));
    let end = text.find(|c: char| !c.is_ascii_digit() && c != '.')?;
    let (number, unit) = text.split_at(end);
    let (_, scale) = UNITS.iter().find(|(name, _)| *name == unit.trim_start())?;
    let (whole, fraction) = number.split_once('.').unwrap_or((number, ""));
    let mut nanos = whole.parse::<i64>().ok()?.checked_mul(*scale)?;
    let mut scale = *scale;
    for digit in fraction.bytes() {
        if scale % 10 != 0 {
            return None;
        }
        scale /= 10;
        nanos = nanos.checked_add(i64::from(digit.checked_sub(b'0')?) * scale)?;
    }
    Some(Duration::from_nanos(if negative { -nanos } else { nanos }))
}

#[cfg(feature = "serde")]
impl serde::Serialize for Duration {
    /// As text where the format is for people, else as nanoseconds.
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        if serializer.is_human_readable() {
            serializer.collect_str(self)
        } else {
            serializer.serialize_i64(self.as_nanos())
        }
    }
}

#[cfg(feature = "serde")]
impl<'de> serde::Deserialize<'de> for Duration {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        if deserializer.is_human_readable() {
            deserializer.deserialize_str(TextVisitor)
        } else {
            i64::deserialize(deserializer).map(Self::from_nanos)
        }
    }
}

#[cfg(feature = "serde")]
struct TextVisitor;

#[cfg(feature = "serde")]
impl serde::de::Visitor<'_> for TextVisitor {
    type Value = Duration;

    fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("a duration with a unit, such as \"100 ms\"")
    }

    fn visit_str<E: serde::de::Error>(self, text: &str) -> Result<Duration, E> {
        text.parse().map_err(E::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn durations_are_numbers_with_units() {
        let table = [
            ("0", Some(0)),
            ("100 ms", Some(100_000_000)),
            ("100ms", Some(100_000_000)),
            ("1.5 s", Some(1_500_000_000)),
            ("0.2 ms", Some(200_000)),
            ("-3 us", Some(-3_000)),
            ("2 min", Some(120_000_000_000)),
            ("100", None),
            ("0.5 ns", None),
            ("ms", None),
            ("1 fortnight", None),
            ("", None),
            ("9999999999 h", None),
        ];
        for (text, expected) in table {
            let parsed = text.parse::<Duration>().ok().map(Duration::as_nanos);
            assert_eq!(parsed, expected, "{text}");
        }
    }

    proptest! {
        #[test]
        fn display_is_read_back(nanos in -i64::MAX..i64::MAX) {
            let duration = Duration::from_nanos(nanos);
            prop_assert_eq!(duration.to_string().parse(), Ok(duration));
        }
    }
}
