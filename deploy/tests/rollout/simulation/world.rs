//! Hosts with records, blobs, leases and runs, and a clock.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use ictus_deploy::Engine;
use ictus_deploy::gives::Gives;
use ictus_deploy::rollout::{
    Blob, Desired, DesiredHost, Held, MemberState, Observed, Operation, Outcome, Reached, Run,
    RunState, Step,
};

use super::Mutant;

/// How long a lease lasts without renewal.
pub(crate) const TTL_MS: u64 = 30_000;

/// Splitmix64.
#[derive(Clone, Debug)]
pub(crate) struct Rng(u64);

impl Rng {
    pub(crate) fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0xd134_2543_de82_ef95) ^ 0x5851_f42d_4c95_7f2d)
    }

    pub(crate) fn fork(&self, purpose: u64) -> Self {
        Self::new(self.0 ^ purpose.wrapping_mul(0x9e37_79b9))
    }

    pub(crate) fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    pub(crate) fn below(&mut self, bound: usize) -> usize {
        let bound = u64::try_from(bound).unwrap();
        usize::try_from(self.bits() % bound).unwrap()
    }

    pub(crate) fn percent(&mut self, parts: usize) -> bool {
        self.below(100) < parts
    }
}

/// A federation of one federate a host, the RTI on the first; `program` and `parameter` are versions.
pub(crate) fn desired(hosts: &BTreeSet<String>, program: u32, parameter: u32) -> Desired {
    let host = |(index, name): (usize, &String)| {
        let federate = format!("f_{name}");
        let host = DesiredHost {
            images: Vec::new(),
            engine: Engine::Process,
            rti: index == 0,
            federates: vec![federate.clone()],
            needs: BTreeMap::new(),
            blobs: vec![Blob {
                digest: format!("program{program}"),
                bytes: 1 << 20,
                arch: "x86_64".to_owned(),
                federates: vec![federate],
            }],
        };
        (name.clone(), host)
    };
    Desired {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        federation: "demo".to_owned(),
        digest: format!("{hosts:?} {program} {parameter}"),
        facets: BTreeMap::new(),
        hosts: hosts.iter().enumerate().map(host).collect(),
        start_limit_ms: 60_000,
        stop_limit_ms: 30_000,
    }
}

/// A part on a host: its record, and what runs of it.
#[derive(Clone, Debug)]
pub(crate) struct There {
    pub(crate) id: String,
    pub(crate) digest: String,
    life: Life,
    hosts: BTreeSet<String>,
    blobs: BTreeSet<String>,
    /// The record was torn: only that something is there is known.
    torn: bool,
    /// Whose stream it is that committed it.
    stream: Option<String>,
    since_ms: u64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Life {
    Prepared,
    Starting,
    Running,
    Ended,
}

impl There {
    pub(crate) fn is_running(&self) -> bool {
        self.life == Life::Running
    }

    fn lives(&self) -> bool {
        matches!(self.life, Life::Starting | Life::Running)
    }

    /// Its id as the host tells it.
    fn told_id(&self) -> String {
        match self.torn {
            true => String::new(),
            false => self.id.clone(),
        }
    }

    /// A start that nobody waits for any more is undone.
    fn hang_up(&mut self, who: &str) {
        if self.stream.as_deref() == Some(who) {
            self.stream = None;
            if self.life == Life::Starting {
                self.life = Life::Ended;
            }
        }
    }
}

#[derive(Clone, Debug)]
struct Lease {
    who: String,
    number: u64,
    until_ms: u64,
}

#[derive(Clone, Debug, Default)]
pub(crate) struct Host {
    pub(crate) run: Option<There>,
    pub(crate) blobs: BTreeSet<String>,
    logs: bool,
    lease: Option<Lease>,
    last_number: u64,
}

impl Host {
    /// Whether nothing of the federation is there.
    pub(crate) fn is_empty(&self) -> bool {
        self.run.is_none() && self.blobs.is_empty() && !self.logs
    }

    fn is(&self, id: &str) -> bool {
        self.run.as_ref().is_some_and(|run| run.told_id() == id)
    }

    /// Ends what runs; a part that was not begun is gone.
    fn end(&mut self) {
        match &mut self.run {
            Some(run) if run.life == Life::Prepared => self.run = None,
            Some(run) => run.life = Life::Ended,
            None => {}
        }
    }

