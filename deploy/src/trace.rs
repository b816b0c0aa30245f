//! Logical traces read back: sets of `FEDERATE.trace` files, compared and hashed.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::{Path, PathBuf};

use serde::Serialize;

/// The traces of one run, by federate; records are sorted, so the order of execution does not show.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TraceSet {
    /// One per federate: records go by the first element of their path, whatever file they stood in.
    pub federates: BTreeMap<String, FederateTrace>,
}

/// What one federate did.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct FederateTrace {
    /// What was executed, sorted.
    pub records: Vec<Record>,
    /// Physical events, which no other run repeats.
    pub physical: Vec<(TraceTag, String)>,
    /// Watchdogs that expired, which no other run repeats: with the tag of the record before.
    pub watchdogs: Vec<(TraceTag, String)>,
    /// Messages that came after their tag had been handled without them: with that tag, and the input.
    pub tardy: Vec<(TraceTag, String)>,
    /// The tag of a stop by request.
    pub stop: Option<TraceTag>,
    /// Where and why the trace ended; absent when the federate was cut off.
    pub end: Option<(TraceTag, String)>,
}

/// A tag of a trace.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct TraceTag {
    /// Nanoseconds after the start tag.
    pub time_ns: i64,
    /// The microstep.
    pub microstep: u32,
}

/// One executed reaction.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct Record {
    /// When, logically.
    pub tag: TraceTag,
    /// The reactor, such as `planner.filter[2]`.
    pub path: String,
    /// The reaction's position in its reactor.
    pub index: u32,
    /// `body`, `deadline` or `stp`.
    pub kind: String,
    /// Outputs written and actions scheduled with the digests of their values.
    pub effects: String,
}

/// The answer to "did both runs do the same?"
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(tag = "verdict", rename_all = "snake_case")]
pub enum Verdict {
    /// Every record is equal.
    Equal {
        /// How many records each federate has.
        records_per_federate: BTreeMap<String, usize>,
    },
    /// The runs differ.
    Different {
        /// The federate whose traces differ at the lowest tag.
        federate: String,
        /// Its first differing record in the first set; absent when that trace has no such record.
        left: Option<Record>,
        /// The record at the same place in the second set.
        right: Option<Record>,
    },
    /// Equality can be neither claimed nor denied.
    NotComparable {
        /// Why.
        why: String,
    },
}

/// Why traces cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum TraceError {
    /// The directory or a file in it cannot be read.
    #[error("cannot read {path}", path = path.display())]
    Unreadable {
        /// The directory or file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The directory has no `.trace` file.
    #[error("no trace in {path}", path = path.display())]
    Empty {
        /// The directory.
        path: PathBuf,
    },
    /// A line is not a trace record.
    #[error("{path}:{line}: not a trace record: {what}", path = path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// What is wrong with it.
        what: &'static str,
    },
}

impl TraceSet {
    /// Reads every `.trace` file of a directory.
    ///
    /// # Errors
    /// When a file cannot be read or a line is no record, and when there is no file.
    pub fn read(dir: &Path) -> Result<Self, TraceError> {
        let mut set = Self::default();
        let files = files(dir, "trace").map_err(|source| TraceError::Unreadable {
            path: dir.to_path_buf(),
            source,
        })?;
        if files.is_empty() {
            return Err(TraceError::Empty {
                path: dir.to_path_buf(),
            });
        }
        for path in files {
            let text = std::fs::read_to_string(&path);
            let text = text.map_err(|source| TraceError::Unreadable {
                path: path.clone(),
                source,
            })?;
            let stem = path
                .file_stem()
                .unwrap_or_default()
                .to_string_lossy()
                .into_owned();
            set.add(&stem, complete_lines(&text))
                .map_err(|(line, what)| TraceError::Malformed { path, line, what })?;
        }
        set.sort();
        Ok(set)
    }

    /// The hash of all records: equal sets have equal hashes. 16 hexadecimal digits (FNV-1a).
    #[must_use]
    pub fn hash(&self) -> String {
        let mut hash = 0xcbf2_9ce4_8422_2325_u64;
        for record in self.federates.values().flat_map(|trace| &trace.records) {
            for byte in format!("{record}\n").bytes() {
                hash = (hash ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3);
            }
        }
        format!("{hash:016x}")
    }

