//! STP offsets: from the manifest's bounds and declared offsets to what each federate waits, and why.

use std::fmt;

use ictus_coord::plan::{Bounds, Coordination, Plan};
use ictus_coord::stp::{self, Link, PositiveCycle, SolveError, milliseconds};
use serde::Serialize;

use crate::federation::Member;
use crate::manifest::{Connection, Manifest, TimeSpan, split_link};
use crate::problem::{Place, Report};
use crate::spans::LONGEST_NS;
use crate::suggest;
use crate::wiring::Wire;

/// What every federate waits, and the links that it waits for.
///
/// Its `Display` is a line per federate: `brake 6.4 ms = planner offset 0.9 + planner launch lag 2.0 + network 3.0 +
/// clock 0.5 - after 0`, in milliseconds.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Offsets {
    /// One per federate of the plan, in its order.
    pub federates: Vec<FederateOffset>,
    /// Connections that carry tags between federates, in the order of the plan.
    pub links: Vec<LinkTerms>,
}

/// The offset S of one federate, in nanoseconds.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct FederateOffset {
    /// The federate.
    pub federate: String,
    /// What the manifest declares; absent for `auto`.
    pub declared_ns: Option<i64>,
    /// What the bounds require; absent when an input has no bounds.
    pub required_ns: Option<i64>,
    /// What it waits: the declared offset, else the required one.
    pub used_ns: i64,
    /// When it has decided all its inputs at the latest: what its receivers reckon with.
    pub decided_ns: i64,
    /// Whether an input waits at all; without one a declared offset has no effect.
    pub waits: bool,
    /// The link that requires most, as an index of [`Offsets::links`]; absent without inputs.
    pub by: Option<usize>,
}

/// One link with the terms of its requirement, in nanoseconds.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct LinkTerms {
    /// Index of the plan's connection.
    pub connection: usize,
    /// The output, as the manifest names it.
    pub from: String,
    /// The input, as the manifest names it.
    pub to: String,
    /// The sending federate.
    pub sender: String,
    /// When the sender has decided all its inputs at the latest.
    pub sender_offset_ns: i64,
    /// L, N and E; absent when they are not all declared.
    pub bounds: Option<Bounds>,
    /// The logical delay, 0 for none and for one microstep.
    pub after_ns: i64,
    /// How much longer the receiver waits before it takes this input for absent.
    pub absent_after_ns: i64,
    /// The offset of this connection alone.
    pub declared_ns: Option<i64>,
    /// The sum of the terms; absent without bounds.
    pub required_ns: Option<i64>,
    /// What the receiver waits for this connection.
    pub used_ns: i64,
}

impl Offsets {
    /// Writes what federates wait into a plan.
    pub(crate) fn apply(&self, plan: &mut Plan) {
        for (federate, offset) in plan.federates.iter_mut().zip(&self.federates) {
            // One that waits for nobody does not wait, whatever it declares.
            federate.stp_offset_ns = offset.used_ns.min(offset.decided_ns);
        }
        for link in &self.links {
            let Some(wire) = plan.connections.get_mut(link.connection) else {
                continue;
            };
            let receiver = self.federates.get(usize::from(wire.to.federate));
            let declared = receiver.is_some_and(|federate| federate.declared_ns.is_some());
            wire.stp_offset_ns = link.declared_ns.or((!declared).then_some(link.used_ns));
        }
    }

    /// The sum that makes a federate's required offset, from its total on: `6.4 ms = planner offset 0.9 + ...`.
    #[must_use]
    pub fn breakdown(&self, federate: &FederateOffset) -> String {
        let Some(link) = federate.by.and_then(|index| self.links.get(index)) else {
            return match federate.required_ns {
                Some(_) => "0 ms: no input to wait for".to_owned(),
                None => "unknown: bounds are not declared".to_owned(),
            };
        };
        match (federate.required_ns, link.required_ns) {
            (Some(0), Some(0)) => format!("0 ms = {link}"),
            (Some(0), Some(sum)) => format!("0 ms ({} = {link})", tenths(sum)),
            (Some(required), _) => format!("{} ms = {link}", tenths(required)),
            (None, _) => format!("unknown: not every input has bounds; at least {link}"),
        }
    }
}

impl fmt::Display for Offsets {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, federate) in self.federates.iter().enumerate() {
            let end = if index == 0 { "" } else { "\n" };
            let (name, breakdown) = (&federate.federate, self.breakdown(federate));
            match federate.declared_ns {
                Some(declared) if !federate.waits && declared > 0 => {
                    let declared = tenths(declared);
                    write!(
                        f,
                        "{end}{name} 0 ms (declared {declared} has no effect): no input to wait for"
                    )?;
                }
                None => write!(f, "{end}{name} {breakdown}")?,
                Some(declared) => {
                    let declared = tenths(declared);
                    write!(
                        f,
                        "{end}{name} {declared} ms as declared; required {breakdown}"
                    )?;
                }
            }
        }
        Ok(())
    }
}

