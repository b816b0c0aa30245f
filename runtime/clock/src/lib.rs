//! The host's clocks, for federates, RTI and daemon alike: readings ([`HostClock`]), who disciplines them
//! ([`discipline`]), a UDP socket that knows when its datagrams came ([`ProbeSocket`]), and whether other hosts still
//! answer ([`Lookout`]).

pub mod discipline;
mod host;
mod lookout;
mod socket;

pub use discipline::{Discipline, Sources};
pub use host::{HostClock, Skew, StepWatch};
pub use lookout::{Lookout, ask_often, give_up, other_host};
pub use socket::{Arrival, Departure, ProbeSocket, Sent, Stamps};
