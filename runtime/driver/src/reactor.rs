//! Reactor classes: what `#[reactor]` and `#[reactions]` implement, and what one can write by hand.

use crate::parameters::{ParameterError, ParameterSource};
use crate::port::Multi;
use crate::scope::{ReactionScope, Scope};
use ictus_coord::describe::ParameterDescription;
use std::fmt;
use std::ops::Deref;

/// A reactor class: its parameters, state and parts.
///
/// `Self` is what reactions reach as `self`: parameters and state. Ports, timers, actions and children are in
/// [`Reactor::Parts`], out of the reach of `self`, so that a reaction touches only what its signature names.
///
/// By hand, without the macros:
///
/// ```
/// use ictus::build::{
///     Handlers, ParameterDescription, ParameterError, ParameterSource, ReactionScope, Reactions, Reactor, Scope,
///     effect, trigger,
/// };
/// use ictus::{Duration, DurationExt, Output, Timer};
///
/// struct Counter {
///     count: u64,
/// }
///
/// struct Parts {
///     tick: Timer,
///     out: Output<u64>,
/// }
///
/// impl Reactor for Counter {
///     const NAME: &'static str = "Counter";
///     type Parameters = ();
///     type Given = ();
///     type Parts = Parts;
///
///     fn parameters() -> Vec<ParameterDescription> {
///         Vec::new()
///     }
///
///     fn read(_: &mut ParameterSource) -> Result<(), ParameterError> {
///         Ok(())
///     }
///
///     fn declare((): (), scope: &mut Scope<'_>) -> (Self, Parts) {
///         let parts = Parts {
///             tick: scope.timer(Duration::ZERO, 100.ms()),
///             out: scope.output("out"),
///         };
///         (Self { count: 0 }, parts)
///     }
/// }
///
/// impl Reactions for Counter {
///     fn react(&self, parts: &Parts, scope: &mut ReactionScope<'_, Self>) {
///         let items = (trigger(&parts.tick), (effect(&parts.out), ()));
///         scope.reaction("count", Handlers::default(), items, |state, _, (_, (out, ())), _| {
///             state.count += 1;
///             out.item_mut().set(state.count);
///         });
///     }
/// }
///
/// ictus::program![Counter];
/// ```
pub trait Reactor: Sized + 'static {
    /// The name that manifests use.
    const NAME: &'static str;
    /// The values of all parameters.
    type Parameters;
    /// Parameters as a container gives them to a child: `Default` gives none, methods of the parameters' names the
    /// rest; [`Complete`](crate::build::Complete) once all that have no default are given.
    type Given;
    /// Ports, timers, actions and children.
    type Parts: 'static;

    /// Describes the parameters in order of declaration.
    fn parameters() -> Vec<ParameterDescription>;

    /// Reads the parameters that a plan gives.
    ///
    /// # Errors
    ///
    /// The first [`ParameterError`].
    fn read(source: &mut ParameterSource) -> Result<Self::Parameters, ParameterError>;

    /// Creates the state and declares the parts.
    fn declare(parameters: Self::Parameters, scope: &mut Scope<'_>) -> (Self, Self::Parts);
}

/// The reactions and connections of a class, in order.
#[diagnostic::on_unimplemented(
    message = "`{Self}` has no reactions",
    label = "a reactor without `#[reactions]`",
    note = "add `#[reactions] impl {Self} {{ .. }}`; it may be empty"
)]
pub trait Reactions: Reactor {
    /// Adds the reactions, in the order in which they run at one tag, and the connections among the parts.
    fn react(&self, parts: &Self::Parts, scope: &mut ReactionScope<'_, Self>);
}

/// A nested reactor; its ports are fields: `first.out`.
pub struct Child<R: Reactor> {
    parts: R::Parts,
}

impl<R: Reactor> Child<R> {
    pub(crate) const fn new(parts: R::Parts) -> Self {
        Self { parts }
    }
}

impl<R: Reactor> Deref for Child<R> {
    type Target = R::Parts;

    fn deref(&self) -> &R::Parts {
        &self.parts
    }
}

impl<R: Reactor> fmt::Debug for Child<R> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Child<{}>", R::NAME)
    }
}

/// Nested reactors of one class, numbered from 0; a slice of [`Child`].
pub struct Bank<R: Reactor> {
    members: Vec<Child<R>>,
}

impl<R: Reactor> Bank<R> {
    pub(crate) const fn new(members: Vec<Child<R>>) -> Self {
        Self { members }
    }

    /// One port of every member, as a multiport: `stages.all(|stage| &stage.out)`.
    pub fn all<P: Clone>(&self, port: impl Fn(&R::Parts) -> &P) -> Multi<P> {
        Multi::new(self.members.iter().map(|m| port(m).clone()).collect())
    }
}

impl<R: Reactor> Deref for Bank<R> {
    type Target = [Child<R>];

    fn deref(&self) -> &[Child<R>] {
        &self.members
    }
}

impl<R: Reactor> fmt::Debug for Bank<R> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Bank<{}>[{}]", R::NAME, self.members.len())
    }
}
