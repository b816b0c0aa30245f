//! Which of two versions is the newer one: an older program may not know the newer one's records.

use ictus_deploy::ssh::Connection;

use crate::error::CliError;
use crate::hosts::unreachable_host;

/// This program's.
const OWN: &str = env!("CARGO_PKG_VERSION");

/// Refuses to put this version in the place of a newer one at `installed`.
pub(super) async fn refuse_newer(
    host: &str,
    connection: &Connection,
    installed: &str,
) -> Result<(), CliError> {
    let said = connection.run(&[installed, "--version"], &[]).await;
    let said = said.map_err(|error| unreachable_host(host, &error))?;
    let said = String::from_utf8_lossy(&said.stdout);
    // One that says nothing is replaced, also when it is only broken.
    let there = said.split_whitespace().last().unwrap_or_default();
    if !is_newer(there, OWN) {
        return Ok(());
    }
    let what = format!("host `{host}` has ictusd {there}, which is newer than this one ({OWN})");
    Err(CliError::failed(what).hint(format!(
        "use ictus {there} or a later one from here, or remove that one first: `ictus host rm {host}`"
    )))
}

/// Whether `one` is a version, and a later one than `other`; of three numbers, whatever follows them.
fn is_newer(one: &str, other: &str) -> bool {
    numbers(one).is_some_and(|one| numbers(other).is_some_and(|other| one > other))
}

fn numbers(version: &str) -> Option<[u64; 3]> {
    let plain = version.split(['-', '+']).next()?;
    let numbers: Vec<u64> = plain
        .split('.')
        .map(str::parse)
        .collect::<Result<_, _>>()
        .ok()?;
    numbers.try_into().ok()
}

#[cfg(test)]
mod tests {
    use super::is_newer;

    #[test]
    fn versions_are_compared_by_their_numbers() {
        let table = [
            ("0.1.0", "0.1.0", false),
            ("0.1.1", "0.1.0", true),
            ("0.10.0", "0.9.9", true),
            ("0.9.9", "0.10.0", false),
            ("1.0.0", "0.99.99", true),
            ("0.2.0-rc.1", "0.1.0", true),
            ("0.1.0+build", "0.1.0", false),
            // Not of ours.
            ("", "0.1.0", false),
            ("9", "0.1.0", false),
            ("9.9.9.9", "0.1.0", false),
            ("9.x.0", "0.1.0", false),
        ];
        for (one, other, expected) in table {
            assert_eq!(is_newer(one, other), expected, "{one} and {other}");
        }
    }
}
