//! Law `batches_do_not_matter`: small federations of model federates run against the RTI, with their bytes cut and drained
//! in ways that a seed decides. What they do must not depend on it.

#![allow(
    clippy::unwrap_used,
    clippy::panic,
    clippy::wildcard_enum_match_arm,
    missing_docs,
    reason = "a test"
)]

use std::collections::BTreeMap;

use ictus_coord::rti::{ConnectionId, Rti, RtiConfig};
use ictus_coord::topology::{FederateId, Topology};
use ictus_coord::wire::{NO_CLOCK_SYNC, TaggedMessage, ToFederate, ToRti};
use ictus_core::{Delay, Duration, PhysicalTime, Tag};
use proptest::collection::vec;
use proptest::prelude::*;

const NOW: PhysicalTime = PhysicalTime::from_nanos(1_000);
/// Every federate stops this many nanoseconds after the start.
const TIMEOUT: i64 = 30;
/// A message is passed on this often.
const HOPS: u8 = 3;

/// Who is connected to whom, and the period of each federate's timer (0: none).
#[derive(Clone, Debug)]
struct Program {
    edges: Vec<(u16, u16, Delay)>,
    periods: Vec<i64>,
    /// Which federates skip the NETs that a DNET allows them to skip.
    skips: Vec<bool>,
}

fn program() -> impl Strategy<Value = Program> {
    (2u16..6).prop_flat_map(|federates| {
        let edge = (0..federates, 0..federates, -1i64..4).prop_map(|(a, b, delay)| {
            // A connection without delay goes forward only: no zero-delay cycles here.
            let delay = if a < b { delay } else { delay.max(0) };
            (a, b, Delay::after(Duration::from_nanos(delay)))
        });
        let federates = usize::from(federates);
        (
            vec(edge, 1..8),
            vec(0i64..7, federates),
            vec(any::<bool>(), federates),
        )
            .prop_map(|(edges, periods, skips)| Program {
                edges,
                periods,
                skips,
            })
    })
}

/// A small generator of numbers; the same seed gives the same ones.
struct Random(u64);

impl Random {
    fn below(&mut self, bound: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        usize::try_from(self.0 >> 33).unwrap() % bound
    }
}

/// A federate that runs its timer and passes messages on.
struct Model {
    connection: ConnectionId,
    waits: bool,
    downstream: Vec<(u16, Delay)>,
    stop: Tag,
    /// Events to come and how often each has been passed on.
    queue: BTreeMap<Tag, u8>,
    granted: Tag,
    announced: Option<Tag>,
    /// DNET as the federate follows it; `None` until one has come, or when it ignores them.
    dnet: Option<Tag>,
    skips: bool,
    last_net: Tag,
    skipped: Option<Tag>,
    done: Tag,
    resigned: bool,
    out: Vec<u8>,
    /// What the RTI's driver keeps of an incomplete message.
    unread: Vec<u8>,
    input: Vec<u8>,
    trace: Vec<(Tag, u8)>,
}

impl Model {
    fn say(&mut self, message: &ToRti<'_>) {
        message.encode(&mut self.out);
    }

    fn read(&mut self) {
        let input = std::mem::take(&mut self.input);
        let mut at = 0;
        while let Some((message, length)) = ToFederate::decode(&input[at..]).unwrap() {
            at += length;
            match message {
                ToFederate::TaggedMessage(message) => {
                    assert!(
                        message.tag > self.done,
                        "tardy: {} after {}",
                        message.tag,
                        self.done
                    );
                    assert!(
                        message.tag > self.granted,
                        "below the grant {}",
                        self.granted
                    );
                    let hops = self.queue.entry(message.tag).or_default();
                    *hops = message.payload[0].max(*hops);
                }
                ToFederate::TagAdvanceGrant(tag) => {
                    assert!(tag > self.granted, "grants rise");
                    self.granted = tag;
                }
                ToFederate::DownstreamNextEventTag(tag) => self.follow(tag),
                ToFederate::Ack | ToFederate::Timestamp(_) => {}
                other => panic!("{other:?}"),
            }
        }
        assert_eq!(at, input.len(), "outputs hold whole messages");
    }

    fn follow(&mut self, dnet: Tag) {
        if self.skips {
            self.dnet = Some(dnet);
            if let Some(skipped) = self.skipped.take_if(|skipped| dnet < *skipped) {
                self.announce(skipped);
            }
        }
    }

    fn announce(&mut self, tag: Tag) {
        self.last_net = tag;
        self.skipped = None;
        self.say(&ToRti::NextEventTag(tag));
    }

    /// Announces a tag that needs no grant: only for others' sake.
    fn announce_for_others(&mut self, tag: Tag) {
        match self.dnet {
            Some(dnet) if tag <= dnet || dnet < self.last_net => self.skipped = Some(tag),
            Some(_) | None => self.announce(tag),
        }
    }

    fn act(&mut self) {
        while !self.resigned {
            let next = self
                .queue
                .keys()
                .next()
                .copied()
                .filter(|&tag| tag <= self.stop);
            let bound = next.unwrap_or(self.stop);
            if self.waits && self.granted < bound {
                let announced = next.unwrap_or(Tag::FOREVER);
                if self.announced != Some(announced) {
                    self.announced = Some(announced);
                    self.announce(announced);
                }
                return;
            }
            match next {
                Some(tag) => self.execute(tag),
                None => {
                    self.resigned = true;
                    self.say(&ToRti::NextEventTag(Tag::FOREVER));
                    self.say(&ToRti::Resign);
                }
            }
        }
    }

