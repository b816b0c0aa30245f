//! `up` and `down` in a world of simulated hosts, from seeds: killed at every event, disturbed, and run again.

use std::collections::{BTreeMap, BTreeSet};
use std::panic::{AssertUnwindSafe, catch_unwind};

use ictus_deploy::rollout::{Desired, Operation, Phase, plan};

use cli::{Cli, Stage, Wish};
use world::{Rng, World, desired};

mod cli;
mod world;

/// Seeds of each test; `ROLLOUT_SEEDS=FIRST..LAST` gives others.
const SEEDS: std::ops::Range<u64> = 0..200;

/// More events than any life has.
const EVENTS_MAX: u32 = 4_000;

/// A bug that the laws must find.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mutant {
    /// A host that cannot be reached counts as one where nothing is.
    AbsentWhenUnreachable,
    /// Only hosts that have answered are undone.
    ForgetsWhoDidNotAnswer,
    /// Hosts take changes with any number.
    StaleNumbers,
    /// What is healthy on one host is left alone when the rest restarts.
    PartialRestart,
    /// What runs is stopped before everything is sent.
    EarlyStop,
}

/// What happens to the first `up`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fate {
    /// Nothing.
    Undisturbed,
    /// It is killed after this many events.
    Killed(u32),
    /// Messages are lost and late, daemons restart, others change the federation, it is paused and interrupted.
    Disturbed,
}

/// A seed's hosts, what ran on them before, and what is wanted.
struct Scenario {
    world: World,
    wanted: Desired,
    rng: Rng,
}

impl Scenario {
    fn new(seed: u64, mutant: Option<Mutant>) -> Self {
        let mut rng = Rng::new(seed);
        let names = ["ant", "bee", "cat", "dog"];
        let count = 1 + rng.below(3);
        let hosts: BTreeSet<String> = names.iter().take(count).map(|&it| it.to_owned()).collect();
        let mut world = World::new(&names, mutant, rng.fork(1));
        let wanted = desired(&hosts, 7, 1);
        // What is there: nothing, the same, an older program, older parameters, or a part on one more host.
        let mut former = hosts.clone();
        let old = match rng.below(6) {
            0 => None,
            1 | 5 => Some(wanted.clone()),
            2 => Some(desired(&hosts, 6, 1)),
            3 => Some(desired(&hosts, 7, 0)),
            _ => {
                former.insert("dog".to_owned());
                Some(desired(&former, 7, 1))
            }
        };
        if let Some(old) = old {
            up(&mut world, &old, "old");
        }
        // A part that is missing on one host, and no part that only that host knows of.
        if rng.percent(20) {
            let lost = hosts.iter().nth(rng.below(count)).unwrap();
            if former == hosts {
                world.wipe(lost);
            }
        }
        Self { world, wanted, rng }
    }
}

/// Runs `up` until it has converged; without disturbance that takes as long as a lease at most.
fn up(world: &mut World, wanted: &Desired, who: &str) {
    converge(world, &Wish::Up(wanted.clone()), who);
}

fn converge(world: &mut World, wish: &Wish, who: &str) {
    world.calm = true;
    let mut last = String::new();
    for attempt in 0..12 {
        let name = format!("{who}{attempt}");
        let mut cli = Cli::new(&name, wish.clone());
        live(world, &mut [&mut cli], None);
        match &cli.stage {
            Stage::Nothing | Stage::Over(Phase::Done) => return,
            Stage::Refused(refusal) => last = refusal.to_string(),
            stage @ (Stage::Observing | Stage::Applying | Stage::Over(_)) => {
                last = format!("{stage:?}");
            }
        }
        world.pass(world::TTL_MS / 3);
    }
    panic!("law: `up` and `down` converge: {last}");
}

/// Lets everybody do what they do, in random order, until all are over; gives the number of events.
fn live(world: &mut World, clis: &mut [&mut Cli], kill_first_at: Option<u32>) -> u32 {
    for events in 0..EVENTS_MAX {
        if kill_first_at == Some(events) {
            clis[0].die(world);
        }
        let over = clis.iter().all(|cli| cli.is_over());
        if over {
            return events;
        }
        let index = world.rng.below(clis.len() + 1);
        match clis.get_mut(index) {
            Some(cli) => cli.act(world),
            None => world.act(),
        }
        world.check();
    }
    panic!("law: nothing hangs: {clis:?}");
}

/// One life of a seed; gives the events of its first `up`.
fn one(seed: u64, fate: Fate, mutant: Option<Mutant>) -> u32 {
    let mut scenario = Scenario::new(seed, mutant);
    let (world, wanted) = (&mut scenario.world, &scenario.wanted);
    world.calm = fate != Fate::Disturbed;
    let mut first = Cli::new("ann", Wish::Up(wanted.clone()));
    let events = match fate {
        Fate::Undisturbed => live(world, &mut [&mut first], None),
        Fate::Killed(event) => live(world, &mut [&mut first], Some(event)),
        Fate::Disturbed => {
            let other = match scenario.rng.below(4) {
                0 => Wish::Up(wanted.clone()),
                1 => Wish::Up(desired(&wanted.hosts.keys().cloned().collect(), 8, 1)),
                2 => Wish::Down { purge: false },
                _ => Wish::Down { purge: true },
            };
            let mut second = Cli::new("bob", other);
            second.sleep(world, scenario.rng.bits() % 40_000);
            let kill = scenario.rng.percent(30).then(|| scenario.rng.below(150));
            let kill = kill.map(|kill| u32::try_from(kill).unwrap());
            live(world, &mut [&mut first, &mut second], kill)
        }
    };
    up(world, wanted, "again");
    settled(world, wanted, false);
    if !matches!(fate, Fate::Killed(event) if event % 8 != 0) {
        changed_parameter(world, wanted);
    }
    converge(world, &Wish::Down { purge: true }, "down");
    world.settle();
    for (name, host) in &world.hosts {
        assert!(
            host.is_empty(),
            "law: `down --purge` leaves nothing: {name} has {host:?}"
        );
    }
    events
}

