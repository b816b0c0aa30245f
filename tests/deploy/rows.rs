//! What may be wrong with hosts, disks, programs, records and engines: each with its clear error, and nothing lost.

#![expect(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::PathBuf;
use std::sync::Once;

use ictus_tests::rig::{Host, Rig};
use ictus_tests::root;

use super::Scenario;
use super::operator::{Operator, program, target};

/// In this order.
pub(crate) const SCENARIOS: &[Scenario] = &[
    (
        "a_full_disk_is_said_before_anything_is_sent",
        a_full_disk_is_said_before_anything_is_sent,
    ),
    (
        "a_disk_that_fills_up_while_preparing_undoes_all_hosts",
        a_disk_that_fills_up_while_preparing_undoes_all_hosts,
    ),
    (
        "a_program_of_another_architecture_is_said_before_anything_is_sent",
        a_program_of_another_architecture_is_said_before_anything_is_sent,
    ),
    (
        "a_record_newer_than_the_daemon_is_left_alone",
        a_record_newer_than_the_daemon_is_left_alone,
    ),
    (
        "a_foreign_container_is_told_and_left_alone",
        a_foreign_container_is_told_and_left_alone,
    ),
    (
        "a_docker_that_is_too_old_is_said_with_the_fix",
        a_docker_that_is_too_old_is_said_with_the_fix,
    ),
];

/// Where a host's daemon keeps its state.
const STATE: &str = "/home/robot/.local/state/ictus";

/// A federate that ticks and one that counts, until they are stopped: a static program, built once.
pub(crate) fn ticking(operator: &Operator<'_>) -> String {
    static BUILT: Once = Once::new();
    BUILT.call_once(|| {
        // Only what travels is built static.
        let hosts = operator.rig.hosts();
        let package = format!("package: {}", root().join("tests/canary").display());
        let text = pair(&hosts[..1], [", engine: docker", ""], &package);
        operator.ok(&["check", &operator.manifest("build.yaml", &text)]);
    });
    format!("binary: {}", program("canary").display())
}

/// A manifest of two federates on one or two hosts, each host with these keys besides.
pub(crate) fn pair(hosts: &[Host], more: [&str; 2], program: &str) -> String {
    let lines = hosts.iter().zip(more);
    let lines: String = lines
        .map(|(host, more)| format!("  {}: {{ ssh: \"{}\"{more} }}\n", host.name, target(host)))
        .collect();
    let (first, last) = (&hosts[0].name, &hosts[hosts.len() - 1].name);
    format!(
        "ictus: v1\nfederation: pair\nhosts:\n{lines}security: trusted-network\nrti: {{ host: {first} }}\n\
         programs:\n  canary: {{ {program} }}\nfederates:\n  \
         ticker: {{ host: {first}, class: Faulty, parameters: {{ at: 0 }} }}\n  \
         counter: {{ host: {last}, class: Counter }}\n\
         connections:\n  - {{ from: ticker.out, to: counter.input }}\n"
    )
}

/// One host whose daemon keeps its state on a disk with so much left, in KiB.
fn with_little_room(rig: &Rig, free_kib: u32) -> (Operator<'_>, &[Host]) {
    let hosts = &rig.hosts()[..1];
    let small = hosts[0].full_disk_dir(free_kib);
    let script =
        "mkdir -p .local/state && mkdir -m 700 $1/ictus && ln -s $1/ictus .local/state/ictus";
    hosts[0].exec_as_robot(&["sh", "-ec", script, "sh", small]);
    let operator = Operator::new(rig);
    operator.add(hosts);
    (operator, hosts)
}

/// Gives it all back.
fn leave_little_room(operator: Operator<'_>, hosts: &[Host]) {
    operator.remove(hosts);
    hosts[0].exec_as_robot(&["rm", STATE]);
    hosts[0].exec_as_robot(&["rmdir", "-p", "--ignore-fail-on-non-empty", ".local/state"]);
    hosts[0].empty_disk();
}

/// What a host keeps of federations and programs.
pub(crate) fn kept(host: &Host) -> String {
    let script = "find -L $1/federations $1/blobs -type f 2>/dev/null || true";
    host.exec(&["sh", "-c", script, "sh", STATE])
}

