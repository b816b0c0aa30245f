//! Users and groups of this host, by number or name: from its files, because a static program has no other way.

use std::fs;
use std::io;
use std::os::fd::AsFd;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::{Gid, Uid};
use serde::{Deserialize, Serialize};

/// Who a process is to be.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Account {
    /// The user's id.
    pub uid: u32,
    /// The group's id.
    pub gid: u32,
    /// Further groups.
    pub groups: Vec<u32>,
}

impl Account {
    /// `UID:GID`, which every container understands.
    pub(crate) fn numbers(&self) -> String {
        format!("{}:{}", self.uid, self.gid)
    }

    /// Gives it a pipe, so that it may open it again by `/proc/self/fd`.
    pub(crate) fn own(&self, pipe: impl AsFd) -> io::Result<()> {
        let (uid, gid) = (Uid::from_raw(self.uid), Gid::from_raw(self.gid));
        Ok(rustix::fs::fchown(pipe, Some(uid), Some(gid))?)
    }
}

/// The account that a manifest's `user` means on this host.
///
/// # Errors
/// Which user or group there is not, or what cannot be read, in words.
pub(crate) fn find(user: &str) -> Result<Account, String> {
    let read = |path: &str| match fs::read(path) {
        Ok(bytes) => Ok(String::from_utf8_lossy(&bytes).into_owned()),
        // Numbers need not stand anywhere.
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(String::new()),
        Err(error) => Err(format!("cannot read {path}: {error}")),
    };
    resolve(user, &read("/etc/passwd")?, &read("/etc/group")?)
}

/// The number of a group of this host, if there is such a one.
pub(crate) fn group(name: &str) -> Option<u32> {
    let text = fs::read_to_string("/etc/group").ok()?;
    let found = lines(&text).find(|line| line[0] == name);
    found?[2].parse().ok()
}

/// The name of a user of this host, or its number.
pub(crate) fn name(uid: u32) -> String {
    let text = fs::read_to_string("/etc/passwd").unwrap_or_default();
    let uid = uid.to_string();
    let found = lines(&text).find(|line| line[2] == uid);
    found.map_or_else(|| uid.clone(), |line| line[0].to_owned())
}

/// `UID`, `UID:GID`, or names, as in these files; a number need not stand there, but then its group has to be said.
fn resolve(text: &str, passwd: &str, group: &str) -> Result<Account, String> {
    let (user, wanted) = match text.split_once(':') {
        Some((user, group)) => (user, Some(group)),
        None => (text, None),
    };
    let number = |text: &str| text.parse::<u32>().ok();
    let is_it = |line: &str| number_of(user).is_some_and(|uid| number(line) == Some(uid));
    let known = lines(passwd).find(|line| line[0] == user || is_it(line[2]));
    let uid = known
        .as_ref()
        .map_or_else(|| number(user), |line| number(line[2]));
    let uid = uid.ok_or_else(|| format!("there is no user `{user}` on this host"))?;
    let gid = match wanted {
        Some(wanted) => {
            let found = lines(group).find(|line| line[0] == wanted);
            let gid = found.map_or_else(|| number(wanted), |line| number(line[2]));
            gid.ok_or_else(|| format!("there is no group `{wanted}` on this host"))?
        }
        None => known
            .as_ref()
            .and_then(|line| number(line.get(3)?))
            .ok_or_else(|| format!("user {uid} is not known on this host: write `{uid}:GID`"))?,
    };
    let name = known.map(|line| line[0]);
    let member = |line: &Vec<&str>| {
        let members = line.get(3).map(|members| members.split(','));
        name.is_some() && members.is_some_and(|mut all| all.any(|it| Some(it) == name))
    };
    let groups = lines(group).filter(member);
    let groups = groups
        .filter_map(|line| number(line[2]))
        .filter(|it| *it != gid);
    let groups = groups.collect();
    Ok(Account { uid, gid, groups })
}

fn number_of(user: &str) -> Option<u32> {
    // A name that is a number is one.
    user.parse()
        .ok()
        .filter(|_| user.bytes().all(|byte| byte.is_ascii_digit()))
}

/// Lines with at least three fields.
fn lines(text: &str) -> impl Iterator<Item = Vec<&str>> {
    let lines = text.lines().map(|line| line.split(':').collect::<Vec<_>>());
    lines.filter(|fields| fields.len() > 2)
}

/// The first directory on the way to `path` that this account may not enter.
pub(crate) fn closed_to(path: &Path, account: &Account) -> Option<PathBuf> {
    if account.uid == 0 {
        return None;
    }
    let may_enter = |path: &Path| {
        let Ok(found) = path.metadata() else {
            return true;
        };
        let mode = found.permissions().mode();
        let bit = if found.uid() == account.uid {
            0o100
        } else if found.gid() == account.gid || account.groups.contains(&found.gid()) {
            0o010
        } else {
            0o001
        };
        mode & bit != 0
    };
    let mut ancestors: Vec<&Path> = path.ancestors().collect();
    ancestors.reverse();
    ancestors
        .into_iter()
        .find(|path| path.is_dir() && !may_enter(path))
        .map(Path::to_path_buf)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn users_are_found_by_number_and_by_name() {
        // A line for NIS has no numbers.
        let passwd = "root:x:0:0:root:/root:/bin/sh\n+::::::\nbob:x:1000:100:Bob:/home/bob:/bin/sh\nbroken\n";
        let group = "root:x:0:\nusers:x:100:\ndialout:x:20:ann,bob\naudio:x:29:ann\n";
        let bob = |gid| {
            Ok(Account {
                uid: 1000,
                gid,
                groups: vec![20],
            })
        };
        let table = [
            ("bob", bob(100)),
            ("1000", bob(100)),
            ("bob:audio", bob(29)),
            ("1000:7", bob(7)),
            ("eve", Err("there is no user `eve` on this host".to_owned())),
            (
                "bob:x",
                Err("there is no group `x` on this host".to_owned()),
            ),
            (
                "7",
                Err("user 7 is not known on this host: write `7:GID`".to_owned()),
            ),
            (
                "7:8",
                Ok(Account {
                    uid: 7,
                    gid: 8,
                    groups: Vec::new(),
                }),
            ),
        ];
        for (text, expected) in table {
            assert_eq!(resolve(text, passwd, group), expected, "{text}");
        }
    }

    #[test]
    fn a_directory_that_is_closed_is_named() {
        let directory = tempfile::tempdir().unwrap();
        let inner = directory.path().join("a");
        fs::create_dir(&inner).unwrap();
        fs::set_permissions(directory.path(), fs::Permissions::from_mode(0o755)).unwrap();
        fs::set_permissions(&inner, fs::Permissions::from_mode(0o700)).unwrap();
        let stranger = Account {
            uid: 60_000,
            gid: 60_000,
            groups: Vec::new(),
        };
        assert_eq!(closed_to(&inner.join("x"), &stranger), Some(inner.clone()));
        let root = Account {
            uid: 0,
            ..stranger.clone()
        };
        assert_eq!(closed_to(&inner.join("x"), &root), None);
        fs::set_permissions(&inner, fs::Permissions::from_mode(0o711)).unwrap();
        assert_eq!(closed_to(&inner.join("x"), &stranger), None);
    }
}
