//! `ictus health`: whether something of this machine, or of this container, serves a TCP port. For health checks in images
//! that hold nothing else; it connects to nobody, so that nobody is disturbed.

use std::fs;

use clap::Args;
use ictusd::sockets;

use crate::error::CliError;

/// Say by the exit code whether a TCP port is listened on, or has connections
#[derive(Debug, Args)]
pub(crate) struct Health {
    /// The port
    port: u16,
}

impl Health {
    pub(crate) fn run(&self) -> Result<(), CliError> {
        let tables = ["/proc/net/tcp", "/proc/net/tcp6"];
        let mut texts = tables
            .iter()
            .filter_map(|table| fs::read_to_string(table).ok());
        if texts.any(|text| serves(&text, self.port)) {
            return Ok(());
        }
        let message = format!("nothing serves port {}", self.port);
        Err(CliError::failed(message))
    }
}

/// Whether a table of the kernel's has a socket at a local port that listens or is connected.
fn serves(table: &str, port: u16) -> bool {
    sockets::of_table(table).any(|socket| socket.serves && socket.port == port)
}

#[cfg(test)]
mod tests {
    use super::serves;

    #[test]
    fn a_port_is_served_by_who_listens_or_is_connected() {
        let rest = "00000000:00000000 00:00000000 00000000 0 0 4711";
        let table = format!(
            "  sl  local_address rem_address   st tx_queue rx_queue\n   \
            0: 0100007F:3AC5 00000000:0000 0A {rest}\n   \
            1: 0100007F:1F90 0100007F:3AC5 01 {rest}\n   \
            2: 0100007F:0050 0100007F:3AC5 06 {rest}\n"
        );
        let table = table.as_str();
        assert!(serves(table, 0x3AC5) && serves(table, 0x1F90));
        // The other end, one that is closing, and the heading.
        assert!(!serves(table, 0x50) && !serves(table, 1) && !serves("", 80));
    }
}
