//! Whether other hosts still answer, whatever their programs do.
//!
//! A program may legitimately say nothing and take nothing for minutes; its host's kernel answers all the same. So it is not
//! asked what a peer says but what came from its host at all ([`Traffic`], which the kernel counts), and whether something
//! that must be answered has gone out since. All connections with one host are taken together: an answer on one speaks
//! for the host.
//!
//! Law `a_cut_shorter_than_the_timeout_is_no_loss`: as the kernel sends again less and less often (up to twice as late each time),
//! a host is not given up when the timeout is over, but when something that was sent after it has found no answer either.
//!
//! Law `a_host_that_is_gone_is_found`: that takes at most three and a quarter timeouts and a second, while anything is to be
//! answered or the kernel asks by itself four times per timeout; less than two where data is sent again at an even pace.

use std::collections::BTreeMap;
use std::net::IpAddr;

use ictus_core::{Duration, PhysicalTime};

/// The least time between two looks.
const PERIOD_MIN: Duration = Duration::from_millis(50);
/// Looks per timeout.
const LOOKS: i64 = 8;

/// What the kernel has counted of one connection since it stands.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Traffic {
    /// Segments that came, of whatever kind; wraps.
    pub heard: u32,
    /// Segments with data that went, those sent again included: each must be acknowledged; wraps.
    pub asked: u32,
    /// Probes (keepalive, closed window) in a row that were not answered.
    pub probes: u32,
}

/// One connection at one time.
#[derive(Clone, Copy, Debug)]
pub struct Reading<K> {
    /// The host at the other end.
    pub host: IpAddr,
    /// Which connection with it.
    pub connection: K,
    /// What is counted.
    pub traffic: Traffic,
}

/// A host that does not answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Silent {
    /// The host.
    pub host: IpAddr,
    /// Since something was sent to it first that it has not answered.
    pub lasting: Duration,
}

/// Decides which hosts are lost. Time is a clock's that nobody steps.
#[derive(Clone, Debug)]
pub struct Silence<K> {
    timeout: Duration,
    hosts: BTreeMap<IpAddr, Host<K>>,
}

#[derive(Clone, Debug)]
struct Host<K> {
    connections: BTreeMap<K, Traffic>,
    answering: Answering,
}

/// Whether a host answers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Answering {
    /// As far as anybody knows.
    Yes,
    /// Not what was sent at this time, nor anything later.
    NotSince(PhysicalTime),
    /// Nor what was sent when the timeout was over.
    NotEven {
        since: PhysicalTime,
        last: PhysicalTime,
    },
}

/// What happened between two looks at a host.
#[derive(Clone, Copy, Debug, Default)]
struct Between {
    heard: bool,
    asked: bool,
}

impl<K: Ord + Copy> Silence<K> {
    /// A host may be silent for `timeout`.
    #[must_use]
    pub const fn new(timeout: Duration) -> Self {
        Self {
            timeout,
            hosts: BTreeMap::new(),
        }
    }

    /// The time between two looks; answers should not take longer.
    #[must_use]
    pub fn period(&self) -> Duration {
        Duration::from_nanos(self.timeout.as_nanos() / LOOKS).max(PERIOD_MIN)
    }

    /// Takes the readings of all connections that there are, and names the hosts that are lost: again at every look until
    /// their connections are gone. O(connections).
    pub fn look(&mut self, now: PhysicalTime, readings: &[Reading<K>]) -> Vec<Silent> {
        let mut before = std::mem::take(&mut self.hosts);
        let mut between: BTreeMap<IpAddr, Between> = BTreeMap::new();
        for reading in readings {
            let known = before.get(&reading.host);
            let known = known.and_then(|host| host.connections.get(&reading.connection));
            let happened = between.entry(reading.host).or_default();
            happened.note(known, &reading.traffic);
            let host = self.hosts.entry(reading.host).or_insert_with(|| Host {
                connections: BTreeMap::new(),
                answering: Answering::Yes,
            });
            host.connections.insert(reading.connection, reading.traffic);
        }
        let (late, period) = (self.timeout + self.period(), self.period());
        let mut lost = Vec::new();
        for (address, host) in &mut self.hosts {
            let was = before.remove(address);
            let was = was.map_or(Answering::Yes, |host| host.answering);
            let happened = between.get(address).copied().unwrap_or_default();
            host.answering = was.then(now, happened, late);
            if let Answering::NotEven { since, last } = host.answering
                && now.since(last) >= period
            {
                let (host, lasting) = (*address, now.since(since));
                lost.push(Silent { host, lasting });
            }
        }
        lost
    }
}

impl Between {
    fn note(&mut self, before: Option<&Traffic>, now: &Traffic) {
        match before {
            // It has just been made, by both sides.
            None => self.heard = true,
            Some(before) => {
                self.heard |= before.heard != now.heard;
                self.asked |= before.asked != now.asked || now.probes > before.probes;
            }
        }
    }
}

impl Answering {
    /// What is known a look later; `late` after the first question the answer to another one decides.
    ///
    /// What is seen now was sent since the last look, so that `late` is a period longer than the timeout.
    fn then(self, now: PhysicalTime, happened: Between, late: Duration) -> Self {
        match (self, happened) {
            (_, Between { heard: true, .. }) => Self::Yes,
            (_, Between { asked: false, .. }) => self,
            (Self::Yes, _) => Self::NotSince(now),
            (Self::NotSince(since), _) if now.since(since) >= late => {
                Self::NotEven { since, last: now }
            }
            (Self::NotSince(_) | Self::NotEven { .. }, _) => self,
        }
    }
}
