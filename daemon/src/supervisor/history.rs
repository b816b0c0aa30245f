//! What a process said so far, for whoever subscribes later and for its exit record.

use std::collections::BTreeMap;

use serde_json::Value;

use super::protocol::Reply;

/// Status lines kept, those apart that a later one replaces.
const STATUSES_MAX: usize = 4096;
/// Kinds of status lines of which the last is kept: enough for a federate with a thousand peers.
const REPORTS_MAX: usize = 4096;
/// Status lines that a later one of the same kind replaces.
const REPORTS: [&str; 5] = ["progress", "measures", "upstream", "downstream", "clock"];

/// What a later subscriber is told first.
#[derive(Debug, Default)]
pub(super) struct History {
    pub(super) started: Option<Reply>,
    statuses: Vec<Reply>,
    reports: BTreeMap<ReportKey, Reply>,
    pub(super) ended: Option<Reply>,
    pub(super) last: Option<Value>,
}

/// Event, federate, peer and part: what tells kinds of reports apart.
type ReportKey = [String; 4];

impl History {
    /// Keeps a status line, and gives what subscribers are told.
    pub(super) fn report(&mut self, at_ns: i64, line: Value) -> Reply {
        self.last = Some(line.clone());
        let key = key(&line);
        let reply = Reply::Reported { at_ns, line };
        if let Some(key) = key {
            if self.reports.len() < REPORTS_MAX || self.reports.contains_key(&key) {
                self.reports.insert(key, reply.clone());
            }
        } else if self.statuses.len() < STATUSES_MAX {
            self.statuses.push(reply.clone());
        }
        reply
    }

    /// Everything that happened, in order; of what was replaced only the last.
    pub(super) fn all(&self) -> impl Iterator<Item = &Reply> {
        let first = self.started.iter().chain(&self.statuses);
        first.chain(self.reports.values()).chain(&self.ended)
    }

    /// The last line of each kind that a later one replaces.
    pub(super) fn reports(&self) -> Vec<Value> {
        let line = |reply: &Reply| match reply {
            Reply::Reported { line, .. } => Some(line.clone()),
            Reply::Identity { .. }
            | Reply::Status { .. }
            | Reply::Done
            | Reply::Refused { .. }
            | Reply::Started { .. }
            | Reply::Ended { .. } => None,
        };
        self.reports.values().filter_map(line).collect()
    }
}

/// The kind of a line that a later one replaces; absent for all others.
fn key(line: &Value) -> Option<ReportKey> {
    let event = line.get("event")?.as_str()?;
    if !REPORTS.contains(&event) {
        return None;
    }
    let text = |name: &str| line.get(name).map(Value::to_string).unwrap_or_default();
    // A number is a peer's id in both.
    let peer = text(event);
    Some([event.to_owned(), text("federate"), peer, text("part")])
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::{History, REPORTS_MAX};
    use crate::supervisor::protocol::Reply;

    fn lines(history: &History) -> Vec<serde_json::Value> {
        let line = |reply: &Reply| {
            let Reply::Reported { line, .. } = reply else {
                panic!("{reply:?}")
            };
            line.clone()
        };
        history.all().map(line).collect()
    }

    #[test]
    fn of_reports_the_last_of_each_kind_is_kept() {
        let mut history = History::default();
        let running = json!({"event": "running", "federate": "a"});
        let upstream = |peer: u16, n: u32| json!({"event": "upstream", "federate": "a", "upstream": peer, "measures": {"messages": n}});
        let part = json!({"event": "upstream", "federate": "a", "upstream": 1, "part": 1});
        let clock = json!({"event": "clock", "federate": "a", "clock": {}});
        for line in [
            &upstream(1, 1),
            &running,
            &clock,
            &upstream(2, 1),
            &part,
            &upstream(1, 2),
        ] {
            history.report(0, line.clone());
        }
        let reports = [clock, upstream(1, 2), part, upstream(2, 1)];
        assert_eq!(history.reports(), reports);
        assert_eq!(lines(&history)[0], running);
        assert_eq!(lines(&history)[1..], reports);
    }

    #[test]
    fn kinds_without_end_do_not_fill_the_memory() {
        let mut history = History::default();
        for peer in 0..2 * REPORTS_MAX {
            history.report(0, json!({"event": "upstream", "upstream": peer}));
        }
        assert_eq!(history.reports().len(), REPORTS_MAX);
        // What is known already goes on.
        let line = json!({"event": "upstream", "upstream": 0, "measures": {}});
        history.report(0, line.clone());
        assert_eq!(history.reports()[0], line);
    }
}
