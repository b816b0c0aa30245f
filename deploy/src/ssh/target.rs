//! Whom to reach and what may be said to its shell: the two places where text becomes something that acts.

use std::fmt;
use std::net::Ipv6Addr;
use std::str::FromStr;

use super::error::SshError;

/// Longest text of a target, longest name of a host (RFC 1035) or user.
const LENGTH_MAX: usize = 255;

/// A host as a person names it: `[user@]host[:port]`.
///
/// Law: `target.to_string().parse() == Ok(target)`. A name never begins with `-` and holds no space, quote or control character, so that it
/// cannot become an option of a program or a word of a shell.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Target {
    /// The user on the host; ssh_config and the local user decide without.
    pub user: Option<String>,
    /// A name, an alias of ssh_config, or an address (IPv6 without brackets).
    pub host: String,
    /// The port; ssh_config and 22 decide without.
    pub port: Option<u16>,
}

impl FromStr for Target {
    type Err = SshError;

    fn from_str(text: &str) -> Result<Self, SshError> {
        let bad = |why| SshError::BadTarget {
            text: text
                .chars()
                .take(LENGTH_MAX)
                .flat_map(char::escape_default)
                .collect(),
            why,
        };
        if text.len() > LENGTH_MAX {
            return Err(bad("it is longer than 255 bytes"));
        }
        let (user, rest) = match text.rsplit_once('@') {
            Some((user, rest)) => (Some(user), rest),
            None => (None, text),
        };
        if let Some(user) = user {
            check_name(user, is_user).map_err(bad)?;
        }
        let (host, port) = split_port(rest).map_err(bad)?;
        if host.parse::<Ipv6Addr>().is_err() {
            check_name(host, is_host).map_err(bad)?;
        }
        Ok(Self {
            user: user.map(str::to_owned),
            host: host.to_owned(),
            port,
        })
    }
}

impl fmt::Display for Target {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(user) = &self.user {
            write!(f, "{user}@")?;
        }
        match (self.host.contains(':'), self.port) {
            (true, Some(port)) => write!(f, "[{}]:{port}", self.host),
            (true, None) => write!(f, "[{}]", self.host),
            (false, Some(port)) => write!(f, "{}:{port}", self.host),
            (false, None) => f.write_str(&self.host),
        }
    }
}

/// Host and port; an address in brackets or with two colons is IPv6.
fn split_port(text: &str) -> Result<(&str, Option<u16>), &'static str> {
    if let Some(rest) = text.strip_prefix('[') {
        let (host, rest) = rest.split_once(']').ok_or("a `[` is not closed")?;
        if host.parse::<Ipv6Addr>().is_err() {
            return Err("what is in brackets is no IPv6 address");
        }
        return match rest.strip_prefix(':') {
            Some(digits) => Ok((host, Some(port(digits)?))),
            None if rest.is_empty() => Ok((host, None)),
            None => Err("only `:port` may follow `]`"),
        };
    }
    match text.split_once(':') {
        Some((_, rest)) if rest.contains(':') => Ok((text, None)),
        Some((host, digits)) => Ok((host, Some(port(digits)?))),
        None => Ok((text, None)),
    }
}

fn port(digits: &str) -> Result<u16, &'static str> {
    let plain = digits.bytes().all(|b| b.is_ascii_digit());
    match digits.parse() {
        Ok(port) if plain && port > 0 => Ok(port),
        Ok(_) | Err(_) => Err("the port is not a number from 1 to 65535"),
    }
}

fn check_name(name: &str, allowed: fn(char) -> bool) -> Result<(), &'static str> {
    if name.is_empty() {
        Err("a name is empty")
    } else if name.starts_with('-') {
        Err("a name may not begin with `-`")
    } else if name.chars().all(allowed) {
        Ok(())
    } else {
        Err("it holds characters that names do not have")
    }
}

fn is_host(c: char) -> bool {
    c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_')
}

fn is_user(c: char) -> bool {
    c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_' | '+')
}

