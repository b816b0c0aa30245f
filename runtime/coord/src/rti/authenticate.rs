//! Authentication of newcomers: FED_NONCE, RTI_RESPONSE, FED_RESPONSE.
//!
//! Where LF's RTI exits on a message that it does not expect here, this one refuses the connection; the id in FED_IDS must
//! be the one that authenticated.

use super::{Closing, ConnectionId, Hello, Link, Rti, RtiEvent};
use crate::auth::Proof;
use crate::wire::{RejectReason, ToFederate, ToRti};

impl Rti {
    /// A message of a newcomer that may come next.
    pub(super) fn authenticate(&mut self, id: ConnectionId, hello: Hello, message: &ToRti<'_>) {
        match (hello, message) {
            (Hello::Silent, ToRti::FederateNonce { federate, nonce }) => {
                let proof = Proof::Rti {
                    federate: *federate,
                    nonce: *nonce,
                };
                self.challenge(id, *federate, proof);
            }
            (Hello::Challenged { federate }, ToRti::FederateResponse { hmac }) => {
                let key = self.config.federation.as_bytes();
                let proof = self.connections[id.0]
                    .nonce
                    .map(|nonce| Proof::Federate { nonce });
                if proof.is_some_and(|proof| proof.verify(key, hmac)) {
                    self.set_hello(id, Hello::Proven { federate });
                } else {
                    let words = "it does not know the federation id: its HMAC is wrong";
                    self.reject(id, RejectReason::HmacWrong, words);
                }
            }
            (_, ToRti::Reject(reason)) => {
                let peer = self.connections[id.0].peer.clone();
                let reason = format!("it refuses this RTI: {reason}");
                self.events.push_back(RtiEvent::Rejected { peer, reason });
                self.close(id, Closing::AfterFlush);
            }
            (_, message) => {
                let words = format!("{} was not expected", message.name());
                self.reject(id, RejectReason::UnexpectedMessage, &words);
            }
        }
    }

    fn challenge(&mut self, id: ConnectionId, federate: u16, proof: Proof) {
        let Some(nonce) = self.connections[id.0].nonce else {
            self.reject(id, RejectReason::HmacWrong, "there is no nonce for it");
            return;
        };
        let hmac = proof.sign(self.config.federation.as_bytes());
        self.send_to(id, &ToFederate::RtiResponse { nonce, hmac });
        self.set_hello(id, Hello::Challenged { federate });
    }

    /// The deadline stays: authentication is no reason to be slow.
    fn set_hello(&mut self, id: ConnectionId, next: Hello) {
        if let Link::Unknown { hello, .. } = &mut self.connections[id.0].link {
            *hello = next;
        }
    }
}
