//! Other hosts that answer no more.

use super::{Io, Runner};
use crate::peers::Peers;
use crate::transport::Connection;
use ictus_core::Duration;
use std::net::IpAddr;
use std::os::fd::BorrowedFd;

impl Io {
    /// How long until it is to be looked whether other hosts still answer; absent when there are none.
    pub(super) fn patience(&self) -> Option<Duration> {
        let any = watched(self.connection.as_ref(), &self.peers)
            .next()
            .is_some();
        any.then(|| self.lookout.patience())
    }
}

impl Runner<'_> {
    /// From time to time: whether other hosts still answer, whatever their programs do.
    pub(super) fn look_out(&mut self) {
        if self.io.patience() != Some(Duration::ZERO) {
            return;
        }
        let Io {
            connection,
            peers,
            lookout,
            ..
        } = &mut self.io;
        for silent in lookout.look(watched(connection.as_ref(), peers)) {
            peers.lose(silent);
            let there = |rti: &&mut Connection| {
                let host = rti.watched().map(|(host, _)| host);
                host == Some(silent.host)
            };
            if let Some(connection) = connection.as_mut().filter(there) {
                connection.lose(silent);
                self.federate.handle_disconnect();
            }
        }
    }

    /// The RTI's address, and why it was lost when its host says nothing.
    pub(super) fn rti_name(&self) -> String {
        let Some(connection) = &self.io.connection else {
            return String::new();
        };
        let address = connection.peer();
        let lost = connection.lost();
        lost.map_or_else(
            || format!(" ({address})"),
            |silent| {
                let seconds = silent.lasting.to_std().as_secs_f64();
                format!(" ({address}): no answer from its host for {seconds:.1} s")
            },
        )
    }
}

/// The sockets to other hosts: the RTI's, and those of other federates by number.
fn watched<'a>(
    rti: Option<&'a Connection>,
    peers: &'a Peers,
) -> impl Iterator<Item = (Option<usize>, IpAddr, BorrowedFd<'a>)> {
    let rti = rti.and_then(Connection::watched);
    let rti = rti.map(|(host, socket)| (None, host, socket));
    let peers = peers.watched();
    let peers = peers.map(|(stream, host, socket)| (Some(stream), host, socket));
    rti.into_iter().chain(peers)
}
