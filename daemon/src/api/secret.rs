//! Values of secrets on their way from whoever starts a federation to a host.
//!
//! | call | answer |
//! |---|---|
//! | `POST /v1/federations/NAME` with a [`StartCall`] | as in [`super`] |
//! | `POST /v1/federations/NAME/secrets` with [`SecretValues`] | [`SecretsChanged`]: those whose value is another one than the run's |
//!
//! Values are never printed, logged, kept on a disk or told in an answer.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use zeroize::Zeroizing;

use super::StartRequest;

/// The longest value, in bytes.
pub const SECRET_BYTES_MAX: usize = 64 << 10;

/// Names of secrets by federate.
pub type SecretsChanged = BTreeMap<String, BTreeSet<String>>;

/// A secret's value: any bytes, at most [`SECRET_BYTES_MAX`]; overwritten when it is dropped.
#[derive(Clone, PartialEq, Eq)]
pub struct SecretValue(Zeroizing<Vec<u8>>);

/// Values by federate and name.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct SecretValues(pub BTreeMap<String, BTreeMap<String, SecretValue>>);

/// What starts a federation of this machine alone.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StartCall {
    /// What to run.
    pub request: StartRequest,
    /// The values of its federates' secrets.
    #[serde(default)]
    pub secrets: SecretValues,
}

impl SecretValue {
    /// A value.
    #[must_use]
    pub fn new(bytes: Vec<u8>) -> Self {
        Self(Zeroizing::new(bytes))
    }

    /// Its bytes.
    #[must_use]
    pub fn bytes(&self) -> &[u8] {
        &self.0
    }
}

impl fmt::Debug for SecretValue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("SecretValue(..)")
    }
}

impl Serialize for SecretValue {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let text = Zeroizing::new(STANDARD.encode(&*self.0));
        serializer.serialize_str(&text)
    }
}

impl<'de> Deserialize<'de> for SecretValue {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        // Errors say nothing of what came.
        let text = String::deserialize(deserializer)
            .map(Zeroizing::new)
            .map_err(|_| D::Error::custom("a secret's value is no text"))?;
        let bytes = STANDARD
            .decode(&*text)
            .map_err(|_| D::Error::custom("a secret's value is no base64"))?;
        Ok(Self::new(bytes))
    }
}

impl SecretValues {
    /// A value.
    #[must_use]
    pub fn value(&self, federate: &str, name: &str) -> Option<&SecretValue> {
        self.0.get(federate)?.get(name)
    }

    /// Those of these federates.
    #[must_use]
    pub fn only(&self, federates: &[String]) -> Self {
        let these = self.0.iter().filter(|(name, _)| federates.contains(name));
        Self(
            these
                .map(|(name, values)| (name.clone(), values.clone()))
                .collect(),
        )
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.0.values().all(BTreeMap::is_empty)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_value_is_never_printed_and_comes_over_whole() {
        let value = SecretValue::new(b"canary\xff\n".to_vec());
        assert_eq!(format!("{value:?}"), "SecretValue(..)");
        let text = serde_json::to_string(&value).unwrap();
        assert!(!text.contains("canary"), "{text}");
        let read: SecretValue = serde_json::from_str(&text).unwrap();
        assert_eq!(read, value);
        for wrong in ["\"canary\\u0000\"", "[\"canary\"]", "7"] {
            let error = serde_json::from_str::<SecretValue>(wrong).unwrap_err();
            assert!(!error.to_string().contains("canary"), "{error}");
        }
    }
}
