//! What the kernel counts when a container reaches a limit: read from its control group, version 1 or 2.

use std::fs;
use std::path::{Path, PathBuf};

/// Where control groups are mounted.
const MOUNT: &str = "/sys/fs/cgroup";

/// A limit of a container.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Limit {
    /// Bytes; something was killed.
    Memory,
    /// Processes and threads; one was refused.
    Processes,
}

/// How often the limit of a process's control group was reached; absent when the system does not tell.
pub(super) fn count(pid: u32, limit: Limit) -> Option<u64> {
    let groups = fs::read_to_string(format!("/proc/{pid}/cgroup")).ok()?;
    let (file, key) = counter(&groups, limit)?;
    value(&fs::read_to_string(file).ok()?, key)
}

/// The file with the counter and the counter's name in it.
fn counter(groups: &str, limit: Limit) -> Option<(PathBuf, &'static str)> {
    let (controller, file, unified, key) = match limit {
        Limit::Memory => ("memory", "memory.oom_control", "memory.events", "oom_kill"),
        Limit::Processes => ("pids", "pids.events", "pids.events", "max"),
    };
    let at = |mount: &Path, path: &str, file| mount.join(path.trim_start_matches('/')).join(file);
    let lines = || groups.lines().map(|line| line.splitn(3, ':'));
    let of_version_1 = lines().find_map(|mut fields| {
        let (_, controllers, path) = (fields.next()?, fields.next()?, fields.next()?);
        let named = controllers.split(',').any(|name| name == controller);
        named.then(|| at(&Path::new(MOUNT).join(controller), path, file))
    });
    let of_version_2 = || {
        lines().find_map(|mut fields| {
            let (number, controllers, path) = (fields.next()?, fields.next()?, fields.next()?);
            (number == "0" && controllers.is_empty()).then(|| at(Path::new(MOUNT), path, unified))
        })
    };
    Some((of_version_1.or_else(of_version_2)?, key))
}

fn value(counters: &str, key: &str) -> Option<u64> {
    let value = |line: &str| {
        line.strip_prefix(key)?
            .strip_prefix(' ')?
            .trim()
            .parse()
            .ok()
    };
    counters.lines().find_map(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counters_of_both_versions_are_found() {
        let one = "9:pids:/docker/c\n4:memory:/docker/c\n1:name=systemd:/docker/c\n0::/x";
        let two = "0::/system.slice/docker-c.scope";
        let path = |groups, limit| counter(groups, limit).unwrap().0.display().to_string();
        assert_eq!(
            path(one, Limit::Memory),
            "/sys/fs/cgroup/memory/docker/c/memory.oom_control"
        );
        assert_eq!(
            path(one, Limit::Processes),
            "/sys/fs/cgroup/pids/docker/c/pids.events"
        );
        let expected = "/sys/fs/cgroup/system.slice/docker-c.scope/memory.events";
        assert_eq!(path(two, Limit::Memory), expected);
        assert_eq!(counter("", Limit::Memory), None);
        assert_eq!(
            value("oom_kill_disable 0\nunder_oom 0\noom_kill 2\n", "oom_kill"),
            Some(2)
        );
        assert_eq!(value("low 0\noom 3\noom_kill 1\n", "oom_kill"), Some(1));
        assert_eq!(value("max\n", "max"), None);
    }
}
