//! What this host gives federates besides running them, tried out where the kernel alone knows.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use ictus_deploy::gives::{Denied, Gives};
use ictus_deploy::placement::RealtimePolicy;
use rustix::process::{Resource, getrlimit};
use rustix::thread::CpuSet;

use crate::paths::Paths;
use crate::secrets::Place;
use crate::supervisor::limits::schedule;

/// Bits of `CapEff`.
const CAP_IPC_LOCK: u32 = 14;
const CAP_SYS_NICE: u32 = 23;
/// The largest priority of Linux.
const HIGHEST: u8 = 99;
/// Where limits are raised for a user.
const LIMITS: &str = "/etc/security/limits.d/ictus.conf";

/// Looks.
pub(crate) fn of_this_host(paths: &Paths, user: &str) -> Gives {
    let capabilities = capabilities(&fs::read_to_string("/proc/self/status").unwrap_or_default());
    let may = |bit: u32| capabilities & (1 << bit) != 0;
    let realtime = Realtime {
        tried: try_realtime(),
        capable: may(CAP_SYS_NICE),
        limit: getrlimit(Resource::Rtprio).current,
        budget: budget(),
    };
    Gives {
        uid: rustix::process::geteuid().as_raw(),
        cpus: cpus(),
        realtime: realtime.judge(user),
        realtime_contained: contained(group_scheduling()),
        lock_memory: lock_memory(
            may(CAP_IPC_LOCK),
            getrlimit(Resource::Memlock).current,
            user,
        ),
        secrets: Place::find(paths).map(|place| place.path().to_path_buf()),
        refuses_root: paths.shared().is_some_and(|shared| !shared.allow_root),
    }
}

/// All that decides whether a process gets realtime scheduling.
#[derive(Clone, Debug)]
struct Realtime {
    /// What the kernel said to a thread that asked for it.
    tried: Result<(), String>,
    /// Whether the daemon may give any priority.
    capable: bool,
    /// The limit `rtprio`; absent: none.
    limit: Option<u64>,
    /// Where the daemon's control group has its budget, and how many microseconds; absent when groups have none.
    budget: Option<(PathBuf, i64)>,
}

impl Realtime {
    fn judge(&self, user: &str) -> Result<u8, Denied> {
        let limit = self.limit.unwrap_or(HIGHEST.into()).min(HIGHEST.into());
        let limit = u8::try_from(limit).unwrap_or(HIGHEST);
        let highest = if self.capable { HIGHEST } else { limit };
        let denied = |why: String, fix: String| Err(Denied { why, fix });
        match (&self.tried, &self.budget) {
            (Ok(()), _) if highest > 0 => Ok(highest),
            (_, Some((path, 0))) => denied(
                format!(
                    "its control group has no budget for it ({} is 0)",
                    path.display()
                ),
                "give the group one, from the root group down: `echo 950000 > cpu.rt_runtime_us`"
                    .to_owned(),
            ),
            _ if highest == 0 => denied(
                format!("the limit `rtprio` of user {user} is 0"),
                raise(user, "rtprio 99"),
            ),
            (Ok(()), _) => Ok(highest),
            (Err(error), _) => denied(
                format!("its kernel refuses it ({error})"),
                "let its daemon have CAP_SYS_NICE, or leave `realtime` out".to_owned(),
            ),
        }
    }
}

fn raise(user: &str, limit: &str) -> String {
    format!(
        "write `{user} - {limit}` into {LIMITS} there, and end its ictusd: the next one that is started has it"
    )
}

/// Asks for the least priority in a thread of its own, which then ends.
fn try_realtime() -> Result<(), String> {
    let asked = std::thread::spawn(|| schedule(RealtimePolicy::Fifo, 1)).join();
    let asked = asked.unwrap_or_else(|_| Err(std::io::ErrorKind::Other.into()));
    asked.map_err(|error| error.to_string())
}

fn lock_memory(capable: bool, limit: Option<u64>, user: &str) -> Result<(), Denied> {
    match limit {
        Some(bytes) if !capable => Err(Denied {
            why: format!("the limit `memlock` of user {user} is {} KiB", bytes >> 10),
            fix: raise(user, "memlock unlimited"),
        }),
        Some(_) | None => Ok(()),
    }
}

/// What a container gets: where control groups have budgets, the engine gives none.
fn contained(group_scheduling: bool) -> Result<u8, Denied> {
    if !group_scheduling {
        return Ok(HIGHEST);
    }
    Err(Denied {
        why: "its kernel has realtime budgets for control groups (cpu.rt_runtime_us), and containers have none"
            .to_owned(),
        fix: "take `engine: process` there, or leave `realtime` out".to_owned(),
    })
}

