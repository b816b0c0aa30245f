//! The kernel's tables of sockets: `/proc/net/{tcp,tcp6,udp,udp6}`.

use std::net::IpAddr;

/// States of a TCP socket that somebody can reach.
const SERVING: [&str; 2] = [ESTABLISHED, LISTENING];
const ESTABLISHED: &str = "01";
const LISTENING: &str = "0A";

/// A socket of this host, or of this container.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Socket {
    /// Its own address; of IPv4 also when a socket of IPv6 has it.
    pub address: IpAddr,
    /// Its own port.
    pub port: u16,
    /// Whether it listens or is connected.
    pub serves: bool,
    /// Whose it is.
    pub user: u32,
    /// 0 when no process has it any more.
    pub inode: u64,
}

/// The sockets of a table.
pub fn of_table(table: &str) -> impl Iterator<Item = Socket> {
    table.lines().filter_map(parse)
}

/// `  0: 0100007F:1F90 00000000:0000 0A 00000000:00000000 00:00000000 00000000  1000 0 4711 ...`
fn parse(line: &str) -> Option<Socket> {
    let mut words = line.split_ascii_whitespace();
    let (address, port) = words.nth(1)?.split_once(':')?;
    Some(Socket {
        address: parse_address(address)?,
        port: u16::from_str_radix(port, 16).ok()?,
        serves: SERVING.contains(&words.nth(1)?),
        user: words.nth(3)?.parse().ok()?,
        inode: words.nth(1)?.parse().ok()?,
    })
}

fn parse_address(digits: &str) -> Option<IpAddr> {
    let word = |digits| u32::from_str_radix(str::from_utf8(digits).ok()?, 16).ok();
    // As the machine stores them, so that their bytes in memory are in network order.
    let words = digits.as_bytes().chunks(8).map(word);
    let words: Vec<_> = words
        .map(|it| Some(it?.to_ne_bytes()))
        .collect::<Option<_>>()?;
    let bytes = words.concat();
    if let Ok(four) = <[u8; 4]>::try_from(bytes.as_slice()) {
        return Some(four.into());
    }
    let six = <[u8; 16]>::try_from(bytes).ok()?;
    Some(IpAddr::from(six).to_canonical())
}

#[cfg(test)]
mod tests {
    use std::net::{Ipv4Addr, Ipv6Addr};

    use super::*;

    #[test]
    fn a_line_is_a_socket() {
        let line = |address: &str, state: &str| {
            let rest =
                "00000000:00000000 00:00000000 00000000  1000        0 4711 1 0000 100 0 0 10 0";
            parse(&format!(
                "   3: {address}:1F90 00000000:0000 {state} {rest}"
            ))
        };
        let socket = line("0100007F", "0A").unwrap();
        assert_eq!((socket.port, socket.serves), (8080, true));
        assert_eq!((socket.user, socket.inode), (1000, 4711));
        assert!(line("0100007F", "01").unwrap().serves);
        assert!(!line("0100007F", "06").unwrap().serves);
        let any = line(&"0".repeat(32), "0A").unwrap().address;
        assert_eq!(any, IpAddr::from(Ipv6Addr::UNSPECIFIED));
        if cfg!(target_endian = "little") {
            for address in ["0100007F", "0000000000000000FFFF00000100007F"] {
                let socket = line(address, "0A").unwrap();
                assert_eq!(socket.address, IpAddr::from(Ipv4Addr::LOCALHOST));
            }
        }
        assert_eq!(parse("  sl  local_address rem_address   st"), None);
        assert_eq!(line("", "0A"), None);
    }
}
