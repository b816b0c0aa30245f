//! What a process is bound to before its program is executed: processors, scheduling, user, no core dumps.

use std::io;

use ictus_deploy::placement::{Realtime, RealtimePolicy};
use nix::libc;
use rustix::fs::Mode;
use rustix::process::{Gid, Resource, Rlimit, Uid};
use rustix::thread::CpuSet;
use serde::{Deserialize, Serialize};

use crate::accounts::Account;

/// The bounds of a process.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Limits {
    /// Processors that it may run on; empty: all.
    pub cpus: Vec<u32>,
    /// Realtime scheduling. That its memory is locked is its own doing.
    pub realtime: Option<Realtime>,
    /// Who it is; absent: who its supervisor is.
    pub account: Option<Account>,
    /// Whether no core is dumped: its memory holds secrets.
    pub no_core: bool,
}

impl Limits {
    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// Binds this process, which has one thread, to them.
    ///
    /// # Errors
    /// What the system refuses, in words.
    pub(crate) fn apply(&self) -> Result<(), String> {
        let said = |what: &str| {
            let what = what.to_owned();
            move |error: io::Error| format!("cannot {what}: {error}")
        };
        if !self.cpus.is_empty() {
            let cpus = cpu_set(&self.cpus)?;
            rustix::thread::sched_setaffinity(None, &cpus).map_err(|error| {
                said(&format!("run on processors {:?}", self.cpus))(error.into())
            })?;
        }
        if self.no_core {
            // A pipe in /proc/sys/kernel/core_pattern gets a core in spite of 0, but not of 1 byte (fs/coredump.c). Where no
            // more than 0 is allowed, only root may have more.
            let most = |bytes| Rlimit {
                current: Some(bytes),
                maximum: Some(bytes),
            };
            let limit = |bytes| rustix::process::setrlimit(Resource::Core, most(bytes));
            limit(1)
                .or_else(|_| limit(0))
                .map_err(|error| said("forbid core dumps")(error.into()))?;
        }
        if let Some(realtime) = self.realtime {
            let what = format!("get realtime priority {}", realtime.priority);
            schedule(realtime.policy, realtime.priority).map_err(said(&what))?;
        }
        // The capability to lock any amount goes with the user.
        if self.account.is_some() && self.realtime.is_some_and(|it| it.lock_memory) {
            let all = Rlimit {
                current: None,
                maximum: None,
            };
            rustix::process::setrlimit(Resource::Memlock, all)
                .map_err(|error| said("let memory be locked")(error.into()))?;
        }
        match &self.account {
            Some(account) => become_user(account).map_err(said(&format!(
                "run as user {}:{}",
                account.uid, account.gid
            ))),
            None => Ok(()),
        }
    }
}

fn cpu_set(cpus: &[u32]) -> Result<CpuSet, String> {
    let mut set = CpuSet::new();
    for cpu in cpus {
        let index = usize::try_from(*cpu)
            .ok()
            .filter(|index| *index < CpuSet::MAX_CPU);
        set.set(index.ok_or_else(|| format!("there is no processor {cpu}"))?);
    }
    Ok(set)
}

/// Schedules this thread, and those that it begins, among realtime ones.
#[expect(
    unsafe_code,
    reason = "neither rustix nor nix has sched_setscheduler; the crates that wrap it bring Windows' API along"
)]
pub(crate) fn schedule(policy: RealtimePolicy, priority: u8) -> io::Result<()> {
    let policy = match policy {
        RealtimePolicy::Fifo => libc::SCHED_FIFO,
        RealtimePolicy::RoundRobin => libc::SCHED_RR,
    };
    let parameters = libc::sched_param {
        sched_priority: priority.into(),
    };
    // SAFETY: 0 is this thread, and the pointer is to our own integers.
    match unsafe { libc::sched_setscheduler(0, policy, &raw const parameters) } {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

/// Groups first: afterwards it may not any more.
fn become_user(account: &Account) -> io::Result<()> {
    account.own(io::stdout())?;
    account.own(io::stderr())?;
    let groups: Vec<Gid> = account.groups.iter().copied().map(Gid::from_raw).collect();
    let (uid, gid) = (Uid::from_raw(account.uid), Gid::from_raw(account.gid));
    rustix::thread::set_thread_groups(&groups)?;
    rustix::thread::set_thread_res_gid(gid, gid, gid)?;
    rustix::thread::set_thread_res_uid(uid, uid, uid)?;
    // What a daemon of root's hides from others is not what this one does.
    rustix::process::umask(Mode::from_raw_mode(0o022));
    Ok(())
}