/// The controller of processors in version 1, by itself and with another one.
const CONTROLLERS: [&str; 2] = ["/sys/fs/cgroup/cpu", "/sys/fs/cgroup/cpu,cpuacct"];
const BUDGET: &str = "cpu.rt_runtime_us";

fn group_scheduling() -> bool {
    let mut controllers = CONTROLLERS.iter();
    controllers.any(|it| Path::new(it).join(BUDGET).exists()) || budget().is_some()
}

fn budget() -> Option<(PathBuf, i64)> {
    let groups = fs::read_to_string("/proc/self/cgroup").ok()?;
    let group = group(&groups)?;
    let mut files = CONTROLLERS.iter().map(|it| {
        Path::new(it)
            .join(group.trim_start_matches('/'))
            .join(BUDGET)
    });
    let path = files.find(|path| path.exists())?;
    let budget = fs::read_to_string(&path).ok()?.trim().parse().ok()?;
    Some((path, budget))
}

/// The group of the controller of processors.
fn group(groups: &str) -> Option<&str> {
    let mut lines = groups.lines().map(|line| line.splitn(3, ':'));
    lines.find_map(|mut fields| {
        let (_, controllers, path) = (fields.next()?, fields.next()?, fields.next()?);
        controllers.split(',').any(|it| it == "cpu").then_some(path)
    })
}

fn capabilities(status: &str) -> u64 {
    let line = status.lines().find_map(|line| line.strip_prefix("CapEff:"));
    line.and_then(|digits| u64::from_str_radix(digits.trim(), 16).ok())
        .unwrap_or(0)
}

fn cpus() -> BTreeSet<u32> {
    let set = rustix::thread::sched_getaffinity(None).unwrap_or_default();
    let indices = (0..CpuSet::MAX_CPU).filter(|index| set.is_set(*index));
    indices
        .filter_map(|index| u32::try_from(index).ok())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Tried, capable, limit and budget to the highest priority, or why there is none.
    #[test]
    fn realtime_is_given_or_denied_with_the_reason() {
        let refused = || Err("Operation not permitted".to_owned());
        let table = [
            (Ok(()), true, Some(0), None, Ok(99)),
            (Ok(()), false, Some(20), None, Ok(20)),
            (Ok(()), false, None, None, Ok(99)),
            (Ok(()), true, Some(0), Some(950_000), Ok(99)),
            (
                refused(),
                false,
                Some(0),
                None,
                Err((
                    "the limit `rtprio` of user bob is 0",
                    "write `bob - rtprio 99`",
                )),
            ),
            (
                refused(),
                true,
                Some(0),
                Some(0),
                Err(("no budget for it (/g is 0)", "cpu.rt_runtime_us")),
            ),
            (
                refused(),
                false,
                Some(0),
                Some(0),
                Err(("no budget for it (/g is 0)", "cpu.rt_runtime_us")),
            ),
            (
                refused(),
                true,
                Some(0),
                None,
                Err(("refuses it (Operation not permitted)", "CAP_SYS_NICE")),
            ),
        ];
        for (tried, capable, limit, budget, expected) in table {
            let realtime = Realtime {
                tried,
                capable,
                limit,
                budget: budget.map(|budget| ("/g".into(), budget)),
            };
            let judged = realtime.judge("bob");
            match (expected, judged) {
                (Ok(highest), Ok(found)) => assert_eq!(found, highest, "{realtime:?}"),
                (Err((why, fix)), Err(denied)) => {
                    assert!(denied.why.contains(why), "{denied:?}");
                    assert!(denied.fix.contains(fix), "{denied:?}");
                }
                (expected, judged) => panic!("{realtime:?}: {judged:?}, not {expected:?}"),
            }
        }
    }

    #[test]
    fn memory_is_locked_by_who_may_or_has_no_limit() {
        assert_eq!(lock_memory(true, Some(0), "bob"), Ok(()));
        assert_eq!(lock_memory(false, None, "bob"), Ok(()));
        let denied = lock_memory(false, Some(8 << 20), "bob").unwrap_err();
        assert_eq!(denied.why, "the limit `memlock` of user bob is 8192 KiB");
        assert!(denied.fix.contains("bob - memlock unlimited"), "{denied:?}");
    }

    #[test]
    fn the_files_of_the_kernel_are_understood() {
        assert_eq!(
            capabilities("Name:\tx\nCapEff:\t0000000000800000\n"),
            1 << CAP_SYS_NICE
        );
        assert_eq!(capabilities(""), 0);
        assert_eq!(
            group("9:name=systemd:/\n1:cpu,cpuacct:/a/b\n0::/"),
            Some("/a/b")
        );
        assert_eq!(group("0::/"), None);
        assert_eq!(contained(false), Ok(99));
        assert!(contained(true).unwrap_err().why.contains("budgets"));
        assert!(!cpus().is_empty());
    }
}