    /// How many records each federate has.
    #[must_use]
    pub fn records_per_federate(&self) -> BTreeMap<String, usize> {
        let count = |(name, trace): (&String, &FederateTrace)| (name.clone(), trace.records.len());
        self.federates.iter().map(count).collect()
    }

    /// Adds one file's lines; the error is the line, from 1, and what is wrong with it.
    fn add(&mut self, stem: &str, text: &str) -> Result<(), (usize, &'static str)> {
        let mut seen: BTreeSet<String> = BTreeSet::new();
        let mut stop = None;
        let mut end = None;
        let mut last = TraceTag::default();
        for (index, line) in text.lines().enumerate() {
            let wrong = |what| (index + 1, what);
            if let Some(comment) = line.strip_prefix('#') {
                let (path, (tag, of)) = match Comment::parse(comment).map_err(wrong)? {
                    Comment::Physical(tag, path) => (path, (tag, Events::Physical)),
                    Comment::Watchdog(path) => (path, (last, Events::Watchdogs)),
                    Comment::Tardy(intended, path) => (path, (intended, Events::Tardy)),
                    Comment::Stop(tag) => {
                        stop = Some(tag);
                        continue;
                    }
                    Comment::End(tag, reason) => {
                        end = Some((tag, reason));
                        continue;
                    }
                    Comment::Other => continue,
                };
                let federate = federate_of(&path).to_owned();
                let trace = self.federates.entry(federate.clone()).or_default();
                trace.events(of).push((tag, path));
                seen.insert(federate);
            } else if !line.is_empty() {
                let record = Record::parse(line).map_err(wrong)?;
                let federate = federate_of(&record.path).to_owned();
                last = record.tag;
                self.federates
                    .entry(federate.clone())
                    .or_default()
                    .records
                    .push(record);
                seen.insert(federate);
            }
        }
        if seen.is_empty() {
            seen.insert(stem.to_owned());
        }
        for federate in seen {
            let trace = self.federates.entry(federate).or_default();
            trace.stop = trace.stop.or(stop);
            trace.end = trace.end.take().or_else(|| end.clone());
        }
        Ok(())
    }

    fn sort(&mut self) {
        for trace in self.federates.values_mut() {
            trace.records.sort();
            for of in [Events::Physical, Events::Watchdogs, Events::Tardy] {
                trace.events(of).sort();
            }
        }
    }
}

/// A kind of event that no other run repeats.
#[derive(Clone, Copy)]
enum Events {
    Physical,
    Watchdogs,
    Tardy,
}

impl FederateTrace {
    fn events(&mut self, of: Events) -> &mut Vec<(TraceTag, String)> {
        match of {
            Events::Physical => &mut self.physical,
            Events::Watchdogs => &mut self.watchdogs,
            Events::Tardy => &mut self.tardy,
        }
    }
}

/// Compares two runs.
///
/// Law: a set is equal to itself, when it is complete and every value has a digest; and swapping the sets swaps
/// the sides of a difference.
#[must_use]
pub fn compare(a: &TraceSet, b: &TraceSet) -> Verdict {
    for (side, set) in [("first", a), ("second", b)] {
        for (name, trace) in &set.federates {
            if trace.end.is_none() {
                let why = format!("the {side} run's trace of `{name}` has no end: it was cut off");
                return Verdict::NotComparable { why };
            }
        }
    }
    let stops = (earliest_stop(a), earliest_stop(b));
    let limit = match stops {
        (left, right) if left == right => None,
        (left, right) => left.into_iter().chain(right).min(),
    };
    if let Some(difference) = first_difference(a, b, limit) {
        return excuse(a, b, &difference).unwrap_or_else(|| difference.into());
    }
    if let Some(limit) = limit {
        let why = format!("a run was stopped by request at {limit}; up to there both are equal");
        return Verdict::NotComparable { why };
    }
    let undigested = |record: &&Record| record.effects.split(',').any(|one| one.ends_with("=?"));
    if let Some(record) = records(a).find(undigested) {
        let why = format!("a value has no digest, so it cannot be compared: {record}");
        return Verdict::NotComparable { why };
    }
    Verdict::Equal {
        records_per_federate: a.records_per_federate(),
    }
}

/// A place at which two sets differ.
#[derive(Debug)]
struct Difference<'a> {
    federate: &'a str,
    left: Option<&'a Record>,
    right: Option<&'a Record>,
}