impl fmt::Display for LinkTerms {
    /// The terms of the requirement in milliseconds.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let sender = &self.sender;
        let Bounds {
            launch_lag_ns,
            latency_ns,
            clock_error_ns,
        } = self.bounds.unwrap_or_default();
        write!(
            f,
            "{sender} offset {} + {sender} launch lag {} + network {} + clock {} - after {}",
            tenths(self.sender_offset_ns),
            tenths(launch_lag_ns),
            tenths(latency_ns),
            tenths(clock_error_ns),
            tenths(self.after_ns),
        )
    }
}

/// Nanoseconds as milliseconds with at least one decimal, exactly; zero is `0`.
pub(crate) fn tenths(ns: i64) -> String {
    let text = milliseconds(ns);
    if ns == 0 || text.contains('.') {
        text
    } else {
        format!("{text}.0")
    }
}

/// Fills in the bounds of connections and solves the offsets. What is wrong is reported under decentralized
/// coordination only; the result is absent then, and when bounds are missing.
pub(crate) fn resolve(
    manifest: &Manifest,
    members: &[Member<'_>],
    wires: &mut [Wire],
    report: &mut Report,
) -> Option<Offsets> {
    let mut system = System {
        manifest,
        members,
        declared: Vec::new(),
        links: Vec::new(),
    };
    for wire in wires.iter_mut() {
        let [launch_lag, latency, clock_error] = system.terms(wire);
        let bounds = launch_lag.zip(latency).zip(clock_error);
        let tagged = Link::of(&wire.plan).is_some();
        wire.plan.bounds = bounds.filter(|_| tagged).map(|((l, n), e)| Bounds {
            launch_lag_ns: l,
            latency_ns: n,
            clock_error_ns: e,
        });
    }
    let links = wires.iter().enumerate();
    system.links = links
        .filter_map(|(index, wire)| Some((index, Link::of(&wire.plan)?)))
        .collect();
    let offset = |member: &Member<'_>| member.federate.stp_offset;
    system.declared = members
        .iter()
        .map(|member| {
            offset(member)
                .or(manifest.defaults.stp_offset)?
                .declared_ns()
        })
        .collect();
    system.check_names(wires, report);
    let decentralized = manifest.coordination == Some(Coordination::Decentralized);
    if decentralized && system.missing(wires, report) {
        return None;
    }
    let links: Vec<Link> = system.links.iter().map(|(_, link)| *link).collect();
    match stp::solve(&links, &system.declared) {
        Ok(solution) => {
            let offsets = system.offsets(wires, &solution);
            if decentralized && system.too_long(&offsets, report) {
                return None;
            }
            if decentralized {
                system.warn(&offsets, wires, report);
            }
            Some(offsets)
        }
        Err(error) => {
            if decentralized {
                system.refuse(&error, wires, report);
            }
            None
        }
    }
}

struct System<'a> {
    manifest: &'a Manifest,
    members: &'a [Member<'a>],
    /// S by federate, as far as it is given.
    declared: Vec<Option<i64>>,
    /// With the index of its wire.
    links: Vec<(usize, Link)>,
}

