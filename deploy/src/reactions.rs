//! The manifest's `timing` section, resolved: names of reactions become paths and positions, and steps of a
//! chain get the logical delay between them.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};

use crate::federation::Member;
use crate::manifest::{Manifest, OneOrMany};
use crate::problem::{Place, Report};
use crate::suggest;
use crate::timing::{ChainSpec, HopSpec, OrderSpec, PairsSpec, ReactionRef, TimingSpec};
use crate::wiring::Wire;

/// Resolves everything that can be; the rest is reported.
pub(crate) fn resolve(
    manifest: &Manifest,
    members: &[Member<'_>],
    wires: &[Wire],
    report: &mut Report,
) -> TimingSpec {
    let mut resolver = Resolver {
        members,
        wires,
        report,
    };
    let timing = &manifest.timing;
    let mut spec = TimingSpec::default();
    for (index, order) in timing.order.iter().enumerate() {
        let path = path(&["timing", "order"], index, "reactions");
        let Some(names) = &order.reactions else {
            continue;
        };
        if names.len() != 2 {
            let message = format!("an order is of two reactions, found {}", names.len());
            resolver
                .report
                .add("F026", Place::value(&path), message, "");
            continue;
        }
        if let [Some(first), Some(second)] = resolver.all(names, &path).as_slice() {
            let (first, second) = (first.clone(), second.clone());
            spec.order.push(OrderSpec { first, second });
        }
    }
    for (index, pairs) in timing.pairs.iter().enumerate() {
        let at = |key| path(&["timing", "pairs"], index, key);
        let tick = pairs
            .tick
            .as_deref()
            .and_then(|tick| resolver.reaction(tick, &at("tick")));
        let names = pairs.reactions.as_deref().unwrap_or_default();
        let reactions = resolver.all(names, &at("reactions"));
        let reactions: Option<Vec<ReactionRef>> = reactions.into_iter().collect();
        if let (Some(tick), Some(reactions)) = (tick, reactions) {
            let name = pairs.name.clone().unwrap_or_else(|| tick.federate.clone());
            spec.pairs.push(PairsSpec {
                name,
                tick,
                reactions,
            });
        }
    }
    for index in 0..timing.end_to_end.len() {
        spec.end_to_end.extend(resolver.chain(manifest, index));
    }
    spec
}

struct Resolver<'a, 'r> {
    members: &'a [Member<'a>],
    wires: &'a [Wire],
    report: &'r mut Report,
}

impl Resolver<'_, '_> {
    fn all(&mut self, names: &[String], path: &[String]) -> Vec<Option<ReactionRef>> {
        let mut found = Vec::new();
        for (index, name) in names.iter().enumerate() {
            let mut path = path.to_vec();
            path.push(index.to_string());
            found.push(self.reaction(name, &path));
        }
        found
    }

    fn one_or_many(&mut self, names: &OneOrMany, path: &[String]) -> Option<Vec<ReactionRef>> {
        match names {
            OneOrMany::One(name) => self.reaction(name, path).map(|one| vec![one]),
            OneOrMany::Many(names) => self.all(names, path).into_iter().collect(),
        }
    }

    /// Finds `federate.reaction` or `federate.reactor.reaction`.
    fn reaction(&mut self, text: &str, path: &[String]) -> Option<ReactionRef> {
        if self.report.is_broken(path) {
            return None;
        }
        let Some((federate, rest)) = text.split_once('.') else {
            let fix = "write `federate.reaction` or `federate.reactor.reaction`";
            let message = format!("`{text}` is not a reaction");
            self.report.add("F026", Place::value(path), message, fix);
            return None;
        };
        let Some(member) = self.members.iter().find(|member| member.name == federate) else {
            let fix = suggest::fix(federate, self.members.iter().map(|member| member.name));
            let message = format!("unknown federate `{federate}`");
            self.report.add("F011", Place::value(path), message, fix);
            return None;
        };
        let description = member.description.as_ref()?;
        let known: Vec<String> = description
            .reactions
            .iter()
            .map(|reaction| joined(&reaction.path, &reaction.name))
            .collect();
        let found = known.iter().position(|name| name == rest);
        let Some(reaction) = found.and_then(|index| description.reactions.get(index)) else {
            let fix = suggest::fix(rest, known.iter().map(String::as_str));
            let message = format!("`{federate}` has no reaction `{rest}`");
            self.report.add("F026", Place::value(path), message, fix);
            return None;
        };
        Some(ReactionRef {
            federate: federate.to_owned(),
            path: joined(federate, &reaction.path),
            index: reaction.index,
            name: reaction.name.clone(),
        })
    }

