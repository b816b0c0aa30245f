//! One seed, one verdict: generate, run, run again differently, compare with the program alone.

use crate::coverage::{Coverage, Feature};
use crate::executor::{Record, SyntheticExecutor};
use crate::observer::{Observer, Violation};
use crate::offsets::decentralize;
use crate::program::Federation;
use crate::reference::{OutsideEvent, reference};
use crate::seed::{Rng, mix};
use crate::swarm::{Ending, Swarm};
use crate::world::{Conditions, Ended, Member, Run, Victim, World};
use ictus_coord::federate::{FederateConfig, LinkConfig, Outcome};
use ictus_coord::mutants::Mutants;
use ictus_coord::topology::{FederateId, Topology};
use ictus_core::{Delay, Duration, Tag};

/// What a seed showed.
#[derive(Debug)]
pub struct Verdict {
    /// The options it drew.
    pub swarm: Swarm,
    /// The first broken law.
    pub violation: Option<Violation>,
    /// What happened.
    pub coverage: Coverage,
    /// Tags completed by all federates.
    pub tags: u64,
    /// Equal for equal runs.
    pub hash: u64,
    /// Every message of one run, if asked for.
    pub log: Option<String>,
}

/// How the federations of seeds are coordinated.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Kind {
    /// By the RTI's grants.
    #[default]
    Centralized,
    /// By clocks and STP offsets.
    Decentralized,
}

impl Kind {
    fn draw(self, rng: &mut Rng) -> Swarm {
        match self {
            Self::Centralized => Swarm::draw(rng),
            Self::Decentralized => Swarm::draw_decentralized(rng),
        }
    }
}

/// Checks one seed.
#[must_use]
pub fn check_seed(seed: u64, kind: Kind, mutants: Mutants) -> Verdict {
    check_seed_logged(seed, kind, mutants, false)
}

/// Checks one seed and, if asked to, keeps a log of the run that broke a law, or else of the first.
#[must_use]
pub fn check_seed_logged(seed: u64, kind: Kind, mutants: Mutants, log: bool) -> Verdict {
    let mut rng = Rng::new(seed);
    let swarm = kind.draw(&mut rng);
    let federation = Federation::generate(&swarm, &mut rng);
    let mut first = simulate(&federation, &swarm, mutants, &rng.fork(1), log);
    let mut verdict = Verdict {
        violation: first.violation().cloned(),
        coverage: first.observer.coverage.clone(),
        tags: first.members.iter().map(|m| m.tags).sum(),
        hash: hash(&first),
        log: first.observer.log.take(),
        swarm,
    };
    if verdict.swarm.mode.offsets.is_some() {
        verdict.coverage.hit(Feature::Decentralized);
    }
    cover_structure(&federation, &mut verdict.coverage, &verdict.swarm);
    if verdict.violation.is_some() {
        return verdict;
    }
    verdict.violation = judge(&federation, &verdict.swarm, &first).err();
    if verdict.violation.is_none() && seed.is_multiple_of(4) {
        // Another network and other batches: the same laws, the same reference.
        let mut second = simulate(&federation, &verdict.swarm, mutants, &rng.fork(2), log);
        verdict.hash = mix(verdict.hash, hash(&second));
        verdict.violation = second
            .violation()
            .cloned()
            .or_else(|| judge(&federation, &verdict.swarm, &second).err());
        verdict.coverage.merge(&second.observer.coverage);
        if verdict.violation.is_some() {
            verdict.log = second.observer.log.take();
        }
    }
    verdict
}

/// The federation of a seed in words: reactors, reactions, connections.
#[must_use]
pub fn describe(seed: u64, kind: Kind) -> String {
    let mut rng = Rng::new(seed);
    let swarm = kind.draw(&mut rng);
    Federation::generate(&swarm, &mut rng).to_string()
}

/// Runs a federation once.
///
/// # Panics
///
/// When a generated federate has a loop without delay, which is a bug of the generator.
#[must_use]
pub fn simulate(
    federation: &Federation,
    swarm: &Swarm,
    mutants: Mutants,
    rng: &Rng,
    log: bool,
) -> Run<SyntheticExecutor> {
    let mut plan = federation.plan();
    if let Some(offsets) = swarm.mode.offsets {
        decentralize(&mut plan, swarm, offsets, &mut rng.fork(3));
    }
    let topology = Topology::of_plan(&plan);
    let legacy = legacy_sources(&topology, swarm);
    let payload = if rng.fork(9).percent(10) { 3_000 } else { 0 };
    let members = (0..federation.federates.len()).map(|id| {
        let assembly = federation
            .federate(id, swarm.mode.parallel, mutants)
            .expect("a federate of a federation without loops has none");
        let id = u16::try_from(id).unwrap_or(u16::MAX);
        let mut link = LinkConfig::from_plan(&plan, id, &assembly.inputs, &assembly.outputs);
        link.federation.clone_from(&plan.federation);
        Member {
            program: assembly.program.clone(),
            link,
            executor: SyntheticExecutor::new(assembly, payload),
            legacy: legacy[usize::from(id)],
        }
    });
    let conditions = Conditions {
        swarm: swarm.clone(),
        config: FederateConfig {
            timeout: federation.timeout,
            fast: federation.fast,
            keepalive: false,
        },
        mutants,
    };
    let mut observer = Observer::of_plan(&plan);
    observer.log = log.then(String::new);
    observer.physical = swarm.shape.physical;
    observer.extensions = swarm.mode.extensions;
    World::new(members.collect(), &plan, observer, conditions, rng).run()
}

