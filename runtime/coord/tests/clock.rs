//! Clock synchronization piece by piece; the whole of it is simulated in `ictus-sim`.
#![allow(clippy::unwrap_used, missing_docs, reason = "a test")]

use ictus_coord::clock::{
    Correction, DRIFT_BOUND_PPB, Datagram, Exchange, Follower, FromFederate, Heard, Interval,
    Prober, SLEW_MAX_PPB, Servo, Taken, Transmit,
};
use ictus_coord::plan::ClockPlan;
use ictus_coord::topology::FederateId;
use ictus_core::{Duration, PhysicalTime};
use proptest::prelude::*;
use std::net::SocketAddr;

const SECOND: i64 = 1_000_000_000;
const EPOCH: i64 = 1_700_000_000 * SECOND;

fn at(nanos: i64) -> PhysicalTime {
    PhysicalTime::from_nanos(EPOCH + nanos)
}

fn address(port: u16) -> SocketAddr {
    ([127, 0, 0, 1], port).into()
}

/// An exchange that begins when the base clock shows `base`, with an offset of `offset` and these delays.
fn exchange(base: i64, offset: i64, there: i64, back: i64) -> Exchange {
    Exchange {
        t1: at(base + offset),
        t2: at(base + there),
        t3: at(base + there + 5_000),
        t4: at(base + there + 5_000 + back + offset),
    }
}

proptest! {
    #[test]
    fn datagrams_round_trip(nanos: i64, federate: u16, echo: Option<i64>) {
        let time = PhysicalTime::from_nanos(nanos);
        for datagram in [
            Datagram::T1(time),
            Datagram::T4 { came: time, left: echo.map(PhysicalTime::from_nanos) },
            Datagram::CodedProbe(time),
        ] {
            prop_assert_eq!(Datagram::decode(&datagram.encode()), Some(datagram));
        }
        let answer = FromFederate { federate, echo: echo.map(PhysicalTime::from_nanos) };
        let bytes = answer.encode();
        prop_assert_eq!(FromFederate::decode(&bytes), Some(answer));
    }

    #[test]
    fn strange_datagrams_are_none(bytes in proptest::collection::vec(any::<u8>(), 0..24)) {
        if bytes.len() != 9 && bytes.len() != 17 {
            prop_assert_eq!(Datagram::decode(&bytes), None);
        }
        if bytes.len() != 3 && bytes.len() != 11 {
            prop_assert_eq!(FromFederate::decode(&bytes), None);
        }
    }

    /// Whatever comes, in whatever order: no panic, and the bound is never negative.
    #[test]
    fn any_datagrams_are_survived(
        datagrams in proptest::collection::vec((0_u8..5, any::<i64>(), 0_i64..SECOND, 0_u16..2), 0..60)
    ) {
        let mut follower = Follower::new(3, address(1).ip(), true);
        let mut prober = Prober::new(4, Duration::from_millis(10));
        let mut servo = Servo::new(&ClockPlan::default());
        prober.begin(at(0), FederateId::new(3), address(7));
        let mut now = 0;
        for (kind, time, later, port) in datagrams {
            now += later;
            let time = PhysicalTime::from_nanos(if kind == 4 { EPOCH + time % SECOND } else { time });
            let bytes = match kind {
                0 => Datagram::T4 { came: time, left: None }.encode(),
                1 => Datagram::CodedProbe(time).encode(),
                2 | 4 => Datagram::T1(time).encode(),
                _ => Datagram::T4 { came: time, left: Some(at(now)) }.encode(),
            };
            match follower.receive(address(port), &bytes, at(now)) {
                Heard::Nothing => {}
                Heard::Answer { datagram, .. } => {
                    follower.answered(at(now));
                    let bytes = datagram.encode();
                    prober.receive(address(7), &bytes, time);
                }
                Heard::Complete(exchange, survived) => {
                    servo.take(at(now), exchange, survived);
                }
            }
            prober.receive(address(7), &bytes, time);
            prober.handle_timeout(time);
            while prober.poll_transmit(time).is_some() {}
            prop_assert!(servo.bound(at(now)).is_none_or(|bound| bound >= Duration::ZERO));
        }
    }

    #[test]
    fn the_offset_is_inside(
        offset in -SECOND..SECOND,
        drift in -DRIFT_BOUND_PPB..DRIFT_BOUND_PPB,
        exchanges in proptest::collection::vec((0_i64..SECOND, 0_i64..1_000_000, 0_i64..1_000_000), 1..50)
    ) {
        let mut base = 0;
        let truth = |base: i64| {
            offset + i64::try_from(i128::from(base) * i128::from(drift) / i128::from(SECOND)).unwrap()
        };
        let mut known: Option<Interval> = None;
        for (pause, there, back) in exchanges {
            base += pause;
            let (t2, t3) = (base + there, base + there + 5_000);
            let one = Exchange {
                t1: at(base + truth(base)),
                t2: at(t2),
                t3: at(t3),
                t4: at(t3 + back + truth(t3 + back)),
            };
            base = t3 + back;
            let one = Interval::of(&one).unwrap();
            let both = known.map_or(one, |known| known.and(&one).unwrap());
            for later in [0, SECOND, 1_000 * SECOND] {
                let offset = Duration::from_nanos(truth(base + later));
                prop_assert!(both.contains(at(base + later), offset), "{both:?} {offset}");
            }
            known = Some(both);
        }
    }

    #[test]
    fn a_corrected_clock_never_goes_back(
        exchanges in proptest::collection::vec((0_i64..20_000_000, -SECOND..SECOND), 1..50)
    ) {
        let mut servo = Servo::new(&ClockPlan::default());
        let (mut base, mut shown) = (0, PhysicalTime::NEVER);
        for (pause, offset) in exchanges {
            for step in 0..4 {
                let now = servo.correction().reading(at(base + pause * step / 3));
                prop_assert!(now >= shown);
                shown = now;
            }
            base += pause;
            let before = servo.correction().reading(at(base));
            servo.take(at(base), exchange(base - 300_000, offset, 100_000, 100_000), true);
            prop_assert_eq!(servo.correction().reading(at(base)), before, "no jump");
            let rate = servo.correction().slew_ppb;
            prop_assert!(rate.abs() <= SLEW_MAX_PPB);
        }
    }
}

