//! The host's clocks, for federates, RTI and daemon alike: readings ([`HostClock`]), who disciplines them
//! ([`discipline`]), and a UDP socket that knows when its datagrams came ([`ProbeSocket`]).

pub mod discipline;
mod host;
mod socket;

pub use discipline::{Discipline, Sources};
pub use host::{HostClock, Skew, StepWatch};
pub use socket::{Arrival, Departure, ProbeSocket, Sent, Stamps};