    /// Removes blobs that no run needs.
    fn collect(&mut self) {
        let needed = self.run.as_ref().map(|run| run.blobs.clone());
        let needed = needed.unwrap_or_default();
        self.blobs.retain(|blob| needed.contains(blob));
    }
}

/// A call on its way to a host.
#[derive(Clone, Debug)]
pub(crate) struct Call {
    pub(crate) who: String,
    pub(crate) number: Option<u64>,
    pub(crate) run: String,
    pub(crate) wanted: Option<Desired>,
    pub(crate) step: Step,
}

#[derive(Debug)]
pub(crate) struct World {
    pub(crate) now_ms: u64,
    pub(crate) hosts: BTreeMap<String, Host>,
    pub(crate) rng: Rng,
    pub(crate) mutant: Option<Mutant>,
    /// Nothing is lost and nobody restarts.
    pub(crate) calm: bool,
    /// Calls that nobody waits for any more and that may arrive yet.
    pub(crate) late: Vec<Call>,
    /// Runs so far; the next one's id.
    pub(crate) runs: u32,
}

impl World {
    pub(crate) fn new(names: &[&str], mutant: Option<Mutant>, rng: Rng) -> Self {
        let host = |name: &&str| ((*name).to_owned(), Host::default());
        Self {
            now_ms: 0,
            hosts: names.iter().map(host).collect(),
            rng,
            mutant,
            calm: true,
            late: Vec::new(),
            runs: 0,
        }
    }

    fn host(&mut self, name: &str) -> &mut Host {
        self.hosts.get_mut(name).unwrap()
    }

    pub(crate) fn pass(&mut self, ms: u64) {
        self.now_ms += ms;
        for _ in 0..20 {
            self.act();
            self.check();
        }
    }

    /// A host loses what it had of the run, and nobody else knows yet.
    pub(crate) fn wipe(&mut self, name: &str) {
        self.host(name).run = None;
    }

    /// Something happens by itself.
    pub(crate) fn act(&mut self) {
        self.now_ms += self.rng.bits() % 300;
        if !self.late.is_empty() && self.rng.percent(20) {
            self.arrive();
        }
        let names: Vec<String> = self.hosts.keys().cloned().collect();
        let name = &names[self.rng.below(names.len())];
        self.live(name);
        if !self.calm && self.rng.percent(2) {
            self.restart(name);
        }
    }

    /// A call arrives after whoever made it has given it up.
    fn arrive(&mut self) {
        let index = self.rng.below(self.late.len());
        let call = self.late.swap_remove(index);
        self.execute(&call);
        self.hang_up(&call.step.host, &call.who);
    }

    /// All that is on its way arrives, and leases that nobody renews end.
    pub(crate) fn settle(&mut self) {
        while !self.late.is_empty() {
            self.arrive();
            self.check();
        }
        self.pass(TTL_MS);
    }

    /// A part becomes healthy when all are started, and ends when another one has.
    fn live(&mut self, name: &str) {
        let Some(run) = self.hosts[name].run.clone().filter(There::lives) else {
            return;
        };
        let of = |name: &String| {
            let there = self.hosts[name].run.as_ref();
            there.filter(|it| it.id == run.id).map(|it| it.life)
        };
        let parts: Vec<_> = run.hosts.iter().map(of).collect();
        let started = |life: &Option<Life>| matches!(life, Some(Life::Starting | Life::Running));
        let over = |life: &Option<Life>| matches!(life, None | Some(Life::Ended));
        let late = run.life == Life::Starting && self.now_ms > run.since_ms + 30_000;
        let there = self.host(name).run.as_mut().unwrap();
        if parts.iter().all(started) {
            there.life = Life::Running;
        } else if parts.iter().any(over) || late {
            there.life = Life::Ended;
        }
    }

    /// A daemon restarts: half starts are undone, leases last for their whole time again, a record may be torn.
    fn restart(&mut self, name: &str) {
        let (now_ms, torn) = (self.now_ms, self.rng.percent(20));
        let host = self.host(name);
        if let Some(lease) = &mut host.lease {
            lease.until_ms = now_ms + TTL_MS;
        }
        if let Some(run) = &mut host.run {
            run.stream = None;
            if run.life == Life::Starting {
                run.life = Life::Ended;
            }
            // Who else takes part has to be known somewhere.
            run.torn |= torn && !run.hosts.contains("dog");
        }
    }

