//! What `ictus host add` puts on a host, and what it does there as root.

#![expect(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use std::fs;

use ictus_tests::ictus;
use ictus_tests::rig::{Host, Rig};
use sha2::{Digest, Sha256};

use super::Scenario;
use super::operator::{Operator, target};

/// In this order.
pub(crate) const SCENARIOS: &[Scenario] = &[
    (
        "a_missing_docker_is_installed_when_asked_for",
        a_missing_docker_is_installed_when_asked_for,
    ),
    (
        "a_docker_that_cannot_be_installed_is_said_with_the_commands",
        a_docker_that_cannot_be_installed_is_said_with_the_commands,
    ),
    (
        "a_newer_ictusd_is_not_replaced",
        a_newer_ictusd_is_not_replaced,
    ),
    (
        "a_program_is_sent_compressed_and_arrives_whole_or_not_at_all",
        a_program_is_sent_compressed_and_arrives_whole_or_not_at_all,
    ),
];

/// Where the program stands, from the user's home.
const BIN: &str = ".local/share/ictus/bin";

/// Takes the engine's program away, stopped, and the user out of its group.
fn take_docker(host: &Host) {
    const SCRIPT: &str = "cp -a /etc/group /etc/group- /etc/gshadow /etc/gshadow- /small
        mv /usr/sbin/dockerd /usr/sbin/dockerd.away
        gpasswd -d robot docker";
    host.stop_docker();
    host.exec(&["sh", "-ec", SCRIPT]);
}

/// Gives all of it back, whoever has started an engine meanwhile.
fn give_docker_back(host: &Host) {
    const SCRIPT: &str = "cd /small
        for file in group group- gshadow gshadow-; do rm /etc/$file; cp -a $file /etc; done
        [ -e /usr/sbin/dockerd ] || mv /usr/sbin/dockerd.away /usr/sbin/dockerd";
    host.stop_docker();
    host.exec(&["sh", "-ec", SCRIPT]);
    host.empty_disk();
    host.start_docker();
}

/// What a test host lacks: a `sudo` that lets everybody, an `apt-get` with a package, services. What they are asked is
/// written down.
fn give_root(host: &Host) {
    const SCRIPT: &str = r#"cp /usr/bin/setpriv /usr/local/lib/rig-root
        chmod 4755 /usr/local/lib/rig-root
        cd /usr/local/bin
        cat >sudo <<'END'
#!/bin/sh
[ "$1" = -n ] || exit 1
shift
export PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
exec /usr/local/lib/rig-root --reuid=0 --regid=0 --clear-groups "$@"
END
        cat >apt-get <<'END'
#!/bin/sh
echo "$(id -un): $DEBIAN_FRONTEND apt-get $*" >>/small/record
[ "$1" = install ] || exit 100
mv /usr/sbin/dockerd.away /usr/sbin/dockerd
END
        cat >service <<'END'
#!/bin/sh
echo "$(id -un): service $*" >>/small/record
exec host start-docker
END
        chmod 755 sudo apt-get service"#;
    host.exec(&["sh", "-ec", SCRIPT]);
}

fn take_root(host: &Host) {
    let script = "cd /usr/local; rm bin/sudo bin/apt-get bin/service lib/rig-root";
    host.exec(&["sh", "-ec", script]);
}

fn a_missing_docker_is_installed_when_asked_for(rig: &Rig) {
    /// An update that fails is only told: what is known from before may do.
    const ASKED: &str = "root:  apt-get update\n\
         root: noninteractive apt-get install --yes --no-install-recommends docker.io\n\
         root: service docker start\n";
    let hosts = &rig.hosts()[..1];
    let (host, at) = (&hosts[0], target(&hosts[0]));
    let operator = Operator::new(rig);
    take_docker(host);
    let without = operator.ok(&["host", "add", &at, "--accept-new"]);
    for words in [
        "no Docker engine: /var/run/docker.sock is not there",
        "--install-docker",
    ] {
        assert!(without.contains(words), "{words} is missing in {without}");
    }
    give_root(host);
    let add = ["host", "add", &at, "--install-docker"];
    let said = operator.ok(&add);
    for words in [
        "`sudo -n apt-get update` failed",
        "sudo -n usermod -aG docker robot",
        "\n  Docker 20.10",
    ] {
        assert!(said.contains(words), "{words} is missing in {said}");
    }
    assert_eq!(host.exec(&["cat", "/small/record"]), ASKED);
    assert!(host.exec(&["id", "-nG", "robot"]).contains("docker"));
    let again = operator.ok(&add);
    assert!(again.contains(": version 20.10"), "{again}");

    // The engine is there, but not for a daemon that begins now.
    host.exec(&["gpasswd", "-d", "robot", "docker"]);
    host.exec(&["pkill", "-KILL", "-f", "[i]ctusd daemon"]);
    let denied = operator.ok(&["host", "check", &at]);
    for words in ["may not use the Docker engine", "--install-docker"] {
        assert!(denied.contains(words), "{words} is missing in {denied}");
    }
    let said = operator.ok(&add);
    assert!(said.contains("\n  Docker 20.10"), "{said}");
    assert_eq!(host.exec(&["cat", "/small/record"]), ASKED, "nothing more");

    operator.remove(hosts);
    take_root(host);
    give_docker_back(host);
}

