//! Which member runs on which host, and whether the hosts can be what the manifest says.

use std::collections::BTreeSet;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr};
use std::path::{Path, PathBuf};

use ictus_coord::plan::Coordination;

use crate::check::Deploy;
use crate::federation::{Member, Origin};
use crate::manifest::{Host, Manifest, Port, PortsText};
use crate::placement::{Engine, HostSpec, Placement, PortRange, Security, Way};
use crate::problem::{Place, Report};
use crate::suggest;

/// The most ports of a range: each is a hole in a firewall.
const MOST_PORTS: u16 = 10_000;

/// What is asked of this machine while a manifest is checked.
pub(crate) struct Outside<'a> {
    /// The manifest's folder.
    pub(crate) dir: &'a Path,
    /// The user's home.
    pub(crate) home: Option<PathBuf>,
    /// The addresses of a name, or why there are none.
    pub(crate) look_up: &'a dyn Fn(&str) -> Result<Vec<IpAddr>, String>,
    /// The text of a file, or why it cannot be read.
    pub(crate) read: &'a dyn Fn(&Path) -> Result<String, String>,
}

impl Outside<'_> {
    /// A path of the manifest: absolute, below `~/`, or relative to its folder. Absent when there is no home.
    pub(crate) fn path(&self, text: &str) -> Option<PathBuf> {
        match text.strip_prefix("~/") {
            Some(rest) => self.home.as_ref().map(|home| home.join(rest)),
            None => Some(self.dir.join(text)),
        }
    }
}

/// Where everything runs, as far as it can be made out. Indices are into the manifest's `hosts`.
pub(crate) struct Seating<'a> {
    hosts: &'a [(String, Host)],
    /// Whether there should be hosts.
    expected: bool,
    rti: Option<usize>,
    federates: Vec<Option<usize>>,
    /// Whether everything runs in containers, whatever the hosts' engine.
    contained: bool,
    /// What the hosts are; absent without hosts, and when anything is wrong with them.
    placement: Option<Placement>,
}

impl<'a> Seating<'a> {
    /// Seats the members, who are in order of their ids, and checks the hosts.
    pub(crate) fn of(
        manifest: &'a Manifest,
        members: &[Member<'_>],
        outside: &Outside<'_>,
        report: &mut Report,
    ) -> Self {
        let hosts = manifest.hosts.0.as_slice();
        let expected = !hosts.is_empty() || report.is_broken(&["hosts"]);
        let (rti, federates) = seats(manifest, members, report);
        let mut seating = Self {
            hosts,
            expected,
            rti,
            federates,
            contained: false,
            placement: None,
        };
        let drafts: Vec<Draft> = hosts
            .iter()
            .map(|(name, host)| Draft::of(name, host, outside, report))
            .collect();
        let used = seating.used();
        if used.len() > 1 {
            security(manifest, members, report);
        }
        for (index, (name, host)) in hosts.iter().enumerate() {
            if seating.is_whole() && !used.contains(&index) {
                let message = format!("nothing runs on the host `{name}`");
                report.warn("W002", Place::key(&["hosts", name]), message, "");
            }
            architecture(&seating, members, (index, name, host), report);
        }
        twins(hosts, &drafts, report);
        if used.len() > 1 {
            reachable(hosts, &drafts, &used, report);
        }
        seating.ports(manifest, &drafts, report);
        let security = manifest.security.unwrap_or(Security::Mtls);
        seating.placement = seating.place(&drafts, security);
        seating
    }

    /// The same, but everything runs in containers.
    pub(crate) fn contained(self, contained: bool) -> Self {
        Self { contained, ..self }
    }

    /// Reports hosts that Compose does not reach when it is to start everything: it has this machine.
    pub(crate) fn one_host(&self, manifest: &Manifest, report: &mut Report) {
        if manifest.deploy != Deploy::Compose {
            return;
        }
        let used = self.used();
        let used: Vec<_> = used.iter().filter_map(|at| self.hosts.get(*at)).collect();
        let away = used.iter().any(|(_, host)| host.ssh.is_some());
        if used.len() > 1 || away {
            let names: Vec<_> = used.iter().map(|(name, _)| name.as_str()).collect();
            let names = names.join(", ");
            let message =
                format!("Compose starts what runs on this machine, and this is on {names}");
            let fix = "remove `deploy: compose`, or `hosts`";
            report.add("F045", Place::value(&["deploy"]), message, fix);
        }
    }

    /// What runs a member; absent when its host is unknown.
    pub(crate) fn engine(&self, member: usize) -> Option<Engine> {
        if self.contained {
            return Some(Engine::Docker);
        }
        if !self.expected {
            return Some(Engine::Process);
        }
        Some(self.host(member)?.1.engine)
    }

    /// The name of a member's host.
    pub(crate) fn host_name(&self, member: usize) -> Option<&str> {
        Some(self.host(member)?.0.as_str())
    }

    /// Whether a member's program leaves this machine's processes: for another host, or into a container.
    pub(crate) fn travels(&self, member: usize) -> bool {
        let host = self.host(member);
        self.contained
            || host.is_some_and(|(_, host)| host.ssh.is_some() || host.engine == Engine::Docker)
    }

    /// The placement; absent without hosts, and when anything is wrong with them.
    pub(crate) fn placement(&self) -> Option<Placement> {
        self.placement.clone()
    }

    fn host(&self, member: usize) -> Option<&'a (String, Host)> {
        self.hosts.get((*self.federates.get(member)?)?)
    }