    fn chain(&mut self, manifest: &Manifest, index: usize) -> Option<ChainSpec> {
        let chain = manifest.timing.end_to_end.get(index)?;
        let at = |key| path(&["timing", "end_to_end"], index, key);
        let source = self.reaction(chain.from.as_deref()?, &at("from"));
        let mut steps = Vec::new();
        for (position, hop) in chain.through.iter().enumerate() {
            let mut path = at("through");
            path.extend([position.to_string(), "reaction".to_owned()]);
            let reactions = hop
                .reaction
                .as_ref()
                .and_then(|names| self.one_or_many(names, &path));
            steps.push((reactions, hop.sampled, path));
        }
        let last = chain
            .to
            .as_ref()
            .and_then(|names| self.one_or_many(names, &at("to")));
        steps.push((last, false, at("to")));
        let source = source?;
        let mut before = vec![source.clone()];
        let mut hops = Vec::new();
        for (reactions, sampled, path) in steps {
            let reactions = reactions?;
            let Some((delay_ns, delay_microsteps)) = self.delay(&before, &reactions) else {
                let message = format!(
                    "no connection leads from `{}` to `{}`",
                    names(&before),
                    names(&reactions)
                );
                self.report.add("F026", Place::value(&path), message, "");
                return None;
            };
            before.clone_from(&reactions);
            hops.push(HopSpec {
                reactions,
                delay_ns,
                delay_microsteps,
                sampled,
            });
        }
        Some(ChainSpec {
            name: chain.name.clone()?,
            source,
            hops,
        })
    }

    /// The least logical delay from any federate of `from` to any of `to`, over any path of connections.
    fn delay(&self, from: &[ReactionRef], to: &[ReactionRef]) -> Option<(i64, u32)> {
        let index = |reaction: &ReactionRef| {
            self.members
                .iter()
                .position(|member| member.name == reaction.federate)
        };
        let targets: Vec<usize> = to.iter().filter_map(index).collect();
        let mut best: BTreeMap<usize, (i64, u32)> = BTreeMap::new();
        let mut queue: BinaryHeap<Reverse<((i64, u32), usize)>> = from
            .iter()
            .filter_map(index)
            .map(|index| Reverse(((0, 0), index)))
            .collect();
        while let Some(Reverse((delay, at))) = queue.pop() {
            if targets.contains(&at) {
                return Some(delay);
            }
            if best.get(&at).is_some_and(|known| *known <= delay) {
                continue;
            }
            best.insert(at, delay);
            let leaving = self
                .wires
                .iter()
                .filter(|wire| usize::from(wire.plan.from.federate) == at);
            for wire in leaving {
                let next = match wire.plan.after_ns {
                    None => delay,
                    Some(0) => (delay.0, delay.1.saturating_add(1)),
                    Some(after) => (delay.0.saturating_add(after), 0),
                };
                queue.push(Reverse((next, usize::from(wire.plan.to.federate))));
            }
        }
        None
    }
}

fn path(start: &[&str], index: usize, key: &str) -> Vec<String> {
    let mut path: Vec<String> = start.iter().map(|step| (*step).to_owned()).collect();
    path.extend([index.to_string(), key.to_owned()]);
    path
}

fn joined(path: &str, name: &str) -> String {
    match (path.is_empty(), name.is_empty()) {
        (true, _) => name.to_owned(),
        (_, true) => path.to_owned(),
        (false, false) => format!("{path}.{name}"),
    }
}

fn names(reactions: &[ReactionRef]) -> String {
    let names: Vec<String> = reactions
        .iter()
        .map(|reaction| joined(&reaction.path, &reaction.name))
        .collect();
    names.join("`, `")
}
