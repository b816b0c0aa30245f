//! One test host: a container that is a machine of its own to everything that talks to it.

use super::USER;
use super::engine::{cgroup_v1, docker, ok};
use crate::{root, said};
use std::io::Write as _;
use std::net::Ipv4Addr;
use std::process::{Command, Output, Stdio};

/// A tmpfs of 4 MiB on every host, for disks that are full.
const SMALL: &str = "/small";

/// Seconds after which what was started on a host is killed.
const BOUND_S: &str = "100";

/// A host with its own sshd, Docker engine, processes, addresses and files.
#[derive(Clone, Debug)]
pub struct Host {
    /// `h1`, `h2`, ...; also what the host calls itself.
    pub name: String,
    /// Stays the same, also when the cable was out.
    pub address: Ipv4Addr,
    rig: String,
    container: String,
}

/// Which packets a cut takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Traffic {
    /// All.
    All,
    /// The data plane: all but ssh (TCP port 22).
    Data,
    /// TCP to this port.
    Tcp(u16),
    /// UDP to this port.
    Udp(u16),
}

impl Host {
    /// The n-th host of a rig, not yet started.
    pub(super) fn planned(rig: &str, n: u8, address: Ipv4Addr) -> Self {
        let name = format!("h{n}");
        Self {
            container: format!("{rig}-{name}"),
            name,
            address,
            rig: rig.to_owned(),
        }
    }

    /// Creates the container and returns when sshd and Docker answer.
    pub(super) fn start(&self, image: &str) {
        let (address, script) = (self.address.to_string(), root().join("tests/rig/host.sh"));
        let mut run = docker(&["run", "--detach", "--network", &self.rig]);
        run.args(["--ip", &address, "--name", &self.container])
            .args(["--hostname", &self.name])
            .args(["--label", &format!("ictus.rig={}", self.rig)])
            .args(["--cap-add=SYS_ADMIN", "--cap-add=NET_ADMIN"])
            .arg("--cap-add=NET_RAW")
            .args(["--security-opt=seccomp=unconfined"])
            .args(["--security-opt=apparmor=unconfined"])
            .args(["--security-opt=systempaths=unconfined"])
            .args(["--tmpfs", "/run:exec,mode=755"])
            .args(["--tmpfs", &format!("{SMALL}:size=4m,mode=1777")])
            .arg("--mount")
            .arg(format!(
                "type=volume,dst=/var/lib/docker,volume-label=ictus.rig={}",
                self.rig
            ))
            .arg("--volume")
            .arg(format!("{}:/usr/local/sbin/host:ro", script.display()));
        let v1 = cgroup_v1();
        if v1 {
            run.args([
                "--cgroupns=host",
                "--volume",
                "/sys/fs/cgroup:/sys/fs/cgroup:rw",
            ]);
        } else {
            run.arg("--cgroupns=private");
        }
        run.args([image, "tini", "--", "host", "up"]);
        if v1 {
            run.arg(self.cgroup());
        }
        ok(&mut run);
        self.exec(&["host", "ready"]);
    }

    /// Lets a public key in.
    pub(super) fn admit(&self, public: &str) {
        let script = r#"mkdir -m 700 .ssh && printf %s "$1" > .ssh/authorized_keys && chmod 600 .ssh/authorized_keys"#;
        self.exec_as_robot(&["sh", "-c", script, "sh", public]);
    }

    /// sshd's keys, as `TYPE KEY` lines.
    pub(super) fn public_keys(&self) -> String {
        let text = self.exec(&["sh", "-c", "cat /etc/ssh/ssh_host_*_key.pub"]);
        let keys = text.lines().filter_map(|line| line.rsplit_once(' '));
        keys.map(|(key, _comment)| format!("{key}\n")).collect()
    }

    /// The parent of the cgroups of this host's containers (cgroup v1).
    pub(super) fn cgroup(&self) -> String {
        format!("/{}/{}", self.rig, self.name)
    }

    /// A command on this host, killed after 100 s; arguments are to be added. Neither ssh nor network is needed for it.
    #[must_use]
    pub fn command(&self, user: &str) -> Command {
        let home = if user == "root" {
            "/root"
        } else {
            "/home/robot"
        };
        let mut command = docker(&["exec", "--interactive", "--user", user]);
        command
            .args(["--workdir", home, "--env", &format!("HOME={home}")])
            .args([&self.container, "timeout", "--kill-after=5", BOUND_S]);
        command
    }

    /// Runs it as root and returns what it said, whatever that was.
    #[must_use]
    pub fn output(&self, args: &[&str]) -> Output {
        self.command("root").args(args).output().unwrap()
    }

    /// Runs it as root, expects success, returns standard output.
    pub fn exec(&self, args: &[&str]) -> String {
        self.expect_ok(args, &self.output(args))
    }

    /// The same as [`USER`].
    pub fn exec_as_robot(&self, args: &[&str]) -> String {
        let output = self.command(USER).args(args).output().unwrap();
        self.expect_ok(args, &output)
    }

