//! The installation for a whole host.

#![expect(
    clippy::unwrap_used,
    clippy::panic,
    reason = "a test stops at the first surprise"
)]

use std::fs;

use ictus_tests::rig::{Host, Rig};
use ictus_tests::{ictus, said};
use serde_json::Value;

use super::Scenario;
use super::operator::{Operator, target, verify};
use super::secrets::{CANARY, FROM_FILE, manifest};
use super::tls::diamond;

/// In this order.
pub(crate) const SCENARIOS: &[Scenario] = &[
    (
        "one_installation_serves_a_whole_host",
        one_installation_serves_a_whole_host,
    ),
    (
        "no_federate_is_root_unless_the_host_allows_it",
        no_federate_is_root_unless_the_host_allows_it,
    ),
    (
        "where_there_is_systemd_it_starts_ictusd",
        where_there_is_systemd_it_starts_ictusd,
    ),
];

const PROGRAM: &str = "/usr/local/lib/ictus/ictusd";
const RUN_AS: &str = "ictus-run";

/// Lets `robot` do everything by `sudo`, and keeps what user management changes.
fn let_in(host: &Host) {
    host.script(
        "mkdir /var/cache/rig && cp -a /etc/passwd* /etc/group* /etc/shadow* /etc/gshadow* /etc/sub* /var/cache/rig/\n\
         echo 'robot ALL=(ALL) NOPASSWD: ALL' > /etc/sudoers.d/robot\n",
        &[],
    );
}

/// Sees that user and group are gone, and takes the rights back.
fn leave(host: &Host) {
    for (kind, name) in [("passwd", RUN_AS), ("group", RUN_AS), ("group", "ictus")] {
        let found = host.output(&["getent", kind, name]);
        assert_eq!(found.status.code(), Some(2), "{}", said(&found));
    }
    // Tools of user management leave copies of what was.
    host.script(
        "rm -f /etc/sudoers.d/robot /etc/passwd* /etc/group* /etc/shadow* /etc/gshadow* /etc/sub*\n\
         cp -a /var/cache/rig/* /etc/ && rm -r /var/cache/rig\n",
        &[],
    );
}

fn add(operator: &Operator<'_>, host: &Host) -> String {
    operator.ok(&["host", "add", &target(host), "--system", "--accept-new"])
}

/// Who the RTI and the federates of a host are.
fn users(host: &Host) -> Vec<String> {
    let listed = host.script(
        "ps -ewwo user:32=,args= | grep -E -e ' rti | --federate ' | grep -v -e supervise -e grep || true",
        &[],
    );
    let users = listed.lines().filter_map(|line| line.split(' ').next());
    users.map(str::to_owned).collect()
}

