//! Connections: names become endpoints, whole multiports become channels, ends are checked against what the
//! federates say of themselves.

use std::collections::{BTreeMap, BTreeSet};

use ictus_coord::describe::{ClassDescription, PortDescription};
use ictus_coord::plan::{ConnectionPlan, Endpoint};

use crate::federation::Member;
use crate::manifest::{Connection, Manifest};
use crate::problem::{Place, Report};
use crate::suggest;

/// The serializers there are.
const SERIALIZERS: &[&str] = &["native", "postcard"];
/// The most channels that one entry may expand to.
const MAX_CHANNELS: u32 = 65_535;

/// A resolved connection and the entry of the manifest that it comes from.
#[derive(Clone, Debug)]
pub(crate) struct Wire {
    pub(crate) plan: ConnectionPlan,
    pub(crate) entry: usize,
}

/// Resolves every connection that can be; the others are reported.
pub(crate) fn wire(manifest: &Manifest, members: &[Member<'_>], report: &mut Report) -> Vec<Wire> {
    let mut wiring = Wiring {
        members,
        report,
        wires: Vec::new(),
        taken: BTreeMap::new(),
    };
    for (entry, connection) in manifest.connections.iter().enumerate() {
        wiring.connection(entry, connection);
    }
    wiring.number_ports(manifest);
    wiring.warn_unconnected();
    wiring.wires
}

struct Wiring<'a, 'r> {
    members: &'a [Member<'a>],
    report: &'r mut Report,
    wires: Vec<Wire>,
    /// Which entry feeds an input's channel.
    taken: BTreeMap<(u16, String, u32), usize>,
}

/// Which end of a connection is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Side {
    From,
    To,
}

/// An end of an entry: a port and the channels meant.
#[derive(Clone, Debug)]
struct End<'a> {
    federate: u16,
    name: &'a str,
    port: &'a str,
    /// Absent when nothing is known of the federate.
    description: Option<&'a PortDescription>,
    first: u32,
    count: u32,
    /// Whether one channel was named.
    single: bool,
}

