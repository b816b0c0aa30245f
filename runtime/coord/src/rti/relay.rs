//! What a running federate sends: messages go straight to their destination's output, the rest is recorded.

use std::collections::VecDeque;

use ictus_core::Tag;

use super::grant::Presence;
use super::{Rti, Stage};
use crate::mutants::Mutant;
use crate::topology::FederateId;
use crate::wire::{TaggedMessage, ToRti, kind};

impl Rti {
    /// Takes the complete messages at the start of `bytes` while `from` is running.
    pub(super) fn receive_running(&mut self, from: FederateId, bytes: &[u8]) -> usize {
        self.last_word = self.now;
        let mut at = 0;
        while at < bytes.len() {
            let rest = &bytes[at..];
            let consumed = if rest[0] == kind::TAGGED_MESSAGE {
                self.receive_message(from, rest)
            } else {
                self.receive_control(from, rest)
            };
            at += consumed;
            if consumed == 0 || self.members[from.index()].stage != Stage::Running {
                break;
            }
        }
        at
    }

    #[inline]
    fn receive_message(&mut self, from: FederateId, bytes: &[u8]) -> usize {
        match TaggedMessage::decode_limited(bytes, self.config.max_payload) {
            Ok(None) => 0,
            Ok(Some((message, consumed))) => {
                if usize::from(message.federate) < self.members.len() {
                    let to = FederateId::new(message.federate);
                    let sender = &mut self.members[from.index()];
                    sender.known_dnet = sender.known_dnet.min(message.tag);
                    sender.last_relayed = sender.last_relayed.max(message.tag);
                    let before = message.tag.latest_earlier();
                    sender.downstream_confirmed = sender.downstream_confirmed.min(before);
                    self.relay_message(to, message.tag, &bytes[..consumed]);
                } else {
                    self.fail(from, format!("it sends to federate {}", message.federate));
                }
                consumed
            }
            Err(error) => {
                self.fail(from, error.to_string());
                bytes.len()
            }
        }
    }

    #[inline]
    fn relay_message(&mut self, to: FederateId, tag: Tag, bytes: &[u8]) {
        let standing = &mut self.standings[to.index()];
        if standing.presence != Presence::Present {
            // Dropped is as good as handled: its sender must not wait for it.
            self.touched.completed(to);
            return;
        }
        let ignored = self.config.mutants.has(Mutant::InTransitIgnored);
        if tag > standing.completed && !ignored {
            insert_in_transit(&mut self.members[to.index()].in_transit, tag);
        }
        if tag < standing.next_event && !ignored {
            standing.next_event = tag;
            self.touched.next_event(to);
        }
        self.relay_bytes(to, bytes);
    }

    #[inline]
    fn relay_bytes(&mut self, to: FederateId, bytes: &[u8]) {
        if self.config.mutants.has(Mutant::GrantBeforeMessage) {
            self.held.push((to, bytes.to_vec()));
            return;
        }
        if let Some(id) = self.members[to.index()].connection {
            self.connections[id.0].output.push(bytes);
            self.queue_output(id);
        }
    }

    /// Writes what the mutant [`Mutant::GrantBeforeMessage`] has held back.
    pub(super) fn release_held(&mut self) {
        for (to, bytes) in std::mem::take(&mut self.held) {
            if let Some(id) = self.members[to.index()].connection {
                self.connections[id.0].output.push(&bytes);
                self.queue_output(id);
            }
        }
    }

    fn receive_control(&mut self, from: FederateId, bytes: &[u8]) -> usize {
        match ToRti::decode_limited(bytes, self.config.wire, self.config.max_payload) {
            Ok(None) => 0,
            Ok(Some((message, consumed))) => {
                self.handle_running(from, &message, &bytes[..consumed]);
                consumed
            }
            Err(error) => {
                self.fail(from, error.to_string());
                bytes.len()
            }
        }
    }

    fn handle_running(&mut self, from: FederateId, message: &ToRti<'_>, bytes: &[u8]) {
        match message {
            ToRti::NextEventTag(tag) => self.record_next_event(from, *tag),
            ToRti::LatestTagConfirmed(tag) => self.record_completed(from, *tag),
            ToRti::PortAbsent(absent) => {
                if usize::from(absent.federate) < self.members.len() {
                    self.relay_bytes(FederateId::new(absent.federate), bytes);
                } else {
                    self.fail(from, format!("it sends to federate {}", absent.federate));
                }
            }
            ToRti::StopRequest(tag) => self.record_stop_request(from, *tag),
            ToRti::StopRequestReply(tag) => self.record_stop_reply(from, *tag),
            ToRti::Resign => self.resign(from),
            ToRti::Failed => self.lose_in_order(from),
            ToRti::AddressAdvertisement { port } => self.take_listener(from, *port),
            ToRti::DataAddress { port, address } => {
                self.take_data_address(from, *port, (*address).into());
            }
            ToRti::AddressQuery { federate, .. } => self.answer_query(from, *federate),
            ToRti::TaggedMessage(_)
            | ToRti::FederateIds { .. }
            | ToRti::Timestamp(_)
            | ToRti::NeighborStructure(_)
            | ToRti::UdpPort(_)
            | ToRti::ClockSyncT3 { .. }
            | ToRti::FederateNonce { .. }
            | ToRti::FederateResponse { .. }
            | ToRti::Capabilities(_)
            | ToRti::Reject(_) => {
                self.fail(
                    from,
                    format!("{} was not expected while running", message.name()),
                );
            }
        }
    }
}

/// Keeps the tags ascending and distinct; they arrive nearly so.
#[inline]
fn insert_in_transit(tags: &mut VecDeque<Tag>, tag: Tag) {
    match tags.back() {
        Some(&last) if last == tag => {}
        Some(&last) if last > tag => {
            if let Err(at) = tags.binary_search(&tag) {
                tags.insert(at, tag);
            }
        }
        Some(_) | None => tags.push_back(tag),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn tags_in_transit_are_ascending_and_distinct(
            times in proptest::collection::vec(0i64..20, 0..40),
        ) {
            let mut tags = VecDeque::new();
            for &time in &times {
                insert_in_transit(&mut tags, Tag::at(time));
            }
            let expected: std::collections::BTreeSet<_> = times.into_iter().map(Tag::at).collect();
            prop_assert!(tags.into_iter().eq(expected));
        }
    }
}
