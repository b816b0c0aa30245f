//! Parameters: from the plan's JSON to typed values.

use ictus_coord::describe::ParameterDescription;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value};
use thiserror::Error;

/// Why the parameters of an instance are not usable. Fatal for the instance.
#[derive(Clone, PartialEq, Eq, Debug, Error)]
#[non_exhaustive]
pub enum ParameterError {
    /// A parameter without a default is not given.
    #[error("parameter `{name}` ({type_name}) is required")]
    Missing {
        /// The parameter.
        name: String,
        /// Its type as declared.
        type_name: String,
    },
    /// The value does not have the parameter's type.
    #[error("parameter `{name}` ({type_name}): {reason}")]
    Invalid {
        /// The parameter.
        name: String,
        /// Its type as declared.
        type_name: String,
        /// What was found and what was expected.
        reason: String,
    },
    /// No parameter has this name.
    #[error("there is no parameter `{name}`; there {}", known_list(.known))]
    Unknown {
        /// The name given.
        name: String,
        /// The names that exist.
        known: Vec<String>,
    },
}

fn known_list(known: &[String]) -> String {
    match known {
        [] => "are none".to_owned(),
        [one] => format!("is `{one}`"),
        many => format!("are `{}`", many.join("`, `")),
    }
}

/// Hands out the values that a plan gives, by name.
#[derive(Debug)]
pub struct ParameterSource {
    given: Map<String, Value>,
}

impl ParameterSource {
    /// Refuses names that are no parameter, so that a misspelt one is not reported as missing.
    pub(crate) fn new(
        given: Map<String, Value>,
        parameters: &[ParameterDescription],
    ) -> Result<Self, ParameterError> {
        let known = |name: &str| parameters.iter().any(|p| p.name == name);
        match given.keys().find(|name| !known(name)) {
            None => Ok(Self { given }),
            Some(name) => Err(ParameterError::Unknown {
                name: name.clone(),
                known: parameters.iter().map(|p| p.name.clone()).collect(),
            }),
        }
    }

    /// Takes a value, or `None` when it is not given.
    ///
    /// # Errors
    ///
    /// [`ParameterError::Invalid`] when it does not have the type.
    pub fn take<T: DeserializeOwned>(
        &mut self,
        name: &str,
        type_name: &str,
    ) -> Result<Option<T>, ParameterError> {
        let Some(value) = self.given.remove(name) else {
            return Ok(None);
        };
        let value = serde_json::from_value(value);
        value.map(Some).map_err(|error| ParameterError::Invalid {
            name: name.to_owned(),
            type_name: type_name.to_owned(),
            reason: error.to_string(),
        })
    }

    /// Takes a value that must be given.
    ///
    /// # Errors
    ///
    /// [`ParameterError`] when it is missing or does not have the type.
    pub fn require<T: DeserializeOwned>(
        &mut self,
        name: &str,
        type_name: &str,
    ) -> Result<T, ParameterError> {
        let value = self.take(name, type_name)?;
        value.ok_or_else(|| ParameterError::Missing {
            name: name.to_owned(),
            type_name: type_name.to_owned(),
        })
    }
}

/// Describes one parameter of a class.
#[must_use]
pub fn parameter(name: &str, type_name: &str, required: bool) -> ParameterDescription {
    ParameterDescription {
        name: name.to_owned(),
        type_name: type_name.to_owned(),
        required,
    }
}

/// Parameters that are ready for an instance: all that have no default are given.
#[diagnostic::on_unimplemented(
    message = "a parameter without default is not given",
    label = "a child's parameter is missing: `#[child(Class {{ parameter: value }})]`"
)]
pub trait Complete<P> {
    /// The parameters, defaults filled in.
    fn complete(self) -> P;
}

impl Complete<()> for () {
    fn complete(self) {}
}

/// Stands for a required parameter that a child's literal does not give.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Missing;
