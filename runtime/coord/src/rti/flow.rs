//! Flow control in logical time between our own federates: which of their messages have been handled.

use ictus_core::Tag;

use super::Rti;
use crate::topology::FederateId;
use crate::wire::{ToFederate, capability};

impl Rti {
    /// Tells the federates that limit their lead up to which tag every message for their immediate downstreams is
    /// handled, as far as their own messages have passed here.
    ///
    /// A downstream with nothing in transit holds nobody back, nor does one that is gone. Not monotone: a message may
    /// have an earlier tag than one before it.
    pub(super) fn confirm_downstream(&mut self) {
        for federate in self.federates() {
            if self.has_capability(federate, capability::FLOW_CONTROL) && self.is_present(federate)
            {
                self.tell_confirmed(federate);
            }
        }
    }

    fn tell_confirmed(&mut self, federate: FederateId) {
        let handled = self
            .topology
            .downstream(federate)
            .iter()
            .filter_map(|&(sink, _)| self.members[sink.index()].in_transit.front())
            .map(|first| first.latest_earlier())
            .min()
            .unwrap_or(Tag::FOREVER);
        let member = &mut self.members[federate.index()];
        let confirmed = handled.min(member.last_relayed);
        if confirmed > member.downstream_confirmed {
            self.send(federate, &ToFederate::DownstreamConfirmed(confirmed));
        }
        self.members[federate.index()].downstream_confirmed = confirmed;
    }
}
