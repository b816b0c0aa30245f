//! Classes: the reactors that a program offers to plans, by name.

/// A reactor class that a manifest can name.
#[derive(Clone, Copy, Debug)]
pub struct Class {
    /// The declared name.
    pub name: &'static str,
}
