//! Manifest to validated federation to plan, and what is read back from a run: traces and timing.
//!
//! [`check()`] reads `federation.yaml`, builds and describes the programs it names, and gives a
//! [`Checked`] federation or every mistake at once ([`Problems`]). [`trace`] compares the logical
//! traces of two runs; [`timing`] prints what a run's timing files say about order and latency.

pub mod check;
pub mod problem;
pub mod timing;
pub mod trace;

pub use check::{
    CheckOptions, Checked, FederateKind, FederateRun, Progress, Settings, check, schema,
};
pub use problem::{Problem, Problems, explain};
pub use timing::TimingSpec;
