//! Authentication: federate and RTI prove to each other that they know the federation id, before a federate joins.
//!
//! An HMAC-SHA256 over the other side's nonce, with the federation id as its key. What follows, the federation id in
//! FED_IDS included, is in clear text.
//!
//! Source: section 3.2 of the wire document; reactor-c `rti_remote.c`, `federate.c`.

use hmac::{Hmac, KeyInit, Mac};
use sha2::Sha256;

use crate::wire::kind;

/// Random bytes that are used once.
pub type Nonce = [u8; 8];

/// The longest key in bytes; what follows is cut off.
const KEY: usize = 255;

/// What an HMAC is made over, by whom.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Proof {
    /// RTI_RESPONSE: the RTI answers FED_NONCE.
    Rti {
        /// The federate's id.
        federate: u16,
        /// The federate's nonce.
        nonce: Nonce,
    },
    /// FED_RESPONSE: the federate answers RTI_RESPONSE.
    Federate {
        /// The RTI's nonce.
        nonce: Nonce,
    },
}

impl Proof {
    /// The HMAC of someone who knows the federation id.
    #[must_use]
    pub fn sign(&self, federation: &[u8]) -> [u8; 32] {
        self.mac(federation).finalize().into_bytes().into()
    }

    /// Whether `hmac` is of someone who knows the federation id; takes as long for every wrong one.
    ///
    /// Law `only_the_key_proves`.
    #[must_use]
    pub fn verify(&self, federation: &[u8], hmac: &[u8; 32]) -> bool {
        self.mac(federation).verify_slice(hmac).is_ok()
    }

    fn mac(&self, federation: &[u8]) -> Hmac<Sha256> {
        let key = &federation[..federation.len().min(KEY)];
        let mut mac = Hmac::<Sha256>::new_from_slice(key).expect("a key may have any length");
        match self {
            Self::Rti { federate, nonce } => {
                mac.update(&[kind::RTI_RESPONSE]);
                mac.update(&federate.to_le_bytes());
                mac.update(nonce);
            }
            Self::Federate { nonce } => {
                mac.update(&[kind::FEDERATE_RESPONSE]);
                mac.update(nonce);
            }
        }
        mac
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn hex(bytes: &[u8]) -> String {
        bytes.iter().map(|byte| format!("{byte:02x}")).collect()
    }

    /// Computed with Python's `hmac` over the bytes that the wire document names.
    #[test]
    fn bytes_of_the_wire_document() {
        let nonce = [1, 2, 3, 4, 5, 6, 7, 8];
        let rti = Proof::Rti {
            federate: 258,
            nonce,
        };
        let federate = Proof::Federate { nonce };
        assert_eq!(
            hex(&rti.sign(b"test")),
            "fcc80af85d195e0ef75f1e71be3511dc4d30fa87665993a067368c52075109df"
        );
        assert_eq!(
            hex(&federate.sign(b"test")),
            "9b2b3c01da4320080c1168c9e3a43458c2e07d7e156391ecb65c353a72a87a68"
        );
        assert_eq!(rti.sign(&[7; 255]), rti.sign(&[7; 300]));
    }

    proptest! {
        #[test]
        fn only_the_key_proves(
            key: Vec<u8>, other: Vec<u8>, federate: u16, nonce: Nonce, bit in 0usize..256,
        ) {
            // A key shorter than the hash's block is filled up with zeros.
            prop_assume!(key.iter().rev().skip_while(|b| **b == 0).ne(other.iter().rev().skip_while(|b| **b == 0)));
            for proof in [Proof::Rti { federate, nonce }, Proof::Federate { nonce }] {
                let mut hmac = proof.sign(&key);
                prop_assert!(proof.verify(&key, &hmac));
                prop_assert!(!proof.verify(&other, &hmac));
                hmac[bit / 8] ^= 1 << (bit % 8);
                prop_assert!(!proof.verify(&key, &hmac));
            }
            let rti = Proof::Rti { federate, nonce };
            let theirs = Proof::Federate { nonce };
            prop_assert!(!theirs.verify(&key, &rti.sign(&key)));
            let next = Proof::Rti { federate: federate.wrapping_add(1), nonce };
            prop_assert!(!next.verify(&key, &rti.sign(&key)));
        }
    }
}