fn a_full_disk_is_said_before_anything_is_sent(rig: &Rig) {
    let (operator, hosts) = with_little_room(rig, 300);
    let file = operator.manifest("pair.yaml", &pair(hosts, [""; 2], &ticking(&operator)));
    let said = operator.fails(&["up", &file], 1);
    let bytes = fs::metadata(program("canary")).unwrap().len();
    for words in [
        "host `h1` has ",
        &format!(" bytes free at {STATE}, but {bytes} bytes are to be sent"),
        "free space on `h1`",
    ] {
        assert!(said.contains(words), "{words} is missing in {said}");
    }
    assert_eq!(kept(&hosts[0]), "");
    leave_little_room(operator, hosts);
}

fn a_disk_that_fills_up_while_preparing_undoes_all_hosts(rig: &Rig) {
    let bytes = {
        let operator = Operator::new(rig);
        ticking(&operator);
        fs::metadata(program("canary")).unwrap().len()
    };
    // The program fits, and next to nothing else does.
    let kib = u32::try_from(bytes.div_ceil(4096) * 4).unwrap() + 24;
    let (operator, hosts) = with_little_room(rig, kib);
    let file = operator.manifest("pair.yaml", &pair(hosts, [""; 2], &ticking(&operator)));
    let said = operator.fails(&["up", &file], 1);
    for words in [
        "host `h1`",
        STATE,
        "No space left on device",
        "free space there",
        "everything was undone",
    ] {
        assert!(said.contains(words), "{words} is missing in {said}");
    }
    assert_eq!(kept(&hosts[0]), "");
    leave_little_room(operator, hosts);
}

fn a_program_of_another_architecture_is_said_before_anything_is_sent(rig: &Rig) {
    let hosts = &rig.hosts()[..1];
    let operator = Operator::new(rig);
    operator.add(hosts);
    let foreign = foreign_program(&operator);
    let (host, at) = (&hosts[0], target(&hosts[0]));
    // Also when the manifest takes the host for such a machine.
    for arch in ["", ", arch: arm64"] {
        let text = format!(
            "ictus: v1\nfederation: pair\nhosts:\n  {0}: {{ ssh: \"{at}\"{arch} }}\nsecurity: trusted-network\n\
             federates:\n  camera: {{ binary: {1}, id: 0 }}\n",
            host.name,
            foreign.display()
        );
        let file = operator.manifest("arch.yaml", &text);
        let said = operator.fails(&["up", &file], 1);
        for words in [
            "host `h1` is x86_64, but the program of federate `camera` is for aarch64",
            "build the program for x86_64",
        ] {
            assert!(said.contains(words), "{words} is missing in {said}");
        }
    }
    // Programs of ours are built for this machine only: that is known without asking the host.
    let text = pair(hosts, [", arch: arm64", ""], &ticking(&operator));
    let said = operator.fails(&["up", &operator.manifest("pair.yaml", &text)], 3);
    assert!(said.contains("F039") && said.contains("arm64"), "{said}");
    assert_eq!(kept(host), "");
    operator.remove(hosts);
}

/// The ticking program with a header that says arm64.
pub(crate) fn foreign_program(operator: &Operator<'_>) -> PathBuf {
    let mut elf = fs::read(program_of(operator)).unwrap();
    elf[18..20].copy_from_slice(&183_u16.to_le_bytes());
    let foreign = operator.home.path().join("foreign");
    fs::write(&foreign, elf).unwrap();
    fs::set_permissions(&foreign, fs::Permissions::from_mode(0o755)).unwrap();
    foreign
}

/// The file of the ticking program.
pub(crate) fn program_of(operator: &Operator<'_>) -> PathBuf {
    ticking(operator);
    program("canary")
}

fn a_record_newer_than_the_daemon_is_left_alone(rig: &Rig) {
    let hosts = &rig.hosts()[..1];
    let operator = Operator::new(rig);
    operator.add(hosts);
    let file = operator.manifest("pair.yaml", &pair(hosts, [""; 2], &ticking(&operator)));
    operator.ok(&["up", &file]);
    let record = format!("{STATE}/federations/pair/record.json");
    let own = hosts[0].exec(&["cat", &record]);
    let newer = own.replacen("\"protocol\": ", "\"protocol\": 9", 1);
    assert_ne!(own, newer);
    write(&hosts[0], &record, &newer);
    // A daemon that does not know the run yet.
    hosts[0].exec(&["pkill", "-KILL", "-f", "[i]ctusd daemon"]);
    for command in [&["up", &file][..], &["down", &file, "--purge"]] {
        let said = operator.fails(command, 1);
        for words in [
            "the record on host `h1` was written by a newer ictusd",
            &record,
            "is of protocol 9",
            "`ictus host upgrade",
        ] {
            assert!(said.contains(words), "{words} is missing in {said}");
        }
    }
    let said = operator.run(&["ps", &file]);
    assert!(
        ictus_tests::said(&said).contains("is of protocol 9"),
        "{said:?}"
    );
    assert_eq!(hosts[0].exec(&["cat", &record]), newer, "never touched");
    let running = hosts[0].exec(&["pgrep", "-cf", "[-]-federate"]);
    assert_eq!(running.trim(), "2", "federates run on");
    write(&hosts[0], &record, &own);
    // One that knows it again.
    hosts[0].exec(&["pkill", "-KILL", "-f", "[i]ctusd daemon"]);
    operator.ok(&["down", &file, "--purge"]);
    operator.remove(hosts);
}

