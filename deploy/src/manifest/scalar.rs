//! What stands at the leaves of a manifest: texts with a form of their own, words, and mappings from names.

use std::fmt;
use std::marker::PhantomData;
use std::net::SocketAddr;

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::{Deserializer, MapAccess, Visitor};
use serde::{Deserialize, Serialize};

use crate::quantity;

/// One text or a list of them.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(untagged)]
#[schemars(inline)]
pub(crate) enum OneOrMany {
    /// One.
    One(String),
    /// Several.
    Many(Vec<String>),
}

impl OneOrMany {
    /// The texts.
    pub(crate) fn as_slice(&self) -> &[String] {
        match self {
            Self::One(one) => std::slice::from_ref(one),
            Self::Many(many) => many,
        }
    }

    /// Whether it was written as a list.
    pub(crate) fn is_list(&self) -> bool {
        matches!(self, Self::Many(_))
    }
}

/// A text, number or boolean, as a text.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(untagged)]
#[schemars(inline)]
pub(crate) enum Scalar {
    /// A boolean.
    Bool(bool),
    /// An integer.
    Integer(i64),
    /// A number.
    Number(f64),
    /// A text.
    Text(String),
}

impl fmt::Display for Scalar {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Bool(value) => value.fmt(f),
            Self::Integer(value) => value.fmt(f),
            Self::Number(value) => value.fmt(f),
            Self::Text(value) => value.fmt(f),
        }
    }
}

/// A TCP port, or `auto`.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(untagged)]
#[schemars(inline)]
pub(crate) enum Port {
    /// This one.
    Number(#[schemars(range(min = 1, max = 65535))] u16),
    /// `auto`.
    Word(AutoWord),
}

/// The word `auto`.
#[derive(Clone, Copy, Debug, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
#[schemars(inline)]
pub(crate) enum AutoWord {
    /// Any free one.
    Auto,
}

/// The word `count`.
#[derive(Clone, Copy, Debug, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
#[schemars(inline)]
pub(crate) enum CountWord {
    /// Counted, and nothing else.
    Count,
}

/// A mapping from names, in the order of the text.
#[derive(Clone, Debug)]
pub(crate) struct Named<T>(pub(crate) Vec<(String, T)>);

impl<T> Default for Named<T> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<T> Named<T> {
    /// The value of a name.
    pub(crate) fn get(&self, name: &str) -> Option<&T> {
        self.0
            .iter()
            .find(|(have, _)| have == name)
            .map(|(_, value)| value)
    }

    /// The names.
    pub(crate) fn names(&self) -> impl Iterator<Item = &str> {
        self.0.iter().map(|(name, _)| name.as_str())
    }

    /// Whether there is none.
    pub(crate) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}

impl<'de, T: Deserialize<'de>> Deserialize<'de> for Named<T> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct NamedVisitor<T>(PhantomData<T>);
        impl<'de, T: Deserialize<'de>> Visitor<'de> for NamedVisitor<T> {
            type Value = Named<T>;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a mapping")
            }
            fn visit_unit<E>(self) -> Result<Named<T>, E> {
                Ok(Named::default())
            }
            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Named<T>, A::Error> {
                let mut entries = Vec::new();
                while let Some(entry) = map.next_entry()? {
                    entries.push(entry);
                }
                Ok(Named(entries))
            }
        }
        deserializer.deserialize_map(NamedVisitor(PhantomData))
    }
}

impl<T: JsonSchema> JsonSchema for Named<T> {
    fn inline_schema() -> bool {
        true
    }
    fn schema_name() -> std::borrow::Cow<'static, str> {
        format!("Named{}", T::schema_name()).into()
    }
    fn json_schema(generator: &mut SchemaGenerator) -> Schema {
        json_schema!({
            "type": "object",
            "propertyNames": Name::json_schema(generator),
            "additionalProperties": generator.subschema_for::<T>(),
        })
    }
}

/// A mapping from pairs of federates, written `SENDER -> RECEIVER`, in the order of the text.
#[derive(Clone, Debug)]
pub(crate) struct LinkMap<T>(pub(crate) Named<T>);

impl<T> Default for LinkMap<T> {
    fn default() -> Self {
        Self(Named::default())
    }
}

impl<T> LinkMap<T> {
    /// The value of a pair.
    pub(crate) fn get(&self, from: &str, to: &str) -> Option<&T> {
        let same = |key: &str| split_link(key) == Some((from, to));
        let entries = self.0.0.iter();
        entries
            .rev()
            .find(|(key, _)| same(key))
            .map(|(_, value)| value)
    }
}

