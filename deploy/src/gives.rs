//! What a host gives federates besides running their programs, and what of their needs it cannot give.

use std::collections::BTreeSet;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::placement::{Engine, Needs};

/// What a host gives.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct Gives {
    /// The user id of its daemon: root's is 0, and may run federates as other users.
    pub uid: u32,
    /// Processors that federates may run on.
    pub cpus: BTreeSet<u32>,
    /// The highest realtime priority of a process, from 1 to 99.
    pub realtime: Result<u8, Denied>,
    /// The same in a container.
    pub realtime_contained: Result<u8, Denied>,
    /// Whether processes may lock their memory.
    pub lock_memory: Result<(), Denied>,
    /// The tmpfs directory in which federates find their secrets.
    pub secrets: Result<PathBuf, Denied>,
    /// Whether no federate may be root, though the daemon is.
    pub refuses_root: bool,
}

/// Why a host does not give something.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Denied {
    /// Why.
    pub why: String,
    /// What to do about it, on the host.
    pub fix: String,
}

/// Something that a federate needs and a host does not give.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Lack {
    /// What, and why not: "realtime priority 60: ...".
    pub what: String,
    /// What to do about it.
    pub fix: String,
}

impl Default for Gives {
    /// Of a daemon that does not say: nothing.
    fn default() -> Self {
        let denied = Denied {
            why: "its ictusd does not say".to_owned(),
            fix: "`ictus host upgrade` installs this version there".to_owned(),
        };
        Self {
            uid: u32::MAX,
            cpus: BTreeSet::new(),
            realtime: Err(denied.clone()),
            realtime_contained: Err(denied.clone()),
            lock_memory: Err(denied.clone()),
            secrets: Err(denied),
            refuses_root: false,
        }
    }
}

impl Gives {
    /// What a federate needs and does not get here; empty when it gets all.
    #[must_use]
    pub fn lacks(&self, engine: Engine, needs: &Needs) -> Vec<Lack> {
        let mut lacks = Vec::new();
        lacks.extend(self.processors(needs));
        lacks.extend(self.user(engine, needs));
        lacks.extend(self.realtime(engine, needs));
        if let (false, Err(denied)) = (needs.secrets.is_empty(), &self.secrets) {
            lacks.push(denied.lack("secrets"));
        }
        lacks
    }

    fn processors(&self, needs: &Needs) -> Option<Lack> {
        let missing: Vec<_> = needs
            .cpus
            .iter()
            .filter(|cpu| !self.cpus.contains(cpu))
            .map(u32::to_string)
            .collect();
        if missing.is_empty() {
            return None;
        }
        let noun = if missing.len() == 1 { "" } else { "s" };
        Some(Lack {
            what: format!(
                "processor{noun} {}: it has {}",
                missing.join(", "),
                ranges(&self.cpus)
            ),
            fix: "name others in `cpus`, or place the federate elsewhere".to_owned(),
        })
    }

    fn user(&self, engine: Engine, needs: &Needs) -> Option<Lack> {
        let user = needs.user.as_deref()?;
        let number: Option<u32> = user.split(':').next()?.parse().ok();
        let own = number == Some(self.uid);
        let root = number == Some(0) || user.split(':').next() == Some("root");
        if root && self.refuses_root {
            return Some(self.no_root(user));
        }
        let (what, fix) = match engine {
            Engine::Process if self.uid == 0 || (own && !user.contains(':')) => return None,
            Engine::Process => (
                format!(
                    "user `{user}`: its daemon runs as user {}, and only root may run processes as others",
                    self.uid
                ),
                "leave `user` out, take `engine: docker` there, or run its daemon as root",
            ),
            Engine::Docker if needs.secrets.is_empty() || own => return None,
            Engine::Docker if self.uid == 0 && number.is_some() => return None,
            Engine::Docker if self.uid == 0 => (
                format!("secrets for user `{user}`: only the image knows its number"),
                "write `user` as a number",
            ),
            Engine::Docker => (
                format!(
                    "secrets for user `{user}`: its daemon runs as user {}, and only root may give files away",
                    self.uid
                ),
                "leave `user` out, or run its daemon as root",
            ),
        };
        let fix = fix.to_owned();
        Some(Lack { what, fix })
    }

    /// That a user who is root is refused.
    #[must_use]
    pub fn no_root(&self, user: &str) -> Lack {
        Lack {
            what: format!("user `{user}`: the host's owner lets no federate be root"),
            fix: "leave `user` out, or write `allow_root = true` into /etc/ictus/ictusd.toml there and start its ictusd again"
                .to_owned(),
        }
    }

    fn realtime(&self, engine: Engine, needs: &Needs) -> Vec<Lack> {
        let Some(wanted) = needs.realtime else {
            return Vec::new();
        };
        let given = match engine {
            Engine::Process => &self.realtime,
            Engine::Docker => &self.realtime_contained,
        };
        let what = format!("realtime priority {}", wanted.priority);
        let mut lacks = Vec::new();
        match given {
            Ok(highest) if wanted.priority <= *highest => {}
            Ok(highest) => lacks.push(Lack {
                what: format!("{what}: its limit `rtprio` is {highest}"),
                fix: format!("ask for at most {highest}, or raise the limit there"),
            }),
            Err(denied) => lacks.push(denied.lack(&what)),
        }
        // The docker engine raises the limit itself.
        if let (true, Engine::Process, Err(denied)) =
            (wanted.lock_memory, engine, &self.lock_memory)
        {
            lacks.push(denied.lack("locked memory"));
        }
        lacks
    }
}