fn write(host: &Host, path: &str, text: &str) {
    host.exec_as_robot(&["sh", "-ec", "printf %s \"$2\" > \"$1\"", "sh", path, text]);
}

fn a_foreign_container_is_told_and_left_alone(rig: &Rig) {
    let hosts = &rig.hosts()[..1];
    let operator = Operator::new(rig);
    operator.add(hosts);
    let image = hosts[0].tiny_image();
    let container = [
        "run",
        "--detach",
        "--network",
        "host",
        "--name",
        "stranger",
        "--label",
        "ictus.federation=pair",
        "--label",
        "ictus.member=ticker",
        "--label",
        "ictus.instance=0123456789abcdef0123456789abcdef",
        image,
    ];
    let id = hosts[0].docker(&container);
    let engines = [", engine: docker", ""];
    let file = operator.manifest("pair.yaml", &pair(hosts, engines, &ticking(&operator)));
    operator.ok(&["up", &file]);
    let told = "h1: container `stranger` is foreign";
    let said = ictus_tests::said(&operator.run(&["ps", &file]));
    assert!(said.contains(told), "{said}");
    let said = operator.ok(&["down", &file, "--purge"]);
    assert!(
        said.contains(told) && said.contains("docker rm -f stranger"),
        "{said}"
    );
    let running = hosts[0].docker(&["ps", "--quiet", "--no-trunc"]);
    assert_eq!(running, id, "it runs on");
    hosts[0].docker(&["rm", "--force", "stranger"]);
    hosts[0].docker(&["image", "rm", image]);
    operator.remove(hosts);
}

fn a_docker_that_is_too_old_is_said_with_the_fix(rig: &Rig) {
    /// An engine of 2019, as far as it is asked.
    const OLD: &str = r#"
use strict; use IO::Socket::UNIX;
unlink "/run/docker.sock";
$SIG{PIPE} = "IGNORE";
my $server = IO::Socket::UNIX->new(Local => "/run/docker.sock", Listen => 8) or die;
chmod 0666, "/run/docker.sock";
if (fork) { exit }
open STDOUT, ">/dev/null"; open STDERR, ">/dev/null"; open STDIN, "</dev/null";
my $body = '{"Version":"19.03.15","ApiVersion":"1.40"}';
while (my $client = $server->accept) {
    sysread $client, my $request, 4096 or next;
    print $client "HTTP/1.1 200 OK\r\nContent-Type: application/json\r\nContent-Length: " . length($body) . "\r\nConnection: close\r\n\r\n$body";
    close $client;
}
"#;
    let hosts = &rig.hosts()[..1];
    let operator = Operator::new(rig);
    operator.add(hosts);
    let engines = [", engine: docker", ""];
    let file = operator.manifest("pair.yaml", &pair(hosts, engines, &ticking(&operator)));
    hosts[0].stop_docker();
    hosts[0].exec(&["perl", "-e", OLD, "old-engine"]);
    let said = operator.run(&["up", &file]);
    hosts[0].exec(&["pkill", "-f", "old-[e]ngine"]);
    hosts[0].exec(&["rm", "-f", "/run/docker.sock"]);
    hosts[0].start_docker();
    let text = ictus_tests::said(&said);
    assert_eq!(said.status.code(), Some(1), "{text}");
    for words in [
        "host `h1`",
        "too old (version 19.03.15, API 1.40)",
        "20.10",
        "--only-upgrade docker.io",
    ] {
        assert!(text.contains(words), "{words} is missing in {text}");
    }
    assert_eq!(kept(&hosts[0]), "");
    operator.remove(hosts);
}
