//! Ports of this host for members of parts: chosen from the host's range when they are prepared, looked at again at commit.
//!
//! A member has one number for both TCP and UDP. Nothing holds a port between prepare and commit but this daemon's records, so
//! whoever takes one meanwhile is found at commit, and named as far as the kernel lets this user see.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::net::{Ipv4Addr, SocketAddrV4, TcpListener, UdpSocket};

use ictus_coord::plan::{ClockSync, Coordination, Plan};
use ictus_deploy::FederateKind;
use ictus_deploy::placement::PortRange;

use crate::agent::RTI;
use crate::api::StartRequest;
use crate::api::part::Part;

mod holder;

use holder::holder;

/// The ports of one part.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Assigned {
    /// The RTI's; absent where it does not run, or any will do.
    pub(crate) rti: Option<u16>,
    /// Those of federates, by name.
    pub(crate) federates: BTreeMap<String, u16>,
}

/// Why a member cannot have its port. Nothing runs.
#[derive(Debug, thiserror::Error)]
pub(crate) enum PortError {
    /// Somebody else has the port that was chosen, or asked for.
    #[error(
        "host `{host}`: port {port} of {address}, which {member} is to have, is taken: {why}{by}; {fix}"
    )]
    Taken {
        /// This host.
        host: String,
        /// Its data address.
        address: Ipv4Addr,
        /// The port.
        port: u16,
        /// For whom.
        member: String,
        /// What the system says.
        why: io::Error,
        /// Who has it, in words.
        by: String,
        /// What helps.
        fix: &'static str,
    },
    /// The range has too few.
    #[error(
        "host `{host}`: of ports {}-{} of {address}, {free} are free and {wanted} are needed; make `ports` larger, or stop what holds them",
        range.first,
        range.last
    )]
    TooFew {
        /// This host.
        host: String,
        /// Its data address.
        address: Ipv4Addr,
        /// The range.
        range: PortRange,
        /// How many are free.
        free: usize,
        /// How many are needed.
        wanted: usize,
    },
    /// The data address belongs to another host.
    #[error(
        "host `{host}`: {address} is not its address; set `hosts.{host}.address` to where the others reach it"
    )]
    NotOurs {
        /// This host.
        host: String,
        /// The address.
        address: Ipv4Addr,
    },
}

/// Chooses the ports of a part; `others` are promised to other federations of this host.
pub(crate) fn assign(
    part: &Part,
    request: &StartRequest,
    others: &BTreeSet<u16>,
) -> Result<Assigned, PortError> {
    let mut assigned = Assigned::default();
    if let Some(port) = request.settings.rti_port.filter(|_| part.rti) {
        look(part, RTI, port, "stop it, or choose another `rti.port`")?;
        assigned.rti = Some(port);
    }
    let Some(range) = part.ports else {
        return Ok(assigned);
    };
    let wanted = wanted(part, request, assigned.rti.is_none());
    let own = assigned.rti;
    let free = |port: &u16| !others.contains(port) && own != Some(*port);
    let free = (range.first..=range.last).filter(free);
    let mut free = free.filter(|port| bind(part.address, *port).is_ok());
    for (taken, member) in wanted.iter().enumerate() {
        let Some(port) = free.next() else {
            let (host, address) = (part.host.clone(), part.address);
            if bind(address, 0).is_err() {
                return Err(PortError::NotOurs { host, address });
            }
            return Err(PortError::TooFew {
                host,
                address,
                range,
                free: taken,
                wanted: wanted.len(),
            });
        };
        if member == RTI {
            assigned.rti = Some(port);
        } else {
            assigned.federates.insert(member.clone(), port);
        }
    }
    Ok(assigned)
}

/// Looks whether all are still free.
pub(crate) fn check(part: &Part, assigned: &Assigned) -> Result<(), PortError> {
    let rti = assigned.rti.map(|port| (RTI, port)).filter(|_| part.rti);
    let federates = assigned.federates.iter();
    let federates = federates.map(|(name, port)| (name.as_str(), *port));
    for (member, port) in rti.into_iter().chain(federates) {
        look(
            part,
            member,
            port,
            "stop it, or run `ictus up` again: others are chosen",
        )?;
    }
    Ok(())
}

/// Who of this host's members gets a port: the RTI, and our federates that others connect to, or whose clock is probed.
fn wanted(part: &Part, request: &StartRequest, rti: bool) -> Vec<String> {
    let federates = part.federates.iter();
    let federates = federates.filter_map(|id| request.federates.get(usize::from(*id)));
    let ours = federates.filter(|run| matches!(run.kind, FederateKind::Ours));
    let listening = ours.filter(|run| listens(&request.plan, run.id));
    let rti = (part.rti && rti).then(|| RTI.to_owned());
    let names = listening.map(|run| run.name.clone());
    rti.into_iter().chain(names).collect()
}

fn listens(plan: &Plan, id: u16) -> bool {
    let direct = plan.coordination == Coordination::Decentralized;
    let mut wires = plan.connections.iter();
    let heard = wires.any(|wire| {
        wire.to.federate == id && wire.from.federate != id && (direct || wire.physical)
    });
    heard || plan.clock.sync == ClockSync::On
}

fn look(part: &Part, member: &str, port: u16, fix: &'static str) -> Result<(), PortError> {
    let why = match bind(part.address, port) {
        Ok(()) => return Ok(()),
        Err(why) => why,
    };
    let (host, address) = (part.host.clone(), part.address);
    if why.kind() == io::ErrorKind::AddrNotAvailable {
        return Err(PortError::NotOurs { host, address });
    }
    let by = holder(address, port).map_or_else(String::new, |by| format!(" ({by})"));
    let member = match member {
        RTI => "the RTI".to_owned(),
        name => format!("federate `{name}`"),
    };
    Err(PortError::Taken {
        host,
        address,
        port,
        member,
        why,
        by,
        fix,
    })
}