#[test]
fn slewing_ends_where_it_should() {
    let correction = Correction {
        from: at(0),
        offset: Duration::from_nanos(1_000),
        drift_ppb: 10,
        slew_ppb: 500_000,
        slew_until: at(2 * SECOND),
    };
    assert_eq!(correction.at(at(SECOND)), Duration::from_nanos(501_010));
    assert_eq!(
        correction.at(at(5 * SECOND)),
        Duration::from_nanos(1_001_050)
    );
}

#[test]
fn a_step_is_counted_and_then_slewed() {
    let mut servo = Servo::new(&ClockPlan::default());
    let joining = Interval::of(&exchange(0, 7_000_000, 50_000, 50_000)).unwrap();
    servo.begin(at(105_000), joining);
    assert!(servo.is_synchronized(at(105_000)));
    let taken = servo.take(
        at(SECOND),
        exchange(SECOND - 200_000, 37_000_000, 50_000, 50_000),
        true,
    );
    let Taken::Step(by) = taken else {
        panic!("{taken:?}");
    };
    assert!(
        (by - Duration::from_millis(30)).as_nanos().abs() < 200_000,
        "{by}"
    );
    let status = servo.status(at(SECOND));
    assert!(!status.synchronized && status.steps == 1);
    assert!(
        status.bound_ns.unwrap() >= 30_000_000,
        "what is still to be slewed counts"
    );
    let mut base = SECOND;
    while !servo.is_synchronized(at(base)) {
        base += 10_000_000;
        servo.take(
            at(base),
            exchange(base - 200_000, 37_000_000, 50_000, 50_000),
            true,
        );
        assert!(base < 90 * SECOND, "500 ppm take a minute");
    }
    assert!(base > 55 * SECOND, "slewed, not stepped: {base}");
}

#[test]
fn a_surer_source_is_followed_unless_it_contradicts() {
    let mut servo = Servo::new(&ClockPlan::default());
    let joining = Interval::of(&exchange(0, 0, 50_000, 50_000)).unwrap();
    servo.begin(at(105_000), joining);
    let micro = |micros: i64| Duration::from_nanos(micros * 1_000);
    servo.trust(Some((micro(20), micro(1))));
    assert!(servo.is_external(at(105_000)));
    servo.trust(Some((micro(20), micro(80))));
    assert!(!servo.is_external(at(105_000)), "not surer");
    servo.trust(Some((micro(900), micro(1))));
    assert!(
        !servo.is_external(at(105_000)),
        "the RTI's clock is elsewhere"
    );
}

