//! The parts of ssh_config that the built-in client follows; what it cannot follow is an error, never ignored silently.

use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use super::error::SshError;
use super::known_hosts::matches;

/// What the file says about one host: the first value of each keyword wins, identity files add up.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct HostConfig {
    pub(super) host_name: Option<String>,
    pub(super) user: Option<String>,
    pub(super) port: Option<u16>,
    pub(super) identities: Vec<PathBuf>,
    pub(super) proxy_jump: Option<String>,
    pub(super) known_hosts: Option<Vec<PathBuf>>,
}

/// Reads the file for a host alias; one that does not exist says nothing.
pub(super) fn read(file: &Path, alias: &str, home: Option<&Path>) -> Result<HostConfig, SshError> {
    match fs::read_to_string(file) {
        Ok(text) => parse(file, &text, alias, home),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(HostConfig::default()),
        Err(error) => Err(SshError::Config {
            file: file.to_owned(),
            line: 0,
            what: format!("cannot read it: {error}; make it readable for you"),
        }),
    }
}

/// Reads the text of the file for a host alias. `home` is what `~/` and `%d` stand for.
fn parse(
    file: &Path,
    text: &str,
    alias: &str,
    home: Option<&Path>,
) -> Result<HostConfig, SshError> {
    let mut config = HostConfig::default();
    let mut applies = true;
    for (line, text) in (1..).zip(text.lines()) {
        let here = |what: String| SshError::Config {
            file: file.to_owned(),
            line,
            what,
        };
        let words = words(text).map_err(|what| here(what.to_owned()))?;
        let Some((keyword, values)) = words.split_first() else {
            continue;
        };
        let keyword = keyword.to_ascii_lowercase();
        if keyword == "host" {
            applies = host_matches(values, alias);
            continue;
        }
        if ["include", "match"].contains(&keyword.as_str()) {
            return Err(here(format!(
                "`{}` is not read by the built-in client; say `client: system` in the host's entry to use the system's ssh",
                words[0]
            )));
        }
        if applies {
            let expand = Expand { alias, home };
            config.set(&keyword, values, &expand).map_err(here)?;
        }
    }
    Ok(config)
}

impl HostConfig {
    fn set(&mut self, keyword: &str, values: &[String], expand: &Expand<'_>) -> Result<(), String> {
        let first = || {
            values
                .first()
                .ok_or_else(|| format!("`{keyword}` has no value"))
        };
        match keyword {
            "hostname" => keep(&mut self.host_name, expand.host(first()?)?),
            "user" => keep(&mut self.user, first()?.clone()),
            "port" => {
                let port = first()?.parse().ok().filter(|port| *port > 0);
                keep(
                    &mut self.port,
                    port.ok_or("`Port` is not a number from 1 to 65535")?,
                );
            }
            "identityfile" if first()? != "none" => self.identities.push(expand.path(first()?)?),
            "proxyjump" => keep(&mut self.proxy_jump, first()?.clone()),
            "userknownhostsfile" => {
                let files = values.iter().filter(|value| *value != "none");
                let files: Result<_, _> = files.map(|value| expand.path(value)).collect();
                keep(&mut self.known_hosts, files?);
            }
            "proxycommand"
            | "hostkeyalias"
            | "certificatefile"
            | "pkcs11provider"
            | "canonicalizehostname"
                if !first()?.eq_ignore_ascii_case("none")
                    && !first()?.eq_ignore_ascii_case("no") =>
            {
                return Err(format!(
                    "`{keyword}` is not understood by the built-in client; say `client: system` in the host's entry to use the system's ssh"
                ));
            }
            // What is left changes comfort, not whom we reach or trust.
            _ => {}
        }
        Ok(())
    }
}

/// The first value wins.
fn keep<T>(slot: &mut Option<T>, value: T) {
    slot.get_or_insert(value);
}

/// What tokens and `~` stand for.
#[derive(Debug)]
struct Expand<'a> {
    alias: &'a str,
    home: Option<&'a Path>,
}

impl Expand<'_> {
    fn host(&self, value: &str) -> Result<String, String> {
        let name = value.replace("%h", self.alias);
        if name.contains('%') {
            return Err(format!(
                "only `%h` is understood in `HostName {value}`; write the name out"
            ));
        }
        Ok(name)
    }

    fn path(&self, value: &str) -> Result<PathBuf, String> {
        let (below, rest) = match (value.strip_prefix("~/"), value.strip_prefix("%d/")) {
            (Some(rest), _) | (None, Some(rest)) => (true, rest),
            (None, None) => (false, value),
        };
        if rest.contains('%') || rest.contains("${") || rest.starts_with('~') {
            return Err(format!(
                "only `~/` and `%d/` in front are understood in `{value}`; write the path out"
            ));
        }
        match (below, self.home) {
            (true, None) => Err(format!(
                "`{value}` is below the home directory, and HOME is not set"
            )),
            (true, Some(home)) => Ok(home.join(rest)),
            (false, _) => Ok(PathBuf::from(rest)),
        }
    }
}

