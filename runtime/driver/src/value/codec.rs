//! Codecs: one way to write values as bytes and read them back.

use super::native::Native;
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::fmt;
use thiserror::Error;

/// Writes values of one type and reads them back. Forms are self-delimiting: a sequence of values is their forms in a row.
pub struct Codec<T> {
    /// Appends the form of a value.
    pub encode: fn(&T, &mut Vec<u8>) -> Result<(), CodecError>,
    /// Takes one value from the front of the input.
    pub decode: fn(&mut &[u8]) -> Result<T, CodecError>,
}

/// Why bytes are not a value, or a value has no form. The message is lost; sender and receiver disagree.
#[derive(Debug, Error, PartialEq, Eq)]
#[non_exhaustive]
pub enum CodecError {
    /// The input ends early.
    #[error("{needed} bytes expected, {left} left")]
    Short {
        /// What the form needs.
        needed: usize,
        /// What the input has.
        left: usize,
    },
    /// Bytes are left after the value.
    #[error("{left} bytes left after the value")]
    Trailing {
        /// How many.
        left: usize,
    },
    /// The bytes stand for no value of the type.
    #[error("not a {expected}")]
    Invalid {
        /// The type.
        expected: &'static str,
    },
    /// Postcard's words.
    #[error(transparent)]
    Postcard(#[from] postcard::Error),
}

impl<T> Codec<T> {
    /// Reads exactly one value.
    ///
    /// # Errors
    ///
    /// [`CodecError`], also when bytes are left.
    pub fn decode_whole(&self, mut input: &[u8]) -> Result<T, CodecError> {
        let value = (self.decode)(&mut input)?;
        match input.len() {
            0 => Ok(value),
            left => Err(CodecError::Trailing { left }),
        }
    }
}

impl<T: Native> Codec<T> {
    /// The fixed layout of plain old data.
    #[must_use]
    pub fn of_native() -> Self {
        Self {
            encode: |value, out| {
                let start = out.len();
                out.resize(start + T::SIZE, 0);
                value.put(&mut out[start..]);
                Ok(())
            },
            decode: |input| {
                let Some((head, rest)) = input.split_at_checked(T::SIZE) else {
                    return Err(CodecError::Short {
                        needed: T::SIZE,
                        left: input.len(),
                    });
                };
                *input = rest;
                T::take(head)
            },
        }
    }
}

/// What serde can write and read back: all that `#[value(postcard)]` asks.
#[diagnostic::on_unimplemented(
    message = "`{Self}` cannot be written by postcard",
    label = "not serde's",
    note = "add `#[derive(serde::Serialize, serde::Deserialize)]` to the type"
)]
pub trait Portable: Serialize + DeserializeOwned {}

impl<T: Serialize + DeserializeOwned> Portable for T {}

impl<T: Portable> Codec<T> {
    /// Postcard over serde.
    #[must_use]
    pub fn of_serde() -> Self {
        Self {
            encode: |value, out| Ok(postcard::serialize_with_flavor(value, Append(out))?),
            decode: |input| {
                let (value, rest) = postcard::take_from_bytes(input)?;
                *input = rest;
                Ok(value)
            },
        }
    }
}

/// Postcard output that goes to the end of a vector.
struct Append<'a>(&'a mut Vec<u8>);

impl postcard::ser_flavors::Flavor for Append<'_> {
    type Output = ();

    fn try_push(&mut self, byte: u8) -> postcard::Result<()> {
        self.0.push(byte);
        Ok(())
    }

    fn try_extend(&mut self, bytes: &[u8]) -> postcard::Result<()> {
        self.0.extend_from_slice(bytes);
        Ok(())
    }

    fn finalize(self) -> postcard::Result<()> {
        Ok(())
    }
}

impl<T> Clone for Codec<T> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<T> Copy for Codec<T> {}

impl<T> fmt::Debug for Codec<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Codec")
    }
}
