//! What this host is and can do.

use std::fs;
use std::path::{Path, PathBuf};

use ictus_deploy::gives::Gives;

use crate::accounts;
use crate::api::part::{DockerFacts, HostFacts};
use crate::paths::Paths;

mod gives;

/// Asks the system, but not the Docker engine.
pub(crate) fn of_this_host(paths: &Paths, docker: Result<DockerFacts, String>) -> HostFacts {
    let name = rustix::system::uname();
    let word = |text: &std::ffi::CStr| text.to_string_lossy().into_owned();
    let cpus = std::thread::available_parallelism().map_or(1, |found| found.get());
    let existing = paths.state.ancestors().find(|path| path.exists());
    let disk = existing.and_then(|path| rustix::fs::statvfs(path).ok());
    HostFacts {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        arch: std::env::consts::ARCH.to_owned(),
        kernel: word(name.release()),
        hostname: word(name.nodename()),
        user: user(),
        cpus: u32::try_from(cpus).unwrap_or(u32::MAX),
        disk_free: disk.map_or(0, |disk| disk.f_bavail.saturating_mul(disk.f_frsize)),
        state: paths.state.clone(),
        gives: gives(paths),
        docker,
        starts_at_boot: starts_at_boot(paths),
        run_as: paths
            .shared()
            .map(|shared| accounts::name(shared.run_as.uid)),
    }
}

/// What federates may need and it gives.
pub(crate) fn gives(paths: &Paths) -> Gives {
    gives::of_this_host(paths, &user())
}

/// Whether systemd has been told to start the host's unit; or the user's, and to do so while nobody is logged in.
fn starts_at_boot(paths: &Paths) -> bool {
    if paths.of_host() {
        let wanted = "/etc/systemd/system/multi-user.target.wants/ictusd.service";
        return fs::symlink_metadata(wanted).is_ok();
    }
    let wanted = ".config/systemd/user/default.target.wants/ictusd.service";
    let home = std::env::var_os("HOME").map(PathBuf::from);
    let enabled = home.is_some_and(|home| fs::symlink_metadata(home.join(wanted)).is_ok());
    enabled && Path::new("/var/lib/systemd/linger").join(user()).exists()
}

fn user() -> String {
    accounts::name(rustix::process::geteuid().as_raw())
}
