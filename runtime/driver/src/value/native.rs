//! Plain old data: types of a fixed number of bytes, written field by field, little-endian, without padding.

use super::Value;
use super::codec::CodecError;
use ictus_core::Duration;

/// A type of fixed size without padding or pointers; its form equals C's memory on a little-endian machine when the C
/// struct has no padding.
///
/// Law: `take(put(value))` is `value`, to the bit.
#[diagnostic::on_unimplemented(
    message = "`{Self}` is not plain old data, so it cannot stand in a native value",
    label = "not native",
    note = "native fields are integers, floats, bool, char, arrays and tuples of them, and types with `#[value(native)]`",
    note = "or offer `#[value(postcard)]` instead"
)]
pub trait Native: Value {
    /// Bytes of the form.
    const SIZE: usize;

    /// Writes the form into `out`, which has [`Native::SIZE`] bytes.
    fn put(&self, out: &mut [u8]);

    /// Reads the form from `input`, which has [`Native::SIZE`] bytes.
    ///
    /// # Errors
    ///
    /// When the bytes stand for no value (a bool of 2).
    fn take(input: &[u8]) -> Result<Self, CodecError>;

    /// Writes several forms in a row.
    #[inline]
    fn put_all(items: &[Self], out: &mut [u8]) {
        for (item, out) in items.iter().zip(out.chunks_exact_mut(Self::SIZE.max(1))) {
            item.put(out);
        }
    }

    /// Reads several forms in a row.
    ///
    /// # Errors
    ///
    /// As [`Native::take`].
    ///
    /// # Panics
    ///
    /// Never: every element was read.
    #[inline]
    fn take_array<const N: usize>(input: &[u8]) -> Result<[Self; N], CodecError> {
        let mut failure = None;
        let items: [Option<Self>; N] = std::array::from_fn(|i| {
            let item = Self::take(&input[i * Self::SIZE..(i + 1) * Self::SIZE]);
            item.map_err(|error| failure = Some(error)).ok()
        });
        match failure {
            Some(error) => Err(error),
            None => Ok(items.map(|item| item.expect("no element failed"))),
        }
    }
}

/// Reads `SIZE` bytes from the front of a form; derived code calls it field by field.
#[doc(hidden)]
#[inline]
pub fn take_front<T: Native>(input: &mut &[u8]) -> Result<T, CodecError> {
    let (head, rest) = input.split_at(T::SIZE);
    *input = rest;
    T::take(head)
}

/// Writes `SIZE` bytes to the front of the rest of a form; derived code calls it field by field.
#[doc(hidden)]
#[inline]
pub fn put_front<'a, T: Native>(value: &T, out: &'a mut [u8]) -> &'a mut [u8] {
    let (head, rest) = out.split_at_mut(T::SIZE);
    value.put(head);
    rest
}

macro_rules! numbers {
    ($($type:ident)*) => {$(
        impl Native for $type {
            const SIZE: usize = size_of::<Self>();

            #[inline]
            fn put(&self, out: &mut [u8]) {
                out.copy_from_slice(&self.to_le_bytes());
            }

            #[inline]
            fn take(input: &[u8]) -> Result<Self, CodecError> {
                let mut bytes = [0; Self::SIZE];
                bytes.copy_from_slice(input);
                Ok(Self::from_le_bytes(bytes))
            }

            #[inline]
            fn take_array<const N: usize>(input: &[u8]) -> Result<[Self; N], CodecError> {
                let (chunks, _) = input.as_chunks::<{ Self::SIZE }>();
                let mut items = [Self::default(); N];
                for (item, chunk) in items.iter_mut().zip(chunks) {
                    *item = Self::from_le_bytes(*chunk);
                }
                Ok(items)
            }
        }
    )*};
}

numbers!(u8 u16 u32 u64 u128 i8 i16 i32 i64 i128 f32 f64);

impl Native for bool {
    const SIZE: usize = 1;

    #[inline]
    fn put(&self, out: &mut [u8]) {
        out[0] = u8::from(*self);
    }

    #[inline]
    fn take(input: &[u8]) -> Result<Self, CodecError> {
        match input[0] {
            0 => Ok(false),
            1 => Ok(true),
            _ => Err(CodecError::Invalid { expected: "bool" }),
        }
    }
}

impl Native for char {
    const SIZE: usize = 4;

    #[inline]
    fn put(&self, out: &mut [u8]) {
        u32::from(*self).put(out);
    }

    #[inline]
    fn take(input: &[u8]) -> Result<Self, CodecError> {
        Self::from_u32(u32::take(input)?).ok_or(CodecError::Invalid { expected: "char" })
    }
}

impl Native for () {
    const SIZE: usize = 0;

    #[inline]
    fn put(&self, _: &mut [u8]) {}

    #[inline]
    fn take(_: &[u8]) -> Result<Self, CodecError> {
        Ok(())
    }
}

impl Native for Duration {
    const SIZE: usize = 8;

    #[inline]
    fn put(&self, out: &mut [u8]) {
        self.as_nanos().put(out);
    }

    #[inline]
    fn take(input: &[u8]) -> Result<Self, CodecError> {
        Ok(Self::from_nanos(i64::take(input)?))
    }
}

impl<T: Native, const N: usize> Native for [T; N] {
    const SIZE: usize = T::SIZE * N;

    #[inline]
    fn put(&self, out: &mut [u8]) {
        T::put_all(self, out);
    }

    #[inline]
    fn take(input: &[u8]) -> Result<Self, CodecError> {
        T::take_array(input)
    }
}

macro_rules! tuples {
    ($(($($name:ident $index:tt),+))*) => {$(
        impl<$($name: Native),+> Native for ($($name,)+) {
            const SIZE: usize = 0 $(+ $name::SIZE)+;

            #[inline]
            fn put(&self, out: &mut [u8]) {
                let mut rest = out;
                $(rest = put_front(&self.$index, rest);)+
                debug_assert!(rest.is_empty(), "the form has SIZE bytes");
            }

            #[inline]
            fn take(input: &[u8]) -> Result<Self, CodecError> {
                let mut rest = input;
                Ok(($(take_front::<$name>(&mut rest)?,)+))
            }
        }
    )*};
}

tuples! {
    (A 0)
    (A 0, B 1)
    (A 0, B 1, C 2)
    (A 0, B 1, C 2, D 3)
    (A 0, B 1, C 2, D 3, E 4)
    (A 0, B 1, C 2, D 3, E 4, F 5)
}