impl Difference<'_> {
    fn tag(&self) -> TraceTag {
        let tags = self
            .left
            .into_iter()
            .chain(self.right)
            .map(|record| record.tag);
        tags.min().unwrap_or_default()
    }
}

impl From<Difference<'_>> for Verdict {
    fn from(difference: Difference<'_>) -> Self {
        Self::Different {
            federate: difference.federate.to_owned(),
            left: difference.left.cloned(),
            right: difference.right.cloned(),
        }
    }
}

/// The difference at the lowest tag, below a limit if there is one.
fn first_difference<'a>(
    a: &'a TraceSet,
    b: &'a TraceSet,
    limit: Option<TraceTag>,
) -> Option<Difference<'a>> {
    let empty: &'static [Record] = &[];
    let names: BTreeSet<&str> = a
        .federates
        .keys()
        .chain(b.federates.keys())
        .map(String::as_str)
        .collect();
    let within = |record: &&Record| limit.is_none_or(|limit| record.tag < limit);
    let differences = names.into_iter().filter_map(|federate| {
        let side = |set: &'a TraceSet| set.federates.get(federate).map_or(empty, |t| &t.records);
        let mut left = side(a).iter().filter(within);
        let mut right = side(b).iter().filter(within);
        loop {
            match (left.next(), right.next()) {
                (None, None) => return None,
                (one, other) if one == other => {}
                (left, right) => {
                    return Some(Difference {
                        federate,
                        left,
                        right,
                    });
                }
            }
        }
    });
    differences.min_by_key(|difference| (difference.tag(), difference.federate))
}

/// Why a difference proves nothing: something that no run repeats came before it.
fn excuse(a: &TraceSet, b: &TraceSet, difference: &Difference<'_>) -> Option<Verdict> {
    let tag = difference.tag();
    let because = |why| Some(Verdict::NotComparable { why });
    let tardy = traces(a, b).find(|(_, trace)| trace.tardy.iter().any(|(at, _)| *at <= tag));
    if let Some((federate, trace)) = tardy {
        let (count, first) = (trace.tardy.len(), &trace.tardy[0]);
        return because(format!(
            "a message was tardy before the runs differ: `{federate}` had {count} tardy in one run, the first for {} at {}",
            first.1, first.0
        ));
    }
    let deadline = records(a)
        .chain(records(b))
        .find(|r| r.kind == "deadline" && r.tag <= tag);
    if let Some(record) = deadline {
        let why = format!("a deadline was missed before the runs differ: {record}");
        return because(why);
    }
    let before = |events: &&(TraceTag, String)| events.0 <= tag;
    let watchdogs = traces(a, b).flat_map(|(_, trace)| &trace.watchdogs);
    if let Some((at, path)) = watchdogs.filter(before).min() {
        return because(format!(
            "a watchdog fired before the runs differ: {path} after {at}"
        ));
    }
    let physical = traces(a, b).flat_map(|(_, trace)| &trace.physical);
    let (at, path) = physical.filter(before).min()?;
    because(format!(
        "a physical event came before the runs differ: {path} at {at}"
    ))
}

/// The traces of both runs.
fn traces<'a>(
    a: &'a TraceSet,
    b: &'a TraceSet,
) -> impl Iterator<Item = (&'a String, &'a FederateTrace)> {
    a.federates.iter().chain(&b.federates)
}

fn records(set: &TraceSet) -> impl Iterator<Item = &Record> {
    set.federates.values().flat_map(|trace| &trace.records)
}

fn earliest_stop(set: &TraceSet) -> Option<TraceTag> {
    set.federates.values().filter_map(|trace| trace.stop).min()
}

/// The first element of a reactor's path.
fn federate_of(path: &str) -> &str {
    path.split(['.', '[']).next().unwrap_or(path)
}

/// A line that starts with `#`.
enum Comment {
    Physical(TraceTag, String),
    Watchdog(String),
    /// With the tag at which it should have been handled.
    Tardy(TraceTag, String),
    Stop(TraceTag),
    End(TraceTag, String),
    Other,
}