struct Pair {
    prober: Prober,
    follower: Follower,
}

fn pair(echoes: bool) -> Pair {
    let mut prober = Prober::new(1, Duration::from_millis(10));
    prober.begin(at(0), FederateId::new(0), address(7));
    let follower = Follower::new(0, address(9).ip(), echoes);
    Pair { prober, follower }
}

fn sent(prober: &mut Prober, now: i64) -> Transmit {
    prober.poll_transmit(at(now)).unwrap()
}

#[test]
fn an_exchange_on_the_wire_is_lfs() {
    let Pair {
        mut prober,
        mut follower,
    } = pair(false);
    assert_eq!(prober.poll_timeout(), Some(at(0)));
    prober.handle_timeout(at(0));
    let t1 = sent(&mut prober, 10);
    assert_eq!((t1.bytes[0], t1.to), (19, address(7)));
    assert!(prober.poll_transmit(at(11)).is_none());
    let heard = follower.receive(address(9), &t1.bytes, at(500));
    let Heard::Answer { to, datagram } = heard else {
        panic!("{heard:?}");
    };
    let bytes = datagram.encode();
    assert_eq!((to, &bytes[..]), (address(9), &[20, 0, 0][..]));
    follower.answered(at(600));
    prober.receive(address(7), &bytes, at(1_000));
    // What is sent between them is what is between the readings, whenever T3 came.
    let (t4, probe) = (sent(&mut prober, 1_400), sent(&mut prober, 1_450));
    assert_eq!(
        Datagram::decode(&t4.bytes),
        Some(Datagram::T4 {
            came: at(1_000),
            left: None
        })
    );
    assert_eq!(
        Datagram::decode(&probe.bytes),
        Some(Datagram::CodedProbe(at(1_050)))
    );
    assert_eq!(
        follower.receive(address(9), &t4.bytes, at(2_000)),
        Heard::Nothing
    );
    let complete = follower.receive(address(9), &probe.bytes, at(2_050));
    let whole = Exchange {
        t1: at(10),
        t2: at(500),
        t3: at(600),
        t4: at(1_000),
    };
    assert_eq!(complete, Heard::Complete(whole, true));
    assert_eq!(
        prober.poll_timeout(),
        Some(at(10_000_010)),
        "the rhythm is T1's"
    );
}

#[test]
fn spacing_that_did_not_survive_is_said() {
    for (r5, survives) in [(2_050, true), (90_000, true), (150_000, false)] {
        let Pair {
            mut prober,
            mut follower,
        } = pair(true);
        prober.handle_timeout(at(0));
        let t1 = sent(&mut prober, 0);
        follower.receive(address(9), &t1.bytes, at(500));
        follower.answered(at(600));
        let t4 = Datagram::T4 {
            came: at(1_000),
            left: None,
        }
        .encode();
        let probe = Datagram::CodedProbe(at(1_050)).encode();
        follower.receive(address(9), &t4, at(2_000));
        let heard = follower.receive(address(9), &probe, at(r5));
        assert!(matches!(heard, Heard::Complete(_, survived) if survived == survives));
    }
}

#[test]
fn a_silent_federate_is_given_up_after_a_second() {
    let Pair { mut prober, .. } = pair(false);
    prober.handle_timeout(at(0));
    sent(&mut prober, 0);
    prober.handle_timeout(at(SECOND - 1));
    assert!(prober.poll_transmit(at(SECOND - 1)).is_none() && prober.unanswered() == 0);
    assert_eq!(prober.poll_timeout(), Some(at(SECOND)));
    prober.handle_timeout(at(SECOND));
    assert_eq!(sent(&mut prober, SECOND).bytes[0], 19);
    assert_eq!(prober.unanswered(), 1);
    prober.end(FederateId::new(0));
    assert_eq!(prober.poll_timeout(), None);
}

