//! The per-host agent: supervises federates and the RTI, serves the API.

pub mod agent;
pub mod api;
mod files;
pub mod identity;
pub mod paths;
pub mod stamp;
pub mod store;
pub mod supervisor;