fn one_installation_serves_a_whole_host(rig: &Rig) {
    let operator = Operator::new(rig);
    let [first, second, third] = rig.hosts() else {
        panic!("three hosts")
    };
    let no_rights = ["host", "add", &target(first), "--system", "--accept-new"];
    let refused = operator.fails(&no_rights, 1);
    assert!(
        refused.contains("user `robot` is not root") && refused.contains("/etc/sudoers.d/ictus"),
        "{refused}"
    );
    for host in [first, second] {
        let_in(host);
        let told = add(&operator, host);
        assert!(
            told.contains(" as root") && told.contains("federates are: ictus-run"),
            "{told}"
        );
        let modes =
            "stat --format '%a %U %G' /run/ictus /run/ictus/ictusd.sock /run/ictus/viewer.sock";
        let modes = host.script(modes, &[]);
        assert_eq!(modes, "750 root ictus\n660 root ictus\n660 root ictus\n");
    }
    // Hosts of both kinds work together.
    operator.add(std::slice::from_ref(third));
    let file = diamond(&operator, "", "");
    operator.ok(&["up", &file, "--set", "run=1 h"]);
    for (host, user) in [(first, RUN_AS), (second, RUN_AS), (third, "robot")] {
        let found = users(host);
        assert!(!found.is_empty(), "{}", host.name);
        assert!(found.iter().all(|found| found == user), "{found:?}");
    }
    strangers_see_nothing(first);
    // A daemon that is gone is for root to start; the next one adopts.
    first.exec(&["pkill", "-KILL", "-f", "[i]ctusd daemon"]);
    let gone = operator.fails(&["host", "check", &target(first)], 4);
    assert!(gone.contains("only root may start it"), "{gone}");
    add(&operator, first);
    let parts = operator.parts(&file);
    let running = |part: &Value| part["state"] == "running";
    assert!(parts.iter().all(running), "{parts:?}");
    operator.ok(&["host", "upgrade", &target(first)]);
    assert!(operator.parts(&file).iter().all(running));
    operator.ok(&["down", &file, "--purge"]);
    let file = diamond(&operator, "", ", engine: docker");
    operator.ok(&["up", &file, "--set", "run=4 s", "--trace"]);
    let numbers = first.script("echo $(id -u ictus-run):$(id -g ictus-run)", &[]);
    let ids = first.docker(&["ps", "-q"]);
    let ids: Vec<_> = ids.lines().collect();
    let format = ["inspect", "--format", "{{.Config.User}}"];
    let found = first.docker(&[&format, ids.as_slice()].concat());
    assert!(found.lines().all(|user| user == numbers.trim()), "{found}");
    verify(&operator, &file, "diamond", "diamond");
    operator.ok(&["down", &file, "--purge"]);
    operator.leave();
    leave(first);
    leave(second);
}

/// Whoever is not in the group may not ask, and may read no more than programs, plans and what federates write for all.
fn strangers_see_nothing(host: &Host) {
    let stranger = |args: &[&str]| host.command("nobody").args(args).output().unwrap();
    let asked = stranger(&[PROGRAM, "dial-stdio"]);
    let told = said(&asked);
    assert!(!asked.status.success(), "{told}");
    assert!(told.contains("usermod -aG ictus nobody"), "{told}");
    let files = host.exec(&["find", "/var/lib/ictus", "/run/ictus", "-type", "f"]);
    assert!(files.contains("key.pem"), "{files}");
    for path in files.lines() {
        let open = ["/blobs/", "/plan", "/trace/", "/timing/"];
        let open = open.iter().any(|part| path.contains(part));
        let reads = stranger(&["test", "-r", path]).status.success();
        assert!(open || !reads, "{path}");
    }
}

fn no_federate_is_root_unless_the_host_allows_it(rig: &Rig) {
    let operator = Operator::new(rig);
    let [first, second, third] = rig.hosts() else {
        panic!("three hosts")
    };
    let_in(second);
    add(&operator, second);
    operator.add(std::slice::from_ref(first));
    operator.add(std::slice::from_ref(third));
    fs::write(operator.home.path().join("token"), CANARY).unwrap();
    let file = manifest(&operator, "process", FROM_FILE);
    operator.ok(&["up", &file]);
    let stat = "stat --format '%a %U' /dev/shm/ictus-0-*/kept/keeper/TOKEN";
    assert_eq!(second.script(stat, &[]), "400 ictus-run\n");
    operator.ok(&["down", &file, "--purge"]);
    let text = fs::read_to_string(&file).unwrap();
    let text = text.replace("class: Keeper,", "class: Keeper, user: root,");
    let as_root = operator.manifest("root.yaml", &text);
    let refused = operator.fails(&["up", &as_root], 1);
    assert!(
        refused.contains("the host's owner lets no federate be root")
            && refused.contains("/etc/ictus/ictusd.toml"),
        "{refused}"
    );
    // Its mistakes are told where the daemon is started.
    let config = |line: &str| {
        let script = format!("pkill -f '[i]ctusd daemon'; echo '{line}' > /etc/ictus/ictusd.toml");
        second.script(&script, &[]);
    };
    config("allow-root = true");
    let wrong = ["host", "add", &target(second), "--system"];
    let wrong = operator.fails(&wrong, 1);
    assert!(wrong.contains("unknown field `allow-root`"), "{wrong}");
    config("allow_root = true");
    add(&operator, second);
    operator.ok(&["up", &as_root]);
    assert_eq!(users(second), ["root"]);
    operator.ok(&["down", &as_root, "--purge"]);
    operator.leave();
    leave(second);
}

