use super::*;
use ictus_core::{Duration, LogicalTime};
use proptest::collection::vec;
use proptest::prelude::*;

fn tag() -> impl Strategy<Value = Tag> {
    prop_oneof![
        1 => Just(Tag::NEVER),
        1 => Just(Tag::FOREVER),
        8 => (i64::MIN + 1..i64::MAX, any::<u32>())
            .prop_map(|(time, microstep)| Tag::new(LogicalTime::from_nanos(time), microstep)),
    ]
}

fn time() -> impl Strategy<Value = PhysicalTime> {
    any::<i64>().prop_map(PhysicalTime::from_nanos)
}

fn delay() -> impl Strategy<Value = Delay> {
    prop_oneof![
        Just(Delay::None),
        Just(Delay::Microstep),
        (1..i64::MAX).prop_map(|nanos| Delay::Time(Duration::from_nanos(nanos))),
    ]
}

fn absent() -> impl Strategy<Value = PortAbsent> {
    (any::<u16>(), any::<u16>(), tag()).prop_map(|(port, federate, tag)| PortAbsent {
        port,
        federate,
        tag,
    })
}

fn neighbors() -> impl Strategy<Value = NeighborStructure> {
    (vec((any::<u16>(), delay()), 0..5), vec(any::<u16>(), 0..5)).prop_map(
        |(upstream, downstream)| NeighborStructure {
            upstream,
            downstream,
        },
    )
}

/// The borrowed parts of a message: (payload or federation id, port, federate, tag).
type Parts = (Vec<u8>, u16, u16, Tag);

fn parts() -> impl Strategy<Value = Parts> {
    (vec(any::<u8>(), 0..40), any::<u16>(), any::<u16>(), tag())
}

fn message((payload, port, federate, tag): &Parts) -> TaggedMessage<'_> {
    TaggedMessage {
        port: *port,
        federate: *federate,
        tag: *tag,
        payload,
    }
}

fn to_rti_owned() -> impl Strategy<Value = ToRti<'static>> {
    prop_oneof![
        time().prop_map(ToRti::Timestamp),
        absent().prop_map(ToRti::PortAbsent),
        tag().prop_map(ToRti::NextEventTag),
        tag().prop_map(ToRti::LatestTagConfirmed),
        tag().prop_map(ToRti::StopRequest),
        tag().prop_map(ToRti::StopRequestReply),
        Just(ToRti::Resign),
        Just(ToRti::Failed),
        neighbors().prop_map(ToRti::NeighborStructure),
        any::<u16>().prop_map(ToRti::UdpPort),
        any::<u16>().prop_map(|federate| ToRti::ClockSyncT3 { federate }),
        any::<u16>().prop_map(|federate| ToRti::AddressQuery {
            federate,
            transient: None,
        }),
        any::<i32>().prop_map(|port| ToRti::AddressAdvertisement { port }),
        any::<(u16, [u8; 8])>()
            .prop_map(|(federate, nonce)| ToRti::FederateNonce { federate, nonce }),
        any::<[u8; 32]>().prop_map(|hmac| ToRti::FederateResponse { hmac }),
        any::<u32>().prop_map(ToRti::Capabilities),
        any::<(i32, [u8; 4])>().prop_map(|(port, address)| ToRti::DataAddress { port, address }),
        any::<u8>().prop_map(|code| ToRti::Reject(RejectReason::from_code(code))),
    ]
}

fn to_federate_owned() -> impl Strategy<Value = ToFederate<'static>> {
    prop_oneof![
        Just(ToFederate::Ack),
        any::<u8>().prop_map(|code| ToFederate::Reject(RejectReason::from_code(code))),
        time().prop_map(ToFederate::Timestamp),
        absent().prop_map(ToFederate::PortAbsent),
        tag().prop_map(ToFederate::TagAdvanceGrant),
        tag().prop_map(ToFederate::ProvisionalTagAdvanceGrant),
        tag().prop_map(ToFederate::DownstreamNextEventTag),
        tag().prop_map(ToFederate::StopRequest),
        tag().prop_map(ToFederate::StopGranted),
        time().prop_map(ToFederate::ClockSyncT1),
        time().prop_map(ToFederate::ClockSyncT4),
        any::<(i32, [u8; 4])>()
            .prop_map(|(port, address)| ToFederate::AddressQueryReply { port, address }),
        any::<([u8; 8], [u8; 32])>()
            .prop_map(|(nonce, hmac)| ToFederate::RtiResponse { nonce, hmac }),
        Just(ToFederate::Failed),
        tag().prop_map(ToFederate::DownstreamConfirmed),
        (any::<u16>(), tag())
            .prop_map(|(federate, promise)| ToFederate::FederateLost { federate, promise }),
    ]
}

