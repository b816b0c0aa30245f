//! Which hosts are lost: laws over a kernel that asks as TCP does, and cases as a table.

use std::net::{IpAddr, Ipv4Addr};

use ictus_coord::silence::{Reading, Silence, Traffic};
use ictus_core::{Duration, PhysicalTime};
use proptest::prelude::*;

const HOST: IpAddr = IpAddr::V4(Ipv4Addr::new(10, 0, 0, 2));
const OTHER: IpAddr = IpAddr::V4(Ipv4Addr::new(10, 0, 0, 3));

fn at(ms: i64) -> PhysicalTime {
    PhysicalTime::from_nanos(0) + Duration::from_millis(ms)
}

fn reading(connection: u8, traffic: Traffic) -> Reading<u8> {
    Reading {
        host: HOST,
        connection,
        traffic,
    }
}

/// What one end of a connection does besides its program.
#[derive(Clone, Copy, Debug)]
enum Kernel {
    /// Nothing is under way: it asks every so often.
    Idle,
    /// Data is under way: it is sent again after a time that doubles.
    Data,
    /// The window is closed: probes, whose distance doubles although they are answered.
    Closed,
}

/// A connection whose peer answers in `trip` unless the network is cut.
struct Simulated {
    kernel: Kernel,
    keepalive: i64,
    trip: i64,
    cut: std::ops::Range<i64>,
    next_ask: i64,
    spacing: i64,
    answers: Vec<i64>,
    traffic: Traffic,
}

impl Simulated {
    fn new(kernel: Kernel, timeout: i64, trip: i64, cut: std::ops::Range<i64>) -> Self {
        let keepalive = (timeout / 4_000).max(1) * 1_000;
        let spacing = match kernel {
            Kernel::Idle => keepalive,
            Kernel::Data | Kernel::Closed => 200,
        };
        Self {
            kernel,
            keepalive,
            trip,
            cut,
            next_ask: spacing,
            spacing,
            answers: Vec::new(),
            traffic: Traffic::default(),
        }
    }

    fn step(&mut self, now: i64) {
        let heard = self.answers.iter().filter(|it| **it <= now).count();
        if heard > 0 {
            self.answers.retain(|it| *it > now);
            self.traffic.heard += 1;
            self.traffic.probes = 0;
            if let Kernel::Data = self.kernel {
                // Acknowledged; the program sends the next.
                (self.next_ask, self.spacing) = (now + 1, 200);
            }
        }
        if self.next_ask > now {
            return;
        }
        match self.kernel {
            Kernel::Idle => {
                self.traffic.probes += 1;
                self.next_ask = now + self.keepalive;
            }
            Kernel::Data => {
                self.traffic.asked += 1;
                self.next_ask = now + self.spacing;
                self.spacing = (self.spacing * 2).min(120_000);
            }
            Kernel::Closed => {
                self.traffic.probes += 1;
                self.next_ask = now + self.spacing;
                self.spacing = (self.spacing * 2).min(120_000);
            }
        }
        let there_and_back = !self.cut.contains(&now) && !self.cut.contains(&(now + self.trip));
        if there_and_back {
            self.answers.push(now + self.trip);
        }
    }
}

/// When the host is given up, in milliseconds; connections are looked at every period, `offset` later.
fn given_up(mut connections: Vec<Simulated>, timeout: i64, offset: i64, end: i64) -> Option<i64> {
    let mut silence = Silence::new(Duration::from_millis(timeout));
    let period = silence.period().as_nanos() / 1_000_000;
    for now in 0..end {
        for connection in &mut connections {
            connection.step(now);
        }
        if now % period == offset % period {
            let readings: Vec<_> = (0_u8..)
                .zip(&connections)
                .map(|(n, it)| reading(n, it.traffic))
                .collect();
            if !silence.look(at(now), &readings).is_empty() {
                return Some(now);
            }
        }
    }
    None
}

fn kernels() -> impl Strategy<Value = Kernel> {
    prop_oneof![Just(Kernel::Idle), Just(Kernel::Data), Just(Kernel::Closed)]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 50, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_cut_shorter_than_the_timeout_is_no_loss(
        kernels in proptest::collection::vec(kernels(), 1..4),
        timeout in 1_000_i64..20_000,
        (begin, part) in (1_000_i64..60_000, 0.0_f64..1.0),
        (trip, offset) in (0_i64..100, 0_i64..3_000),
    ) {
        #[expect(clippy::cast_possible_truncation, clippy::cast_precision_loss, reason = "small")]
        let length = ((timeout - 2 * trip) as f64 * part) as i64;
        let cut = begin..begin + length;
        let kernels = kernels.into_iter();
        let connections = kernels.map(|it| Simulated::new(it, timeout, trip, cut.clone())).collect();
        prop_assert_eq!(given_up(connections, timeout, offset, begin + 5 * timeout), None);
    }

    #[test]
    fn a_host_that_is_gone_is_found(
        kernel in prop_oneof![Just(Kernel::Idle), Just(Kernel::Data)],
        more in proptest::collection::vec(kernels(), 0..3),
        timeout in 1_000_i64..20_000,
        begin in 1_000_i64..60_000,
        (trip, offset) in (0_i64..100, 0_i64..3_000),
    ) {
        let kernels = more.into_iter().chain([kernel]);
        let gone = begin..i64::MAX;
        let connections = kernels.map(|it| Simulated::new(it, timeout, trip, gone.clone())).collect();
        let found = given_up(connections, timeout, offset, begin + 5 * timeout);
        prop_assert!(found.is_some_and(|at| at > begin + timeout), "{found:?}");
        prop_assert!(found.is_some_and(|at| at <= begin + timeout * 13 / 4 + 1_000), "{found:?}");
    }

    #[test]
    fn a_closed_window_is_no_loss(trip in 0_i64..100, timeout in 1_000_i64..20_000, offset in 0_i64..3_000) {
        let closed = vec![Simulated::new(Kernel::Closed, timeout, trip, 0..0)];
        prop_assert_eq!(given_up(closed, timeout, offset, 20 * timeout), None);
    }
}

#[test]
fn one_connection_speaks_for_its_host_and_for_no_other() {
    let mut silence = Silence::new(Duration::from_secs(8));
    let of = |host, connection, heard, asked| Reading {
        host,
        connection,
        traffic: Traffic {
            heard,
            asked,
            probes: 0,
        },
    };
    for second in 0_u32..30 {
        let readings = [
            of(HOST, 0_u8, 1, second),
            of(HOST, 1, second, 1),
            of(OTHER, 0, 1, second),
        ];
        let lost = silence.look(at(i64::from(second) * 1_000), &readings);
        let expected = if second >= 11 {
            vec![OTHER]
        } else {
            Vec::new()
        };
        let hosts: Vec<_> = lost.iter().map(|silent| silent.host).collect();
        assert_eq!(hosts, expected, "after {second} s");
        if let Some(silent) = lost.first() {
            assert_eq!(silent.lasting, Duration::from_secs(i64::from(second) - 1));
        }
    }
    assert!(silence.look(at(31_000), &[]).is_empty());
}

#[test]
fn who_is_not_asked_need_not_answer() {
    let mut silence = Silence::new(Duration::from_secs(1));
    let traffic = Traffic {
        heard: 1,
        asked: 7,
        probes: 0,
    };
    for second in 0..1_000 {
        assert!(
            silence
                .look(at(second * 1_000), &[reading(0, traffic)])
                .is_empty()
        );
    }
}
