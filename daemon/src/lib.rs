//! The per-host agent: supervises federates and the RTI, serves the API.
//!
//! - [`supervisor`]: one small process per federate, which outlives the daemon;
//! - [`agent`]: what to do next, as a state machine without I/O;
//! - [`daemon`]: the process that owns federations and serves [`api`] on a Unix socket;
//! - [`client`]: what the command line uses;
//! - [`collector`], [`images`]: what a federation needs that Compose starts, without a daemon.

pub mod accounts;
pub mod agent;
pub mod api;
pub mod blobs;
pub mod client;
pub mod collector;
pub mod daemon;
mod docker;
mod facts;
mod federation;
mod files;
mod history;
mod host;
pub mod identity;
pub mod images;
pub mod installation;
mod leases;
pub mod logs;
mod metrics;
pub mod paths;
mod ports;
mod process;
mod reach;
mod rescue;
mod scrape;
pub mod secrets;
mod server;
pub mod sockets;
pub mod stamp;
pub mod store;
pub mod supervisor;
