//! The codes of problems and what they mean.

/// Tells what a code means and what to do, in a paragraph; absent for an unknown code.
#[must_use]
pub fn explain(code: &str) -> Option<&'static str> {
    CODES
        .iter()
        .find(|(have, _)| have.eq_ignore_ascii_case(code))
        .map(|(_, text)| *text)
}

/// Every code, in order.
pub(crate) const CODES: &[(&str, &str)] = &[
    (
        "F000",
        "There are more mistakes than are worth showing. Mend those above and check again.",
    ),
    (
        "F001",
        "The file cannot be read, or is not YAML. The place is where the reader gave up; the \
         mistake often stands a line before it: a missing colon, a bracket or quote that is not \
         closed, a tab in the indentation.",
    ),
    (
        "F002",
        "A mapping has the same key twice, for example two federates of one name. YAML readers \
         would silently keep one of them, so this is refused. Rename or remove one.",
    ),
    (
        "F003",
        "A key that the manifest does not know. Often a typing error, or a key at the wrong depth. \
         `ictus schema` prints every key with its meaning.",
    ),
    (
        "F004",
        "A key that must be given is missing. `ictus schema` lists the required ones.",
    ),
    (
        "F005",
        "A value of the wrong kind, an unknown word, or a number out of range. A text that looks \
         like a number or a boolean needs quotes: `\"10\"`.",
    ),
    (
        "F006",
        "A duration or size that cannot be read. Both need a unit, also for zero: `10 ms`, `0 s`, \
         `10 MiB`. Units of time: ns, us, ms, s, min, h. Units of size: B, kB, KiB, MB, MiB, GB, \
         GiB. Nothing is negative or infinite, and an offset, or a bound that \
         one is made of, is at most an hour.",
    ),
    (
        "F007",
        "A value `$name` stands for the value of `let.name`, which `--set name=value` may replace. \
         There is no such name in `let`. For a text that begins with a dollar sign, write `$$`.",
    ),
    (
        "F008",
        "Names of federations, programs, federates, ports and parameters are a letter followed by \
         letters, digits, `_` or `-`, at most 64 in all: they become file names and parts of paths. No federate is called `rti`: that is the coordinator.",
    ),
    (
        "F009",
        "A federate names a program that `programs` does not have.",
    ),
    (
        "F010",
        "The program has no reactor class of that name. `PROGRAM --describe` lists its classes; a \
         class must stand in the program's `ictus::program!` line.",
    ),
    (
        "F011",
        "A connection or report names a federate that `federates` does not have.",
    ),
    (
        "F012",
        "The federate's class has no port of that name. `PROGRAM --describe` lists ports; those of \
         a foreign federate are the manifest's `ports`.",
    ),
    (
        "F013",
        "A connection leads from an output to an input. One of its ends is the other way round.",
    ),
    (
        "F014",
        "Two connected ports have different types. Types are equal when their declared name and \
         their layout (field names, types and order) are equal.",
    ),
    (
        "F015",
        "An input, or a channel of it, has two connections. An input has at most one sender; give \
         the receiver a multiport and connect each sender to a channel.",
    ),
    (
        "F016",
        "The serializer is unknown, or one of the ports does not offer it. `native` copies plain \
         old data between our own federates and LF's; `postcard` needs serde on the type.",
    ),
    (
        "F017",
        "A channel is out of range, or multiports of different widths are connected as a whole. \
         Name channels (`federate.port[2]`) or make the widths equal.",
    ),
    (
        "F018",
        "Values would have to pass around a loop without logical time passing: every connection of \
         it has no `after`, and every federate on it reacts to its input at the same tag. Give one \
         connection an `after`; `after: 0 s` is one microstep and enough.",
    ),
    (
        "F019",
        "`fast` runs ahead of physical time, but something depends on it: a physical action, a \
         physical connection, or decentralized coordination, under which federates wait by their \
         clocks. Remove `fast`, or the other.",
    ),
    (
        "F020",
        "The ids of foreign federates are compiled in. They must differ, and lie below the number \
         of federates; our own federates take the ids that are left.",
    ),
    (
        "F021",
        "A program cannot be built. The compiler's first error is shown; `cargo build` in the \
         package's folder shows all.",
    ),
    (
        "F022",
        "A program was asked what it consists of (`PROGRAM --describe`) and did not answer: it \
         crashed, took too long, or printed something else. It runs with a closed standard input, \
         an environment of PATH and HOME only, a time limit and an output limit.",
    ),
    ("F023", "A federation has at least one federate."),
    (
        "F024",
        "The class does not have such a parameter, needs one that is not given, or does not accept \
         its value.",
    ),
    (
        "F025",
        "A federate is either ours (`program` and `class`) or foreign (`binary`, `id` and \
         `ports`), never both.",
    ),
    (
        "F026",
        "The `timing` section names a reaction that does not exist, or a chain whose steps no \
         connection joins. Reactions are named `federate.reaction`, or `federate.reactor.reaction` \
         for one of a contained reactor.",
    ),
    (
        "F027",
        "A program is either a cargo package (`package`) or an executable that exists (`binary`); \
         paths are relative to the manifest.",
    ),
    (
        "F028",
        "Under decentralized coordination a federate waits an offset for what may still come. It is \
         declared (`stp_offset: 5 ms`) or solved (`auto`) from three bounds of every connection to \
         it: `launch_lag`, `latency` and `clock_error`. They stand in `bounds`, for all connections \
         or under `links` for those between two federates, or at a connection itself; `launch_lag` \
         also at the sender. `ictus timing --suggest` prints measured ones.",
    ),
    (
        "F029",
        "Offsets are the least solution of S_j = max(0, S_i + L + N + E - after), and here there is \
         none. Around a cycle of connections a message becomes later each time, because launch \
         lags, latencies and clock errors add up to more than the `after` delays; so no federate of \
         it can wait long enough. Give the cycle more `after`, declare smaller bounds if they hold, \
         or coordinate centrally. An offset of more than an hour is refused too: it is a mistake.",
    ),
    (
        "F030",
        "Something is to run on a host that `hosts` does not have, or does not say where it runs. With \
         one host everything runs there; with several, each federate and the coordinator names one \
         (`host:`, `rti: { host: }`), or `defaults: { host: }` holds for those that do not.",
    ),
    (
        "F031",
        "A host is either this machine (`local: true`) or reached over ssh (`ssh: [USER@]HOST[:PORT]`, or \
         an alias of ssh_config). Letters, digits and `._-` make a name, and nothing begins with `-`, so \
         that no part of a manifest can be an option or a command.",
    ),
    (
        "F032",
        "`hosts.NAME.address` is where the federates of a host are reached by those of the others: an IPv4 \
         address in the network that they share, because Lingua Franca's messages have four bytes for it. \
         A name is resolved once, here. Left out, it is the address in `ssh`; an alias or a loopback \
         address does not say it. Each host is another machine with another address.",
    ),
    (
        "F033",
        "`hosts.NAME.ports` is a range such as `15045-15099`, both ends included, of at most 10000 ports. \
         The coordinator's port must be one of them, and there must be one for every member of the host \
         that listens: the coordinator, and each federate when messages go from federate to federate.",
    ),
    (
        "F034",
        "Messages between hosts are under TLS, with certificates that `ictus up` makes for each run \
         (`security: mtls`, the default). Lingua Franca's federates, which have a `binary` or an `image` and an \
         `id`, speak none: with one of them `security: trusted-network` says that all goes in clear text, and \
         that this is known: whoever is in the hosts' network can read messages, join the federation and stop it.",
    ),
    (
        "F035",
        "Limits of memory and processes, devices, volumes and images are given by containers: the host of \
         such a federate has `engine: docker`. Processors, realtime scheduling, variables and secrets work \
         with both engines.",
    ),
    (
        "F036",
        "What a federate needs from its host cannot be given so: a path that is not absolute or has a `..`, \
         a volume over what is Ictus' own (`/ictus`, `/.ictus`, `/app`, `/`), a user or image whose name \
         has no such form, a folder to build without its Dockerfile, too little memory, a processor named twice.",
    ),
    (
        "F037",
        "A file of environment variables cannot be read. Each line is `KEY=VALUE`, empty, or a comment \
         after `#`. A value may stand in single quotes, where every character is itself, or in double ones, \
         where `\\n`, `\\r`, `\\t`, `\\\"`, `\\\\` and `\\$` are escapes. Nothing is replaced: `$NAME` stays as it is. \
         Messages never show a value.",
    ),
    (
        "F038",
        "A secret is a name, whose value is read from the environment when the federation is started, or \
         `{ name, file }`. The federate finds it in a file that `NAME_FILE` names. It is never an environment \
         variable of the federate, because those can be read from outside.",
    ),
    (
        "F039",
        "A program is built on this machine and asked here what it consists of, so it can only go to hosts \
         of the same architecture. Prebuilt Lingua Franca federates and images may be of another one.",
    ),
    (
        "F045",
        "`deploy: compose` has docker-compose start everything on this machine, and `hosts` names others. \
         Those are the daemons' work: leave `deploy` out.",
    ),
    (
        "W001",
        "No connection leads to an input, so its reactions will not run.",
    ),
    ("W002", "Nothing uses this name."),
    (
        "W003",
        "The key does nothing here: offsets belong to decentralized coordination, `max_lead` to \
         centralized; a federate without inputs waits for nobody; a physical connection has no tag to be late for; a foreign federate cannot be \
         told; without clock synchronization no error is measured.",
    ),
    (
        "W004",
        "The declared offset is smaller than the bounds require, so messages that keep all their \
         bounds may come too late. That is legal: availability before consistency. Every violation \
         is counted.",
    ),
    (
        "W005",
        "The offset of a foreign federate is compiled in. The one shown here is what it needs; \
         what it has, only its `stp_offset` in the manifest says, and its receivers' offsets are \
         solved with that.",
    ),
    (
        "W006",
        "With engine process, only a daemon that runs as root can start a federate as another user.",
    ),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_are_sorted_and_explained() {
        assert!(CODES.windows(2).all(|pair| pair[0].0 < pair[1].0));
        assert!(explain("f012").is_some_and(|text| text.contains("port")));
        assert_eq!(explain("F999"), None);
    }

    /// Every code that is reported is explained, and the reverse.
    #[test]
    fn every_code_is_used() {
        let dir = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
        let mut used = std::collections::BTreeSet::new();
        for entry in std::fs::read_dir(dir).unwrap() {
            let path = entry.unwrap().path();
            if path.extension().is_none() || path.ends_with("codes.rs") {
                continue;
            }
            let text = std::fs::read_to_string(path).unwrap();
            for piece in text.split('"').filter(|piece| piece.len() == 4) {
                if piece.starts_with(['F', 'W']) && piece[1..].bytes().all(|b| b.is_ascii_digit()) {
                    used.insert(piece.to_owned());
                }
            }
        }
        let known: Vec<&str> = CODES.iter().map(|(code, _)| *code).collect();
        assert_eq!(used.iter().map(String::as_str).collect::<Vec<_>>(), known);
    }
}