impl System<'_> {
    fn name(&self, federate: u16) -> &str {
        let member = self.members.get(usize::from(federate));
        member.map_or("", |member| member.name)
    }

    fn connection(&self, wire: &Wire) -> Option<&Connection> {
        self.manifest.connections.get(wire.entry)
    }

    /// L, N and E of a connection in nanoseconds: its own, else those between its federates, else the sender's, else
    /// the general ones.
    fn terms(&self, wire: &Wire) -> [Option<i64>; 3] {
        let (from, to) = (wire.plan.from.federate, wire.plan.to.federate);
        let all = &self.manifest.bounds;
        let own = self
            .connection(wire)
            .map(|one| one.bounds)
            .unwrap_or_default();
        let link = all.links.get(self.name(from), self.name(to));
        let link = link.copied().unwrap_or_default();
        let sender = self.members.get(usize::from(from));
        let lag = sender.and_then(|member| member.federate.launch_lag);
        [
            own.launch_lag
                .or(link.launch_lag)
                .or(lag)
                .or(all.launch_lag),
            own.latency.or(link.latency).or(all.latency),
            own.clock_error.or(link.clock_error).or(all.clock_error),
        ]
        .map(|term: Option<TimeSpan>| term.map(|span| span.0))
    }

    /// `planner.command`, with the channel of a multiport.
    fn end(&self, wire: &Wire, from: bool) -> String {
        let end = if from { &wire.plan.from } else { &wire.plan.to };
        let member = self.members.get(usize::from(end.federate));
        let known = member.and_then(|member| member.description.as_ref());
        let ports = known.map(|known| if from { &known.outputs } else { &known.inputs });
        let port = ports.and_then(|ports| ports.iter().find(|port| port.name == end.port));
        let name = format!("{}.{}", self.name(end.federate), end.port);
        match port.is_some_and(|port| port.width.is_some()) {
            true => format!("{name}[{}]", end.channel),
            false => name,
        }
    }

    /// Federates in `bounds.links` that are not there, and pairs that nothing connects.
    fn check_names(&self, wires: &[Wire], report: &mut Report) {
        for key in self.manifest.bounds.links.0.names() {
            let place = || Place::key(&["bounds", "links", key]);
            let Some((from, to)) = split_link(key) else {
                let message = format!("`{key}` is not a pair of federates");
                report.add("F005", place(), message, "write `SENDER -> RECEIVER`");
                continue;
            };
            let known = || self.members.iter().map(|member| member.name);
            let strangers = [from, to]
                .into_iter()
                .filter(|name| !known().any(|one| one == *name));
            let mut good = true;
            for name in strangers {
                let message = format!("unknown federate `{name}`");
                report.add("F011", place(), message, suggest::fix(name, known()));
                good = false;
            }
            let joined = wires.iter().any(|wire| {
                let ends = (wire.plan.from.federate, wire.plan.to.federate);
                (self.name(ends.0), self.name(ends.1)) == (from, to)
            });
            if good && !joined {
                let message = format!("nothing leads from `{from}` to `{to}`");
                report.warn("W002", place(), message, "");
            }
        }
    }

    /// Reports federates whose offset is neither declared nor to be solved; whether there is one.
    fn missing(&self, wires: &[Wire], report: &mut Report) -> bool {
        let mut missing = false;
        let mut reported = vec![false; self.members.len()];
        for (index, link) in &self.links {
            let to = link.to.index();
            let declared = link
                .declared_ns
                .or(self.declared.get(to).copied().flatten());
            if link.bounds.is_some() || declared.is_some() {
                continue;
            }
            missing = true;
            let (Some(wire), Some(member)) = (wires.get(*index), self.members.get(to)) else {
                continue;
            };
            let path = ["federates", member.name, "stp_offset"];
            let entry = wire.entry.to_string();
            let broken = report.is_broken(&["bounds"])
                || report.is_broken(&path)
                || report.is_broken(&["defaults", "stp_offset"])
                || report.is_broken(&["connections", &entry]);
            if broken || std::mem::replace(&mut reported[to], true) {
                continue;
            }
            let terms = ["launch_lag", "latency", "clock_error"].into_iter();
            let absent: Vec<&str> = terms
                .zip(self.terms(wire))
                .filter(|(_, term)| term.is_none())
                .map(|(name, _)| name)
                .collect();
            let (name, from, to) = (member.name, self.end(wire, true), self.end(wire, false));
            let message = format!(
                "the offset of `{name}` cannot be solved: `{from} -> {to}` has no `{}`",
                absent.join("`, `")
            );
            let fix = format!(
                "declare `bounds: {{ {}: ... }}`, or give `{name}` an offset: `stp_offset: 5 ms`",
                absent.join(": ..., ")
            );
            let place = match member.federate.stp_offset {
                Some(_) => Place::value(&path),
                None => Place::key(&path[..2]),
            };
            report.add("F028", place, message, fix);
        }
        missing
    }

    /// Refuses what would be waited for more than an hour; whether there is such a federate.
    fn too_long(&self, offsets: &Offsets, report: &mut Report) -> bool {
        let long = |offset: &&FederateOffset| offset.used_ns.max(offset.decided_ns) > LONGEST_NS;
        let first = offsets.federates.iter().find(long);
        if let Some(offset) = first {
            let name = &offset.federate;
            let ms = tenths(offset.used_ns.max(offset.decided_ns));
            let message = format!("`{name}` would wait {ms} ms: an offset is at most 1 h");
            let fix = "declare smaller bounds";
            report.add("F029", Place::key(&["federates", name]), message, fix);
        }
        first.is_some()
    }

    fn refuse(&self, error: &SolveError, wires: &[Wire], report: &mut Report) {
        match error {
            SolveError::Cycle(cycle) => self.refuse_cycle(cycle, wires, report),
            SolveError::TooLong(federate) => {
                let name = self.name(federate.get());
                let message = format!("the offset of `{name}` is beyond the range of time");
                let fix = "declare smaller bounds";
                report.add("F029", Place::key(&["federates", name]), message, fix);
            }
            // `missing` has reported them; and wires name federates that are there.
            SolveError::Unbounded(_) | SolveError::UnknownFederate(_) => {}
        }
    }

    fn refuse_cycle(&self, cycle: &PositiveCycle, wires: &[Wire], report: &mut Report) {
        let first = cycle.links.first().and_then(|index| self.links.get(*index));
        let wire = first.and_then(|(index, _)| wires.get(*index));
        let entry = wire.map_or(0, |wire| wire.entry).to_string();
        let text = cycle.describe(&|id| self.name(id.get()).to_owned());
        let growth = milliseconds(cycle.growth_ns());
        let message = format!("no offset is enough: {text}");
        let fix = format!(
            "give the connections of the cycle {growth} ms more `after`, or declare smaller bounds"
        );
        let place = Place::key(&["connections", &entry, "from"]);
        report.add("F029", place, message, fix);
    }

    fn offsets(&self, wires: &[Wire], solution: &stp::Solution) -> Offsets {
        let federates = self
            .members
            .iter()
            .zip(&solution.federates)
            .zip(&self.declared);
        let links = self.links.iter().zip(&solution.links);
        Offsets {
            federates: federates
                .enumerate()
                .map(|(id, ((member, offset), declared))| FederateOffset {
                    federate: member.name.to_owned(),
                    declared_ns: *declared,
                    required_ns: offset.required_ns,
                    used_ns: offset.used_ns,
                    decided_ns: offset.decided_ns,
                    waits: self.links.iter().any(|(_, link)| link.to.index() == id),
                    by: offset.by,
                })
                .collect(),
            links: links
                .filter_map(|((index, link), offset)| {
                    let wire = wires.get(*index)?;
                    let sender = solution.federates.get(link.from.index());
                    Some(LinkTerms {
                        connection: *index,
                        from: self.end(wire, true),
                        to: self.end(wire, false),
                        sender: self.name(link.from.get()).to_owned(),
                        sender_offset_ns: sender.map_or(0, |sender| sender.decided_ns),
                        bounds: link.bounds,
                        after_ns: link.after_ns,
                        absent_after_ns: link.absent_after_ns,
                        declared_ns: link.declared_ns,
                        required_ns: offset.required_ns,
                        used_ns: offset.used_ns,
                    })
                })
                .collect(),
        }
    }

    /// Warns of declared offsets that are smaller than the required ones, and of what a foreign federate
    /// cannot be told.
    fn warn(&self, offsets: &Offsets, wires: &[Wire], report: &mut Report) {
        for link in offsets
            .links
            .iter()
            .filter(|link| link.declared_ns.is_some())
        {
            let Some(required) = link.required_ns.filter(|it| *it > link.used_ns) else {
                continue;
            };
            let entry = wires
                .get(link.connection)
                .map_or(0, |wire| wire.entry)
                .to_string();
            let (to, used, needed) = (&link.to, tenths(link.used_ns), tenths(required));
            let message = format!(
                "the offset of `{to}` is {used} ms, but its bounds require {needed} ms = {link}"
            );
            let fix = format!("write at least `stp_offset: {needed} ms`");
            let place = Place::value(&["connections", &entry, "stp_offset"]);
            report.warn("W004", place, message, fix);
        }
        for (member, offset) in self.members.iter().zip(&offsets.federates) {
            let name = member.name;
            if member.is_foreign() && offset.declared_ns.is_none() && offset.by.is_some() {
                let used = tenths(offset.used_ns);
                let message = format!(
                    "`{name}` is foreign, so its offset cannot be set here: it needs {used} ms"
                );
                let fix = "compile it in, and write it here as `stp_offset`";
                report.warn("W005", Place::key(&["federates", name]), message, fix);
            }
            let Some(declared) = offset.declared_ns else {
                continue;
            };
            let own = member.federate.stp_offset.is_some();
            if own && declared > 0 && !offset.waits && !member.is_foreign() {
                let message =
                    format!("`stp_offset` has no effect: `{name}` has no input to wait for");
                let place = Place::key(&["federates", name, "stp_offset"]);
                report.warn("W003", place, message, "remove it");
            }
            // Links with an offset of their own do not use this one.
            let inherits = |link: &&LinkTerms| {
                let wire = wires.get(link.connection);
                let to = wire.map_or("", |wire| self.name(wire.plan.to.federate));
                link.declared_ns.is_none() && to == name
            };
            let most = offsets.links.iter().filter(inherits);
            let most = most.filter(|link| link.required_ns.is_some_and(|it| it > declared));
            let Some(link) = most.max_by_key(|link| link.required_ns) else {
                continue;
            };
            let (used, needed) = (tenths(declared), tenths(link.required_ns.unwrap_or(0)));
            let message = format!(
                "the offset of `{name}` is {used} ms, but its bounds require {needed} ms = {link}"
            );
            let fix = format!("write `stp_offset: auto`, or at least `{needed} ms`");
            let place = match member.federate.stp_offset {
                Some(_) => Place::value(&["federates", name, "stp_offset"]),
                None => Place::value(&["defaults", "stp_offset"]),
            };
            report.warn("W004", place, message, fix);
        }
    }
}