/// The federates that may announce by LTC alone: they have no upstream, and whoever hears from them hears from no others
/// and is heard by none, because the LTC rule reaches no further.
fn legacy_sources(topology: &Topology, swarm: &Swarm) -> Vec<bool> {
    let source = |f: FederateId| topology.upstream(f).is_empty();
    let leaf = |f: FederateId| {
        topology.downstream(f).is_empty() && topology.upstream(f).iter().all(|(u, _)| source(*u))
    };
    let may = |f| source(f) && topology.downstream(f).iter().all(|(d, _)| leaf(*d));
    // Their kind knows neither physical actions nor flow control.
    let ours = swarm.shape.physical || swarm.mode.max_lead.is_some();
    let wanted = swarm.mode.legacy_sources && !ours;
    // All sources of a leaf must, or none.
    let all = |f: FederateId| {
        topology
            .downstream(f)
            .iter()
            .all(|(d, _)| topology.upstream(*d).iter().all(|(u, _)| may(*u)))
    };
    topology
        .federates()
        .map(|f| wanted && may(f) && all(f))
        .collect()
}

/// The checkers that look at a run when it is over.
fn judge(
    federation: &Federation,
    swarm: &Swarm,
    run: &Run<SyntheticExecutor>,
) -> Result<(), Violation> {
    check_outcomes(swarm.mode.extensions, run)?;
    for (index, member) in run.members.iter().enumerate() {
        if let Some(node) = member.executor.unstable() {
            return Err(Violation {
                checker: "executor",
                what: format!("in federate {index} what {node:?} reads changed while it ran"),
            });
        }
    }
    if run.start.is_some() {
        check_stops(federation, swarm, run)?;
        check_trace(federation, swarm, run)?;
    }
    Ok(())
}

fn check_outcomes(extensions: bool, run: &Run<SyntheticExecutor>) -> Result<(), Violation> {
    for (index, member) in run.members.iter().enumerate() {
        let right = match (&member.outcome, run.victim) {
            (None, Some(Victim::Federate(victim))) => victim == index,
            (None, Some(Victim::Rti)) => run.start.is_none(),
            (None, None) => false,
            (Some(Outcome::Stopped), _) => true,
            (Some(Outcome::PeerLost(lost)), Some(Victim::Federate(victim))) => {
                usize::from(*lost) == victim
            }
            // Without our extensions it cannot be told up to where it may run.
            (Some(Outcome::RtiFailed), Some(Victim::Federate(_))) if !extensions => true,
            (
                Some(Outcome::RtiFailed | Outcome::Rejected(_) | Outcome::RtiLost),
                Some(Victim::Federate(_)),
            ) => run.start.is_none(),
            (Some(Outcome::RtiLost), Some(Victim::Rti)) => true,
            (Some(_), _) => false,
        };
        if !right {
            let words = member.outcome.as_ref().map(ToString::to_string);
            return Err(Violation {
                checker: "outcome",
                what: format!("federate {index}: {words:?}, victim {:?}", run.victim),
            });
        }
    }
    Ok(())
}

/// Every record must be one of the reference, and every one of the reference must be there, as far as the run went.
fn check_trace(
    federation: &Federation,
    swarm: &Swarm,
    run: &Run<SyntheticExecutor>,
) -> Result<(), Violation> {
    let Some(start) = run.start else {
        return Ok(());
    };
    let events: Vec<OutsideEvent> = run
        .members
        .iter()
        .enumerate()
        .flat_map(|(federate, m)| m.executor.outside_events(federate, start))
        .collect();
    let stop = common_stop(run, start);
    if stop.is_none() && swarm.ending != Ending::Starvation {
        return Ok(());
    }
    let mut expected = reference(federation, &events, stop);
    expected.sort_unstable();
    for (index, member) in run.members.iter().enumerate() {
        let first = federation.first_reactor(index);
        let last = first + federation.federates[index].reactors.len();
        let mine = |r: &&Record| (first..last).contains(&(r.reactor as usize));
        let limit = Limit::new(member, run, index, swarm);
        let mut actual: Vec<Record> = member.executor.trace().to_vec();
        actual.sort_unstable();
        check_limit(index, &limit, &actual, &expected, start)?;
        let wanted = expected.iter().filter(mine);
        let wanted: Vec<Record> = wanted.filter(|r| limit.covers(r, start)).copied().collect();
        let got: Vec<Record> = actual
            .into_iter()
            .filter(|r| limit.covers(r, start))
            .collect();
        compare(federation, index, &wanted, &got)?;
    }
    Ok(())
}

