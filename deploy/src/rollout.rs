//! From what a manifest asks for and what the hosts say to what is done, in which order and why.
//!
//! Three pure pieces; whoever drives them only asks hosts and carries out one [`Step`] after the other:
//!
//! - [`Desired`] (of the manifest) and [`Observed`] (of each host) give a [`Plan`]: steps with their causes and what
//!   each waits for; or a [`Refusal`]. The same manifest and hosts give the same plan, byte for byte.
//! - [`Apply`] carries out exactly one plan: what may begin now, what a failure means, what is undone.
//! - [`merge_outcomes`] makes one outcome of a federation from those of its parts.
//!
//! **Laws.** One plan restarts all parts or none: members of two runs are never healthy together. Nothing changes before
//! every host is leased, and nothing after a host has said that somebody else took over. The old run is stopped when all
//! that can fail without stopping it has succeeded. What fails before the first commit leaves nothing of the new
//! run. What is not known is never taken for absent.

mod apply;
mod desired;
mod diff;
mod observed;
mod outcome;
mod plan;
mod reach;
mod refusal;
mod show;
mod step;

pub use apply::{Apply, Moment, Outcome, Phase};
pub use desired::{Blob, Desired, DesiredError, DesiredHost, Image, ImageFile, ProgramFile};
pub use observed::{Held, MemberState, NewerRecord, Observed, Reached, Run, RunState};
pub use outcome::{Cause, Ended, Merged, PartOutcome, merge_outcomes};
pub use plan::{Part, Plan, Stale, plan, plan_down, plan_stop};
pub use reach::{Needs as ReachNeeds, Protocol, Shut, Way as ReachWay, ways as reach_ways};
pub use refusal::{Reason, Refusal};
pub use step::{Operation, Step, StepId};