impl<'a> Wiring<'a, '_> {
    fn connection(&mut self, entry: usize, connection: &'a Connection) {
        let position = entry.to_string();
        let from_path = vec![
            "connections".to_owned(),
            position.clone(),
            "from".to_owned(),
        ];
        let from = connection.from.as_deref();
        let from = from.and_then(|text| self.end(text, Side::From, &from_path));
        let Some(targets) = &connection.to else {
            return;
        };
        if targets.as_slice().is_empty() {
            let place = Place::value(&["connections", &position, "to"]);
            self.report
                .add("F005", place, "the list is empty", "name an input");
        }
        for (index, target) in targets.as_slice().iter().enumerate() {
            let mut path = vec!["connections".to_owned(), position.clone(), "to".to_owned()];
            if targets.is_list() {
                path.push(index.to_string());
            }
            if self.report.is_broken(&path) {
                continue;
            }
            let to = self.end(target, Side::To, &path);
            if let (Some(from), Some(to)) = (&from, to) {
                self.join(entry, connection, (from, &to), &path);
            }
        }
    }

    /// Reads `federate.port` or `federate.port[channel]`.
    fn end(&mut self, text: &'a str, side: Side, path: &[String]) -> Option<End<'a>> {
        let place = || Place::value(path);
        let Some((federate, port, channel)) = split(text) else {
            let message = format!("`{text}` is not a port");
            let fix = "write `federate.port` or `federate.port[channel]`";
            self.report.add("F005", place(), message, fix);
            return None;
        };
        let Some(index) = self
            .members
            .iter()
            .position(|member| member.name == federate)
        else {
            let fix = suggest::fix(federate, self.members.iter().map(|member| member.name));
            self.report.add(
                "F011",
                place(),
                format!("unknown federate `{federate}`"),
                fix,
            );
            return None;
        };
        let member = self.members.get(index)?;
        let mut end = End {
            federate: u16::try_from(index).ok()?,
            name: federate,
            port,
            description: None,
            first: channel.unwrap_or(0),
            count: 1,
            single: channel.is_some(),
        };
        let Some(description) = &member.description else {
            return Some(end);
        };
        let found = self.port(&end, side, description, path)?;
        let width = found.width.unwrap_or(1);
        if end.first >= width {
            let name = format!("{federate}.{port}");
            let (message, fix) = match found.width {
                Some(0) => (
                    format!("`{name}` has no channels"),
                    "give the federate parameters that make it wider".to_owned(),
                ),
                Some(width) => (
                    format!("`{name}` has {width} channels, from 0"),
                    format!("use a channel up to {}", width - 1),
                ),
                None => (
                    format!("`{name}` is not a multiport"),
                    format!("write `{name}`"),
                ),
            };
            self.report.add("F017", place(), message, fix);
            return None;
        }
        end.description = Some(found);
        if channel.is_none() {
            end.count = width;
        }
        Some(end)
    }

    /// Finds a port among those that may stand at this side.
    fn port(
        &mut self,
        end: &End<'_>,
        side: Side,
        description: &'a ClassDescription,
        path: &[String],
    ) -> Option<&'a PortDescription> {
        let (right, wrong, kind) = match side {
            Side::From => (&description.outputs, &description.inputs, "output"),
            Side::To => (&description.inputs, &description.outputs, "input"),
        };
        let (federate, port) = (end.name, end.port);
        let found = right.iter().find(|known| known.name == port);
        if found.is_some() {
            return found;
        }
        let place = Place::value(path);
        if wrong.iter().any(|known| known.name == port) {
            let message = match side {
                Side::From => {
                    format!("`{federate}.{port}` is an input: a connection starts at an output")
                }
                Side::To => {
                    format!("`{federate}.{port}` is an output: a connection ends at an input")
                }
            };
            self.report
                .add("F013", place, message, ends_fix(federate, right, kind));
        } else {
            let fix = suggest::fix(port, right.iter().map(|known| known.name.as_str()));
            self.report.add(
                "F012",
                place,
                format!("`{federate}` has no {kind} `{port}`"),
                fix,
            );
        }
        None
    }

    fn join(
        &mut self,
        entry: usize,
        connection: &Connection,
        (from, to): (&End<'_>, &End<'_>),
        path: &[String],
    ) {
        if !self.fit(from, to, path) {
            return;
        }
        let Some(serializer) = self.serializer(entry, connection, from, to) else {
            return;
        };
        if from.count > MAX_CHANNELS {
            let message = format!("{} channels are more than {MAX_CHANNELS}", from.count);
            self.report.add("F017", Place::value(path), message, "");
            return;
        }
        for channel in 0..from.count {
            let target = Endpoint {
                federate: to.federate,
                port: to.port.to_owned(),
                channel: to.first + channel,
            };
            let key = (target.federate, target.port.clone(), target.channel);
            if let Some(first) = self.taken.get(&key) {
                let shown = shown(to, to.first + channel);
                let line = self.report.line(&["connections", &first.to_string()]);
                let message = format!("`{shown}` is connected already, in line {line}");
                let fix = "an input has one sender; make it a multiport, or remove one connection";
                self.report.add("F015", Place::value(path), message, fix);
                return;
            }
            self.taken.insert(key, entry);
            let source = Endpoint {
                federate: from.federate,
                port: from.port.to_owned(),
                channel: from.first + channel,
            };
            self.wires.push(Wire {
                entry,
                plan: ConnectionPlan {
                    from: source,
                    to: target,
                    after_ns: connection.after.map(|after| after.0),
                    serializer: serializer.clone(),
                    port_id: 0,
                    physical: connection.physical,
                    stp_offset_ns: connection.stp_offset.map(|offset| offset.0),
                    absent_after_ns: connection.absent_after.map_or(0, |wait| wait.0),
                    bounds: None,
                },
            });
        }
    }

    /// Whether widths and types of two ends agree.
    fn fit(&mut self, from: &End<'_>, to: &End<'_>, path: &[String]) -> bool {
        let (Some(source), Some(target)) = (from.description, to.description) else {
            return true;
        };
        let mut good = true;
        if from.count != to.count {
            let message = format!("{} does not fit {}", width(from), width(to));
            let fix = match (from.count, to.count) {
                (1, _) if !to.single => format!("name a channel: `{}.{}[0]`", to.name, to.port),
                (_, 1) if !from.single => {
                    format!("name a channel: `{}.{}[0]`", from.name, from.port)
                }
                _ => "make the widths equal, or connect channel by channel".to_owned(),
            };
            self.report.add("F017", Place::value(path), message, fix);
            good = false;
        }
        let (sent, wanted) = (&source.type_identity, &target.type_identity);
        let unknown = sent.name.is_empty() || wanted.name.is_empty();
        let layouts = sent.fingerprint.is_empty()
            || wanted.fingerprint.is_empty()
            || sent.fingerprint == wanted.fingerprint;
        if !unknown && (sent.name != wanted.name || !layouts) {
            let message = if sent.name == wanted.name {
                format!(
                    "`{}.{}` and `{}.{}` both carry `{}`, but with different layouts ({} and {})",
                    from.name,
                    from.port,
                    to.name,
                    to.port,
                    sent.name,
                    sent.fingerprint,
                    wanted.fingerprint
                )
            } else {
                format!(
                    "`{}.{}` carries `{}`, but `{}.{}` takes `{}`",
                    from.name, from.port, sent.name, to.name, to.port, wanted.name
                )
            };
            let fix = "connect ports of one type; a shared type belongs into a shared crate";
            self.report.add("F014", Place::value(path), message, fix);
            good = false;
        }
        good
    }

    /// The serializer of a connection: the one given, or the best that both ends offer.
    fn serializer(
        &mut self,
        entry: usize,
        connection: &Connection,
        from: &End<'_>,
        to: &End<'_>,
    ) -> Option<String> {
        let offers = |end: &End<'_>, name: &str| {
            end.description
                .is_none_or(|port| port.serializers.iter().any(|have| have == name))
        };
        let place = Place::value(&["connections", &entry.to_string(), "serializer"]);
        if let Some(given) = &connection.serializer {
            if !SERIALIZERS.contains(&given.as_str()) {
                let fix = suggest::fix(given, SERIALIZERS.iter().copied());
                self.report
                    .add("F016", place, format!("unknown serializer `{given}`"), fix);
                return None;
            }
            if let Some(end) = [from, to].into_iter().find(|end| !offers(end, given)) {
                let have = end.description.map(|port| port.serializers.join("`, `"));
                let message = format!("`{}.{}` does not offer `{given}`", end.name, end.port);
                let fix = format!("it offers `{}`", have.unwrap_or_default());
                self.report.add("F016", place, message, fix);
                return None;
            }
            return Some(given.clone());
        }
        let best = match (from.description, to.description) {
            (Some(port), _) | (None, Some(port)) => port.serializers.clone(),
            (None, None) => vec!["native".to_owned()],
        };
        let common = best
            .into_iter()
            .find(|name| offers(from, name) && offers(to, name));
        if common.is_none() {
            let place = Place::key(&["connections", &entry.to_string()]);
            let message = format!(
                "`{}.{}` and `{}.{}` have no serializer in common",
                from.name, from.port, to.name, to.port
            );
            self.report.add(
                "F016",
                place,
                message,
                "derive `serde` on the type for `postcard`",
            );
        }
        common
    }

    /// Gives every connection its port id: unique per receiver, compiled in for foreign ones, else in order.
    fn number_ports(&mut self, manifest: &Manifest) {
        let mut used: BTreeMap<u16, BTreeSet<u16>> = BTreeMap::new();
        let mut open = Vec::new();
        for (index, wire) in self.wires.iter_mut().enumerate() {
            let receiver = wire.plan.to.federate;
            let given = manifest
                .connections
                .get(wire.entry)
                .and_then(|one| one.port_id);
            let member = self.members.get(usize::from(receiver));
            let compiled = member
                .filter(|member| member.is_foreign())
                .and_then(|member| member.federate.ports.inputs.get(&wire.plan.to.port))
                .and_then(|input| input.id);
            let channel = u16::try_from(wire.plan.to.channel).unwrap_or(u16::MAX);
            let Some(id) = compiled.or(given) else {
                open.push(index);
                continue;
            };
            let id = id.saturating_add(channel);
            wire.plan.port_id = id;
            if !used.entry(receiver).or_default().insert(id) {
                let name = member.map_or("", |member| member.name);
                let place = Place::key(&["connections", &wire.entry.to_string()]);
                let message = format!("two inputs of `{name}` have the port id {id}");
                self.report
                    .add("F020", place, message, "port ids of one receiver differ");
            }
        }
        for index in open {
            let Some(wire) = self.wires.get_mut(index) else {
                continue;
            };
            let used = used.entry(wire.plan.to.federate).or_default();
            let Some(free) = (0..=u16::MAX).find(|id| !used.contains(id)) else {
                continue;
            };
            used.insert(free);
            wire.plan.port_id = free;
        }
    }

    /// Warns of inputs that nothing feeds.
    fn warn_unconnected(&mut self) {
        for (index, member) in self.members.iter().enumerate() {
            let Some(description) = &member.description else {
                continue;
            };
            for port in &description.inputs {
                let fed = self.taken.keys().any(|(federate, name, _)| {
                    usize::from(*federate) == index && *name == port.name
                });
                if !fed {
                    let name = member.name;
                    let message = format!("nothing is connected to `{name}.{}`", port.name);
                    self.report
                        .warn("W001", Place::key(&["federates", name]), message, "");
                }
            }
        }
    }
}