    /// Whoever committed a part does not listen any more.
    pub(crate) fn hang_up(&mut self, host: &str, who: &str) {
        if let Some(run) = &mut self.host(host).run {
            run.hang_up(who);
        }
    }

    /// Laws that hold at any time.
    pub(crate) fn check(&self) {
        let parts = self.hosts.values().filter_map(|host| host.run.as_ref());
        let living: Vec<_> = parts.filter(|run| run.lives()).collect();
        let ids: BTreeSet<_> = living.iter().map(|run| &run.id).collect();
        assert!(ids.len() <= 1, "law: never parts of two runs: {living:?}");
    }

    pub(crate) fn observe_all(&self) -> BTreeMap<String, Observed> {
        let names = self.hosts.keys();
        names
            .map(|name| (name.clone(), self.observe(name)))
            .collect()
    }

    /// What a host says.
    pub(crate) fn observe(&self, name: &str) -> Observed {
        let host = &self.hosts[name];
        let lease = host.lease.as_ref();
        let lease = lease.filter(|lease| self.now_ms < lease.until_ms);
        Observed::Reached(Box::new(Reached {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            arch: "x86_64".to_owned(),
            docker: Err("none".to_owned()),
            gives: Gives::default(),
            secrets_changed: BTreeMap::new(),
            disk_free: 1 << 30,
            state: PathBuf::from("/home/robot/.local/state/ictus"),
            images: BTreeMap::new(),
            blobs: host.blobs.clone(),
            run: Ok(host.run.as_ref().map(|run| told(name, run))),
            lease: lease.map(|lease| Held {
                who: lease.who.clone(),
                left_ms: lease.until_ms - self.now_ms,
            }),
        }))
    }

    /// A host does what it is asked.
    pub(crate) fn execute(&mut self, call: &Call) -> Outcome {
        let (now_ms, mutant) = (self.now_ms, self.mutant);
        let step = &call.step;
        let host = self.host(&step.host);
        host.lease = host.lease.take().filter(|lease| now_ms < lease.until_ms);
        if step.operation == Operation::Lease {
            return lease(host, now_ms, call);
        }
        let number = host.lease.as_ref().map(|lease| lease.number);
        let valid = number.is_some() && number == call.number;
        if !valid && mutant != Some(Mutant::StaleNumbers) {
            return Outcome::Held {
                what: "the number is not the last one".to_owned(),
            };
        }
        assert!(
            call.number == Some(host.last_number),
            "law: who was fenced off changes nothing: {} {:?} on {}",
            call.who,
            step.operation,
            step.host
        );
        if let Err(what) = change(host, now_ms, call) {
            return failed(&what, 0);
        }
        self.stopped_late(call);
        Outcome::Done
    }

    /// What ran may only be stopped when everything is sent.
    fn stopped_late(&self, call: &Call) {
        let stops = matches!(call.step.operation, Operation::StopOld { .. });
        for (name, part) in call.wanted.iter().flat_map(|wanted| &wanted.hosts) {
            let there = &self.hosts[name].blobs;
            let sent = part.blobs.iter().all(|blob| there.contains(&blob.digest));
            // When others are at it, their end may have collected them since; then preparing fails.
            assert!(
                sent || !stops || !self.calm,
                "law: what runs is stopped when all is sent: {name}"
            );
        }
    }

    pub(crate) fn number(&self, host: &str) -> u64 {
        self.hosts[host].last_number
    }

    pub(crate) fn renew(&mut self, host: &str, number: u64) -> bool {
        let now_ms = self.now_ms;
        let lease = self.host(host).lease.as_mut();
        let lease = lease.filter(|it| it.number == number && now_ms < it.until_ms);
        lease
            .map(|lease| lease.until_ms = now_ms + TTL_MS)
            .is_some()
    }

