//! The test hosts themselves: what every other scenario relies on.

#![expect(
    clippy::unwrap_used,
    clippy::panic,
    reason = "a test stops at the first surprise"
)]

use super::Scenario;
use ictus_tests::rig::{Host, LeakChecker, Rig, Traffic};
use ictus_tests::said;
use std::net::{SocketAddr, TcpStream};
use std::time::{Duration, Instant};

/// How long an answer that must come may take.
const PATIENCE: Duration = Duration::from_secs(20);

/// In this order.
pub(crate) const SCENARIOS: &[Scenario] = &[
    ("three_hosts_are_ready", three_hosts_are_ready),
    (
        "a_partition_is_pairwise_and_heals",
        a_partition_is_pairwise_and_heals,
    ),
    ("a_cut_may_be_one_way", a_cut_may_be_one_way),
    (
        "a_cut_of_the_data_plane_leaves_ssh",
        a_cut_of_the_data_plane_leaves_ssh,
    ),
    ("the_operator_may_be_cut_off", the_operator_may_be_cut_off),
    (
        "a_cable_pulled_comes_back_with_its_address",
        a_cable_pulled_comes_back_with_its_address,
    ),
    ("docker_stops_and_starts", docker_stops_and_starts),
    ("a_small_disk_is_full", a_small_disk_is_full),
    (
        "the_leak_checker_sees_what_is_left",
        the_leak_checker_sees_what_is_left,
    ),
];

fn three_hosts_are_ready(rig: &Rig) {
    assert_eq!(rig.hosts().len(), 3);
    for host in rig.hosts() {
        let output = rig
            .ssh(host)
            .args(["docker info --format '{{.ServerVersion}}'; id -un; hostname"])
            .output()
            .unwrap();
        let text = said(&output);
        assert!(output.status.success(), "{text}");
        let lines: Vec<String> = String::from_utf8(output.stdout)
            .unwrap()
            .lines()
            .map(str::to_owned)
            .collect();
        assert_eq!(lines[1..], ["robot", host.name.as_str()], "{text}");

        let image = host.tiny_image();
        let run = [
            "run",
            "--rm",
            "--network",
            "host",
            image,
            "echo",
            "from inside",
        ];
        assert_eq!(host.docker(&run), "from inside\n");
        host.docker(&["image", "rm", image]);
    }
    // Each has an engine of its own.
    let ids: Vec<String> = rig
        .hosts()
        .iter()
        .map(|host| host.docker(&["info", "--format", "{{.ID}}"]))
        .collect();
    assert_ne!(ids[0], ids[1]);
    assert_ne!(ids[1], ids[2]);
}

fn a_partition_is_pairwise_and_heals(rig: &Rig) {
    let [a, b, c] = rig.hosts() else {
        panic!("three hosts")
    };
    a.partition_from(b, Traffic::All);
    assert!(is_cut(a, b, 22) && is_cut(b, a, 22), "both ways");
    assert!(connects(c, a, 22) && connects(c, b, 22), "not the third");
    assert!(connects(a, c, 22) && connects(b, c, 22), "not the third");
    a.heal();
    b.heal();
    assert!(connects(a, b, 22) && connects(b, a, 22), "healed");
}

fn a_cut_may_be_one_way(rig: &Rig) {
    let [a, b, _] = rig.hosts() else {
        panic!("three hosts")
    };
    // A datagram to a closed port is counted where it arrives.
    let (at_a, at_b) = (arrived(a), arrived(b));
    send(a, b);
    send(b, a);
    let (at_a, at_b) = (arrives(a, at_a + 1), arrives(b, at_b + 1));
    a.drop_from(b.address, Traffic::All);
    for _ in 0..3 {
        send(b, a);
    }
    // Those from a still arrive at b, and what a tells itself arrives after the lost ones.
    send(a, b);
    send(a, a);
    arrives(b, at_b + 1);
    assert_eq!(arrives(a, at_a + 1), at_a + 1, "b's datagrams are lost");
}

fn a_cut_of_the_data_plane_leaves_ssh(rig: &Rig) {
    let [a, b, _] = rig.hosts() else {
        panic!("three hosts")
    };
    serve(b, 15045);
    assert!(connects(a, b, 15045));
    a.partition_from(b, Traffic::Data);
    assert!(is_cut(a, b, 15045));
    assert!(connects(a, b, 22));
    rig.heal();
    assert!(connects(a, b, 15045), "healed");
    b.drop_from(a.address, Traffic::Tcp(15045));
    assert!(is_cut(a, b, 15045), "one port");
    assert!(connects(a, b, 22), "the rest is open");
    b.exec(&["pkill", "-x", "busybox"]);
}

fn the_operator_may_be_cut_off(rig: &Rig) {
    let [a, b, _] = rig.hosts() else {
        panic!("three hosts")
    };
    let reached = |bound| TcpStream::connect_timeout(&SocketAddr::new(b.address.into(), 22), bound);
    reached(PATIENCE).unwrap();
    b.drop_from(rig.gateway(), Traffic::All);
    reached(Duration::from_secs(2)).unwrap_err();
    assert!(connects(a, b, 22), "the hosts hear each other");
    b.heal();
    reached(PATIENCE).unwrap();
}

