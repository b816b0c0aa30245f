//! The machine's own Docker engine, spoken to by its command, and what else the rig calls: always bounded in time.

use crate::said;
use std::fs;
use std::io::Write as _;
use std::net::Ipv4Addr;
use std::path::Path;
use std::process::{Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

/// Seconds that one command of the rig may take; `timeout` of coreutils sees to it.
const BOUND_S: &str = "120";

/// PROGRAM, killed when it takes too long; arguments are to be added.
pub(super) fn bounded(program: &str) -> Command {
    let mut command = Command::new("timeout");
    command
        .args(["--kill-after=5", BOUND_S, program])
        .stdin(Stdio::null());
    command
}

/// `docker ARGS` on the machine's engine.
pub(super) fn docker(args: &[&str]) -> Command {
    let mut command = bounded("docker");
    command.args(args);
    command
}

/// Runs it, expects success, returns standard output.
pub(super) fn ok(command: &mut Command) -> String {
    let output = command.output().unwrap();
    assert!(output.status.success(), "{command:?}: {}", said(&output));
    String::from_utf8(output.stdout).unwrap()
}

/// Does it for all at once; the results are in the order of the items.
pub(super) fn in_parallel<T: Sync, R: Send>(items: &[T], f: impl Fn(&T) -> R + Sync) -> Vec<R> {
    thread::scope(|scope| {
        let threads: Vec<_> = items.iter().map(|item| scope.spawn(|| f(item))).collect();
        let results = threads.into_iter().map(|thread| thread.join());
        results
            .map(|result| result.unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
            .collect()
    })
}

/// A line on standard error.
pub(super) fn tell(line: &str) {
    drop(writeln!(std::io::stderr(), "ictus: {line}"));
}

/// A network of 256 addresses.
#[derive(Clone, Copy, Debug)]
pub(super) struct Network(u8, u8);

impl Network {
    const fn address(self, last: u8) -> Ipv4Addr {
        Ipv4Addr::new(10, self.0, self.1, last)
    }

    /// This machine's own address in it.
    pub(super) const fn gateway(self) -> Ipv4Addr {
        self.address(1)
    }

    /// The address of the n-th host; what Docker chooses itself lies in the upper half.
    pub(super) const fn host(self, n: u8) -> Ipv4Addr {
        self.address(10 + n)
    }
}

/// Makes the network `name`, where nothing else is; nothing leads out of it.
pub(super) fn make_network(name: &str) -> Network {
    let routes = bounded("ip").args(["-4", "-o", "route"]).output().unwrap();
    let routes = String::from_utf8_lossy(&routes.stdout).into_owned();
    let label = format!("ictus.rig={name}");
    let mut refused = String::new();
    for third in 0..50 {
        let network = Network(201, third);
        let subnet = format!("{}/24", network.address(0));
        if routes.lines().any(|route| covers(route, network.gateway())) {
            continue;
        }
        let upper = format!("{}/25", network.address(128));
        let output = docker(&["network", "create", "--internal", "--label", &label])
            .args(["--subnet", &subnet, "--ip-range", &upper])
            .args(["--gateway", &network.gateway().to_string(), name])
            .output()
            .unwrap();
        if output.status.success() {
            return network;
        }
        refused = said(&output);
    }
    panic!("no network between 10.201.0.0 and 10.201.49.255 is free: {refused}");
}

/// Whether a line of `ip route` is of a network (not the default one) that holds this address.
fn covers(route: &str, address: Ipv4Addr) -> bool {
    let destination = route.split_whitespace().next().unwrap_or_default();
    let (network, length) = destination.split_once('/').unwrap_or((destination, "32"));
    let (Ok(network), Ok(length)) = (network.parse::<Ipv4Addr>(), length.parse::<u32>()) else {
        return false;
    };
    let shift = 32_u32.saturating_sub(length);
    let kept = |address: Ipv4Addr| address.to_bits().checked_shr(shift);
    length > 0 && kept(network) == kept(address)
}

/// Whether the machine has cgroup v1, where test hosts share its tree.
pub(super) fn cgroup_v1() -> bool {
    ok(&mut docker(&["info", "--format", "{{.CgroupVersion}}"])).trim() == "1"
}

/// Removes the cgroups below the rig's name, which processes that are just dying may still hold.
pub(super) fn remove_cgroups(name: &str) {
    let trees: Vec<_> = fs::read_dir("/sys/fs/cgroup")
        .into_iter()
        .flatten()
        .flatten()
        .map(|entry| entry.path().join(name))
        .collect();
    let end = Instant::now() + Duration::from_secs(5);
    for tree in trees {
        while tree.exists() && !remove_cgroup(&tree) && Instant::now() < end {
            thread::sleep(Duration::from_millis(50));
        }
    }
}

/// Removes one with all below it; false when some are still in use.
fn remove_cgroup(group: &Path) -> bool {
    for entry in fs::read_dir(group).into_iter().flatten().flatten() {
        if entry.path().is_dir() {
            remove_cgroup(&entry.path());
        }
    }
    fs::remove_dir(group).is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_route_covers_its_network_only() {
        let address = Ipv4Addr::new(10, 201, 7, 1);
        for (route, expected) in [
            ("default via 192.0.2.1 dev eth0", false),
            ("10.0.0.0/8 dev tun0", true),
            ("10.201.7.0/24 dev br-1 proto kernel", true),
            ("10.201.8.0/24 dev br-1 proto kernel", false),
            ("10.201.7.1 dev lo", true),
            ("0.0.0.0/0 dev eth0", false),
            ("", false),
        ] {
            assert_eq!(covers(route, address), expected, "{route}");
        }
    }
}