/// Where the reference stops: nowhere, if nobody has started.
fn common_stop(run: &Run<SyntheticExecutor>, start: Tag) -> Option<(Duration, u32)> {
    let stops = survivors(run).map(|(_, m)| m.stop);
    let stop = stops.filter(|stop| *stop != Tag::FOREVER).max()?;
    Some(since(stop, start))
}

/// The federates that did not die.
fn survivors(
    run: &Run<SyntheticExecutor>,
) -> impl Iterator<Item = (usize, &Ended<SyntheticExecutor>)> {
    let died = move |index: usize| run.victim == Some(Victim::Federate(index));
    run.members
        .iter()
        .enumerate()
        .filter(move |(index, _)| !died(*index))
}

/// All who take part in a stop stop at the same tag; others have ended at the time-out before it was agreed.
fn check_stops(
    federation: &Federation,
    swarm: &Swarm,
    run: &Run<SyntheticExecutor>,
) -> Result<(), Violation> {
    let (Some(start), Some(timeout)) = (run.start, federation.timeout) else {
        return Ok(());
    };
    if run.victim == Some(Victim::Rti) || swarm.ending == Ending::Starvation {
        return Ok(());
    }
    let end = start.delayed(Delay::Time(timeout));
    let stops = survivors(run).filter(|(_, m)| m.stop != Tag::FOREVER && m.stop != end);
    let stops = stops.filter(|(_, m)| !matches!(m.outcome, Some(Outcome::RtiFailed)));
    let mut stops = stops.map(|(index, m)| (index, m.stop));
    let Some((first, stop)) = stops.next() else {
        return Ok(());
    };
    match stops.find(|(_, other)| *other != stop) {
        Some((second, other)) => Err(Violation {
            checker: "stop",
            what: format!("{first} stopped at {stop}, {second} at {other}"),
        }),
        None => Ok(()),
    }
}

fn since(tag: Tag, start: Tag) -> (Duration, u32) {
    (tag.time - start.time, tag.microstep)
}

/// Up to which tag a federate's records can be compared.
#[derive(Debug)]
struct Limit {
    /// The last tag.
    last: Tag,
    /// Ordinary reactions may run up to here, and again nothing but shutdown at the stop tag.
    promise: Option<Tag>,
    /// The tag reached when the loss became known.
    entered: Option<Tag>,
    stop: Tag,
}

impl Limit {
    fn new(
        member: &Ended<SyntheticExecutor>,
        run: &Run<SyntheticExecutor>,
        index: usize,
        swarm: &Swarm,
    ) -> Self {
        let (stop, at) = (member.stop, member.at);
        let decentralized = swarm.mode.offsets.is_some();
        let promise = if decentralized {
            None
        } else {
            run.observer.promise(index)
        };
        let before_stop = stop.latest_earlier();
        let last = match run.victim {
            // It may have died amid a tag.
            Some(Victim::Federate(victim)) if victim == index => {
                let agreed = survivors(run).map(|(_, m)| m.stop).max();
                at.min(agreed.unwrap_or(at)).latest_earlier()
            }
            Some(Victim::Federate(_)) if matches!(member.outcome, Some(Outcome::RtiFailed)) => {
                before_stop.latest_earlier()
            }
            Some(Victim::Federate(_)) if decentralized => before_stop.latest_earlier(),
            Some(Victim::Federate(_)) => promise.map_or(before_stop, |p| p.min(before_stop)),
            // The last tag may have been left half done, and shutdown ran early.
            Some(Victim::Rti) if at >= stop => before_stop.latest_earlier(),
            Some(Victim::Rti) => at.latest_earlier(),
            None if swarm.ending == Ending::Starvation => before_stop,
            // Without our extensions, what is written at an agreed stop tag may stay where it is.
            None if !swarm.mode.extensions => before_stop,
            // Others ended later, and ran no shutdown at this one's stop tag.
            None if survivors(run).any(|(_, m)| m.stop > stop) => before_stop,
            None => stop,
        };
        // From the first counted violation, or the loss of anybody, on, time may have decided otherwise than the program.
        let last = match run.faithful {
            Some(tag) if decentralized => last.min(tag.latest_earlier()),
            Some(_) | None => last,
        };
        Self {
            last,
            promise,
            entered: run.observer.entered_before_loss(index),
            stop,
        }
    }