    /// How waiting for a part's health comes out; absent: not yet.
    pub(crate) fn health(&self, host: &str, id: &str) -> Option<Outcome> {
        let run = self.hosts[host].run.as_ref().filter(|run| run.id == id);
        match run.map(|run| run.life) {
            Some(Life::Running) => Some(Outcome::Done),
            Some(Life::Prepared | Life::Starting) => None,
            Some(Life::Ended) | None => Some(failed("it has ended", 3)),
        }
    }
}

fn told(name: &str, run: &There) -> Run {
    let ended = |how: &str| RunState::Ended {
        how: how.to_owned(),
    };
    let mut members = BTreeMap::from([(format!("f_{name}"), MemberState::Lives)]);
    if run.hosts.first().is_some_and(|first| first == name) {
        members.insert("rti".to_owned(), MemberState::Lives);
    }
    Run {
        id: run.told_id(),
        digest: if run.torn {
            String::new()
        } else {
            run.digest.clone()
        },
        facets: BTreeMap::new(),
        state: match run.life {
            Life::Prepared if run.torn => ended("its record is damaged"),
            Life::Prepared => RunState::Prepared,
            Life::Starting => RunState::Starting,
            Life::Running => RunState::Running,
            Life::Ended => ended("stopped"),
        },
        members,
        hosts: if run.torn {
            BTreeSet::new()
        } else {
            run.hosts.clone()
        },
    }
}

fn lease(host: &mut Host, now_ms: u64, call: &Call) -> Outcome {
    if let Some(lease) = &host.lease {
        return Outcome::Held {
            what: format!("{} holds it", lease.who),
        };
    }
    host.last_number += 1;
    host.lease = Some(Lease {
        who: call.who.clone(),
        number: host.last_number,
        until_ms: now_ms + TTL_MS,
    });
    Outcome::Leased {
        run: host.run.as_ref().map(There::told_id),
    }
}

fn change(host: &mut Host, now_ms: u64, call: &Call) -> Result<(), String> {
    match &call.step.operation {
        Operation::Lease | Operation::AwaitHealthy | Operation::SendImage { .. } => {}
        Operation::SendBlob { digest, .. } => {
            host.blobs.insert(digest.clone());
        }
        Operation::StopOld { run } | Operation::StopPart { run } => {
            if host.is(run) {
                host.end();
            }
        }
        Operation::RemovePart { run } => {
            if host.is(run) || host.is("") {
                host.run = None;
            }
        }
        Operation::RemoveOld { run, purge } => {
            let planned = run.as_deref();
            match &host.run {
                Some(there) if Some(there.told_id().as_str()) != planned => {
                    return Err(format!("{} is there", there.id));
                }
                Some(there) if there.lives() => return Err("it runs".to_owned()),
                Some(_) | None => host.run = None,
            }
            host.logs &= !purge;
        }
        Operation::Prepare { previous } => prepare(host, now_ms, previous.as_ref(), call)?,
        Operation::CommitRti | Operation::Commit => {
            let there = host.run.as_mut();
            let prepared =
                there.filter(|run| run.id == call.run && run.life == Life::Prepared && !run.torn);
            let run = prepared.ok_or("it is not prepared")?;
            run.life = Life::Starting;
            run.stream = Some(call.who.clone());
            run.since_ms = now_ms;
            host.logs = true;
        }
        Operation::Release => {
            host.lease = None;
            host.collect();
        }
    }
    Ok(())
}

fn prepare(
    host: &mut Host,
    now_ms: u64,
    previous: Option<&String>,
    call: &Call,
) -> Result<(), String> {
    let there = host.run.as_ref();
    if there.is_some_and(There::lives) {
        return Err("another run is alive".to_owned());
    }
    let id = there.map(There::told_id);
    if id.as_ref() != previous {
        return Err(format!("{id:?} is there, not {previous:?}"));
    }
    let wanted = call.wanted.as_ref().unwrap();
    let blobs = wanted.hosts[&call.step.host].blobs.iter();
    let blobs: BTreeSet<String> = blobs.map(|blob| blob.digest.clone()).collect();
    if !blobs.is_subset(&host.blobs) {
        return Err("a program is missing".to_owned());
    }
    host.run = Some(There {
        id: call.run.clone(),
        digest: wanted.digest.clone(),
        life: Life::Prepared,
        hosts: wanted.hosts.keys().cloned().collect(),
        blobs,
        torn: false,
        stream: None,
        since_ms: now_ms,
    });
    Ok(())
}

pub(crate) fn failed(what: &str, rank: u8) -> Outcome {
    Outcome::Failed {
        what: what.to_owned(),
        rank,
        at_ns: None,
    }
}