impl Comment {
    fn parse(text: &str) -> Result<Self, &'static str> {
        let mut words = text.split_whitespace();
        let kind = words.next();
        if kind == Some("watchdog") {
            words.next();
            return Ok(Self::Watchdog(words.next().ok_or("no path")?.to_owned()));
        }
        if !matches!(kind, Some("physical" | "tardy" | "stop" | "end")) {
            return Ok(Self::Other);
        }
        let tag = TraceTag::parse(words.next(), words.next())?;
        if kind == Some("tardy") {
            let path = words.next().ok_or("no path")?.to_owned();
            let intended = TraceTag::parse(words.next(), words.next())?;
            return Ok(Self::Tardy(intended, path));
        }
        let rest = words.collect::<Vec<_>>().join(" ");
        Ok(match kind {
            Some("physical") => Self::Physical(tag, rest),
            Some("stop") => Self::Stop(tag),
            _ => Self::End(tag, rest),
        })
    }
}

impl Record {
    fn parse(line: &str) -> Result<Self, &'static str> {
        let mut fields = line.split('\t');
        let tag = TraceTag::parse(fields.next(), fields.next())?;
        let path = fields
            .next()
            .filter(|path| !path.is_empty())
            .ok_or("no path")?;
        let index = fields
            .next()
            .and_then(|field| field.parse().ok())
            .ok_or("no index")?;
        let kind = fields.next().ok_or("no kind")?;
        let effects = fields.next().ok_or("no effects")?;
        if fields.next().is_some() {
            return Err("more than six fields");
        }
        if !matches!(kind, "body" | "deadline" | "stp") {
            return Err("the kind is none of `body`, `deadline` and `stp`");
        }
        let (path, kind, effects) = (path.to_owned(), kind.to_owned(), effects.to_owned());
        Ok(Self {
            tag,
            path,
            index,
            kind,
            effects,
        })
    }
}

impl fmt::Display for Record {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            tag,
            path,
            index,
            kind,
            effects,
        } = self;
        write!(f, "{tag} {path} #{index} {kind} {effects}")
    }
}

impl TraceTag {
    /// From the first two fields of a trace or timing line.
    pub(crate) fn parse(
        time_ns: Option<&str>,
        microstep: Option<&str>,
    ) -> Result<Self, &'static str> {
        let time_ns = time_ns
            .and_then(|field| field.parse().ok())
            .ok_or("no time")?;
        let microstep = microstep
            .and_then(|field| field.parse().ok())
            .ok_or("no microstep")?;
        Ok(Self { time_ns, microstep })
    }
}

impl fmt::Display for TraceTag {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "({}, {})",
            ictus_core::Duration::from_nanos(self.time_ns),
            self.microstep
        )
    }
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let shown = |record: &Option<Record>| match record {
            Some(record) => record.to_string(),
            None => "nothing".to_owned(),
        };
        match self {
            Self::Equal {
                records_per_federate,
            } => {
                let total: usize = records_per_federate.values().sum();
                write!(f, "equal: {total} records")
            }
            Self::Different {
                federate,
                left,
                right,
            } => {
                writeln!(f, "different, first in `{federate}`:")?;
                write!(
                    f,
                    "  first run:  {}\n  second run: {}",
                    shown(left),
                    shown(right)
                )
            }
            Self::NotComparable { why } => write!(f, "not comparable: {why}"),
        }
    }
}

/// A text without the line that a killed writer left unfinished.
pub(crate) fn complete_lines(text: &str) -> &str {
    text.rfind('\n').map_or("", |end| &text[..=end])
}

