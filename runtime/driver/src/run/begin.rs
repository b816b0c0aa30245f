//! What a run begins with: its plan, the federates it is for, and the way to the RTI.

use std::io;
use std::net::{SocketAddr, ToSocketAddrs};

use ictus_coord::auth::Nonce;
use ictus_coord::plan::Plan;
use ictus_core::Duration;
use ictus_stream::{Credentials, Member};
use nix::libc;

use super::RunError;
use crate::args::RunArgs;
use crate::clock::{Clock, SystemClock};
use crate::status::Status;
use crate::transport::Connection;

/// How long a connect is retried: the RTI may start after its federates.
const CONNECT_FOR: Duration = Duration::from_secs(60);

/// The plan, from a file or, where there is no file to share (`ictus compose`), from the environment.
pub(super) fn read_plan(args: &RunArgs) -> Result<Plan, RunError> {
    if let Some(name) = &args.plan_env {
        let text = std::env::var(name).map_err(|_| RunError::NoPlan { name: name.clone() })?;
        return serde_json::from_str(&text).map_err(|source| RunError::ParsePlan {
            path: name.into(),
            source,
        });
    }
    let path = || args.plan.clone();
    let text = std::fs::read(&args.plan).map_err(|source| RunError::ReadPlan {
        path: path(),
        source,
    })?;
    serde_json::from_slice(&text).map_err(|source| RunError::ParsePlan {
        path: path(),
        source,
    })
}

/// No page of this process, now or later, is written to swap or waited for. Executing a program undoes it, so nobody else
/// can do it for us.
#[expect(
    unsafe_code,
    reason = "mlockall stands behind features of nix and rustix that nothing else needs"
)]
pub(super) fn lock_memory() -> io::Result<()> {
    // SAFETY: it takes flags only, and changes nothing that a program could observe in its memory.
    match unsafe { libc::mlockall(libc::MCL_CURRENT | libc::MCL_FUTURE) } {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

pub(super) fn named_federates(plan: &Plan, names: &[String]) -> Result<Vec<u16>, RunError> {
    let index = |name: &String| {
        let found = plan.federates.iter().position(|f| f.name == *name);
        let id = found.and_then(|index| u16::try_from(index).ok());
        id.ok_or_else(|| RunError::UnknownFederate {
            name: name.clone(),
            known: plan.federates.iter().map(|f| f.name.clone()).collect(),
        })
    };
    if names.is_empty() {
        let count = u16::try_from(plan.federates.len()).unwrap_or(u16::MAX);
        Ok((0..count).collect())
    } else {
        names.iter().map(index).collect()
    }
}

pub(super) fn resolve(rti: &str) -> Result<SocketAddr, RunError> {
    let refused = || RunError::BadAddress {
        address: rti.to_owned(),
    };
    // `user@host:port` is what LF's launcher passes.
    let host = rti.rsplit('@').next().unwrap_or(rti);
    let host = if host.contains(':') {
        host.to_owned()
    } else {
        format!("{host}:15045")
    };
    let mut addresses = host.to_socket_addrs().map_err(|_| refused())?;
    addresses.find(SocketAddr::is_ipv4).ok_or_else(refused)
}

/// Where status lines go. Who takes them from a socket may come later, or go away: that is no reason to fail.
pub(super) fn status_of(args: &RunArgs) -> io::Result<Status> {
    match &args.status_socket {
        Some(path) => Ok(Status::to_socket(path)),
        None => Status::new(args.status_fd),
    }
}

/// LF's default on both sides.
pub(super) fn default_federation() -> String {
    "Unidentified Federation".to_owned()
}

/// Random bytes for the authentication.
pub(super) fn nonce() -> Result<Nonce, RunError> {
    let mut nonce = Nonce::default();
    getrandom::fill(&mut nonce).map_err(|error| RunError::Io(error.into()))?;
    Ok(nonce)
}

pub(super) fn connect(
    address: SocketAddr,
    credentials: Option<&Credentials>,
) -> Result<Connection, RunError> {
    let to = credentials.map(|credentials| (credentials, Member::Rti));
    let clock = SystemClock::new();
    let until = clock.now() + CONNECT_FOR;
    loop {
        match Connection::open(address, Duration::from_secs(5), to) {
            Ok(connection) => return Ok(connection),
            Err(source) if clock.now() > until => {
                return Err(RunError::Connect { address, source });
            }
            Err(_) => std::thread::sleep(std::time::Duration::from_millis(20)),
        }
    }
}
