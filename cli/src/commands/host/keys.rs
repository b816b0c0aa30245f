//! Keys that let somebody in with a fixed command: without `restrict` they let in to everything else, too.

/// A line of `authorized_keys` that fixes our command and restricts nothing, with its number and the fix.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Unrestricted {
    /// From 1.
    pub(super) line: usize,
    /// The key's comment, or the end of the key.
    pub(super) whose: String,
}

/// Looks for such lines.
pub(super) fn unrestricted(authorized_keys: &str) -> Vec<Unrestricted> {
    let lines = authorized_keys.lines().zip(1..);
    let found = lines.filter_map(|(text, line)| {
        let text = text.trim();
        let (options, key) = text.split_at(end_of_options(text));
        let all = split(options);
        let ours = |option: &&str| option.starts_with("command=") && option.contains("dial-stdio");
        let fixed = all.iter().any(|option| ours(&option.trim()));
        let restricted = all.iter().any(|option| option.trim() == "restrict");
        let whose = key.split_whitespace().last().unwrap_or_default();
        (!text.starts_with('#') && fixed && !restricted).then(|| Unrestricted {
            line,
            whose: whose.to_owned(),
        })
    });
    found.collect()
}

/// Where the options of a line end: at the first blank that is not in quotes; a line may have none.
fn end_of_options(line: &str) -> usize {
    let (mut quoted, mut escaped) = (false, false);
    for (index, c) in line.char_indices() {
        match c {
            '"' if !escaped => quoted = !quoted,
            ' ' | '\t' if !quoted => return index,
            _ => {}
        }
        escaped = c == '\\' && !escaped;
    }
    line.len()
}

/// Options are separated by commas outside quotes.
fn split(options: &str) -> Vec<&str> {
    let (mut quoted, mut escaped, mut start) = (false, false, 0);
    let mut all = Vec::new();
    for (index, c) in options.char_indices() {
        match c {
            '"' if !escaped => quoted = !quoted,
            ',' if !quoted => {
                all.push(&options[start..index]);
                start = index + 1;
            }
            _ => {}
        }
        escaped = c == '\\' && !escaped;
    }
    all.push(&options[start..]);
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fixed_command_without_restrict_is_found() {
        let table = [
            ("ssh-ed25519 AAAA ann", false),
            (
                "restrict,command=\"~/x/ictusd dial-stdio --viewer\" ssh-ed25519 AAAA bob",
                false,
            ),
            (
                "command=\"~/x/ictusd dial-stdio --viewer\",restrict ssh-ed25519 AAAA bob",
                false,
            ),
            (
                "command=\"~/x/ictusd dial-stdio --viewer\" ssh-ed25519 AAAA bob",
                true,
            ),
            (
                "no-pty,command=\"ictusd dial-stdio\" ssh-rsa AAAA bob",
                true,
            ),
            // The word within the command is no option.
            (
                "command=\"ictusd dial-stdio, restrict,\" ssh-rsa AAAA bob",
                true,
            ),
            (
                "command=\"echo \\\",restrict,\\\" dial-stdio\" ssh-rsa AAAA bob",
                true,
            ),
            ("command=\"/usr/bin/borg\" ssh-rsa AAAA bob", false),
            ("# command=\"ictusd dial-stdio\" ssh-rsa AAAA bob", false),
            ("", false),
        ];
        for (line, found) in table {
            assert_eq!(!unrestricted(line).is_empty(), found, "{line}");
        }
        let text = "\nssh-rsa A a\ncommand=\"ictusd dial-stdio\" ssh-rsa AAAA bob@far\n";
        let found = unrestricted(text);
        assert_eq!((found[0].line, found[0].whose.as_str()), (3, "bob@far"));
    }
}
