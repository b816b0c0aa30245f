//! The per-host agent: supervises federates and the RTI, serves the API.
