//! Who holds a port, from /proc.

use std::fs;
use std::net::Ipv4Addr;

/// A line of /proc/net/{tcp,udp}: a socket.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Socket {
    address: Ipv4Addr,
    port: u16,
    user: u32,
    inode: u64,
}

/// Who has this port of an address, in words; nothing when it cannot be seen.
pub(super) fn holder(address: Ipv4Addr, port: u16) -> Option<String> {
    let tables = ["/proc/net/tcp", "/proc/net/udp"].map(fs::read_to_string);
    let lines: Vec<Socket> = tables
        .iter()
        .flatten()
        .flat_map(|table| table.lines().filter_map(parse))
        .collect();
    let there = |socket: &&Socket| {
        socket.port == port
            && socket.inode != 0
            && (socket.address == address || socket.address.is_unspecified())
    };
    let socket = lines.iter().find(there)?;
    let process = process(socket.inode);
    Some(process.unwrap_or_else(|| format!("a process of user {}", socket.user)))
}

/// `  0: 0100007F:1F90 00000000:0000 0A 00000000:00000000 00:00000000 00000000  1000 0 4711 ...`
fn parse(line: &str) -> Option<Socket> {
    let mut words = line.split_ascii_whitespace();
    let (address, port) = words.nth(1)?.split_once(':')?;
    // As the machine stores it, so that its bytes in memory are in network order.
    let address = u32::from_str_radix(address, 16).ok()?;
    Some(Socket {
        address: Ipv4Addr::from(address.to_ne_bytes()),
        port: u16::from_str_radix(port, 16).ok()?,
        user: words.nth(5)?.parse().ok()?,
        inode: words.nth(1)?.parse().ok()?,
    })
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
    fn a_line_is_a_socket() {
        let line = "   3: 0100007F:1F90 00000000:0000 0A 00000000:00000000 00:00000000 00000000  1000        0 4711 1 0000 100 0 0 10 0";
        let socket = parse(line).unwrap();
        let (port, user, inode) = (8080, 1000, 4711);
        assert_eq!(
            (socket.port, socket.user, socket.inode),
            (port, user, inode)
        );
        if cfg!(target_endian = "little") {
            assert_eq!(socket.address, Ipv4Addr::LOCALHOST);
        }
        assert_eq!(parse("  sl  local_address rem_address   st"), None);
    }

    #[test]
    fn this_process_is_found() {
        let tcp = TcpListener::bind("127.0.0.1:0").unwrap();
        let udp = UdpSocket::bind("127.0.0.1:0").unwrap();
        let ports = [tcp.local_addr(), udp.local_addr()].map(|it| it.unwrap().port());
        for port in ports {
            let said = holder(Ipv4Addr::LOCALHOST, port).unwrap();
            let me = format!("process {}, ", std::process::id());
            assert!(said.starts_with(&me), "{said}");
        }
    }
}