    /// `docker ARGS` on this host's own engine.
    pub fn docker(&self, args: &[&str]) -> String {
        self.exec(&[&["docker"], args].concat())
    }

    /// Runs a shell script as root that never was a file on this host; returns standard output.
    pub fn script(&self, text: &str, args: &[&str]) -> String {
        let mut child = self
            .command("root")
            .args(["sh", "-s"])
            .args(args)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut input = child.stdin.take().unwrap();
        input.write_all(text.as_bytes()).unwrap();
        drop(input);
        self.expect_ok(&["script"], &child.wait_with_output().unwrap())
    }

    /// An image of busybox alone in this host's engine, about 2 MB; sleeps when nothing else is asked. Returns its name.
    #[must_use]
    pub fn tiny_image(&self) -> &'static str {
        let script = r#"tar -C /usr/bin -c busybox | docker import --change 'ENTRYPOINT ["/busybox"]' --change 'CMD ["sleep", "600"]' - "$1""#;
        let name = "rig-tiny:latest";
        self.exec(&["sh", "-c", script, "sh", name]);
        name
    }

    /// What comes from `peer` (a host's address, or the gateway's) is lost in silence; the other way is open.
    pub fn drop_from(&self, peer: Ipv4Addr, traffic: Traffic) {
        let port;
        let rules: &[&[&str]] = match traffic {
            Traffic::All => &[&[]],
            Traffic::Data => &[
                &["!", "-p", "tcp"],
                &["-p", "tcp", "-m", "multiport", "!", "--ports", "22"],
            ],
            Traffic::Tcp(number) => {
                port = number.to_string();
                &[&["-p", "tcp", "--dport", &port]]
            }
            Traffic::Udp(number) => {
                port = number.to_string();
                &[&["-p", "udp", "--dport", &port]]
            }
        };
        for rule in rules {
            let peer = peer.to_string();
            let head = ["iptables", "--wait", "-t", "raw", "-A", "RIG", "-s", &peer];
            self.exec(&[&head, *rule, &["-j", "DROP"]].concat());
        }
    }

    /// Neither hears the other any more.
    pub fn partition_from(&self, other: &Self, traffic: Traffic) {
        self.drop_from(other.address, traffic);
        other.drop_from(self.address, traffic);
    }

    /// Hears everybody again. A partition has two sides: both heal, or the whole rig.
    pub fn heal(&self) {
        self.exec(&["iptables", "--wait", "-t", "raw", "-F", "RIG"]);
    }

    /// Pulls the network cable: the interface goes, the host notices at once.
    pub fn cut_cable(&self) {
        ok(&mut docker(&[
            "network",
            "disconnect",
            &self.rig,
            &self.container,
        ]));
    }

    /// Plugs it in again when it was out; the address is the old one.
    pub fn restore_cable(&self) {
        let networks = "{{range .NetworkSettings.Networks}}{{.NetworkID}}{{end}}";
        let connected = ok(&mut docker(&[
            "inspect",
            "--format",
            networks,
            &self.container,
        ]));
        if connected.trim().is_empty() {
            let address = self.address.to_string();
            let connect = [
                "network",
                "connect",
                "--ip",
                &address,
                &self.rig,
                &self.container,
            ];
            ok(&mut docker(&connect));
        }
    }

    /// A directory that everybody may write, on a small tmpfs with only this much left (0 to 4000 KiB); emptied first.
    #[must_use]
    pub fn full_disk_dir(&self, free_kib: u32) -> &'static str {
        let script = r#"find "$1" -mindepth 1 -delete
            have=$(df --output=avail -k "$1" | tail -n 1)
            fallocate -l "$((have - $2))KiB" "$1/filling""#;
        self.exec(&["sh", "-ec", script, "sh", SMALL, &free_kib.to_string()]);
        SMALL
    }

    /// Gives the small disk back, empty.
    pub fn empty_disk(&self) {
        self.exec(&["find", SMALL, "-mindepth", "1", "-delete"]);
    }

    /// Stops the Docker engine in order, and its containers with it.
    pub fn stop_docker(&self) {
        self.exec(&["host", "stop-docker"]);
    }

    /// Starts it and returns when it answers.
    pub fn start_docker(&self) {
        self.exec(&["host", "start-docker"]);
    }

    /// Everything this host can tell about itself, as text; never fails.
    #[must_use]
    pub fn gather_logs(&self) -> String {
        let script = include_str!("logs.sh");
        match self.command("root").args(["sh", "-c", script]).output() {
            Ok(output) => said(&output),
            Err(error) => error.to_string(),
        }
    }

    fn expect_ok(&self, args: &[&str], output: &Output) -> String {
        assert!(
            output.status.success(),
            "{}: {args:?}: {}",
            self.name,
            said(output)
        );
        String::from_utf8(output.stdout.clone()).unwrap()
    }
}
