//! A host whose systemd starts ictusd: a unit of the user's own, and leave to run while nobody is logged in.

use std::io::Write;

use ictus_deploy::ssh::Connection;

use super::root::holds;
use super::run;
use crate::error::CliError;
use crate::hosts::unreachable_host;
use crate::ui::Ui;

/// What `ictus host unit` prints and `host add --at-boot` installs.
pub(super) const UNIT: &str = include_str!("ictusd.service");

const NAME: &str = "ictusd.service";
const DIRECTORY: &str = ".config/systemd/user";
const PATH: &str = ".config/systemd/user/ictusd.service";

/// Writes the unit there, enables it and lets it run while nobody is logged in.
pub(super) async fn install(
    ui: &mut Ui,
    host: &str,
    connection: &Connection,
) -> Result<(), CliError> {
    if !has_systemd(host, connection).await? {
        let what = format!("host `{host}` has no systemd that runs");
        return Err(CliError::failed(what)
            .hint("without `--at-boot` ictusd is started when it is asked for something"));
    }
    let mut file = tempfile::NamedTempFile::new().map_err(CliError::failed)?;
    file.write_all(UNIT.as_bytes()).map_err(CliError::failed)?;
    run(host, connection, &["mkdir", "-p", DIRECTORY]).await?;
    let sent = connection
        .upload(file.path(), PATH, 0o644, &mut |_| {})
        .await;
    sent.map_err(|error| unreachable_host(host, &error))?;
    let linger = connection.run(&["loginctl", "enable-linger"], &[]).await;
    if !linger.is_ok_and(|output| output.code == 0) {
        ui.warning(&format!(
            "{host}: it will end when the user logs out: have root run `loginctl enable-linger {}`",
            connection.peer().user
        ));
    }
    run(host, connection, &["systemctl", "--user", "daemon-reload"]).await?;
    let enable = ["systemctl", "--user", "enable", "--now", NAME];
    run(host, connection, &enable).await?;
    ui.stage("enabled", &format!("{host}: ~/{PATH}"));
    Ok(())
}

/// Takes it back; that there is none is no error.
pub(super) async fn remove(host: &str, connection: &Connection) -> Result<(), CliError> {
    let there = connection.run(&["test", "-e", PATH], &[]).await;
    if there.is_ok_and(|output| output.code == 0) {
        let disable = ["systemctl", "--user", "disable", "--now", NAME];
        run(host, connection, &disable).await?;
        run(host, connection, &["rm", "-f", PATH]).await?;
    }
    Ok(())
}

/// Whether systemd is what runs there, and not only installed.
pub(super) async fn has_systemd(host: &str, connection: &Connection) -> Result<bool, CliError> {
    holds(host, connection, &["test", "-d", "/run/systemd/system"]).await
}

#[cfg(test)]
mod tests {
    use std::process::Command;

    use super::UNIT;

    /// What a restart of the daemon must not take with it, and what keeps it there.
    #[test]
    fn a_restart_of_the_unit_kills_nobody() {
        for line in [
            "KillMode=process",
            "Restart=on-failure",
            "ExecStart=%h/.local/share/ictus/bin/ictusd daemon",
        ] {
            assert!(UNIT.lines().any(|it| it == line), "{line}");
        }
    }

    #[test]
    fn systemd_understands_the_unit() {
        let directory = tempfile::tempdir().unwrap();
        let unit = directory.path().join("ictusd.service");
        // What it executes need not be installed here.
        std::fs::write(
            &unit,
            UNIT.replace("%h/.local/share/ictus/bin/ictusd", "/bin/true"),
        )
        .unwrap();
        let analyzed = Command::new("systemd-analyze")
            .args(["verify", "--man=no"])
            .arg(&unit)
            .output();
        let Ok(output) = analyzed else {
            println!("skipped: no systemd-analyze here");
            return;
        };
        let said = String::from_utf8_lossy(&output.stderr);
        let about_us: Vec<_> = said
            .lines()
            .filter(|line| line.contains("ictusd"))
            .collect();
        assert!(output.status.success() && about_us.is_empty(), "{said}");
    }
}