#[test]
fn strangers_are_counted_and_forgotten() {
    let Pair {
        mut prober,
        mut follower,
    } = pair(true);
    prober.receive(address(7), &[20, 0, 0], at(0));
    prober.handle_timeout(at(0));
    let t1 = sent(&mut prober, 0);
    let strange: [(u16, &[u8]); 6] = [
        (8, &[20, 0, 0]),
        (7, &[20, 1, 0]),
        (7, &[20, 0, 0, 0]),
        (7, &[21, 0, 0]),
        (7, &[20, 0, 0, 9, 9, 9, 9, 9, 9, 9, 9]),
        (7, &[]),
    ];
    for (port, bytes) in strange {
        prober.receive(address(port), bytes, at(1_000));
        assert!(prober.poll_transmit(at(1_000)).is_none());
    }
    assert_eq!(prober.strangers(), 7);

    let elsewhere: SocketAddr = ([10, 0, 0, 1], 9).into();
    assert_eq!(
        follower.receive(elsewhere, &t1.bytes, at(0)),
        Heard::Nothing
    );
    assert_eq!(
        follower.receive(address(9), &t1.bytes[..8], at(0)),
        Heard::Nothing
    );
    assert!(matches!(
        follower.receive(address(9), &t1.bytes, at(0)),
        Heard::Answer { .. }
    ));
    assert_eq!(
        follower.receive(address(9), &t1.bytes, at(9)),
        Heard::Nothing,
        "twice"
    );
    // The first who completes an exchange is the RTI, not the first who speaks.
    follower.answered(at(10));
    let t4 = Datagram::T4 {
        came: at(20),
        left: None,
    };
    follower.receive(address(9), &t4.encode(), at(30));
    let probe = Datagram::CodedProbe(at(21)).encode();
    follower.receive(address(10), &probe, at(31));
    assert_eq!(follower.strangers(), 3);
    let complete = follower.receive(address(9), &probe, at(31));
    assert!(matches!(complete, Heard::Complete(..)));
    let later = Datagram::T1(at(5)).encode();
    assert_eq!(
        follower.receive(address(10), &later, at(9)),
        Heard::Nothing,
        "another port"
    );
    assert_eq!(follower.strangers(), 4);
}

#[test]
fn what_answers_an_earlier_exchange_is_not_taken() {
    let Pair {
        mut prober,
        mut follower,
    } = pair(true);
    prober.handle_timeout(at(0));
    let first = sent(&mut prober, 0);
    let Heard::Answer { datagram: late, .. } = follower.receive(address(9), &first.bytes, at(500))
    else {
        panic!("it is the first");
    };
    follower.answered(at(600));
    prober.handle_timeout(at(SECOND));
    let second = sent(&mut prober, SECOND);
    let bytes = late.encode();
    prober.receive(address(7), &bytes, at(SECOND + 10));
    assert!(
        prober.poll_transmit(at(SECOND + 10)).is_none(),
        "it repeats another T1"
    );
    follower.receive(address(9), &second.bytes, at(SECOND + 20));
    follower.answered(at(SECOND + 30));
    assert_eq!(follower.incomplete(), 1);
    let t4 = Datagram::T4 {
        came: at(700),
        left: None,
    }
    .encode();
    let probe = Datagram::CodedProbe(at(750)).encode();
    follower.receive(address(9), &t4, at(SECOND + 40));
    assert_eq!(
        follower.receive(address(9), &probe, at(SECOND + 50)),
        Heard::Nothing
    );
}

#[test]
fn when_datagrams_left_is_known_afterwards() {
    for echoes in [true, false] {
        let Pair {
            mut prober,
            mut follower,
        } = pair(echoes);
        prober.handle_timeout(at(0));
        let t1 = sent(&mut prober, 10);
        assert_eq!(t1.begins, Some(FederateId::new(0)));
        prober.left(FederateId::new(0), at(40));
        let heard = follower.receive(address(9), &t1.bytes, at(500));
        let Heard::Answer { datagram, .. } = heard else {
            panic!("{heard:?}");
        };
        follower.answered(at(600));
        follower.left(at(650));
        prober.receive(address(7), &datagram.encode(), at(1_000));
        let (t4, probe) = (sent(&mut prober, 1_400), sent(&mut prober, 1_450));
        follower.receive(address(9), &t4.bytes, at(2_000));
        let heard = follower.receive(address(9), &probe.bytes, at(2_050));
        // To LF's federates T3 came as much later as T1 left later.
        let (t1, t4) = if echoes { (40, 1_000) } else { (10, 1_030) };
        let [t1, t2, t3, t4] = [t1, 500, 650, t4].map(at);
        let exchange = Exchange { t1, t2, t3, t4 };
        assert_eq!(heard, Heard::Complete(exchange, true), "echoes: {echoes}");
    }
}
