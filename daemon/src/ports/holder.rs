//! Who holds a port, from /proc.

use std::fs;
use std::net::Ipv4Addr;
use std::path::Path;

use crate::sockets::{self, Socket};

/// Who has this port of an address, in words; nothing when it cannot be seen.
pub(super) fn holder(address: Ipv4Addr, port: u16) -> Option<String> {
    // A socket of IPv6 has the port, too, unless it is told otherwise.
    let tables = ["tcp", "udp", "tcp6", "udp6"];
    let tables = tables.map(|table| fs::read_to_string(Path::new("/proc/net").join(table)));
    let mut sockets = tables
        .iter()
        .flatten()
        .flat_map(|table| sockets::of_table(table));
    let there = |socket: &Socket| {
        socket.port == port
            && socket.inode != 0
            && (socket.address == address || socket.address.is_unspecified())
    };
    let socket = sockets.find(there)?;
    let process = process(socket.inode);
    Some(process.unwrap_or_else(|| format!("a process of user {}", socket.user)))
}

/// The process that has a socket open; only those of this user can be seen.
fn process(inode: u64) -> Option<String> {
    let wanted = format!("socket:[{inode}]");
    for process in fs::read_dir("/proc").ok()?.flatten() {
        let name = process.file_name();
        let Some(pid) = name.to_str().and_then(|name| name.parse::<u32>().ok()) else {
            continue;
        };
        let Ok(files) = fs::read_dir(process.path().join("fd")) else {
            continue;
        };
        let is_it = |file: fs::DirEntry| {
            let target = fs::read_link(file.path());
            target.is_ok_and(|target| target.to_str() == Some(&wanted))
        };
        if files.flatten().any(is_it) {
            let comm = fs::read_to_string(process.path().join("comm")).unwrap_or_default();
            return Some(format!("process {pid}, {}", comm.trim_end()));
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::net::{TcpListener, UdpSocket};

    #[test]
    fn this_process_is_found() {
        let tcp = TcpListener::bind("127.0.0.1:0").unwrap();
        let udp = UdpSocket::bind("127.0.0.1:0").unwrap();
        // Where the kernel has IPv6.
        let wide = TcpListener::bind("[::]:0").ok();
        let mut ports = vec![tcp.local_addr(), udp.local_addr()];
        ports.extend(wide.as_ref().map(TcpListener::local_addr));
        for port in ports.into_iter().map(|it| it.unwrap().port()) {
            let said = holder(Ipv4Addr::LOCALHOST, port).unwrap();
            let me = format!("process {}, ", std::process::id());
            assert!(said.starts_with(&me), "{said}");
        }
    }
}