/// `federate.port[channel]` in its parts.
fn split(text: &str) -> Option<(&str, &str, Option<u32>)> {
    let (federate, rest) = text.split_once('.')?;
    let (port, channel) = match rest.split_once('[') {
        Some((port, channel)) => (port, Some(channel.strip_suffix(']')?.parse().ok()?)),
        None => (rest, None),
    };
    let word = |text: &str| !text.is_empty() && !text.contains(['.', ' ', ']']);
    (word(federate) && word(port)).then_some((federate, port, channel))
}

fn ends_fix(federate: &str, ports: &[PortDescription], kind: &str) -> String {
    match ports {
        [] => format!("`{federate}` has no such port; exchange `from` and `to`"),
        [only] => format!(
            "exchange `from` and `to`, or use {kind}: `{federate}.{}`",
            only.name
        ),
        many => {
            let names: Vec<&str> = many.iter().map(|port| port.name.as_str()).collect();
            format!(
                "exchange `from` and `to`, or use {kind}: `{}`",
                names.join("`, `")
            )
        }
    }
}

/// An end and its width, for a message.
fn width(end: &End<'_>) -> String {
    let (name, port, first) = (end.name, end.port, end.first);
    match (end.count, end.single) {
        (_, true) => format!("`{name}.{port}[{first}]`"),
        (1, false) => format!("`{name}.{port}`"),
        (count, false) => format!("`{name}.{port}` ({count} channels)"),
    }
}

fn shown(end: &End<'_>, channel: u32) -> String {
    let multiport = end.description.is_some_and(|port| port.width.is_some()) || end.single;
    match multiport {
        true => format!("{}.{}[{channel}]", end.name, end.port),
        false => format!("{}.{}", end.name, end.port),
    }
}