/// A stand-in for systemd, which test hosts have not: it knows one unit a manager, and writes down what it is asked.
const SYSTEMCTL: &str = r#"mkdir -p /run/systemd/system
touch /small/asked && chmod 666 /small/asked
cat > /usr/local/bin/systemctl <<'END'
#!/bin/sh
echo "$*" >> /small/asked
unit=/etc/systemd/system/ictusd.service
wants=/etc/systemd/system/multi-user.target.wants
if [ "$1" = --user ]; then
    shift
    unit=$HOME/.config/systemd/user/ictusd.service
    wants=$HOME/.config/systemd/user/default.target.wants
fi
serve() {
    pkill -u "$(id -u)" -f '[i]ctusd daemon'
    setsid $(sed -n "s,%h,$HOME,; s/^ExecStart=//p" "$unit") < /dev/null > /dev/null 2>&1 &
}
case "$1" in
daemon-reload | reset-failed) ;;
is-enabled) [ -e "$wants/ictusd.service" ] ;;
enable)
    mkdir -p "$wants" && ln -sf "$unit" "$wants/ictusd.service"
    if [ "$2" = --now ]; then serve; fi
    ;;
restart) serve ;;
is-failed) ! pgrep -u "$(id -u)" -f '[i]ctusd daemon' > /dev/null ;;
disable) rm -r "$wants" ;;
*) exit 1 ;;
esac
END
mkdir -p -m 777 /var/lib/systemd/linger
printf '#!/bin/sh\ntouch /var/lib/systemd/linger/robot\n' > /usr/local/bin/loginctl
chmod 755 /usr/local/bin/systemctl /usr/local/bin/loginctl
"#;

fn where_there_is_systemd_it_starts_ictusd(rig: &Rig) {
    let operator = Operator::new(rig);
    let host = &rig.hosts()[0];
    let at = target(host);
    let_in(host);
    host.script(
        "mkdir -p /var/cache/before && cp -a /etc/systemd /var/cache/before/",
        &[],
    );
    host.script(SYSTEMCTL, &[]);
    for (kind, whose) in [("--system", ""), ("--at-boot", "--user ")] {
        let told = operator.ok(&["host", "add", &at, kind, "--accept-new"]);
        assert!(told.contains("starts at boot: yes"), "{told}");
        operator.ok(&["host", "upgrade", &at]);
        let asked = host.script("cat /small/asked; : > /small/asked", &[]);
        let restarted = format!("{whose}restart ictusd.service\n");
        assert!(asked.contains(&restarted), "{asked}");
        let broken = ictus().with_file_name("diamond");
        let broken = [
            "host",
            "upgrade",
            &at,
            "--program",
            broken.to_str().unwrap(),
        ];
        let told = operator.fails(&broken, 1);
        assert!(told.contains("the one before serves again"), "{told}");
        operator.ok(&["host", "rm", &at]);
        let asked = host.script("cat /small/asked; : > /small/asked", &[]);
        assert!(
            asked.contains(&format!("{whose}disable --now ictusd.service")),
            "{asked}"
        );
    }
    host.script(
        "rm -r /run/systemd /var/lib/systemd /usr/local/bin/systemctl /usr/local/bin/loginctl /small/asked /home/robot/.config\n\
         rm -rf /etc/systemd && mv /var/cache/before/systemd /etc/ && rm -r /var/cache/before\n",
        &[],
    );
    leave(host);
}