/// The command line that a remote shell gets: words that no shell interprets, with one space between.
///
/// Let through are words of `[A-Za-z0-9_./=:,@+-]` with an optional `~/` in front; the first may not begin with `-`.
///
/// # Errors
/// [`SshError::BadCommand`] names the first other word.
pub(super) fn command_line(words: &[&str]) -> Result<String, SshError> {
    let refuse = |word: &str, why| {
        Err(SshError::BadCommand {
            word: word
                .chars()
                .take(LENGTH_MAX)
                .flat_map(char::escape_default)
                .collect(),
            why,
        })
    };
    for (at, word) in words.iter().enumerate() {
        let plain = word.strip_prefix("~/").unwrap_or(word);
        if word.is_empty() {
            return refuse(word, "it is empty");
        }
        if at == 0 && word.starts_with('-') {
            return refuse(word, "a program's name does not begin with `-`");
        }
        if !plain.chars().all(is_word) {
            return refuse(
                word,
                "only letters, digits and _ . / = : , @ + - are let through, and `~/` in front",
            );
        }
    }
    if words.is_empty() {
        return refuse("", "there is no program");
    }
    Ok(words.join(" "))
}

fn is_word(c: char) -> bool {
    c.is_ascii_alphanumeric() || matches!(c, '_' | '.' | '/' | '=' | ':' | ',' | '@' | '+' | '-')
}

#[cfg(test)]
mod tests {
    use super::{Target, command_line};
    use proptest::prelude::*;

    fn target(user: Option<&str>, host: &str, port: Option<u16>) -> Target {
        Target {
            user: user.map(str::to_owned),
            host: host.to_owned(),
            port,
        }
    }

    #[test]
    fn targets_as_people_write_them() {
        let table = [
            ("pi", target(None, "pi", None)),
            ("robot@10.0.0.11", target(Some("robot"), "10.0.0.11", None)),
            ("pi:2222", target(None, "pi", Some(2222))),
            ("a@[::1]:2222", target(Some("a"), "::1", Some(2222))),
            ("::1", target(None, "::1", None)),
            ("[fe80::1]", target(None, "fe80::1", None)),
            (
                "a.b+c@x_y-z.example",
                target(Some("a.b+c"), "x_y-z.example", None),
            ),
        ];
        for (text, expected) in table {
            assert_eq!(text.parse(), Ok(expected), "{text}");
        }
    }

    #[test]
    fn targets_that_could_act_are_refused() {
        for text in [
            "",
            "@",
            "a@",
            "@h",
            "-oProxyCommand=x",
            "a@-oX",
            "-a@h",
            "h h",
            "h\n",
            "h:0",
            "h:65536",
            "h:+1",
            "h:",
            "a b@h",
            "[::1",
            "[::1]x",
            "[x]:1",
            "h;id",
            "$(id)",
            "a'@h",
            "h/..",
            "1:2:3",
            "\u{e9}",
            "h\u{0}",
        ] {
            assert!(text.parse::<Target>().is_err(), "{text:?}");
        }
    }

    #[test]
    fn commands_that_a_shell_would_interpret_are_refused() {
        for word in [
            "", "a b", "a;b", "$x", "`x`", "a|b", ">x", "*", "?", "a~", "~root/x", "~", "(", "\\",
            "'", "\"", "\n", "#", "!x", "{a}", "&",
        ] {
            assert!(command_line(&["echo", word]).is_err(), "{word:?}");
        }
        assert!(command_line(&[]).is_err());
        assert!(command_line(&["-x"]).is_err());
        assert_eq!(
            command_line(&["~/.local/bin/ictus", "dial-stdio", "--x=a,b:c@d+e"]).unwrap(),
            "~/.local/bin/ictus dial-stdio --x=a,b:c@d+e"
        );
    }

    proptest! {
        #[test]
        fn a_target_reads_as_it_prints(text in "([a-z-]{0,3}@)?(\\[?[0-9a-f:.]{0,9}\\]?|[ -~]{0,12})(:[0-9]{0,6})?") {
            if let Ok(target) = text.parse::<Target>() {
                prop_assert_eq!(target.to_string().parse::<Target>().unwrap(), target.clone());
                prop_assert!(!target.host.starts_with('-') && !target.host.contains(char::is_whitespace));
            }
        }

        #[test]
        fn no_text_breaks_the_parsers(text in "\\PC{0,40}") {
            drop(text.parse::<Target>());
            if let Ok(line) = command_line(&["x", &text]) {
                prop_assert!(!line.contains(['\'', '"', '$', '`', ';', '|', '&', '<', '>', '\n', '*', '?', '(']));
            }
        }
    }
}
