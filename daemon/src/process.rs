//! Waiting for the end of processes that are not our children.

use std::os::fd::OwnedFd;
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::process::{Pid, PidfdFlags, pidfd_open};

/// A process's pidfd; absent when there is no such process.
pub(crate) fn open(pid: u32) -> Option<OwnedFd> {
    let pid = Pid::from_raw(i32::try_from(pid).ok()?)?;
    pidfd_open(pid, PidfdFlags::empty()).ok()
}

/// Waits until the process has ended; at most so long.
pub(crate) async fn wait_for_end(pidfd: OwnedFd, at_most: Duration) {
    let wait = move || {
        let bound = Timespec::try_from(at_most).ok();
        poll(&mut [PollFd::new(&pidfd, PollFlags::IN)], bound.as_ref())
    };
    if let Ok(Err(error)) = tokio::task::spawn_blocking(wait).await {
        tracing::warn!(%error, "cannot wait for a process");
    }
}
