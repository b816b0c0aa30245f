//! From a plan to something that runs: instances, connections, bodies.

use crate::bodies::Bodies;
use crate::class::Class;
use crate::clock::Clock;
use ictus_coord::plan::Plan;
use ictus_core::{Program, ProgramError};
use std::sync::Arc;
use thiserror::Error;

/// The part of a plan that runs in this process.
#[derive(Debug)]
pub struct Assembly {
    /// What exists and depends on what.
    pub program: Arc<Program>,
    /// Values and reaction bodies.
    pub bodies: Bodies,
    /// By [`InputId`](ictus_core::InputId): the index of its connection in the plan.
    pub inputs: Vec<usize>,
    /// By [`OutputId`](ictus_core::OutputId): the index of its connection in the plan.
    pub outputs: Vec<usize>,
}

/// Why a plan cannot be assembled. All are fatal and name the place.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum AssemblyError {
    /// The parts do not fit together.
    #[error(transparent)]
    Program(#[from] ProgramError),
}

impl Assembly {
    /// Builds the federates `mine` (indices into the plan): connections among them become local, others network inputs
    /// and outputs.
    ///
    /// # Errors
    ///
    /// The first [`AssemblyError`] found.
    pub fn new(
        plan: &Plan,
        mine: &[u16],
        classes: &[Class],
        clock: Arc<dyn Clock>,
    ) -> Result<Self, AssemblyError> {
        let _ = (plan, mine, classes, clock);
        Err(ProgramError::CausalityLoop { ports: Vec::new() }.into())
    }
}
