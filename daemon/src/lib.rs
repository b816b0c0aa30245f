//! The per-host agent: supervises federates and the RTI, serves the API.

mod files;
pub mod identity;
pub mod paths;
pub mod stamp;
pub mod supervisor;