impl Denied {
    fn lack(&self, what: &str) -> Lack {
        Lack {
            what: format!("{what}: {}", self.why),
            fix: self.fix.clone(),
        }
    }
}

/// `0 to 3, 6`.
#[must_use]
pub fn ranges(cpus: &BTreeSet<u32>) -> String {
    let mut ranges: Vec<(u32, u32)> = Vec::new();
    for cpu in cpus {
        match ranges.last_mut() {
            Some((_, last)) if last.checked_add(1) == Some(*cpu) => *last = *cpu,
            Some(_) | None => ranges.push((*cpu, *cpu)),
        }
    }
    let word = |(first, last): &(u32, u32)| match first == last {
        true => first.to_string(),
        false => format!("{first} to {last}"),
    };
    match ranges.is_empty() {
        true => "none".to_owned(),
        false => ranges.iter().map(word).collect::<Vec<_>>().join(", "),
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::placement::{Realtime, RealtimePolicy, SecretSource};

    fn denied(why: &str) -> Denied {
        Denied {
            why: why.to_owned(),
            fix: "f".to_owned(),
        }
    }

    fn gives(uid: u32) -> Gives {
        Gives {
            uid,
            cpus: BTreeSet::from([0, 1, 2, 5]),
            realtime: Ok(20),
            realtime_contained: Err(denied("no budget")),
            lock_memory: Err(denied("little")),
            secrets: Ok("/dev/shm/x".into()),
            refuses_root: false,
        }
    }

    fn needs() -> Needs {
        Needs::default()
    }

    fn realtime(priority: u8, lock_memory: bool) -> Needs {
        Needs {
            realtime: Some(Realtime {
                policy: RealtimePolicy::Fifo,
                priority,
                lock_memory,
            }),
            ..needs()
        }
    }

    fn user(user: &str, secret: bool) -> Needs {
        let secrets = secret.then(|| ("S".to_owned(), SecretSource::Environment));
        Needs {
            user: Some(user.to_owned()),
            secrets: secrets.into_iter().collect::<BTreeMap<_, _>>(),
            ..needs()
        }
    }

    /// What a host with these gives lacks, in words.
    #[test]
    #[expect(clippy::too_many_lines, reason = "a table is as long as what it lists")]
    fn what_a_host_does_not_give_is_named_with_its_reason() {
        let cpus = |cpus: &[u32]| Needs {
            cpus: cpus.to_vec(),
            ..needs()
        };
        let (process, docker) = (Engine::Process, Engine::Docker);
        let table: &[(u32, Engine, Needs, &[&str])] = &[
            (1000, process, needs(), &[]),
            (1000, process, cpus(&[0, 5]), &[]),
            (1000, docker, cpus(&[3]), &["processor 3: it has 0 to 2, 5"]),
            (
                1000,
                process,
                cpus(&[3, 4]),
                &["processors 3, 4: it has 0 to 2, 5"],
            ),
            (1000, process, user("1000", true), &[]),
            (0, process, user("bob", true), &[]),
            (
                1000,
                process,
                user("bob", false),
                &[
                    "user `bob`: its daemon runs as user 1000, and only root may run processes as others",
                ],
            ),
            (1000, docker, user("bob", false), &[]),
            (1000, docker, user("1000:1000", true), &[]),
            (
                1000,
                docker,
                user("7", true),
                &[
                    "secrets for user `7`: its daemon runs as user 1000, and only root may give files away",
                ],
            ),
            (0, docker, user("7", true), &[]),
            (
                0,
                docker,
                user("bob", true),
                &["secrets for user `bob`: only the image knows its number"],
            ),
            (1000, process, realtime(20, false), &[]),
            (
                1000,
                process,
                realtime(60, false),
                &["realtime priority 60: its limit `rtprio` is 20"],
            ),
            (
                1000,
                process,
                realtime(10, true),
                &["locked memory: little"],
            ),
            (
                1000,
                docker,
                realtime(10, true),
                &["realtime priority 10: no budget"],
            ),
        ];
        for (uid, engine, needs, expected) in table {
            let lacks = gives(*uid).lacks(*engine, needs);
            let found: Vec<_> = lacks.iter().map(|lack| lack.what.as_str()).collect();
            assert_eq!(&found, expected, "{engine:?} {needs:?}");
        }
        let owned = Gives {
            refuses_root: true,
            ..gives(0)
        };
        for (name, refused) in [("root", true), ("0:7", true), ("bob", false), ("7", false)] {
            for engine in [process, docker] {
                let lacks = owned.lacks(engine, &user(name, false));
                assert_eq!(!lacks.is_empty(), refused, "{engine:?} {name}");
            }
        }
        let none = Gives {
            secrets: Err(denied("no tmpfs")),
            ..gives(0)
        };
        assert_eq!(
            none.lacks(process, &user("0", true))[0].what,
            "secrets: no tmpfs"
        );
    }

    /// An old daemon says nothing of it, and is not taken to give anything.
    #[test]
    fn a_daemon_that_does_not_say_gives_nothing() {
        let gives: Gives = serde_json::from_str("{}").unwrap();
        assert_eq!(gives, Gives::default());
        assert_eq!(gives.lacks(Engine::Process, &realtime(1, true)).len(), 2);
    }
}
