//! What a host holds, and what it holds more or less than before.

use super::Host;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::thread;
use std::time::{Duration, Instant};

/// How long what is just ending may take to be gone.
const SETTLE: Duration = Duration::from_secs(5);

/// Compares a host with what it was: processes, sockets, mounts, cgroups, iptables, the engine's objects, files.
#[derive(Debug)]
pub struct LeakChecker<'a> {
    host: &'a Host,
    before: Snapshot,
}

impl<'a> LeakChecker<'a> {
    /// What the host holds now is what it may hold later.
    #[must_use]
    pub fn snapshot(host: &'a Host) -> Self {
        Self::since(host, Snapshot::take(host))
    }

    /// The same with what it held earlier.
    #[must_use]
    pub const fn since(host: &'a Host, before: Snapshot) -> Self {
        Self { host, before }
    }

    /// What is other than it was, as text; empty when nothing is. Processes that just end get 5 s for it.
    #[must_use]
    pub fn diff(&self) -> String {
        let end = Instant::now() + SETTLE;
        loop {
            let diff = self.before.diff(&Snapshot::take(self.host));
            if diff.is_empty() || Instant::now() > end {
                return diff;
            }
            thread::sleep(Duration::from_millis(100));
        }
    }
}

/// What a host holds at one moment: by section, how often each line.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Snapshot {
    sections: BTreeMap<String, BTreeMap<String, i64>>,
}

impl Snapshot {
    /// Looks.
    #[must_use]
    pub fn take(host: &Host) -> Self {
        Self::parse(&host.script(include_str!("snapshot.sh"), &[&host.cgroup()]))
    }

    /// Reads lines below `## SECTION` headings.
    #[must_use]
    pub fn parse(text: &str) -> Self {
        let mut snapshot = Self::default();
        let mut section = String::new();
        for line in text.lines() {
            if let Some(heading) = line.strip_prefix("## ") {
                heading.clone_into(&mut section);
                continue;
            }
            let lines = snapshot.sections.entry(section.clone()).or_default();
            *lines.entry(line.to_owned()).or_default() += 1;
        }
        snapshot
    }

    /// One line a thing that came (`+`) or went (`-`) until `later`, with its section; empty when both hold the same.
    #[must_use]
    pub fn diff(&self, later: &Self) -> String {
        let mut text = String::new();
        let sections: BTreeSet<&String> =
            self.sections.keys().chain(later.sections.keys()).collect();
        let nothing = BTreeMap::new();
        for section in sections {
            let before = self.sections.get(section).unwrap_or(&nothing);
            let after = later.sections.get(section).unwrap_or(&nothing);
            let lines: BTreeSet<&String> = before.keys().chain(after.keys()).collect();
            for line in lines {
                let count = |lines: &BTreeMap<String, i64>| lines.get(line).copied().unwrap_or(0);
                let more = count(after) - count(before);
                let sign = if more > 0 { '+' } else { '-' };
                for _ in 0..more.abs() {
                    writeln!(text, "{sign} {section}: {line}").unwrap();
                }
            }
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_diff_counts_lines_by_section() {
        let before = Snapshot::parse("## processes\na\na\nb\n## files\n/tmp\n");
        let after = Snapshot::parse("## processes\na\nb\nc\nc\n## mounts\n/tmp\n## files\n/tmp\n");
        assert_eq!(before.diff(&before), "");
        assert_eq!(
            before.diff(&after),
            "+ mounts: /tmp\n- processes: a\n+ processes: c\n+ processes: c\n"
        );
    }
}
