//! Which hosts must be able to connect to which, and what to open when one cannot.

use std::collections::BTreeMap;
use std::fmt;
use std::net::Ipv4Addr;

use ictus_coord::plan::{ClockSync, Coordination, Plan};

use crate::placement::{HostSpec, Placement, PortRange};

/// A host connects to another one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Way<'a> {
    /// Who connects.
    pub from: &'a HostSpec,
    /// To whom.
    pub to: &'a HostSpec,
    /// Over what.
    pub needs: Needs,
}

/// What one host needs of the way to another.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Needs {
    /// Over TCP: to the RTI, or to federates.
    pub tcp: bool,
    /// Over UDP: clock probes.
    pub udp: bool,
}

/// The ways that the members of a federation take from host to host, by the names of both.
///
/// Federates connect to the RTI; under decentralized coordination, and over physical connections, senders to receivers; the RTI
/// probes the clocks of federates.
#[must_use]
pub fn ways<'a>(plan: &Plan, placement: &'a Placement) -> Vec<Way<'a>> {
    let mut needs: BTreeMap<(usize, usize), Needs> = BTreeMap::new();
    let rti = placement.rti;
    for &host in &placement.federates {
        needs.entry((host, rti)).or_default().tcp = true;
        needs.entry((rti, host)).or_default().udp |= plan.clock.sync == ClockSync::On;
    }
    let host = |federate: u16| placement.federates.get(usize::from(federate)).copied();
    for wire in &plan.connections {
        let direct = wire.physical || plan.coordination == Coordination::Decentralized;
        let ends = (host(wire.from.federate), host(wire.to.federate));
        if let (true, (Some(from), Some(to))) = (direct, ends) {
            needs.entry((from, to)).or_default().tcp = true;
        }
    }
    let needed = needs.into_iter();
    let needed = needed.filter(|((from, to), needs)| from != to && (needs.tcp || needs.udp));
    needed
        .filter_map(|((from, to), needs)| {
            let from = placement.hosts.get(from)?;
            let to = placement.hosts.get(to)?;
            Some(Way { from, to, needs })
        })
        .collect()
}

/// Over what something does not come through.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Protocol {
    /// TCP.
    Tcp,
    /// UDP.
    Udp,
}

impl Protocol {
    const fn name(self) -> &'static str {
        match self {
            Self::Tcp => "tcp",
            Self::Udp => "udp",
        }
    }
}

/// A way that is shut: what was tried, and the rule that opens it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Shut {
    /// Who tried, by name, and its data address.
    pub from: (String, Ipv4Addr),
    /// Whom it tried to reach.
    pub to: (String, Ipv4Addr),
    /// Over what.
    pub protocol: Protocol,
    /// The port that was tried.
    pub port: u16,
    /// The ports that may be used there; absent: any.
    pub ports: Option<PortRange>,
    /// What came of it.
    pub why: String,
}

impl fmt::Display for Shut {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ((from, source), (to, address)) = (&self.from, &self.to);
        let (protocol, port, why) = (self.protocol.name(), self.port, &self.why);
        let upper = protocol.to_uppercase();
        writeln!(
            f,
            "host `{from}` ({source}) cannot reach host `{to}` ({address}) at {upper} port {port}: {why}"
        )?;
        let Some(range) = self.ports else {
            return write!(
                f,
                "  its members may listen on any port: set `hosts.{to}.ports` to a range, and let that in from {source} there"
            );
        };
        let (first, last) = (range.first, range.last);
        writeln!(f, "  on `{to}`, whichever firewall it has:")?;
        writeln!(
            f,
            "    iptables -I INPUT -p {protocol} -s {source} --dport {first}:{last} -j ACCEPT"
        )?;
        writeln!(
            f,
            "    nft insert rule inet filter input ip saddr {source} {protocol} dport {first}-{last} accept"
        )?;
        write!(
            f,
            "    ufw allow proto {protocol} from {source} to any port {first}:{last}"
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::placement::{self, Engine};

    fn placement() -> Placement {
        let host = |(n, name): (u8, &str)| HostSpec {
            name: name.to_owned(),
            way: placement::Way::Local,
            address: Ipv4Addr::new(10, 0, 0, n),
            engine: Engine::Process,
            ports: None,
        };
        Placement {
            hosts: (1..).zip(["h1", "h2", "h3"]).map(host).collect(),
            rti: 0,
            federates: vec![0, 1, 2],
            security: placement::Security::default(),
        }
    }

    fn plan(coordination: &str, sync: &str, physical: bool) -> Plan {
        let text = format!(
            r#"{{"ictus": "v1", "federation": "f", "coordination": "{coordination}", "clock": {{"sync": "{sync}"}},
                "federates": [{{"name": "a"}}, {{"name": "b"}}, {{"name": "c"}}],
                "connections": [
                    {{"from": {{"federate": 0, "port": "o"}}, "to": {{"federate": 1, "port": "i"}}, "serializer": "native",
                      "port_id": 0}},
                    {{"from": {{"federate": 1, "port": "o"}}, "to": {{"federate": 2, "port": "i"}}, "serializer": "native",
                      "port_id": 0, "physical": {physical}}}]}}"#
        );
        serde_json::from_str(&text).unwrap()
    }

    fn listed(plan: &Plan) -> String {
        let placement = placement();
        let ways = ways(plan, &placement);
        let word = |way: &Way<'_>| {
            let tcp = if way.needs.tcp { " tcp" } else { "" };
            let udp = if way.needs.udp { " udp" } else { "" };
            format!("{}>{}{tcp}{udp}", way.from.name, way.to.name)
        };
        ways.iter().map(word).collect::<Vec<_>>().join(", ")
    }

    #[test]
    fn who_connects_to_whom() {
        let table = [
            ("centralized", "off", false, "h2>h1 tcp, h3>h1 tcp"),
            (
                "centralized",
                "off",
                true,
                "h2>h1 tcp, h2>h3 tcp, h3>h1 tcp",
            ),
            (
                "centralized",
                "on",
                false,
                "h1>h2 udp, h1>h3 udp, h2>h1 tcp, h3>h1 tcp",
            ),
            (
                "decentralized",
                "init",
                false,
                "h1>h2 tcp, h2>h1 tcp, h2>h3 tcp, h3>h1 tcp",
            ),
        ];
        for (coordination, sync, physical, expected) in table {
            assert_eq!(listed(&plan(coordination, sync, physical)), expected);
        }
    }

    #[test]
    fn a_shut_way_names_both_ends_and_the_rule() {
        let mut shut = Shut {
            from: ("h1".to_owned(), Ipv4Addr::new(10, 0, 0, 1)),
            to: ("h2".to_owned(), Ipv4Addr::new(10, 0, 0, 2)),
            protocol: Protocol::Udp,
            port: 15_045,
            ports: Some(PortRange {
                first: 15_045,
                last: 15_099,
            }),
            why: "no answer within 2 s".to_owned(),
        };
        assert_eq!(
            shut.to_string(),
            "\
host `h1` (10.0.0.1) cannot reach host `h2` (10.0.0.2) at UDP port 15045: no answer within 2 s
  on `h2`, whichever firewall it has:
    iptables -I INPUT -p udp -s 10.0.0.1 --dport 15045:15099 -j ACCEPT
    nft insert rule inet filter input ip saddr 10.0.0.1 udp dport 15045-15099 accept
    ufw allow proto udp from 10.0.0.1 to any port 15045:15099"
        );
        shut.ports = None;
        assert!(shut.to_string().contains("set `hosts.h2.ports` to a range"));
    }
}
