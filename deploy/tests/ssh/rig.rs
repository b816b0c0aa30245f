//! A real sshd on a loopback port: one process per connection, with its own configuration, host keys and authorized keys.

use std::fs;
use std::net::{TcpListener, TcpStream};
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use ictus_deploy::ssh::{Method, Options, Target};
use tempfile::TempDir;

const SSHD: &str = "/usr/sbin/sshd";

pub(crate) const BOTH: [Method; 2] = [Method::Ssh2, Method::System];

/// Whether the tests can run here; where they must, that they cannot is a failure.
pub(crate) fn available() -> bool {
    let there = Path::new(SSHD).exists() && Path::new("/usr/bin/ssh").exists();
    assert!(
        there || std::env::var_os("CI").is_none_or(|value| value != "true"),
        "CI needs openssh-server and openssh-client"
    );
    if !there {
        println!("skipped: no sshd here (`apt-get install openssh-server openssh-client`)");
    }
    there
}

pub(crate) struct Sshd {
    pub(crate) dir: TempDir,
    pub(crate) port: u16,
    children: Arc<Mutex<Vec<Child>>>,
    over: Arc<AtomicBool>,
    acceptor: Option<JoinHandle<()>>,
}

impl Sshd {
    /// An sshd with an ed25519 host key that lets the key `user` in and whose key is in `known_hosts`.
    pub(crate) fn new() -> Self {
        Self::with(&["ed25519"], "")
    }

    /// One with these host keys and more lines of sshd_config.
    pub(crate) fn with(host_keys: &[&str], more: &str) -> Self {
        let dir = TempDir::new().unwrap();
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        keygen(&dir.path().join("user"), "ed25519", "");
        fs::copy(
            dir.path().join("user.pub"),
            dir.path().join("authorized_keys"),
        )
        .unwrap();
        // A home of its own: what the user's shell runs at login is slow and not ours.
        let mut config = format!(
            "AuthorizedKeysFile {0}/authorized_keys\nStrictModes no\nUsePAM no\nPermitRootLogin prohibit-password\n\
             PasswordAuthentication no\nKbdInteractiveAuthentication no\nPidFile none\nPrintMotd no\nPrintLastLog no\nLogLevel INFO\nSetEnv HOME={0}\n{more}\n",
            dir.path().display()
        );
        for kind in host_keys {
            let file = dir.path().join(format!("host_{kind}"));
            keygen(&file, kind, "");
            config.push_str(&format!("HostKey {}\n", file.display()));
        }
        fs::write(dir.path().join("sshd_config"), config).unwrap();
        // sshd of root wants its directory for privilege separation.
        drop(fs::create_dir_all("/run/sshd"));
        let children = Arc::new(Mutex::new(Vec::new()));
        let over = Arc::new(AtomicBool::new(false));
        let sshd = Self {
            port,
            acceptor: Some(accept(
                listener,
                dir.path().to_owned(),
                Arc::clone(&children),
                Arc::clone(&over),
            )),
            children,
            over,
            dir,
        };
        for kind in host_keys {
            sshd.know(&sshd.host_line(kind));
        }
        sshd
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    pub(crate) fn target(&self) -> Target {
        format!("127.0.0.1:{}", self.port).parse().unwrap()
    }

    /// The name in known_hosts.
    pub(crate) fn name(&self) -> String {
        format!("[127.0.0.1]:{}", self.port)
    }

    /// Type and key of a host key.
    pub(crate) fn host_key(&self, kind: &str) -> String {
        public(&self.path(&format!("host_{kind}")))
    }

    pub(crate) fn host_line(&self, kind: &str) -> String {
        format!("{} {}", self.name(), self.host_key(kind))
    }

    /// Adds a line to known_hosts.
    pub(crate) fn know(&self, line: &str) {
        let file = self.path("known_hosts");
        let before = fs::read_to_string(&file).unwrap_or_default();
        fs::write(file, format!("{before}{line}\n")).unwrap();
    }

    /// Replaces known_hosts.
    pub(crate) fn know_only(&self, lines: &[String]) {
        fs::write(self.path("known_hosts"), lines.join("\n") + "\n").unwrap();
    }

    pub(crate) fn options(&self, method: Method) -> Options {
        Options {
            method,
            config: None,
            known_hosts: self.path("known_hosts"),
            connect_timeout: Duration::from_secs(60),
            command_timeout: Duration::from_secs(300),
            identity: Some(self.path("user")),
            agent: None,
            home: Some(self.dir.path().to_owned()),
        }
    }

    /// Kills what serves the connections.
    pub(crate) fn kill_connections(&self) {
        for child in self.children.lock().unwrap().iter_mut() {
            drop(child.kill());
            drop(child.wait());
        }
    }

    pub(crate) fn connections(&self) -> usize {
        self.children.lock().unwrap().len()
    }
}

impl Drop for Sshd {
    fn drop(&mut self) {
        self.over.store(true, Ordering::SeqCst);
        drop(TcpStream::connect(("127.0.0.1", self.port)));
        drop(self.acceptor.take().map(JoinHandle::join));
        self.kill_connections();
        if std::thread::panicking() {
            let log = fs::read(self.path("log")).unwrap_or_default();
            println!("sshd says:\n{}", String::from_utf8_lossy(&log));
        }
    }
}

fn accept(
    listener: TcpListener,
    dir: PathBuf,
    children: Arc<Mutex<Vec<Child>>>,
    over: Arc<AtomicBool>,
) -> JoinHandle<()> {
    std::thread::spawn(move || {
        let log = fs::File::create(dir.join("log")).unwrap();
        for stream in listener.incoming() {
            if over.load(Ordering::SeqCst) {
                return;
            }
            let socket: OwnedFd = stream.unwrap().into();
            let child = Command::new(SSHD)
                .args(["-i", "-e", "-f"])
                .arg(dir.join("sshd_config"))
                .stdin(socket.try_clone().unwrap())
                .stdout(Stdio::from(socket))
                .stderr(log.try_clone().unwrap())
                .spawn()
                .unwrap();
            children.lock().unwrap().push(child);
        }
    })
}

pub(crate) fn keygen(file: &Path, kind: &str, passphrase: &str) {
    let bits = if kind == "rsa" { "2048" } else { "256" };
    let status = Command::new("ssh-keygen")
        .args([
            "-q", "-t", kind, "-b", bits, "-C", "test", "-N", passphrase, "-f",
        ])
        .arg(file)
        .status()
        .unwrap();
    assert!(status.success());
}

/// Type and key of a public key, without its comment.
pub(crate) fn public(file: &Path) -> String {
    let text = fs::read_to_string(file.with_extension("pub")).unwrap();
    text.split(' ').take(2).collect::<Vec<_>>().join(" ")
}

/// The fingerprint as `ssh-keygen` prints it.
pub(crate) fn fingerprint(file: &Path) -> String {
    let output = Command::new("ssh-keygen")
        .arg("-lf")
        .arg(file.with_extension("pub"))
        .output()
        .unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    text.split(' ').nth(1).unwrap().to_owned()
}
