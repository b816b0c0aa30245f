//! Values: digests, identities, serializers.

use ictus::Value;
use ictus::value::{Codec, digest_of, identity};
use proptest::prelude::*;
use serde::{Deserialize, Serialize};

#[derive(Clone, Debug, PartialEq, Value, Serialize, Deserialize)]
#[value(native, postcard)]
struct Plain {
    id: u16,
    at: (i64, bool),
    samples: [f32; 3],
    bytes: [u8; 5],
    letter: char,
    unit: (),
}

#[derive(Clone, Debug, PartialEq, Value, Serialize, Deserialize)]
#[value(postcard)]
enum Rich {
    Nothing,
    Text(String),
    Tree {
        label: Option<u32>,
        children: Vec<Self>,
    },
}

#[derive(Clone, Debug, PartialEq, Value)]
#[value(native)]
struct Pair<T> {
    first: T,
    second: T,
}

fn plain() -> impl Strategy<Value = Plain> {
    let fields = (
        any::<u16>(),
        any::<(i64, bool)>(),
        any::<[f32; 3]>(),
        any::<[u8; 5]>(),
        any::<char>(),
    );
    fields.prop_map(|(id, at, samples, bytes, letter)| Plain {
        id,
        at,
        samples,
        bytes,
        letter,
        unit: (),
    })
}

fn rich() -> impl Strategy<Value = Rich> {
    let leaf = prop_oneof![Just(Rich::Nothing), ".*".prop_map(Rich::Text)];
    leaf.prop_recursive(3, 12, 3, |inner| {
        let children = prop::collection::vec(inner, 0..3);
        (any::<Option<u32>>(), children)
            .prop_map(|(label, children)| Rich::Tree { label, children })
    })
}

/// Every serializer gives back a value of the same digest, alone and in a row of two.
fn keeps_digest<T: Value>(value: &T, expected: &[&str]) -> Result<(), TestCaseError> {
    let serializers = T::serializers();
    let names: Vec<_> = serializers.iter().map(|(name, _)| *name).collect();
    prop_assert_eq!(&names, expected);
    for (name, Codec { encode, decode }) in serializers {
        let mut bytes = Vec::new();
        encode(value, &mut bytes).unwrap();
        encode(value, &mut bytes).unwrap();
        let mut rest = bytes.as_slice();
        for _ in 0..2 {
            let back = decode(&mut rest).unwrap();
            prop_assert_eq!(digest_of(&back), digest_of(value), "{}", name);
        }
        prop_assert!(rest.is_empty());
    }
    Ok(())
}

proptest! {
    #[test]
    fn decoding_keeps_the_digest(
        plain in plain(),
        rich in rich(),
        numbers in any::<(u8, i16, u64, u128, f64)>(),
        words in any::<[i32; 4]>(),
        nested in any::<Vec<Option<(u32, bool)>>>(),
    ) {
        keeps_digest(&plain, &["native", "postcard"])?;
        keeps_digest(&rich, &["postcard"])?;
        keeps_digest(&numbers, &["native", "postcard"])?;
        keeps_digest(&words, &["native", "postcard"])?;
        keeps_digest(&nested, &["postcard"])?;
        keeps_digest(&Box::new(plain), &["native", "postcard"])?;
        keeps_digest(&Pair { first: numbers, second: numbers }, &["native"])?;
    }

    #[test]
    fn equal_values_have_equal_digests(a in rich(), b in rich()) {
        prop_assert_eq!(a == b, digest_of(&a) == digest_of(&b));
    }

    #[test]
    fn sequences_that_differ_in_one_word_differ(
        words in prop::collection::vec(any::<u64>(), 1..20),
        at in any::<prop::sample::Index>(),
        change in 1_u64..,
    ) {
        let mut other = words.clone();
        other[at.index(words.len())] ^= change;
        prop_assert_ne!(digest_of(&words), digest_of(&other));
    }

    #[test]
    fn decoding_never_panics(bytes in prop::collection::vec(any::<u8>(), 0..64)) {
        fn try_all<T: Value>(bytes: &[u8]) {
            for (_, codec) in T::serializers() {
                let _ = codec.decode_whole(bytes).map(|value| digest_of(&value));
            }
        }
        try_all::<Plain>(&bytes);
        try_all::<Rich>(&bytes);
        try_all::<Vec<Vec<()>>>(&bytes);
        try_all::<Option<[bool; 3]>>(&bytes);
        try_all::<(char, String)>(&bytes);
    }
}

#[test]
fn the_native_form_is_packed_and_little_endian() {
    let value = Plain {
        id: 0x0102,
        at: (-2, true),
        samples: [1.0, 0.0, -0.0],
        bytes: *b"bytes",
        letter: 'x',
        unit: (),
    };
    let mut bytes = Vec::new();
    (Plain::native().unwrap().encode)(&value, &mut bytes).unwrap();
    let mut expected = vec![2, 1, 0xfe, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 1];
    expected.extend([0, 0, 0x80, 0x3f, 0, 0, 0, 0, 0, 0, 0, 0x80]);
    expected.extend(*b"bytes");
    expected.extend([b'x', 0, 0, 0]);
    assert_eq!(bytes, expected);
}

#[test]
fn postcard_is_what_serde_writes() {
    let value = Some(vec![(1_u32, true), (300, false)]);
    let mut bytes = Vec::new();
    let codec = <Option<Vec<(u32, bool)>>>::postcard().unwrap();
    (codec.encode)(&value, &mut bytes).unwrap();
    assert_eq!(bytes, [1, 2, 1, 1, 0xac, 2, 0]);
}

mod other {
    use ictus::Value;

    #[derive(Clone, Value)]
    #[value(native)]
    pub struct Sample {
        pub a: u32,
        pub c: u32,
    }
}

#[derive(Clone, Value)]
#[value(native)]
struct Sample {
    a: u32,
    b: u32,
}

#[test]
fn identities_tell_layouts_apart() {
    let (here, there) = (identity::<Sample>(), identity::<other::Sample>());
    assert_eq!(
        (here.name.as_str(), there.name.as_str()),
        ("Sample", "Sample")
    );
    assert_ne!(here.fingerprint, there.fingerprint);
    let nested = [
        identity::<Vec<Vec<u8>>>(),
        identity::<Vec<Vec<u16>>>(),
        identity::<[u8; 3]>(),
        identity::<[u8; 4]>(),
        identity::<(u8, u8)>(),
        identity::<Pair<u8>>(),
        identity::<Pair<u16>>(),
    ];
    for (i, one) in nested.iter().enumerate() {
        for other in &nested[i + 1..] {
            assert_ne!(one.fingerprint, other.fingerprint, "{one:?} {other:?}");
        }
    }
    assert_eq!(identity::<Pair<u8>>().name, "Pair<u8>");
    // A recursive type has an end.
    assert_eq!(identity::<Rich>().name, "Rich");
}