fn bind(address: Ipv4Addr, port: u16) -> io::Result<()> {
    let listener = TcpListener::bind(SocketAddrV4::new(address, port))?;
    let port = listener.local_addr()?.port();
    UdpSocket::bind(SocketAddrV4::new(address, port)).map(drop)
}

#[cfg(test)]
mod tests {
    use ictus_coord::plan::{ConnectionPlan, Endpoint, FederatePlan};
    use ictus_deploy::placement::Engine;
    use ictus_deploy::{FederateRun, Needs, Settings, TimingSpec};

    use super::*;

    const HERE: Ipv4Addr = Ipv4Addr::LOCALHOST;

    /// Federates a and b beside the RTI; a sends to b.
    fn request(coordination: Coordination, ports: Option<PortRange>) -> (Part, StartRequest) {
        let federate = |name: &str| FederatePlan {
            name: name.to_owned(),
            ..FederatePlan::default()
        };
        let end = |federate| Endpoint {
            federate,
            ..Endpoint::default()
        };
        let plan = Plan {
            coordination,
            federates: vec![federate("a"), federate("b")],
            connections: vec![ConnectionPlan {
                from: end(0),
                to: end(1),
                ..ConnectionPlan::default()
            }],
            ..Plan::default()
        };
        let run = |(id, name): (u16, &str)| FederateRun {
            id,
            name: name.to_owned(),
            executable: "/bin/f".into(),
            kind: FederateKind::Ours,
            env: BTreeMap::new(),
            needs: Needs::default(),
            portable: true,
        };
        let part = Part {
            host: "h1".to_owned(),
            hosts: BTreeMap::new(),
            rti: true,
            federates: vec![0, 1],
            address: HERE,
            engine: Engine::Process,
            ports,
            security: ictus_deploy::placement::Security::TrustedNetwork,
            programs: BTreeMap::new(),
        };
        let request = StartRequest {
            manifest: "/f.yaml".into(),
            cwd: "/".into(),
            plan,
            federates: vec![run((0, "a")), run((1, "b"))],
            settings: Settings::default(),
            timing: TimingSpec::default(),
            trace: false,
            part: Some(part.clone()),
        };
        (part, request)
    }

    /// A range of which the first is taken by the listener.
    fn range(length: u16) -> (TcpListener, PortRange) {
        loop {
            let listener = TcpListener::bind((HERE, 0)).unwrap();
            let first = listener.local_addr().unwrap().port();
            let Some(last) = first.checked_add(length) else {
                continue;
            };
            if (first + 1..=last).all(|port| bind(HERE, port).is_ok()) {
                return (listener, PortRange { first, last });
            }
        }
    }

    #[test]
    fn who_listens_gets_a_port_of_the_range() {
        let (_taken, range) = range(3);
        let next = range.first + 1;
        let none = BTreeSet::new();
        let (part, centralized) = request(Coordination::Centralized, Some(range));
        let rti = assign(&part, &centralized, &none).unwrap();
        assert_eq!((rti.rti, rti.federates.len()), (Some(next), 0));
        let (part, direct) = request(Coordination::Decentralized, Some(range));
        let both = assign(&part, &direct, &none).unwrap();
        let b = BTreeMap::from([("b".to_owned(), next + 1)]);
        assert_eq!((both.rti, &both.federates), (Some(next), &b));
        check(&part, &both).unwrap();
        // What others were promised is theirs, although nobody listens there yet.
        let promised = BTreeSet::from([next]);
        let later = assign(&part, &direct, &promised).unwrap();
        assert_eq!(
            (later.rti, later.federates["b"]),
            (Some(next + 1), next + 2)
        );
        let promised = BTreeSet::from([next, next + 1]);
        let error = assign(&part, &direct, &promised).unwrap_err().to_string();
        assert!(error.contains("1 are free and 2 are needed"), "{error}");
        let (part, any) = request(Coordination::Decentralized, None);
        assert_eq!(assign(&part, &any, &none).unwrap(), Assigned::default());
    }

    #[test]
    fn who_takes_a_port_meanwhile_is_named() {
        let (_taken, range) = range(2);
        let (part, direct) = request(Coordination::Decentralized, Some(range));
        let assigned = assign(&part, &direct, &BTreeSet::new()).unwrap();
        let port = assigned.federates["b"];
        let me = std::process::id();
        let thief = UdpSocket::bind((HERE, port)).unwrap();
        let error = check(&part, &assigned).unwrap_err().to_string();
        for words in [
            format!("host `h1`: port {port} of 127.0.0.1"),
            "which federate `b` is to have".to_owned(),
            format!("(process {me}, "),
            "`ictus up` again".to_owned(),
        ] {
            assert!(error.contains(&words), "{words} is missing in {error}");
        }
        drop(thief);
        check(&part, &assigned).unwrap();
    }

    #[test]
    fn an_address_of_another_host_is_said() {
        let (_taken, range) = range(2);
        let (mut part, request) = request(Coordination::Centralized, Some(range));
        part.address = Ipv4Addr::new(192, 0, 2, 1);
        let error = assign(&part, &request, &BTreeSet::new()).unwrap_err();
        assert!(matches!(error, PortError::NotOurs { .. }), "{error}");
    }
}