    fn covers(&self, record: &Record, start: Tag) -> bool {
        (record.time, record.microstep) <= since(self.last, start)
    }
}

/// No ordinary reaction past the promise of a lost one, but for what did not depend on it at tags that had been entered
/// before the loss was known.
fn check_limit(
    index: usize,
    limit: &Limit,
    records: &[Record],
    expected: &[Record],
    start: Tag,
) -> Result<(), Violation> {
    let Some(promise) = limit.promise else {
        return Ok(());
    };
    let (promise, stop) = (since(promise, start), since(limit.stop, start));
    let tag = |r: &Record| (r.time, r.microstep);
    let mut past = records.iter().filter(|r| tag(r) > promise && tag(r) < stop);
    let entered = limit.entered.map(|entered| since(entered, start));
    match past.find(|r| Some(tag(r)) > entered || expected.binary_search(r).is_err()) {
        Some(record) => Err(Violation {
            checker: "promise",
            what: format!("federate {index} ran {record:?} past {promise:?}, stop {stop:?}"),
        }),
        None => Ok(()),
    }
}

fn compare(
    federation: &Federation,
    index: usize,
    wanted: &[Record],
    got: &[Record],
) -> Result<(), Violation> {
    if wanted == got {
        return Ok(());
    }
    let place = wanted.iter().zip(got).take_while(|(w, g)| w == g).count();
    let name = |record: Option<&Record>| {
        record.map_or("nothing".to_owned(), |r| {
            let path = federation.paths().nth(r.reactor as usize).unwrap_or("?");
            format!(
                "{path}#{} at {}+{} ({:x})",
                r.reaction, r.time, r.microstep, r.effects
            )
        })
    };
    Err(Violation {
        checker: "determinism",
        what: format!(
            "federate {index}, record {place}: expected {}, got {}",
            name(wanted.get(place)),
            name(got.get(place))
        ),
    })
}

fn hash(run: &Run<SyntheticExecutor>) -> u64 {
    let mut hash = run.duration.as_nanos().cast_unsigned();
    for member in &run.members {
        for record in member.executor.trace() {
            let tag = mix(
                record.time.as_nanos().cast_unsigned(),
                u64::from(record.microstep),
            );
            hash = mix(hash, mix(tag, record.effects));
        }
    }
    hash
}

/// Counts what follows from the structure alone.
fn cover_structure(federation: &Federation, coverage: &mut Coverage, swarm: &Swarm) {
    let topology = Topology::of_plan(&federation.plan());
    let ids: Vec<FederateId> = topology.federates().collect();
    let in_zero_delay_cycle = |f: &FederateId| topology.in_zero_delay_cycle(*f);
    let apart = ids.iter().filter(|f| in_zero_delay_cycle(f)).any(|a| {
        ids.iter().filter(|f| in_zero_delay_cycle(f)).any(|b| {
            topology.path(*a, *b).is_some() && !topology.share_zero_delay_cycle(*a, *b) && a != b
        })
    });
    let hits = [
        (Feature::TwoZeroDelayCycles, apart),
        (
            Feature::AnsweringPair,
            swarm.shape.zero_delay_cycles && ids.iter().any(in_zero_delay_cycle),
        ),
        (
            Feature::Cycle,
            ids.iter()
                .any(|f| topology.in_cycle(*f) && !topology.in_zero_delay_cycle(*f)),
        ),
        (
            Feature::SelfContained,
            federation
                .links
                .iter()
                .any(|l| l.from.0 == l.to.0 && l.delay != Delay::None),
        ),
        (
            Feature::Alone,
            ids.iter()
                .any(|f| topology.upstream(*f).is_empty() && topology.downstream(*f).is_empty()),
        ),
        (Feature::Fast, swarm.mode.fast),
        (Feature::Foreign, !swarm.mode.extensions),
        (Feature::Calm, swarm.mode.calm),
        (
            Feature::LegacySource,
            legacy_sources(&topology, swarm)
                .iter()
                .zip(&ids)
                .any(|(legacy, id)| *legacy && !topology.downstream(*id).is_empty()),
        ),
        (
            Feature::StopByReaction,
            swarm.ending == Ending::ReactionStop,
        ),
        (Feature::Starvation, swarm.ending == Ending::Starvation),
    ];
    for (feature, hit) in hits {
        if hit {
            coverage.hit(feature);
        }
    }
}