    /// Whether every member has a host.
    fn is_whole(&self) -> bool {
        self.rti.is_some() && self.federates.iter().all(Option::is_some)
    }

    /// The hosts on which something runs.
    fn used(&self) -> BTreeSet<usize> {
        let federates = self.federates.iter().copied();
        federates.chain([self.rti]).flatten().collect()
    }

    /// Whether the ranges have the coordinator's port, and enough of them.
    fn ports(&self, manifest: &Manifest, drafts: &[Draft], report: &mut Report) {
        let hosts = self.hosts.iter().zip(drafts).enumerate();
        for (index, ((name, _), draft)) in hosts {
            let Some(range) = draft.ports else { continue };
            let rti = self.rti == Some(index);
            if let (true, Some(Port::Number(port))) = (rti, &manifest.rti.port)
                && !(range.first..=range.last).contains(port)
            {
                let message = format!("port {port} is not one of host `{name}`: {}", shown(range));
                let fix = "take one of them, or `auto`";
                report.add("F033", Place::value(&["rti", "port"]), message, fix);
            }
            let listen = manifest.coordination == Some(Coordination::Decentralized)
                || manifest.connections.iter().any(|one| one.physical);
            let here = self.federates.iter().filter(|at| **at == Some(index));
            let federates = if listen { here.count() } else { 0 };
            let needed = federates + usize::from(rti);
            let have = usize::from(range.last - range.first) + 1;
            if needed > have {
                let message = format!(
                    "{} is {have} ports, and {needed} members listen on host `{name}`",
                    shown(range)
                );
                let place = Place::value(&["hosts", name, "ports"]);
                report.add("F033", place, message, "make the range longer");
            }
        }
    }

    fn place(&self, drafts: &[Draft], security: Security) -> Option<Placement> {
        let mut used: Vec<usize> = self.used().into_iter().collect();
        used.sort_by_key(|index| self.hosts.get(*index).map(|(name, _)| name));
        let alone = used.len() == 1;
        let spec = |index: &usize| {
            let ((name, host), draft) = (self.hosts.get(*index)?, drafts.get(*index)?);
            let address = match alone {
                true => Ipv4Addr::LOCALHOST,
                false => draft.address?,
            };
            Some(HostSpec {
                name: name.clone(),
                way: draft.way.clone()?,
                address,
                engine: host.engine,
                ports: draft.ports,
            })
        };
        let position = |at: Option<usize>| used.iter().position(|index| Some(*index) == at);
        let federates = self.federates.iter();
        Some(Placement {
            hosts: used.iter().map(spec).collect::<Option<_>>()?,
            rti: position(Some(self.rti?))?,
            federates: federates
                .map(|at| position(Some((*at)?)))
                .collect::<Option<_>>()?,
            security: match alone {
                true => Security::TrustedNetwork,
                false => security,
            },
        })
    }
}

