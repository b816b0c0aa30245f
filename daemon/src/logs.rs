//! Log files read back: the lines of several members merged by time, and followed as they grow.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{BufRead, BufReader};
use std::iter::Peekable;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use crate::api::LogLine;
use crate::stamp;
use crate::supervisor::log::numbered;
use crate::supervisor::log_path;

/// The longest line taken from a file: the supervisor writes no longer ones.
const LINE_BYTES_MAX: usize = 64 * 1024;
/// The highest number of a rotated file that is looked for.
const ROTATED_MAX: u32 = 1000;

/// The members that have a log in this directory, sorted.
#[must_use]
pub fn members(logs: &Path) -> Vec<String> {
    let entries = fs::read_dir(logs).into_iter().flatten().flatten();
    let names = entries.filter_map(|entry| entry.file_name().into_string().ok());
    let mut members: Vec<_> = names
        .filter_map(|name| Some(name.strip_suffix(".log")?.to_owned()))
        .collect();
    members.sort();
    members
}

/// The logs of some members from their beginnings, and then as they grow.
///
/// Law: lines of one member come in the order in which they were written; lines found by one
/// [`Follower::read`] come in the order of their times.
#[derive(Debug)]
pub struct Follower {
    logs: PathBuf,
    /// Empty: everybody, also who comes later.
    members: Vec<String>,
    tails: BTreeMap<String, Tail>,
}

#[derive(Debug)]
struct Tail {
    /// The files still to read, oldest first; the last one is the current one.
    files: Vec<BufReader<File>>,
    /// The current file's inode: another one at its path means that it was rotated.
    inode: u64,
    partial: Vec<u8>,
}

impl Follower {
    /// Follows these members, or everybody when none is given.
    #[must_use]
    pub fn new(logs: &Path, members: Vec<String>) -> Self {
        Self {
            logs: logs.to_path_buf(),
            members,
            tails: BTreeMap::new(),
        }
    }

    /// Hands out every line that is there and was not handed out before, merged by time. Blocks on the disk.
    pub fn read(&mut self, mut each: impl FnMut(LogLine)) {
        let wanted = if self.members.is_empty() {
            members(&self.logs)
        } else {
            self.members.clone()
        };
        for member in wanted {
            let path = log_path(&self.logs, &member);
            match self.tails.get_mut(&member) {
                Some(tail) => tail.look_for_rotation(&path),
                None => {
                    self.tails
                        .extend(Tail::open(&path).map(|tail| (member, tail)));
                }
            }
        }
        let mut sources: Vec<_> = self
            .tails
            .iter_mut()
            .map(|(member, tail)| std::iter::from_fn(|| tail.next(member)).peekable())
            .collect();
        while let Some(index) = earliest(&mut sources) {
            if let Some(line) = sources[index].next() {
                each(line);
            }
        }
    }
}

/// The source whose next line is the earliest; at equal times the first one.
fn earliest(sources: &mut [Peekable<impl Iterator<Item = LogLine>>]) -> Option<usize> {
    let mut best: Option<(String, usize)> = None;
    for (index, source) in sources.iter_mut().enumerate() {
        if let Some(line) = source.peek()
            && best.as_ref().is_none_or(|(time, _)| line.time < *time)
        {
            best = Some((line.time.clone(), index));
        }
    }
    best.map(|(_, index)| index)
}

impl Tail {
    fn open(path: &Path) -> Option<Self> {
        let current = File::open(path).ok()?;
        let inode = current.metadata().ok()?.ino();
        let rotated = (1..ROTATED_MAX).map_while(|number| File::open(numbered(path, number)).ok());
        let mut files: Vec<_> = rotated.map(BufReader::new).collect();
        files.reverse();
        files.push(BufReader::new(current));
        Some(Self {
            files,
            inode,
            partial: Vec::new(),
        })
    }

    fn look_for_rotation(&mut self, path: &Path) {
        let Ok(current) = File::open(path) else {
            return;
        };
        let Ok(found) = current.metadata() else {
            return;
        };
        if found.ino() != self.inode {
            self.inode = found.ino();
            self.files.push(BufReader::new(current));
        }
    }

    fn next(&mut self, member: &str) -> Option<LogLine> {
        loop {
            let file = self.files.first_mut()?;
            let before = self.partial.len();
            let room = u64::try_from(LINE_BYTES_MAX).unwrap_or(u64::MAX);
            let mut bounded = std::io::Read::take(&mut *file, room);
            if bounded.read_until(b'\n', &mut self.partial).is_err() {
                return None;
            }
            if self.partial.ends_with(b"\n") {
                let line = parse(member, &self.partial);
                self.partial.clear();
                if line.is_some() {
                    return line;
                }
            } else if self.partial.len() > LINE_BYTES_MAX {
                self.partial.clear();
            } else if self.partial.len() == before {
                // The end of this file; the current one may still grow.
                if self.files.len() == 1 {
                    return None;
                }
                self.files.remove(0);
                self.partial.clear();
            }
        }
    }
}

/// Reads `TIME STREAM TEXT`.
fn parse(member: &str, line: &[u8]) -> Option<LogLine> {
    let line = std::str::from_utf8(line).ok()?.strip_suffix('\n')?;
    let (time, rest) = line.split_once(' ')?;
    stamp::parse(time)?;
    let (stream, text) = rest.split_once(' ').unwrap_or((rest, ""));
    Some(LogLine {
        time: time.to_owned(),
        member: member.to_owned(),
        stream: stream.to_owned(),
        text: text.to_owned(),
    })
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::io::Write;
    use std::path::Path;

    use super::{Follower, members};
    use crate::stamp;
    use crate::supervisor::log_path;

    fn append(logs: &Path, member: &str, micro: i64, text: &str) {
        let mut options = fs::OpenOptions::new();
        let path = log_path(logs, member);
        let mut file = options.append(true).create(true).open(path).unwrap();
        writeln!(file, "{} out {text}", stamp::text(micro * 1000)).unwrap();
    }

    fn read(follower: &mut Follower) -> Vec<String> {
        let mut found = Vec::new();
        follower.read(|line| found.push(format!("{} {}", line.member, line.text)));
        found
    }

    #[test]
    fn lines_are_merged_by_time_and_followed_over_a_rotation() {
        let directory = tempfile::tempdir().unwrap();
        let logs = directory.path();
        append(logs, "b", 1, "one");
        append(logs, "a", 2, "two");
        append(logs, "b", 3, "three");
        assert_eq!(members(logs), ["a", "b"]);
        let mut follower = Follower::new(logs, Vec::new());
        assert_eq!(read(&mut follower), ["b one", "a two", "b three"]);
        append(logs, "a", 4, "four");
        fs::rename(log_path(logs, "a"), logs.join("a.log.1")).unwrap();
        append(logs, "a", 5, "five");
        append(logs, "c", 6, "");
        assert_eq!(read(&mut follower), ["a four", "a five", "c "]);
        assert!(read(&mut follower).is_empty());
    }

    #[test]
    fn rotated_files_are_read_first_and_others_left_out() {
        let directory = tempfile::tempdir().unwrap();
        let logs = directory.path();
        append(logs, "a", 1, "old");
        fs::rename(log_path(logs, "a"), logs.join("a.log.1")).unwrap();
        append(logs, "a", 2, "new");
        append(logs, "b", 3, "other");
        let mut follower = Follower::new(logs, vec!["a".to_owned()]);
        assert_eq!(read(&mut follower), ["a old", "a new"]);
    }
}