/// The files of a folder with an extension, sorted.
pub(crate) fn files(dir: &Path, extension: &str) -> std::io::Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(dir)? {
        let path = entry?.path();
        if path.extension().is_some_and(|have| have == extension) {
            files.push(path);
        }
    }
    files.sort();
    Ok(files)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn set(files: &[(&str, &str)]) -> TraceSet {
        let mut set = TraceSet::default();
        for (stem, text) in files {
            set.add(stem, &text.replace(' ', "\t").replace("#\t", "# "))
                .unwrap();
        }
        set.sort();
        set
    }

    const A: &str = "0 0 a 0 body out=0000000000000001\n5 0 a.x[1] 1 body -\n# end 9 0 timeout\n";
    const B: &str = "5 0 b 0 body out=0000000000000002\n# end 9 0 timeout\n";

    #[test]
    fn order_of_lines_and_split_into_files_do_not_matter() {
        let federated = set(&[("a", A), ("b", B)]);
        let backwards: Vec<&str> = A.lines().rev().collect();
        let together = set(&[("all", &format!("{}\n{B}", backwards.join("\n")))]);
        assert_eq!(federated.hash(), together.hash());
        let counts = [("a".to_owned(), 2), ("b".to_owned(), 1)].into();
        assert_eq!(
            compare(&federated, &together),
            Verdict::Equal {
                records_per_federate: counts
            }
        );
    }

    #[test]
    fn the_first_difference_is_the_one_at_the_lowest_tag() {
        let left = set(&[("a", A), ("b", B)]);
        let right = set(&[
            ("a", &A.replace("5 0 a.x", "4 0 a.x")),
            ("b", &B.replace("02", "03")),
        ]);
        assert_ne!(left.hash(), right.hash());
        let verdict = compare(&left, &right);
        let Verdict::Different {
            federate,
            left: Some(one),
            right: Some(other),
        } = &verdict
        else {
            panic!("{verdict}")
        };
        assert_eq!(
            (federate.as_str(), one.tag.time_ns, other.tag.time_ns),
            ("a", 5, 4)
        );
        assert_eq!(
            verdict.to_string(),
            "different, first in `a`:\n  first run:  (5 ns, 0) a.x[1] #1 body -\n  second run: (4 \
             ns, 0) a.x[1] #1 body -"
        );
    }

    #[test]
    fn what_no_run_repeats_is_not_comparable() {
        let why =
            |left: &str, right: &str| match compare(&set(&[("a", left)]), &set(&[("a", right)])) {
                Verdict::NotComparable { why } => why,
                verdict @ (Verdict::Equal { .. } | Verdict::Different { .. }) => {
                    panic!("{verdict}")
                }
            };
        assert!(why(A, &A.replace("# end 9 0 timeout\n", "")).contains("cut off"));
        assert!(why(A, &A.replace("1 body", "1 deadline")).contains("deadline"));
        let physical = format!("# physical 5 0 a.button\n{}", A.replace("5 0", "6 0"));
        assert!(why(A, &physical).contains("a.button at (5 ns, 0)"));
        let later = A.replace("5 0", "6 0");
        let watchdog = later.replace("6 0", "# watchdog 700 a.guard\n6 0");
        assert!(
            why(A, &watchdog)
                .contains("a watchdog fired before the runs differ: a.guard after (0 ns, 0)")
        );
        let tardy = format!("# tardy 6 0 a.in 5 0\n# tardy 8 1 a.in 7 0\n{later}");
        assert!(
            why(&tardy, A).contains("`a` had 2 tardy in one run, the first for a.in at (5 ns, 0)")
        );
        assert!(why(A, &format!("# stop 5 0\n{}", A.replace("5 0", "6 0"))).contains("by request"));
        let undigested = A.replace("=0000000000000001", "=?");
        assert!(why(&undigested, &undigested).contains("no digest"));
    }

    #[test]
    fn what_came_after_the_difference_does_not_excuse_it() {
        let later = A.replace("5 0", "6 0");
        for line in [
            "# watchdog 700 a.guard",
            "# tardy 8 1 a.in 7 0",
            "# physical 7 0 a.button",
        ] {
            let text = later.replace("# end", &format!("{line}\n# end"));
            let verdict = compare(&set(&[("a", A)]), &set(&[("a", &text)]));
            assert!(
                matches!(verdict, Verdict::Different { .. }),
                "{line}: {verdict}"
            );
        }
    }

    #[test]
    fn lines_that_are_no_records_are_named() {
        let mut set = TraceSet::default();
        assert_eq!(
            set.add("a", "# header\n0\t0\ta\t0\tbody\t-\n0\t0\n"),
            Err((3, "no path"))
        );
        assert_eq!(set.add("a", "x"), Err((1, "no time")));
        assert_eq!(set.add("a", "0\t0\ta\t0\tmind\t-").map_err(|e| e.0), Err(1));
    }

    #[test]
    fn an_unfinished_line_is_no_error() {
        assert_eq!(complete_lines("a\nb\n1\t0"), "a\nb\n");
        assert_eq!(complete_lines("1\t0"), "");
    }

    proptest! {
        #[test]
        fn reading_never_panics(text in "[0-9a-z#\t\n .\\[=?,-]{0,200}") {
            let mut set = TraceSet::default();
            if set.add("a", &text).is_ok() {
                set.sort();
                let twice = compare(&set, &set);
                let different = matches!(twice, Verdict::Different { .. });
                prop_assert!(!different, "{twice}");
            }
        }
    }
}
