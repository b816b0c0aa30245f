//! Who a process is. A pid alone is reused; pid, start time and pid namespace together are not.

use std::fs;
use std::io;
use std::os::unix::fs::MetadataExt;

use ictus_deploy::image::hex;
use serde::{Deserialize, Serialize};

/// A process, told apart from every later one with the same pid.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProcessIdentity {
    /// The process id in its own namespace.
    pub pid: u32,
    /// Clock ticks after boot at which it started (`/proc/PID/stat`, field 22).
    pub start_time: u64,
    /// The inode of its pid namespace: containers of one host share the boot id, but not this.
    pub pid_namespace: u64,
}

impl ProcessIdentity {
    /// Reads the identity of a living process of this namespace.
    ///
    /// # Errors
    /// When there is no such process, or it belongs to another user.
    pub fn of(pid: u32) -> io::Result<Self> {
        let pid_namespace = fs::metadata(format!("/proc/{pid}/ns/pid"))?.ino();
        Self::in_namespace(pid, pid_namespace)
    }

    /// Reads the identity of a living process that says of itself in which namespace it is: another user's is not told.
    ///
    /// # Errors
    /// When there is no such process.
    pub(crate) fn seen(pid: u32, said: u64) -> io::Result<Self> {
        match Self::of(pid) {
            Err(error) if error.kind() == io::ErrorKind::PermissionDenied => {
                Self::in_namespace(pid, said)
            }
            read => read,
        }
    }

    fn in_namespace(pid: u32, pid_namespace: u64) -> io::Result<Self> {
        let stat = fs::read_to_string(format!("/proc/{pid}/stat"))?;
        let start_time = start_time(&stat).ok_or(io::ErrorKind::InvalidData)?;
        Ok(Self {
            pid,
            start_time,
            pid_namespace,
        })
    }

    /// Reads the identity of this process.
    ///
    /// # Errors
    /// When `/proc` is not mounted.
    pub fn own() -> io::Result<Self> {
        Self::of(std::process::id())
    }

    /// Whether the process still lives: the same pid with the same start time in the same namespace.
    #[must_use]
    pub fn lives(&self) -> bool {
        Self::of(self.pid).is_ok_and(|now| now == *self)
    }
}

/// Makes a random id of 128 bits, as 32 hexadecimal digits.
///
/// # Errors
/// When the system has no random numbers.
pub fn random_id() -> io::Result<String> {
    let mut bytes = [0_u8; 16];
    getrandom::fill(&mut bytes)?;
    Ok(hex(&bytes))
}

/// Field 22 of a `stat` line; the command in field 2 may hold spaces and parentheses.
fn start_time(stat: &str) -> Option<u64> {
    let after_command = &stat[stat.rfind(')')? + 1..];
    after_command.split_ascii_whitespace().nth(19)?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::{ProcessIdentity, random_id, start_time};

    #[test]
    fn start_time_survives_a_strange_command() {
        let stat = "7 (a) b) S 1 7 7 0 -1 4194560 1 0 0 0 0 0 0 0 20 0 1 0 4711 0 0";
        assert_eq!(start_time(stat), Some(4711));
        assert_eq!(start_time("7"), None);
    }

    #[test]
    fn own_process_lives_and_another_start_time_does_not() {
        let own = ProcessIdentity::own().unwrap();
        assert!(own.lives());
        assert!(
            !ProcessIdentity {
                start_time: own.start_time + 1,
                ..own
            }
            .lives()
        );
    }

    #[test]
    fn random_ids_differ() {
        assert_ne!(random_id().unwrap(), random_id().unwrap());
        assert_eq!(random_id().unwrap().len(), 32);
    }
}