/// The hosts of the coordinator and of each member, in their order.
fn seats(
    manifest: &Manifest,
    members: &[Member<'_>],
    report: &mut Report,
) -> (Option<usize>, Vec<Option<usize>>) {
    let hosts = &manifest.hosts.0;
    let broken = hosts.is_empty() && report.is_broken(&["hosts"]);
    let find = |name: &str, path: &[&str], report: &mut Report| {
        let found = hosts.iter().position(|(have, _)| have == name);
        if found.is_none() && !broken && !report.is_broken(&["hosts", name]) {
            let (message, fix) = match hosts.is_empty() {
                true => (
                    format!("unknown host `{name}`: there are no `hosts`"),
                    "add `hosts: { NAME: { ssh: USER@ADDRESS } }`".to_owned(),
                ),
                false => (
                    format!("unknown host `{name}`"),
                    suggest::fix(name, manifest.hosts.names()),
                ),
            };
            report.add("F030", Place::value(path), message, fix);
        }
        found
    };
    let general = match (&manifest.defaults.host, hosts.as_slice()) {
        (Some(name), _) => find(name, &["defaults", "host"], report),
        (None, [_only]) => Some(0),
        (None, _) => None,
    };
    let rti = match &manifest.rti.host {
        Some(name) => find(name, &["rti", "host"], report),
        None => general,
    };
    let mut homeless: Vec<&str> = Vec::new();
    let mut federates = Vec::new();
    for member in members {
        let seat = match &member.federate.host {
            Some(name) => find(name, &["federates", member.name, "host"], report),
            None => general,
        };
        let silent = !report.is_broken(&["federates", member.name, "host"]);
        if member.federate.host.is_none() && seat.is_none() && silent {
            homeless.push(member.name);
        }
        federates.push(seat);
    }
    if !hosts.is_empty() && manifest.defaults.host.is_none() {
        unseated(&homeless, rti.is_none(), manifest, report);
    }
    (rti, federates)
}

/// Reports who does not say on which host it runs.
fn unseated(homeless: &[&str], rti: bool, manifest: &Manifest, report: &mut Report) {
    let names: Vec<&str> = manifest.hosts.names().collect();
    let names = names.join("`, `");
    if let [first, others @ ..] = homeless {
        let message = match others.len() {
            0 => format!("`{first}` does not say on which host it runs"),
            more => {
                format!("`{first}` and {more} more federates do not say on which host they run")
            }
        };
        let fix = format!("add `host:`, one of `{names}`; or `defaults: {{ host: NAME }}` for all");
        report.add("F030", Place::key(&["federates", first]), message, fix);
    }
    if rti && manifest.rti.host.is_none() && !report.is_broken(&["rti"]) {
        let message = "nothing says on which host the coordinator runs";
        let fix = format!("add `rti: {{ host: NAME }}`, one of `{names}`");
        let place = match manifest.rti.port {
            Some(_) => Place::key(&["rti"]),
            None => Place::key(&["hosts"]),
        };
        report.add("F030", place, message, fix);
    }
}

/// Lingua Franca's federates speak no TLS: where one is, who deploys must have said that the network is trusted.
fn security(manifest: &Manifest, members: &[Member<'_>], report: &mut Report) {
    if manifest.security == Some(Security::TrustedNetwork) || report.is_broken(&["security"]) {
        return;
    }
    let mut foreign = members.iter().filter(|member| member.is_foreign());
    let Some(first) = foreign.next() else { return };
    let name = first.name;
    let message = match foreign.count() {
        0 => format!("`{name}` is a Lingua Franca federate, and those speak no TLS"),
        more => {
            format!("`{name}` and {more} more are Lingua Franca federates, and those speak no TLS")
        }
    };
    let place = match manifest.security {
        Some(_) => Place::value(&["security"]),
        None => Place::key(&["federates", name]),
    };
    let fix = "write `security: trusted-network`, and let nobody else into the hosts' network";
    report.add("F034", place, message, fix);
}

/// What is understood of one host.
struct Draft {
    way: Option<Way>,
    address: Option<Ipv4Addr>,
    ports: Option<PortRange>,
}

impl Draft {
    fn of(name: &str, host: &Host, outside: &Outside<'_>, report: &mut Report) -> Self {
        let way = way(name, host, outside, report);
        let mut address = None;
        match &host.address {
            Some(text) => match read_address(text, outside.look_up) {
                Ok(read) => address = Some(read),
                Err((message, fix)) => {
                    report.add(
                        "F032",
                        Place::value(&["hosts", name, "address"]),
                        message,
                        fix,
                    );
                }
            },
            None => {
                if let Some(Way::Ssh { target, .. }) = &way {
                    address = target_host(target).ok().and_then(|host| host.parse().ok());
                }
            }
        }
        Self {
            way,
            address,
            ports: ports(name, host, report),
        }
    }
}

fn way(name: &str, host: &Host, outside: &Outside<'_>, report: &mut Report) -> Option<Way> {
    let at = |key| ["hosts", name, key];
    let Some(target) = &host.ssh else {
        if !host.local {
            if !report.is_broken(&["hosts", name]) {
                let message = format!("host `{name}` does not say how it is reached");
                let fix = "add `ssh: USER@HOST`, or `local: true` when it is this machine";
                report.add("F031", Place::key(&["hosts", name]), message, fix);
            }
            return None;
        }
        let keys = [
            ("client", host.client.is_some()),
            ("identity", host.identity.is_some()),
        ];
        for (key, _) in keys.iter().filter(|(_, given)| *given) {
            let message = format!("`{key}` goes only with `ssh`: host `{name}` is this machine");
            report.add("F031", Place::key(&at(key)), message, "remove it");
        }
        return Some(Way::Local);
    };
    if host.local {
        let message = format!("host `{name}` has both `ssh` and `local`");
        report.add(
            "F031",
            Place::key(&at("local")),
            message,
            "keep one of them",
        );
        return None;
    }
    if let Err(wrong) = target_host(target) {
        let message = format!("`{target}` is no ssh target: {wrong}");
        let fix = "write `[USER@]HOST[:PORT]`, or an alias of ssh_config";
        report.add("F031", Place::value(&at("ssh")), message, fix);
        return None;
    }
    let mut identity = None;
    if let Some(text) = &host.identity {
        identity = outside.path(text);
        if identity.is_none() {
            let message = format!("`{text}` cannot be found: HOME is not set");
            report.add(
                "F031",
                Place::value(&at("identity")),
                message,
                "write an absolute path",
            );
        }
    }
    Some(Way::Ssh {
        target: target.clone(),
        client: host.client.unwrap_or_default(),
        identity,
    })
}

/// The host of `[USER@]HOST[:PORT]`, without brackets; else what is wrong.
fn target_host(text: &str) -> Result<&str, &'static str> {
    let (user, rest) = match text.rsplit_once('@') {
        Some((user, rest)) => (Some(user), rest),
        None => (None, text),
    };
    let plain = |text: &str, more: &str| {
        text.chars()
            .all(|c| c.is_ascii_alphanumeric() || more.contains(c))
    };
    if text.starts_with('-') || rest.starts_with('-') {
        return Err("it begins with `-`, as options do");
    }
    if text.len() > 255 {
        return Err("it is longer than 255 bytes");
    }
    if let Some(user) = user {
        if user.is_empty() {
            return Err("the user before `@` is missing");
        }
        if !plain(user, "._-+") {
            return Err("the user has a character that is not let through");
        }
    }
    if rest.parse::<Ipv6Addr>().is_ok() {
        return Ok(rest);
    }
    let (host, port) = match rest.strip_prefix('[') {
        Some(rest) => {
            let (host, after) = rest.split_once(']').ok_or("`]` is missing")?;
            if host.parse::<Ipv6Addr>().is_err() {
                return Err("what is in brackets is no IPv6 address");
            }
            match after.strip_prefix(':') {
                Some(port) => (host, Some(port)),
                None if after.is_empty() => (host, None),
                None => return Err("after `]` there is only `:PORT`"),
            }
        }
        None => match rest.split_once(':') {
            Some((host, port)) => (host, Some(port)),
            None => (rest, None),
        },
    };
    if host.is_empty() {
        return Err("the host is missing");
    }
    if !rest.starts_with('[') && !plain(host, "._-") {
        return Err("the host has a character that is not let through");
    }
    match port {
        Some(port) if port.starts_with('+') || !port.parse::<u16>().is_ok_and(|it| it > 0) => {
            Err("the port is not between 1 and 65535")
        }
        Some(_) | None => Ok(host),
    }
}

/// Reads a data address; else what is wrong, and what to do.
fn read_address(
    text: &str,
    look_up: &dyn Fn(&str) -> Result<Vec<IpAddr>, String>,
) -> Result<Ipv4Addr, (String, String)> {
    let literal = text.trim_start_matches('[').trim_end_matches(']');
    let fix = "write the IPv4 address that it has in the hosts' network".to_owned();
    let read = match literal.parse::<IpAddr>() {
        Ok(IpAddr::V4(read)) => read,
        Ok(IpAddr::V6(_)) => {
            let message = format!(
                "`{text}` is an IPv6 address, and the messages that tell federates each other's have room for IPv4"
            );
            return Err((message, fix));
        }
        Err(_) => {
            let name = |c: char| c.is_ascii_alphanumeric() || c == '.' || c == '-' || c == '_';
            let number = text.chars().all(|c| c.is_ascii_digit() || c == '.');
            if number || text.starts_with('-') || !text.chars().all(name) {
                return Err((format!("`{text}` is no address"), fix));
            }
            let all = match look_up(text) {
                Ok(all) => all,
                Err(why) => return Err((format!("`{text}` cannot be resolved: {why}"), fix)),
            };
            let usable = |one: &IpAddr| match one {
                IpAddr::V4(one) => Some(*one),
                IpAddr::V6(_) => None,
            };
            let usable: BTreeSet<Ipv4Addr> = all.iter().filter_map(usable).collect();
            let shown: Vec<String> = usable.iter().map(ToString::to_string).collect();
            match (usable.first(), shown.as_slice()) {
                (Some(only), [_]) => *only,
                (None, _) => {
                    let message =
                        format!("`{text}` has no IPv4 address, and the data plane is IPv4");
                    return Err((message, fix));
                }
                (Some(_), several) => {
                    let message = format!("`{text}` has several addresses: {}", several.join(", "));
                    return Err((message, "write the one in the hosts' network".to_owned()));
                }
            }
        }
    };
    if read.octets()[0] == 0 || read.is_multicast() || read.is_broadcast() {
        return Err((format!("`{text}` is not the address of one host"), fix));
    }
    Ok(read)
}

/// Reads the ports of a host, and reports what is wrong with them.
fn ports(name: &str, host: &Host, report: &mut Report) -> Option<PortRange> {
    let wrong = match host.ports.as_ref()? {
        PortsText::One(port) => {
            return Some(PortRange {
                first: *port,
                last: *port,
            });
        }
        PortsText::Range(text) => match read_ports(text) {
            Ok(range) => return Some(range),
            Err(wrong) => wrong,
        },
    };
    let place = Place::value(&["hosts", name, "ports"]);
    report.add("F033", place, wrong, "write it as `15045-15099`");
    None
}

fn read_ports(text: &str) -> Result<PortRange, String> {
    let (first, last) = text.split_once('-').unwrap_or((text, text));
    let read = |text: &str| text.trim().parse::<u16>().ok().filter(|port| *port > 0);
    let (Some(first), Some(last)) = (read(first), read(last)) else {
        return Err(format!(
            "`{text}` is no range of ports, which are 1 to 65535"
        ));
    };
    if first > last {
        return Err(format!("`{text}` has no port: the first is after the last"));
    }
    if last - first >= MOST_PORTS {
        return Err(format!("`{text}` is more than {MOST_PORTS} ports"));
    }
    Ok(PortRange { first, last })
}

fn shown(range: PortRange) -> String {
    format!("`{}-{}`", range.first, range.last)
}

/// Two names for one machine: each would take the other's members for strangers.
fn twins(hosts: &[(String, Host)], drafts: &[Draft], report: &mut Report) {
    for (index, ((name, host), draft)) in hosts.iter().zip(drafts).enumerate() {
        for ((other, _), before) in hosts.iter().zip(drafts).take(index) {
            let way = match (&draft.way, &before.way) {
                (Some(Way::Local), Some(Way::Local)) => Some(("local", "this machine".to_owned())),
                (Some(Way::Ssh { target, .. }), Some(Way::Ssh { target: same, .. }))
                    if target == same =>
                {
                    Some(("ssh", format!("`{target}`")))
                }
                (Some(_) | None, Some(_) | None) => None,
            };
            let key = if host.address.is_some() {
                "address"
            } else {
                "ssh"
            };
            let address = draft
                .address
                .filter(|address| before.address == Some(*address));
            let both = way.or(address.map(|address| (key, format!("at {address}"))));
            if let Some((key, what)) = both {
                let message = format!("hosts `{other}` and `{name}` are both {what}");
                let place = Place::value(&["hosts", name, key]);
                report.add("F032", place, message, "two hosts are two machines");
            }
        }
    }
}

/// Whether the hosts can reach each other at all.
fn reachable(
    hosts: &[(String, Host)],
    drafts: &[Draft],
    used: &BTreeSet<usize>,
    report: &mut Report,
) {
    let inside = |index: &usize| {
        let address = drafts.get(*index).and_then(|draft| draft.address);
        address.is_none_or(|address| address.is_loopback())
    };
    let rehearsal = used.iter().all(inside);
    for index in used {
        let (Some((name, host)), Some(draft)) = (hosts.get(*index), drafts.get(*index)) else {
            continue;
        };
        let fix = "add `address:`, the IPv4 address that it has in the hosts' network";
        match draft.address {
            None if host.address.is_none() && draft.way.is_some() => {
                let message = match &host.ssh {
                    Some(target) => format!(
                        "host `{name}` has no `address`, and `{target}` does not say an IPv4 address"
                    ),
                    None => format!("host `{name}` has no `address`, at which the others reach it"),
                };
                report.add("F032", Place::key(&["hosts", name]), message, fix);
            }
            Some(address) if address.is_loopback() && !rehearsal => {
                let key = if host.address.is_some() {
                    "address"
                } else {
                    "ssh"
                };
                let message =
                    format!("{address} is loopback: other hosts cannot reach `{name}` there");
                report.add("F032", Place::value(&["hosts", name, key]), message, fix);
            }
            None | Some(_) => {}
        }
    }
}

/// Programs are built and asked on this machine, so those of another architecture are out of reach.
fn architecture(
    seating: &Seating<'_>,
    members: &[Member<'_>],
    (index, name, host): (usize, &str, &Host),
    report: &mut Report,
) {
    let here = std::env::consts::ARCH;
    let Some(arch) = host.arch.filter(|arch| arch.rust() != here) else {
        return;
    };
    let ours = |(member, seat): &(&Member<'_>, &Option<usize>)| {
        **seat == Some(index) && matches!(member.origin, Origin::Ours { .. })
    };
    let Some((member, _)) = members.iter().zip(&seating.federates).find(ours) else {
        return;
    };
    let (shown, rust) = (arch.name(), arch.rust());
    let message = format!(
        "`{}` runs on `{name}`, which is {shown}, and programs are built for this machine only, which is {here}",
        member.name
    );
    let compiler = rust.replace('_', "-");
    let fix = format!(
        "deploy from a machine that is {shown}; building for it will need `rustup target add {rust}-unknown-linux-gnu` \
         and `apt-get install gcc-{compiler}-linux-gnu`"
    );
    report.add("F039", Place::value(&["hosts", name, "arch"]), message, fix);
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Target, then its host or what is wrong.
    const TARGETS: &[(&str, Result<&str, &str>)] = &[
        ("10.0.0.11", Ok("10.0.0.11")),
        ("robot@nuc", Ok("nuc")),
        ("robot@nuc.lan:2222", Ok("nuc.lan")),
        (
            "a@b@nuc",
            Err("the user has a character that is not let through"),
        ),
        ("my_alias-1", Ok("my_alias-1")),
        ("robot@[fe80::1]:22", Ok("fe80::1")),
        ("robot@fe80::1", Ok("fe80::1")),
        ("[::1]", Ok("::1")),
        ("", Err("the host is missing")),
        ("robot@", Err("the host is missing")),
        ("@nuc", Err("the user before `@` is missing")),
        ("-oProxyCommand=x", Err("it begins with `-`, as options do")),
        ("robot@-nuc", Err("it begins with `-`, as options do")),
        (
            "robot@[-nuc]",
            Err("what is in brackets is no IPv6 address"),
        ),
        (
            "ro bot@nuc",
            Err("the user has a character that is not let through"),
        ),
        (
            "$(id)@nuc",
            Err("the user has a character that is not let through"),
        ),
        (
            "nuc;id",
            Err("the host has a character that is not let through"),
        ),
        (
            "n\u{fc}c",
            Err("the host has a character that is not let through"),
        ),
        (
            "nuc\n",
            Err("the host has a character that is not let through"),
        ),
        ("[::1", Err("`]` is missing")),
        ("[::1]22", Err("after `]` there is only `:PORT`")),
        ("a:b:c", Err("the port is not between 1 and 65535")),
        ("nuc:+5", Err("the port is not between 1 and 65535")),
        ("nuc:0", Err("the port is not between 1 and 65535")),
        ("nuc:65536", Err("the port is not between 1 and 65535")),
        ("nuc:", Err("the port is not between 1 and 65535")),
    ];

    #[test]
    fn targets() {
        for (text, expected) in TARGETS {
            assert_eq!(target_host(text), *expected, "{text:?}");
        }
    }

    /// Address, then what it is or what is wrong. The names are those of the next test.
    const ADDRESSES: &[(&str, &str)] = &[
        ("10.0.0.11", "10.0.0.11"),
        ("four", "10.0.0.4"),
        ("both", "10.0.0.4"),
        (
            "six",
            "`six` has no IPv4 address, and the data plane is IPv4",
        ),
        (
            "several",
            "`several` has several addresses: 10.0.0.4, 10.0.0.5",
        ),
        ("none", "`none` cannot be resolved: unknown"),
        (
            "fe80::1",
            "`fe80::1` is an IPv6 address, and the messages that tell federates each other's have room for IPv4",
        ),
        (
            "[::1]",
            "`[::1]` is an IPv6 address, and the messages that tell federates each other's have room for IPv4",
        ),
        ("0.0.0.0", "`0.0.0.0` is not the address of one host"),
        ("224.0.0.1", "`224.0.0.1` is not the address of one host"),
        (
            "255.255.255.255",
            "`255.255.255.255` is not the address of one host",
        ),
        ("10.0.0.256", "`10.0.0.256` is no address"),
        ("10.0.0.0/24", "`10.0.0.0/24` is no address"),
        ("-x", "`-x` is no address"),
        ("", "`` is no address"),
    ];

    #[test]
    fn addresses() {
        let (four, five) = (IpAddr::from([10, 0, 0, 4]), IpAddr::from([10, 0, 0, 5]));
        let six = IpAddr::from([0xfe80, 0, 0, 0, 0, 0, 0, 1]);
        let look_up = |name: &str| match name {
            "four" => Ok(vec![four, four]),
            "both" => Ok(vec![six, four]),
            "six" => Ok(vec![six]),
            "several" => Ok(vec![five, four]),
            "none" => Err("unknown".to_owned()),
            other => panic!("{other} was looked up"),
        };
        for (text, expected) in ADDRESSES {
            let read = read_address(text, &look_up);
            let read = read.map_or_else(|(message, _)| message, |address| address.to_string());
            assert_eq!(read, *expected);
        }
    }

    #[test]
    fn ranges() {
        let table = [
            ("15045-15099", Ok((15_045, 15_099))),
            ("15045", Ok((15_045, 15_045))),
            (" 1 - 2 ", Ok((1, 2))),
            ("10001-20000", Ok((10_001, 20_000))),
            ("2-1", Err("`2-1` has no port: the first is after the last")),
            ("10000-20000", Err("`10000-20000` is more than 10000 ports")),
            (
                "0-5",
                Err("`0-5` is no range of ports, which are 1 to 65535"),
            ),
            (
                "5-65536",
                Err("`5-65536` is no range of ports, which are 1 to 65535"),
            ),
            (
                "5-6-7",
                Err("`5-6-7` is no range of ports, which are 1 to 65535"),
            ),
            ("-5", Err("`-5` is no range of ports, which are 1 to 65535")),
            (
                "auto",
                Err("`auto` is no range of ports, which are 1 to 65535"),
            ),
        ];
        for (text, expected) in table {
            let read = read_ports(text).map(|range| (range.first, range.last));
            assert_eq!(read, expected.map_err(str::to_owned));
        }
    }

    proptest! {
        /// Nothing that a shell or an option parser could take for its own passes as a target, and what passes is one.
        #[test]
        fn targets_are_words(text in "([a-z$;-]{0,3}@)?([a-z.;-]{0,9}|\\[[f:1]{0,4}\\]|[ -~\n\u{e9}]{0,9})(:[0-9+]{0,6})?") {
            if let Ok(host) = target_host(&text) {
                prop_assert!(!text.starts_with('-') && !host.starts_with('-'));
                let plain = |c: char| c.is_ascii_alphanumeric() || "._-+@:%[]".contains(c);
                prop_assert!(text.chars().all(plain));
                #[cfg(feature = "ssh")]
                prop_assert!(text.parse::<crate::ssh::Target>().is_ok());
            }
        }
    }
}