fn a_cable_pulled_comes_back_with_its_address(rig: &Rig) {
    let [a, b, _] = rig.hosts() else {
        panic!("three hosts")
    };
    let address = a.address.to_string();
    a.cut_cable();
    assert!(is_cut(b, a, 22));
    assert!(
        !a.exec(&["ip", "-4", "address"]).contains(&address),
        "the interface is gone"
    );
    a.restore_cable();
    assert!(a.exec(&["ip", "-4", "address"]).contains(&address));
    assert!(connects(a, b, 22) && connects(b, a, 22));
    let output = rig.ssh(a).arg("true").output().unwrap();
    assert!(output.status.success(), "{}", said(&output));
}

fn docker_stops_and_starts(rig: &Rig) {
    let host = &rig.hosts()[0];
    host.stop_docker();
    let output = host.output(&["docker", "version"]);
    assert!(!output.status.success());
    let output = rig.ssh(host).arg("true").output().unwrap();
    assert!(
        output.status.success(),
        "the host lives on: {}",
        said(&output)
    );
    host.start_docker();
    host.docker(&["version"]);
}

fn a_small_disk_is_full(rig: &Rig) {
    let host = &rig.hosts()[0];
    let directory = host.full_disk_dir(8);
    let write = |kib: u32| {
        let script = format!("head -c {kib}K /dev/zero >{directory}/more");
        host.command("robot")
            .args(["sh", "-c", &script])
            .output()
            .unwrap()
    };
    assert!(write(4).status.success());
    let output = write(64);
    assert!(said(&output).contains("No space left"), "{}", said(&output));
    host.empty_disk();
}

fn the_leak_checker_sees_what_is_left(rig: &Rig) {
    let host = &rig.hosts()[0];
    let image = host.tiny_image();
    let checker = LeakChecker::snapshot(host);
    assert_eq!(checker.diff(), "");

    host.docker(&["network", "create", "left"]);
    host.docker(&["volume", "create", "left-volume"]);
    host.docker(&["tag", image, "left-image:1"]);
    let container = [
        "run",
        "--detach",
        "--name",
        "left-container",
        "--network",
        "host",
        image,
    ];
    host.docker(&container);
    host.exec_as_robot(&["sh", "-c", "touch left-file; setsid -f sleep 599"]);
    serve(host, 15046);
    host.exec(&[
        "sh",
        "-ec",
        "mkdir /var/lib/ictus; mount -t tmpfs left /mnt; iptables -A INPUT -s 192.0.2.7 -j DROP",
    ]);

    let diff = checker.diff();
    for (section, part) in [
        ("processes", "robot sleep 599"),
        ("processes", "/busybox sleep 600"),
        ("sockets", ":15046 \"busybox\""),
        ("mounts", "/mnt tmpfs left"),
        ("cgroups", "/h1/"),
        ("iptables", "-A INPUT -s 192.0.2.7/32 -j DROP"),
        ("engine", "network left bridge"),
        ("engine", "volume left-volume"),
        ("engine", "image left-image:1"),
        ("engine", "container left-container of rig-tiny"),
        ("files", "robot /home/robot/left-file 0 bytes"),
        ("files", "/var/lib/ictus"),
    ] {
        let start = format!("+ {section}: ");
        let seen = diff
            .lines()
            .any(|line| line.starts_with(&start) && line.contains(part));
        assert!(seen, "{section}: {part} is not in\n{diff}");
    }

    host.exec(&["sh", "-ec", "iptables -D INPUT -s 192.0.2.7 -j DROP; umount /mnt; rmdir /var/lib/ictus; rm /home/robot/left-file"]);
    host.exec(&[
        "sh",
        "-c",
        "docker rm -f left-container; pkill -u robot -x sleep; pkill -x busybox",
    ]);
    host.docker(&["network", "rm", "left"]);
    host.docker(&["volume", "rm", "left-volume"]);
    host.docker(&["image", "rm", "left-image:1"]);
    assert_eq!(checker.diff(), "", "and that it is gone");
    host.docker(&["image", "rm", image]);
}

/// Whether a connection comes about; it gets 20 s.
fn connects(from: &Host, to: &Host, port: u16) -> bool {
    connects_within(from, to, port, "20")
}

/// Whether no connection comes about in 2 s.
fn is_cut(from: &Host, to: &Host, port: u16) -> bool {
    !connects_within(from, to, port, "2")
}

fn connects_within(from: &Host, to: &Host, port: u16, seconds: &str) -> bool {
    let connect = format!("</dev/tcp/{}/{port}", to.address);
    let output = from.output(&["timeout", seconds, "bash", "-c", &connect]);
    output.status.success()
}

/// Listens until it is killed, under the name of busybox.
fn serve(host: &Host, port: u16) {
    host.exec(&["busybox", "httpd", "-p", &port.to_string(), "-h", "/srv"]);
}

/// Sends one datagram to a port that nobody listens on.
fn send(from: &Host, to: &Host) {
    let echo = format!("echo >/dev/udp/{}/7", to.address);
    from.exec(&["bash", "-c", &echo]);
}

/// How many such datagrams have arrived so far.
fn arrived(host: &Host) -> u64 {
    let text = host.exec(&["sh", "-c", "grep ^Udp: /proc/net/snmp | tail -n 1"]);
    // Udp: InDatagrams NoPorts ...
    text.split_whitespace().nth(2).unwrap().parse().unwrap()
}

/// Waits until at least this many have arrived; returns how many.
fn arrives(host: &Host, count: u64) -> u64 {
    let end = Instant::now() + PATIENCE;
    loop {
        let now = arrived(host);
        if now >= count {
            return now;
        }
        assert!(Instant::now() < end, "{} got {now} of {count}", host.name);
    }
}
