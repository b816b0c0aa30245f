//! Physical time as an input.

use ictus_core::PhysicalTime;

/// Where physical time comes from: the host's clock, a simulated one, a test's.
///
/// Law: `now` never decreases. Physical actions read it from any thread.
pub trait Clock: Send + Sync + std::fmt::Debug {
    /// The present reading.
    fn now(&self) -> PhysicalTime;
}