/// The federates of a key `SENDER -> RECEIVER`.
pub(crate) fn split_link(key: &str) -> Option<(&str, &str)> {
    key.split_once("->")
        .map(|(from, to)| (from.trim(), to.trim()))
}

impl<'de, T: Deserialize<'de>> Deserialize<'de> for LinkMap<T> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        Named::deserialize(deserializer).map(Self)
    }
}

impl<T: JsonSchema> JsonSchema for LinkMap<T> {
    fn inline_schema() -> bool {
        true
    }
    fn schema_name() -> std::borrow::Cow<'static, str> {
        format!("LinkMap{}", T::schema_name()).into()
    }
    fn json_schema(generator: &mut SchemaGenerator) -> Schema {
        json_schema!({
            "type": "object",
            "additionalProperties": generator.subschema_for::<T>(),
        })
    }
}

/// An offset: a duration or `auto`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum OffsetText {
    /// Solved from the bounds.
    Auto,
    /// This one.
    Span(TimeSpan),
}

impl OffsetText {
    /// The offset in nanoseconds; absent when it is to be solved.
    pub(crate) fn declared_ns(self) -> Option<i64> {
        match self {
            Self::Auto => None,
            Self::Span(span) => Some(span.0),
        }
    }
}

impl<'de> Deserialize<'de> for OffsetText {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        if text.trim() == "auto" {
            return Ok(Self::Auto);
        }
        let span = quantity::duration(&text).map_err(serde::de::Error::custom)?;
        Ok(Self::Span(TimeSpan(span.as_nanos())))
    }
}

impl JsonSchema for OffsetText {
    fn inline_schema() -> bool {
        true
    }
    fn schema_name() -> std::borrow::Cow<'static, str> {
        "ictus-offset".into()
    }
    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        let pattern = r"^\s*(auto|[0-9]+(\.[0-9]+)?\s*(ns|nsec|us|usec|ms|msec|s|sec|min|h))\s*$";
        json_schema!({ "type": "string", "format": "ictus-offset", "pattern": pattern })
    }
}

macro_rules! text_with_format {
    ($(#[$doc:meta])* $name:ident($inner:ty), $format:literal, $pattern:literal) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
        pub(crate) struct $name(pub(crate) $inner);

        impl JsonSchema for $name {
            fn inline_schema() -> bool {
                true
            }
            fn schema_name() -> std::borrow::Cow<'static, str> {
                $format.into()
            }
            fn json_schema(_: &mut SchemaGenerator) -> Schema {
                json_schema!({ "type": "string", "format": $format, "pattern": $pattern })
            }
        }
    };
}

text_with_format! {
    /// A duration in nanoseconds, written `10 ms`.
    TimeSpan(i64), "ictus-duration",
    r"^\s*[0-9]+(\.[0-9]+)?\s*(ns|nsec|us|usec|ms|msec|s|sec|min|h)\s*$"
}
text_with_format! {
    /// A duration in nanoseconds that may be negative, written `-10 ms`.
    SignedSpan(i64), "ictus-signed-duration",
    r"^\s*[+-]?\s*[0-9]+(\.[0-9]+)?\s*(ns|nsec|us|usec|ms|msec|s|sec|min|h)\s*$"
}
text_with_format! {
    /// An IP address with a port, written `127.0.0.1:9464`.
    Address(SocketAddr), "ictus-address", r"^\s*\S+:[0-9]+\s*$"
}
text_with_format! {
    /// A size in bytes, written `10 MiB`.
    ByteSize(u64), "ictus-size", r"^\s*[0-9]+(\.[0-9]+)?\s*(B|kB|KiB|MB|MiB|GB|GiB)\s*$"
}
text_with_format! {
    /// A name: a letter, then letters, digits, `_` and `-`.
    Name(()), "ictus-name", r"^[A-Za-z][A-Za-z0-9_-]{0,63}$"
}

impl<'de> Deserialize<'de> for TimeSpan {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        let span = quantity::duration(&text).map_err(serde::de::Error::custom)?;
        Ok(Self(span.as_nanos()))
    }
}

impl<'de> Deserialize<'de> for ByteSize {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        quantity::size(&text)
            .map(Self)
            .map_err(serde::de::Error::custom)
    }
}

impl<'de> Deserialize<'de> for SignedSpan {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        let span = quantity::signed_duration(&text).map_err(serde::de::Error::custom)?;
        Ok(Self(span.as_nanos()))
    }
}

impl<'de> Deserialize<'de> for Address {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        text.trim()
            .parse()
            .map(Self)
            .map_err(serde::de::Error::custom)
    }
}
