//! Classes: the reactors that a program offers to plans, by name.

use crate::parameters::{ParameterError, ParameterSource};
use crate::reactor::Reactions;
use crate::scope::Elaboration;
use ictus_coord::describe::ParameterDescription;
use ictus_core::ReactorId;
use serde_json::{Map, Value};
use std::fmt;

/// A reactor class that a manifest can name.
#[derive(Clone, Copy)]
pub struct Class {
    name: &'static str,
    parameters: fn() -> Vec<ParameterDescription>,
    build: Build,
}

type Build = fn(&mut Elaboration, &str, Map<String, Value>) -> Result<ReactorId, ParameterError>;

impl Class {
    /// The class of `R`.
    #[must_use]
    pub const fn of<R: Reactions>() -> Self {
        Self {
            name: R::NAME,
            parameters: R::parameters,
            build: build::<R>,
        }
    }

    /// The declared name.
    #[must_use]
    pub const fn name(&self) -> &'static str {
        self.name
    }

    /// The parameters in order of declaration.
    #[must_use]
    pub fn parameters(&self) -> Vec<ParameterDescription> {
        (self.parameters)()
    }

    /// Adds an instance as a top-level reactor.
    pub(crate) fn build(
        &self,
        elaboration: &mut Elaboration,
        path: &str,
        parameters: Map<String, Value>,
    ) -> Result<ReactorId, ParameterError> {
        (self.build)(elaboration, path, parameters)
    }
}

fn build<R: Reactions>(
    elaboration: &mut Elaboration,
    path: &str,
    parameters: Map<String, Value>,
) -> Result<ReactorId, ParameterError> {
    let mut source = ParameterSource::new(parameters, &R::parameters())?;
    let parameters = R::read(&mut source)?;
    Ok(elaboration.instance::<R>(path.to_owned(), 0, parameters).0)
}

impl fmt::Debug for Class {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Class").field(&self.name).finish()
    }
}
