//! Where federates reach each other: what they advertise, and what others are told.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use super::{ConnectionId, Rti};
use crate::plan::Wire;
use crate::topology::FederateId;
use crate::wire::{ToFederate, ToRti};

impl Rti {
    /// ADDRESS_ADVERTISEMENT.
    pub(super) fn take_listener(&mut self, federate: FederateId, port: i32) {
        match u16::try_from(port) {
            Ok(port @ 1..) => self.members[federate.index()].listener = Some(port),
            Ok(0) | Err(_) => self.fail(federate, format!("it advertises port {port}")),
        }
    }

    /// DATA_ADDRESS, from a federate that has said that it is ours.
    pub(super) fn take_data_address(&mut self, federate: FederateId, port: i32, address: Ipv4Addr) {
        if self.members[federate.index()].capabilities.is_none() {
            let words = "DATA_ADDRESS was not expected before CAPABILITIES";
            self.fail(federate, words.to_owned());
            return;
        }
        self.members[federate.index()].data_address =
            Some(address).filter(|address| !address.is_unspecified());
        self.take_listener(federate, port);
    }

    /// ADDRESS_QUERY. Whoever is not there, has not advertised or cannot be reached has port -1.
    pub(super) fn answer_query(&mut self, federate: FederateId, asked: u16) {
        let Some(member) = self.members.get(usize::from(asked)) else {
            let federates = self.config.federates;
            self.fail(
                federate,
                format!("it asks where federate {asked} of {federates} is"),
            );
            return;
        };
        let address = self.address_for(federate, FederateId::new(asked));
        let port = member
            .listener
            .filter(|_| !address.is_unspecified())
            .map_or(-1, i32::from);
        self.send(
            federate,
            &ToFederate::AddressQueryReply {
                port,
                address: address.octets(),
            },
        );
    }

    /// The address at which `asker` reaches `asked`; unspecified when there is none.
    ///
    /// Who has joined over the loopback interface is on the RTI's host: others reach it where they reach the RTI. LF's RTI
    /// tells them 127.0.0.1, where they would find themselves.
    fn address_for(&self, asker: FederateId, asked: FederateId) -> Ipv4Addr {
        let nowhere = Ipv4Addr::UNSPECIFIED;
        let connection = |federate: FederateId| self.members[federate.index()].connection;
        let (Some(asker), Some(seen)) = (connection(asker), connection(asked)) else {
            return nowhere;
        };
        let told = self.members[asked.index()].data_address;
        let Some(address) = told.or_else(|| self.remote(seen)) else {
            return nowhere;
        };
        let near = self
            .remote(asker)
            .is_some_and(|address| address.is_loopback());
        if near || !address.is_loopback() {
            return address;
        }
        self.connections[asker.0]
            .local
            .and_then(v4)
            .filter(|local| !local.is_loopback())
            .unwrap_or(nowhere)
    }

    /// The address that a connection comes from.
    fn remote(&self, id: ConnectionId) -> Option<Ipv4Addr> {
        let peer: SocketAddr = self.connections[id.0].peer.parse().ok()?;
        v4(peer.ip())
    }

    /// What an unexpected message, after a query, says of the layout of that.
    pub(super) fn layout_hint(&self, queried: bool, message: &ToRti<'_>) -> &'static str {
        let flag = matches!(message, ToRti::Reject(_) | ToRti::FederateIds { .. });
        if queried && flag && self.config.wire == Wire::V0_12 {
            " (does it speak the layout of LF 0.13? then the RTI needs `--wire 0.13`)"
        } else {
            ""
        }
    }
}

/// The protocol has room for IPv4 only.
const fn v4(address: IpAddr) -> Option<Ipv4Addr> {
    match address.to_canonical() {
        IpAddr::V4(address) => Some(address),
        IpAddr::V6(_) => None,
    }
}
