//! Values of the language: numbers, text, collections, tuples.

use super::{Codec, CodecError, Digest, Layout, Value};
use ictus_core::Duration;

macro_rules! integers {
    ($($type:ident as $word:ident)*) => {$(
        impl Value for $type {
            fn type_name() -> String {
                stringify!($type).to_owned()
            }

            fn layout(layout: &mut Layout) {
                layout.primitive(stringify!($type));
            }

            #[inline]
            fn digest(&self, digest: &mut Digest) {
                digest.word(u64::from_le_bytes($word::from(*self).to_le_bytes()));
            }

            fn native() -> Option<Codec<Self>> {
                Some(Codec::of_native())
            }

            fn postcard() -> Option<Codec<Self>> {
                Some(Codec::of_serde())
            }
        }
    )*};
}

integers! {
    u16 as u64 u32 as u64 u64 as u64
    i8 as i64 i16 as i64 i32 as i64 i64 as i64
}

/// `$words` mixes `$self` into `$digest`; the rest is as for every primitive.
macro_rules! primitives {
    ($($type:ident |$self:ident, $digest:ident| $words:expr;)*) => {$(
        impl Value for $type {
            fn type_name() -> String {
                stringify!($type).to_owned()
            }

            fn layout(layout: &mut Layout) {
                layout.primitive(stringify!($type));
            }

            #[inline]
            fn digest(&self, $digest: &mut Digest) {
                let $self = self;
                $words;
            }

            fn native() -> Option<Codec<Self>> {
                Some(Codec::of_native())
            }

            fn postcard() -> Option<Codec<Self>> {
                Some(Codec::of_serde())
            }
        }
    )*};
}

primitives! {
    // Floats go by their bits: 0.0 and -0.0 differ, and so do NaNs of different bits.
    f32 |value, digest| digest.word(u64::from(value.to_bits()));
    f64 |value, digest| digest.word(value.to_bits());
    bool |value, digest| digest.word(u64::from(*value));
    char |value, digest| digest.word(u64::from(*value));
    u128 |value, digest| digest.bytes(&value.to_le_bytes());
    i128 |value, digest| digest.bytes(&value.to_le_bytes());
    Duration |value, digest| value.as_nanos().digest(digest);
}

impl Value for u8 {
    fn type_name() -> String {
        "u8".to_owned()
    }

    fn layout(layout: &mut Layout) {
        layout.primitive("u8");
    }

    #[inline]
    fn digest(&self, digest: &mut Digest) {
        digest.word(u64::from(*self));
    }

    #[inline]
    fn digest_all(items: &[Self], digest: &mut Digest) {
        digest.bytes(items);
    }

    fn native() -> Option<Codec<Self>> {
        Some(Codec::of_native())
    }

    fn postcard() -> Option<Codec<Self>> {
        Some(Codec::of_serde())
    }
}

impl Value for () {
    fn type_name() -> String {
        "()".to_owned()
    }

    fn layout(layout: &mut Layout) {
        layout.primitive("()");
    }

    #[inline]
    fn digest(&self, _: &mut Digest) {}

    fn native() -> Option<Codec<Self>> {
        Some(Codec::of_native())
    }

    fn postcard() -> Option<Codec<Self>> {
        Some(Codec::of_serde())
    }
}

impl Value for String {
    fn type_name() -> String {
        "String".to_owned()
    }

    fn layout(layout: &mut Layout) {
        layout.primitive("String");
    }

    fn digest(&self, digest: &mut Digest) {
        digest.word(self.len() as u64);
        digest.bytes(self.as_bytes());
    }

    fn postcard() -> Option<Codec<Self>> {
        Some(Codec::of_serde())
    }
}

impl<T: Value> Value for Vec<T> {
    fn type_name() -> String {
        format!("Vec<{}>", T::type_name())
    }

    fn layout(layout: &mut Layout) {
        layout.composed("Vec", T::layout);
    }

    fn digest(&self, digest: &mut Digest) {
        digest.word(self.len() as u64);
        T::digest_all(self, digest);
    }

    fn postcard() -> Option<Codec<Self>> {
        T::postcard().map(|_| Codec::<Self> {
            encode: |items, out| {
                (usize_codec().encode)(&items.len(), out)?;
                encode_each::<T>(items, out)
            },
            decode: |input| {
                let codec = offered(T::postcard())?;
                let count = (usize_codec().decode)(input)?;
                // A hostile length must cost neither memory nor time: only types without any byte have empty forms.
                let left = if size_of::<T>() == 0 {
                    1 << 20
                } else {
                    input.len()
                };
                if count > left {
                    return Err(CodecError::Short {
                        needed: count,
                        left,
                    });
                }
                let mut items = Self::with_capacity(count);
                for _ in 0..count {
                    items.push((codec.decode)(input)?);
                }
                Ok(items)
            },
        })
    }
}

impl<T: Value> Value for Option<T> {
    fn type_name() -> String {
        format!("Option<{}>", T::type_name())
    }

    fn layout(layout: &mut Layout) {
        layout.composed("Option", T::layout);
    }