/// Whether the patterns of a `Host` line name the alias: one does, and no `!pattern` does.
fn host_matches(patterns: &[String], alias: &str) -> bool {
    let denied = patterns
        .iter()
        .filter_map(|pattern| pattern.strip_prefix('!'))
        .any(|pattern| matches(pattern, alias));
    !denied && patterns.iter().any(|pattern| matches(pattern, alias))
}

/// The words of a line: `keyword value...` or `keyword=value`, values in double quotes may hold spaces, `#` begins a comment.
fn words(line: &str) -> Result<Vec<String>, &'static str> {
    let mut words = Vec::new();
    let mut rest = line.trim();
    while !rest.is_empty() && !rest.starts_with('#') {
        let word;
        if let Some(quoted) = rest.strip_prefix('"') {
            (word, rest) = quoted
                .split_once('"')
                .ok_or("a `\"` is not closed; close it")?;
        } else {
            let keyword = words.is_empty();
            let end = rest
                .find(|c: char| c.is_whitespace() || (keyword && c == '='))
                .unwrap_or(rest.len());
            (word, rest) = rest.split_at(end);
        }
        let keyword = words.is_empty();
        words.push(word.to_owned());
        rest = rest.trim_start();
        if keyword {
            rest = rest.strip_prefix('=').unwrap_or(rest).trim_start();
        }
    }
    Ok(words)
}

#[cfg(test)]
mod tests {
    use super::{HostConfig, parse};
    use crate::ssh::SshError;
    use proptest::prelude::*;
    use std::path::{Path, PathBuf};

    fn read(text: &str, alias: &str) -> Result<HostConfig, SshError> {
        parse(
            Path::new("config"),
            text,
            alias,
            Some(Path::new("/home/me")),
        )
    }

    #[test]
    fn the_first_value_wins_and_identities_add_up() {
        let text = "\
# comment
User=everyone
Host pi  # the one in the lab
    HostName 10.0.0.11
    Port 2222
    IdentityFile ~/.ssh/lab
Host p* !po
    User late
    port = 22
    IdentityFile \"/keys/with space\"
    ProxyJump gate@door:22
    UserKnownHostsFile ~/.ssh/a %d/b
    ForwardAgent yes
Host po
    HostName %h.example
";
        let pi = read(text, "pi").unwrap();
        assert_eq!(
            pi,
            HostConfig {
                host_name: Some("10.0.0.11".to_owned()),
                user: Some("everyone".to_owned()),
                port: Some(2222),
                identities: vec![
                    PathBuf::from("/home/me/.ssh/lab"),
                    PathBuf::from("/keys/with space")
                ],
                proxy_jump: Some("gate@door:22".to_owned()),
                known_hosts: Some(vec![
                    PathBuf::from("/home/me/.ssh/a"),
                    PathBuf::from("/home/me/b")
                ]),
            }
        );
        let po = read(text, "po").unwrap();
        assert_eq!(po.host_name.as_deref(), Some("po.example"));
        assert_eq!(po.proxy_jump, None);
    }

    #[test]
    fn what_is_not_understood_is_an_error_with_its_line() {
        let table = [
            ("\nInclude other", 2, "client: system"),
            ("Host x\nMatch all", 2, "client: system"),
            ("Host *\n ProxyCommand nc %h %p", 2, "client: system"),
            ("HostKeyAlias x", 1, "client: system"),
            ("Port 0", 1, "65535"),
            ("Port", 1, "no value"),
            ("HostName %n", 1, "write the name out"),
            ("IdentityFile ~other/key", 1, "write the path out"),
            ("IdentityFile \"x", 1, "close it"),
        ];
        for (text, expected, says) in table {
            match read(text, "pi") {
                Err(SshError::Config { line, what, .. }) => {
                    assert_eq!(line, expected, "{text}");
                    assert!(what.contains(says), "{text}: {what}");
                }
                other => panic!("{text}: {other:?}"),
            }
        }
        read(
            "Host other\n ProxyCommand nc\nHost pi\n ProxyCommand none",
            "pi",
        )
        .unwrap();
    }

    proptest! {
        #[test]
        fn no_text_breaks_the_reader(text in "((Host|Port|User|HostName|IdentityFile|#|\"|=|%|~/)? ?\\PC{0,6}\n?){0,12}") {
            drop(read(&text, "pi"));
        }

        #[test]
        fn a_block_for_another_host_changes_nothing(host in "[a-z]{1,6}", other in "[A-Z]{1,6}", port in 1_u16..) {
            let mine = format!("Host {host}\nPort {port}\n");
            let both = format!("Host {other}\nPort 7\nUser x\nProxyCommand y\n{mine}");
            prop_assert_eq!(read(&mine, &host).unwrap(), read(&both, &host).unwrap());
        }
    }
}