/// Exactly what is wanted is there, and a second plan is empty. `exactly`: no other program is left either, which a change
/// sees to when it ends.
fn settled(world: &mut World, wanted: &Desired, exactly: bool) {
    world.settle();
    for (name, host) in &world.hosts {
        let run = host.run.as_ref();
        match wanted.hosts.get(name) {
            None => assert!(run.is_none(), "law: nothing extra: {name} has {run:?}"),
            Some(part) => {
                let run = run.unwrap();
                assert_eq!(
                    run.digest, wanted.digest,
                    "law: what is wanted is there: {name}"
                );
                assert!(run.is_running(), "law: it is healthy: {name} {run:?}");
                let blobs: BTreeSet<_> = part.blobs.iter().map(|it| it.digest.clone()).collect();
                assert!(
                    blobs.is_subset(&host.blobs),
                    "law: its programs are there: {name}"
                );
                assert!(
                    !exactly || host.blobs == blobs,
                    "law: nothing extra: {name} {host:?}"
                );
            }
        }
    }
    let observed = world.observe_all();
    let plan = plan(wanted, &observed).unwrap();
    assert!(plan.is_empty(), "law: a second plan is empty: {plan}");
}

/// One parameter changes: everything restarts, and nothing is sent.
fn changed_parameter(world: &mut World, wanted: &Desired) {
    let hosts = wanted.hosts.keys().cloned().collect();
    let changed = desired(&hosts, 7, 99);
    let plan = plan(&changed, &world.observe_all()).unwrap();
    assert_eq!(
        plan.bytes(),
        0,
        "law: a changed parameter sends nothing: {plan}"
    );
    let sends = |operation: &Operation| matches!(operation, Operation::SendBlob { .. });
    assert!(!plan.is_empty() && !plan.steps.iter().any(|step| sends(&step.operation)));
    up(world, &changed, "changed");
    settled(world, &changed, true);
}

fn seeds() -> std::ops::Range<u64> {
    let Ok(asked) = std::env::var("ROLLOUT_SEEDS") else {
        return SEEDS;
    };
    let (first, last) = asked.split_once("..").unwrap();
    first.parse().unwrap()..last.parse().unwrap()
}

/// Runs a seed; a failure says how to repeat it.
fn attempt(seed: u64, fate: Fate, mutant: Option<Mutant>) -> Result<u32, String> {
    catch_unwind(AssertUnwindSafe(|| one(seed, fate, mutant))).map_err(|panic| {
        let what = panic.downcast_ref::<String>().cloned();
        let what = what.or_else(|| panic.downcast_ref::<&str>().map(|&it| it.to_owned()));
        format!(
            "seed {seed}, {fate:?}: {}\nrepeat: ROLLOUT_SEEDS={seed}..{} cargo nextest run -p ictus-deploy simulation",
            what.unwrap_or_default(),
            seed + 1
        )
    })
}

/// Every event of `up` is one at which it is killed once. `share`: one of four shares of the seeds.
fn killed_at_every_event(share: u64) {
    for seed in seeds().filter(|seed| seed % 4 == share) {
        let events =
            attempt(seed, Fate::Undisturbed, None).unwrap_or_else(|error| panic!("{error}"));
        for event in 0..events {
            attempt(seed, Fate::Killed(event), None).unwrap_or_else(|error| panic!("{error}"));
        }
    }
}

#[test]
fn a_cli_killed_at_any_event_converges_when_run_again_0() {
    killed_at_every_event(0);
}

#[test]
fn a_cli_killed_at_any_event_converges_when_run_again_1() {
    killed_at_every_event(1);
}

#[test]
fn a_cli_killed_at_any_event_converges_when_run_again_2() {
    killed_at_every_event(2);
}

#[test]
fn a_cli_killed_at_any_event_converges_when_run_again_3() {
    killed_at_every_event(3);
}

#[test]
fn lost_messages_restarts_pauses_and_others_break_no_law() {
    let wanted = seeds();
    for seed in wanted.start..wanted.start + 10 * (wanted.end - wanted.start) {
        attempt(seed, Fate::Disturbed, None).unwrap_or_else(|error| panic!("{error}"));
    }
}

#[test]
fn the_laws_find_deliberate_bugs() {
    let mutants = [
        Mutant::AbsentWhenUnreachable,
        Mutant::ForgetsWhoDidNotAnswer,
        Mutant::StaleNumbers,
        Mutant::PartialRestart,
        Mutant::EarlyStop,
    ];
    std::panic::set_hook(Box::new(|_| {}));
    let mut found: BTreeMap<String, Option<String>> = BTreeMap::new();
    for mutant in mutants {
        let caught = (0..2_000).find_map(|seed| attempt(seed, Fate::Disturbed, Some(mutant)).err());
        found.insert(format!("{mutant:?}"), caught);
    }
    drop(std::panic::take_hook());
    for (mutant, caught) in &found {
        println!("{mutant}: {}", caught.as_deref().unwrap_or("not found"));
    }
    assert!(found.values().all(Option::is_some), "{found:#?}");
}