    fn digest(&self, digest: &mut Digest) {
        digest.word(u64::from(self.is_some()));
        if let Some(value) = self {
            value.digest(digest);
        }
    }

    fn postcard() -> Option<Codec<Self>> {
        T::postcard().map(|_| Codec::<Self> {
            encode: |value, out| {
                out.push(u8::from(value.is_some()));
                encode_each::<T>(value.as_slice(), out)
            },
            decode: |input| {
                let codec = offered(T::postcard())?;
                match input.split_first() {
                    Some((0, rest)) => {
                        *input = rest;
                        Ok(None)
                    }
                    Some((1, rest)) => {
                        *input = rest;
                        (codec.decode)(input).map(Some)
                    }
                    Some(_) => Err(CodecError::Invalid { expected: "Option" }),
                    None => Err(CodecError::Short { needed: 1, left: 0 }),
                }
            },
        })
    }
}

impl<T: Value> Value for Box<T> {
    fn type_name() -> String {
        T::type_name()
    }

    fn layout(layout: &mut Layout) {
        T::layout(layout);
    }

    fn digest(&self, digest: &mut Digest) {
        T::digest(self, digest);
    }

    fn native() -> Option<Codec<Self>> {
        T::native().map(|_| Codec::<Self> {
            encode: |value, out| (offered(T::native())?.encode)(value, out),
            decode: |input| (offered(T::native())?.decode)(input).map(Self::new),
        })
    }

    fn postcard() -> Option<Codec<Self>> {
        T::postcard().map(|_| Codec::<Self> {
            encode: |value, out| (offered(T::postcard())?.encode)(value, out),
            decode: |input| (offered(T::postcard())?.decode)(input).map(Self::new),
        })
    }
}

impl<T: Value, const N: usize> Value for [T; N] {
    fn type_name() -> String {
        format!("[{}; {N}]", T::type_name())
    }

    fn layout(layout: &mut Layout) {
        layout.composed(&format!("array {N} "), T::layout);
    }

    #[inline]
    fn digest(&self, digest: &mut Digest) {
        T::digest_all(self, digest);
    }

    fn native() -> Option<Codec<Self>> {
        T::native().map(|_| Codec::<Self> {
            encode: |items, out| {
                let codec = offered(T::native())?;
                items.iter().try_for_each(|item| (codec.encode)(item, out))
            },
            decode: |input| decode_array(T::native(), input),
        })
    }

    fn postcard() -> Option<Codec<Self>> {
        T::postcard().map(|_| Codec::<Self> {
            encode: |items, out| encode_each::<T>(items, out),
            decode: |input| decode_array(T::postcard(), input),
        })
    }
}

macro_rules! tuples {
    ($(($($name:ident $index:tt),+))*) => {$(
        impl<$($name: Value),+> Value for ($($name,)+) {
            fn type_name() -> String {
                let names = [$($name::type_name()),+];
                format!("({})", names.join(", "))
            }

            fn layout(layout: &mut Layout) {
                layout.composed("tuple", |layout| {$($name::layout(layout);)+});
            }

            #[inline]
            fn digest(&self, digest: &mut Digest) {
                $(self.$index.digest(digest);)+
            }

            fn native() -> Option<Codec<Self>> {
                let all = true $(&& $name::native().is_some())+;
                all.then_some(Codec::<Self> {
                    encode: |value, out| {
                        $((offered($name::native())?.encode)(&value.$index, out)?;)+
                        Ok(())
                    },
                    decode: |input| Ok(($((offered($name::native())?.decode)(input)?,)+)),
                })
            }

            fn postcard() -> Option<Codec<Self>> {
                let all = true $(&& $name::postcard().is_some())+;
                all.then_some(Codec::<Self> {
                    encode: |value, out| {
                        $((offered($name::postcard())?.encode)(&value.$index, out)?;)+
                        Ok(())
                    },
                    decode: |input| Ok(($((offered($name::postcard())?.decode)(input)?,)+)),
                })
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

/// The codec of a part. A whole has a codec only when its parts have, so this fails only when a hand-written type
/// answers differently from one call to the next.
fn offered<T>(codec: Option<Codec<T>>) -> Result<Codec<T>, CodecError> {
    codec.ok_or(CodecError::Invalid {
        expected: "type with this serializer",
    })
}

fn usize_codec() -> Codec<usize> {
    Codec::of_serde()
}

fn encode_each<T: Value>(items: &[T], out: &mut Vec<u8>) -> Result<(), CodecError> {
    let codec = offered(T::postcard())?;
    items.iter().try_for_each(|item| (codec.encode)(item, out))
}

fn decode_array<T, const N: usize>(
    codec: Option<Codec<T>>,
    input: &mut &[u8],
) -> Result<[T; N], CodecError> {
    let codec = offered(codec)?;
    let mut failure = None;
    let items: [Option<T>; N] = std::array::from_fn(|_| {
        if failure.is_some() {
            return None;
        }
        let item = (codec.decode)(input);
        item.map_err(|error| failure = Some(error)).ok()
    });
    match failure {
        Some(error) => Err(error),
        None => Ok(items.map(|item| item.expect("no element failed"))),
    }
}
