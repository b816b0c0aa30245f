//! Flow control in logical time between our own federates: how far those downstream are.

use ictus_core::Tag;

use super::Rti;
use super::grant::LostRule;
use crate::topology::FederateId;
use crate::wire::{ToFederate, capability};

impl Rti {
    /// Tells the federates that limit their lead the least tag confirmed by all that they can reach.
    ///
    /// A federate has confirmed its LTC, and also every tag before the earliest at which anything can still happen there:
    /// an idle one holds nobody back, provided that whoever waits has announced (NET) the tag it waits at.
    pub(super) fn confirm_downstream<'a>(
        &mut self,
        start: Tag,
        changed: impl Iterator<Item = &'a FederateId>,
    ) {
        let limited: Vec<_> = self
            .federates()
            .filter(|&f| self.has_capability(f, capability::FLOW_CONTROL) && self.is_present(f))
            .collect();
        if limited.is_empty() {
            return;
        }
        for &federate in changed {
            let activity = self.view(LostRule::Gone, start).earliest_activity(federate);
            let confirmed = self.standings[federate.index()]
                .completed
                .max(activity.latest_earlier());
            let known = &mut self.members[federate.index()].confirmed;
            *known = confirmed.max(*known);
        }
        for federate in limited {
            self.tell_confirmed(federate);
        }
    }

    fn tell_confirmed(&mut self, federate: FederateId) {
        let least = self
            .topology
            .sinks(federate)
            .iter()
            .filter(|&&(sink, _)| sink != federate)
            .map(|&(sink, _)| self.members[sink.index()].confirmed)
            .min()
            .unwrap_or(Tag::FOREVER);
        let member = &mut self.members[federate.index()];
        if least > member.last_downstream_confirmed {
            member.last_downstream_confirmed = least;
            self.send(federate, &ToFederate::DownstreamConfirmed(least));
        }
    }
}