fn a_docker_that_cannot_be_installed_is_said_with_the_commands(rig: &Rig) {
    let hosts = &rig.hosts()[..1];
    let (host, at) = (&hosts[0], target(&hosts[0]));
    let operator = Operator::new(rig);
    take_docker(host);
    let add = ["host", "add", &at, "--accept-new", "--install-docker"];
    let said = operator.fails(&add, 1);
    for words in [
        "user `robot` is not root and may not use `sudo` without a password",
        "run there: `sudo apt-get update`, `sudo env DEBIAN_FRONTEND=noninteractive apt-get install --yes \
         --no-install-recommends docker.io`, `sudo usermod -aG docker robot`, `sudo service docker start`; then run this \
         again",
    ] {
        assert!(said.contains(words), "{words} is missing in {said}");
    }
    give_root(host);
    let os = |edit: &str| host.exec(&["sed", "-i", edit, "/usr/lib/os-release"]);
    os("s/^ID=debian/ID=fedora/; s/Debian/Fedora/");
    let said = operator.fails(&add, 1);
    os("s/^ID=fedora/ID=debian/; s/Fedora/Debian/");
    for words in [
        "host `robot@10.",
        " runs Fedora GNU/Linux 12 (bookworm): Docker is installed from here on Debian and Ubuntu only",
        "docs.docker.com/engine/install",
        "`sudo usermod -aG docker robot`",
    ] {
        assert!(said.contains(words), "{words} is missing in {said}");
    }
    let asked = host.output(&["test", "-e", "/small/record"]);
    assert!(!asked.status.success(), "nothing was done there");
    operator.remove(hosts);
    take_root(host);
    give_docker_back(host);
}

fn a_newer_ictusd_is_not_replaced(rig: &Rig) {
    const NEWER: &str = r#"mkdir -p "$1"; cd "$1"; rm -f ictusd; printf '#!/bin/sh\necho ictus 9.1.0\n' >ictusd; chmod 755 ictusd"#;
    let hosts = &rig.hosts()[..1];
    let (host, at) = (&hosts[0], target(&hosts[0]));
    let operator = Operator::new(rig);
    host.exec_as_robot(&["sh", "-ec", NEWER, "sh", BIN]);
    let said = operator.fails(&["host", "add", &at, "--accept-new"], 1);
    for words in ["has ictusd 9.1.0, which is newer than", "`ictus host rm"] {
        assert!(said.contains(words), "{words} is missing in {said}");
    }
    let there = host.exec_as_robot(&["sh", "-c", "cat $1/*", "sh", BIN]);
    assert!(there.contains("9.1.0"), "it is as it was: {there}");
    // Nor is one that is older, or broken, in the way.
    for older in ["s/9.1.0/0.0.9/", "s/echo.*/exit 1/"] {
        host.exec_as_robot(&["sed", "-i", older, &format!("{BIN}/ictusd")]);
        operator.add(hosts);
        host.exec_as_robot(&["sh", "-ec", NEWER, "sh", BIN]);
    }
    host.exec_as_robot(&["rm", &format!("{BIN}/ictusd")]);
    operator.add(hosts);
    operator.remove(hosts);
}

fn a_program_is_sent_compressed_and_arrives_whole_or_not_at_all(rig: &Rig) {
    /// A `gzip` of which only this much works.
    const GZIP: &str =
        r#"printf '#!/bin/sh\n%s\n' "$1" >/usr/local/bin/gzip; chmod 755 /usr/local/bin/gzip"#;
    let hosts = &rig.hosts()[..1];
    let (host, at) = (&hosts[0], target(&hosts[0]));
    let operator = Operator::new(rig);
    let program = fs::read(ictus()).unwrap();
    let digest: String = Sha256::digest(&program)
        .iter()
        .map(|byte| format!("{byte:02x}"))
        .collect();
    // What is there, with its mode.
    let there = || {
        let script = r#"cd "$1"; sha256sum *; stat -c %a *"#;
        host.exec_as_robot(&["sh", "-ec", script, "sh", BIN])
    };
    let whole = format!("{digest}  ictusd\n755\n");
    let megabytes = |text: &str| -> f64 {
        let (_, rest) = text.split_once(&format!("{BIN}/ictusd (")).unwrap();
        let (_, sent) = rest.split_once(" MB, ").unwrap();
        sent.split(' ').next().unwrap().parse().unwrap()
    };
    let add = ["host", "add", &at, "--accept-new"];
    let sent = megabytes(&operator.ok(&add));
    assert_eq!(there(), whole);

    host.exec(&["sh", "-c", GZIP, "sh", "exit 1"]);
    let plain = megabytes(&operator.ok(&add));
    assert!(sent < plain * 0.6, "{sent} of {plain}");
    assert_eq!(there(), whole);

    let broken = r#"[ "$1" = --version ] || { echo no space >&2; exit 1; }"#;
    host.exec(&["sh", "-c", GZIP, "sh", broken]);
    let said = operator.fails(&add, 1);
    assert!(said.contains("failed: no space"), "{said}");
    assert_eq!(
        there(),
        whole,
        "what was there is there, and nothing beside it"
    );

    host.exec(&["rm", "/usr/local/bin/gzip"]);
    operator.remove(hosts);
}
