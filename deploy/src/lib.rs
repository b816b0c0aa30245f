//! Manifest to validated federation to plan, and what is read back from a run: traces and timing.
//!
//! [`check()`] reads `federation.yaml`, builds and describes the programs it names, and gives a
//! [`Checked`] federation or every mistake at once ([`Problems`]). [`trace`] compares the logical
//! traces of two runs; [`timing`] prints what a run's timing files say about order and latency.

mod causality;
pub mod check;
mod codes;
pub mod compose;
mod document;
mod env_file;
mod federation;
pub mod gives;
mod hosts;
pub mod image;
mod lets;
mod manifest;
mod modes;
mod needs;
pub mod offsets;
pub mod placement;
mod places;
mod plan;
mod policy;
pub mod problem;
mod program;
mod quantity;
mod reactions;
pub mod rollout;
pub mod rti;
mod spans;
#[cfg(feature = "ssh")]
pub mod ssh;
mod structure;
mod suggest;
pub mod timing;
pub mod trace;
mod wiring;

pub use check::{
    CheckOptions, Checked, Deploy, FederateKind, FederateRun, Progress, Settings, check, schema,
};
pub use codes::explain;
pub use manifest::COORDINATOR;
pub use modes::OffsetOrigin;
pub use offsets::Offsets;
pub use placement::{Engine, HostSpec, Needs, Placement, PortRange};
pub use problem::{Problem, Problems};
pub use timing::TimingSpec;