    fn execute(&mut self, tag: Tag) {
        let hops = self.queue.remove(&tag).unwrap();
        self.trace.push((tag, hops));
        if hops < HOPS {
            for (federate, delay) in self.downstream.clone() {
                let arrival = tag.delayed(delay);
                self.dnet = self.dnet.map(|dnet| dnet.min(arrival));
                let message = TaggedMessage {
                    port: 0,
                    federate,
                    tag: arrival,
                    payload: &[hops + 1],
                };
                self.say(&ToRti::TaggedMessage(message));
            }
        }
        self.done = tag;
        self.announced = None;
        self.say(&ToRti::LatestTagConfirmed(tag));
        let next = self.queue.keys().next().copied().unwrap_or(Tag::FOREVER);
        if !self.waits || next <= self.granted {
            self.announce_for_others(next);
        }
    }
}

fn begin(program: &Program) -> (Rti, Vec<Model>) {
    let federates = u16::try_from(program.periods.len()).unwrap();
    let id = FederateId::new;
    let edges = program
        .edges
        .iter()
        .map(|&(a, b, delay)| (id(a), id(b), delay));
    let topology = Topology::new(program.periods.len(), edges);
    let mut rti = Rti::new(RtiConfig::new("law", federates));
    let mut joined = Vec::new();
    for federate in 0..federates {
        let connection = rti.connect(NOW, format!("model {federate}"));
        let mut bytes = Vec::new();
        ToRti::FederateIds {
            federate,
            federation: b"law",
        }
        .encode(&mut bytes);
        ToRti::NeighborStructure(topology.neighbor_structure(id(federate))).encode(&mut bytes);
        ToRti::UdpPort(NO_CLOCK_SYNC).encode(&mut bytes);
        ToRti::Timestamp(NOW).encode(&mut bytes);
        assert_eq!(rti.receive(NOW, connection, &bytes), bytes.len());
        joined.push(connection);
    }
    rti.drain(NOW);
    let start = Tag::new(NOW.as_logical() + Duration::from_secs(1), 0);
    let models = joined.into_iter().zip(0..).map(|(connection, federate)| {
        let period = program.periods[usize::from(federate)];
        let ticks = (0..=TIMEOUT).filter(|&at| period > 0 && at % period == 0);
        let queue = ticks
            .map(|at| (Tag::at(start.time.as_nanos() + at), 0))
            .collect();
        let mut model = Model {
            connection,
            waits: !topology.upstream(id(federate)).is_empty(),
            downstream: program
                .edges
                .iter()
                .filter(|edge| edge.0 == federate)
                .map(|edge| (edge.1, edge.2))
                .collect(),
            stop: Tag::at(start.time.as_nanos() + TIMEOUT),
            queue,
            granted: Tag::NEVER,
            announced: None,
            dnet: None,
            skips: program.skips[usize::from(federate)],
            last_net: start,
            skipped: None,
            done: Tag::NEVER,
            resigned: false,
            out: Vec::new(),
            unread: Vec::new(),
            input: Vec::new(),
            trace: Vec::new(),
        };
        model.say(&ToRti::NextEventTag(start));
        model
    });
    let models = models.collect();
    (rti, models)
}

fn collect(rti: &mut Rti, models: &mut [Model]) {
    while let Some(id) = rti.poll_output() {
        let output = rti.output(id);
        while !output.chunk().is_empty() {
            let length = output.chunk().len();
            if let Some(model) = models.iter_mut().find(|model| model.connection == id) {
                model.input.extend_from_slice(output.chunk());
            }
            output.advance(length);
        }
    }
}

/// Runs a program; `seed` decides who goes next, where bytes are cut and when the RTI is drained.
fn run(program: &Program, seed: u64) -> Vec<Vec<(Tag, u8)>> {
    let (mut rti, mut models) = begin(program);
    let mut random = Random(seed | 1);
    let largest = 1 + random.below(200);
    loop {
        let quiet = models
            .iter()
            .all(|model| model.out.is_empty() && model.input.is_empty());
        if quiet {
            rti.drain(NOW);
            collect(&mut rti, &mut models);
            for model in &mut models {
                model.read();
                model.act();
            }
            if models.iter().all(|model| model.out.is_empty()) {
                break;
            }
        }
        let who = random.below(models.len());
        let model = &mut models[who];
        match random.below(8) {
            0 => {
                rti.drain(NOW);
                collect(&mut rti, &mut models);
            }
            1 | 2 => {
                model.read();
                model.act();
            }
            _ => {
                let arriving = model.out.len().min(1 + random.below(largest));
                model.unread.extend(model.out.drain(..arriving));
                let taken = rti.receive(NOW, model.connection, &model.unread);
                model.unread.drain(..taken);
            }
        }
    }
    for (federate, model) in models.iter().enumerate() {
        assert!(
            model.resigned,
            "federate {federate} waits for ever at {:?}",
            model.announced
        );
    }
    models.into_iter().map(|model| model.trace).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn batches_do_not_matter(program in program(), seeds in any::<(u64, u64)>()) {
        prop_assert_eq!(run(&program, seeds.0), run(&program, seeds.1));
    }
}