fn check_to_rti(message: &ToRti<'_>, rest: &[u8]) {
    let mut bytes = Vec::new();
    message.encode(&mut bytes);
    let length = bytes.len();
    for prefix in 0..length {
        assert_eq!(
            ToRti::decode(&bytes[..prefix]),
            Ok(None),
            "{prefix} of {length} bytes"
        );
    }
    bytes.extend_from_slice(rest);
    assert_eq!(ToRti::decode(&bytes), Ok(Some((message.clone(), length))));
}

fn check_to_federate(message: &ToFederate<'_>, rest: &[u8]) {
    let mut bytes = Vec::new();
    message.encode(&mut bytes);
    let length = bytes.len();
    for prefix in 0..length {
        assert_eq!(
            ToFederate::decode(&bytes[..prefix]),
            Ok(None),
            "{prefix} of {length} bytes"
        );
    }
    bytes.extend_from_slice(rest);
    assert_eq!(
        ToFederate::decode(&bytes),
        Ok(Some((message.clone(), length)))
    );
}

proptest! {
    #[test]
    fn decode_never_panics(bytes in vec(any::<u8>(), 0..60)) {
        if let Ok(Some((_, consumed))) = ToRti::decode(&bytes) {
            prop_assert!(0 < consumed && consumed <= bytes.len());
        }
        if let Ok(Some((_, consumed))) = ToFederate::decode(&bytes) {
            prop_assert!(0 < consumed && consumed <= bytes.len());
        }
    }

    #[test]
    fn to_rti_round_trip(message in to_rti_owned(), rest in vec(any::<u8>(), 0..4)) {
        check_to_rti(&message, &rest);
    }

    #[test]
    fn to_federate_round_trip(message in to_federate_owned(), rest in vec(any::<u8>(), 0..4)) {
        check_to_federate(&message, &rest);
    }

    #[test]
    fn every_prefix_is_incomplete(parts in parts(), rest in vec(any::<u8>(), 0..4)) {
        check_to_rti(&ToRti::TaggedMessage(message(&parts)), &rest);
        check_to_federate(&ToFederate::TaggedMessage(message(&parts)), &rest);
        check_to_rti(&ToRti::FederateIds { federate: parts.1, federation: &parts.0 }, &rest);
    }
}

#[test]
fn bytes_of_the_wire_document() {
    let mut bytes = Vec::new();
    ToRti::TaggedMessage(TaggedMessage {
        port: 2,
        federate: 1,
        tag: Tag::new(LogicalTime::from_nanos(7), 3),
        payload: &[9, 8],
    })
    .encode(&mut bytes);
    assert_eq!(
        bytes,
        [
            5, 2, 0, 1, 0, 2, 0, 0, 0, 7, 0, 0, 0, 0, 0, 0, 0, 3, 0, 0, 0, 9, 8
        ]
    );
    bytes.clear();
    ToRti::NeighborStructure(NeighborStructure {
        upstream: vec![(1, Delay::None), (2, Delay::Microstep)],
        downstream: vec![3],
    })
    .encode(&mut bytes);
    let mut expected = vec![24, 2, 0, 0, 0, 1, 0, 0, 0, 1, 0];
    expected.extend_from_slice(&i64::MIN.to_le_bytes());
    expected.extend_from_slice(&[2, 0, 0, 0, 0, 0, 0, 0, 0, 0, 3, 0]);
    assert_eq!(bytes, expected);
}

#[test]
fn a_long_payload_is_refused_before_it_arrives() {
    let bytes = [5, 0, 0, 0, 0, 0xff, 0xff, 0xff, 0xff];
    let error = DecodeError::PayloadTooLong {
        length: u32::MAX,
        limit: MAX_PAYLOAD,
    };
    assert_eq!(ToRti::decode(&bytes), Err(error));
    assert_eq!(ToFederate::decode(&bytes), Err(error));
}

#[test]
fn an_impossible_neighbour_count_is_refused() {
    let bytes = [24, 0xff, 0xff, 0xff, 0xff, 0, 0, 0, 0];
    assert_eq!(ToRti::decode(&bytes), Err(DecodeError::NeighborCount(-1)));
}

#[test]
fn messages_of_the_other_direction_are_unknown() {
    for byte in [7, 8, 12, 16, 17, 18, 26, 3, 27] {
        assert_eq!(ToRti::decode(&[byte]), Err(DecodeError::UnknownType(byte)));
    }
    for byte in [1, 4, 6, 9, 11, 24, 200, 254] {
        assert_eq!(
            ToFederate::decode(&[byte]),
            Err(DecodeError::UnknownType(byte))
        );
    }
}

#[test]
fn forever_has_one_form() {
    let mut bytes = vec![kind::NEXT_EVENT_TAG];
    bytes.extend_from_slice(&i64::MAX.to_le_bytes());
    bytes.extend_from_slice(&[0; 4]);
    assert_eq!(
        ToRti::decode(&bytes),
        Ok(Some((ToRti::NextEventTag(Tag::FOREVER), 13)))
    );
}
