//! The way to other hosts, against a real sshd: what holds for both methods, and each trap of libssh2.
#![cfg(feature = "ssh")]
#![expect(
    clippy::unwrap_used,
    clippy::panic,
    clippy::wildcard_enum_match_arm,
    clippy::print_stdout,
    reason = "a test stops at the first surprise"
)]

#[path = "ssh/rig.rs"]
mod rig;

use std::fs;
use std::io::Read as _;
use std::net::TcpListener;
use std::os::unix::fs::PermissionsExt as _;
use std::process::{Command, Stdio};
use std::time::Duration;

use ictus_deploy::ssh::{Connection, Method, Options, SshError, host_keys, pin};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};

use rig::{BOTH, Sshd, available, fingerprint, keygen, public};

async fn open(sshd: &Sshd, options: &Options) -> Connection {
    Connection::open(&sshd.target(), options)
        .await
        .unwrap_or_else(|error| panic!("{:?}: {error}", options.method))
}

async fn refused(sshd: &Sshd, options: &Options) -> SshError {
    match Connection::open(&sshd.target(), options).await {
        Ok(connection) => panic!("{:?} got in: {connection:?}", options.method),
        Err(error) => error,
    }
}

/// Bytes that are not all alike.
fn noise(length: usize) -> Vec<u8> {
    let mut state = 1_u32;
    let mut next = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        state.to_be_bytes()[0]
    };
    (0..length).map(|_| next()).collect()
}

/// 5 MB through `cat`, written and read at once; the half-close ends it.
async fn echo(connection: &Connection, bytes: Vec<u8>) {
    let channel = connection.exec(&["cat"]).await.unwrap();
    let (mut from, mut to) = tokio::io::split(channel);
    let copy = bytes.clone();
    let write = async move {
        to.write_all(&copy).await.unwrap();
        to.shutdown().await.unwrap();
    };
    let mut back = Vec::new();
    let (_, read) = tokio::join!(write, from.read_to_end(&mut back));
    read.unwrap();
    assert!(
        back == bytes,
        "{} of {} bytes came back",
        back.len(),
        bytes.len()
    );
}

#[tokio::test]
async fn both_methods_run_commands() {
    if !available() {
        return;
    }
    let sshd = Sshd::new();
    for method in BOTH {
        let connection = open(&sshd, &sshd.options(method)).await;
        assert_eq!(connection.remarks(), &[] as &[String]);
        assert_eq!(connection.peer().host, "127.0.0.1");
        assert_eq!(connection.peer().port, sshd.port);
        echo(&connection, noise(5_000_000)).await;
        let counted = connection
            .run(&["wc", "-c"], &noise(300_000))
            .await
            .unwrap();
        assert_eq!(
            (counted.code, counted.stdout.as_slice()),
            (0, b"300000\n".as_slice())
        );
        let failed = connection.run(&["ls", "/no/such/file"], b"").await.unwrap();
        assert_eq!(failed.code, 2);
        assert!(String::from_utf8_lossy(&failed.stderr).contains("/no/such/file"));
        assert_eq!(
            connection
                .run(&["no-such-program"], b"")
                .await
                .unwrap()
                .code,
            127
        );
        // It never reads what it is given.
        assert_eq!(
            connection
                .run(&["true"], &noise(3_000_000))
                .await
                .unwrap()
                .code,
            0
        );
        let bad = connection.run(&["echo", "$(id)"], b"").await;
        assert!(matches!(bad, Err(SshError::BadCommand { .. })), "{bad:?}");
    }
}

#[tokio::test]
async fn a_command_that_a_signal_ends_is_no_success() {
    if !available() {
        return;
    }
    let sshd = Sshd::new();
    for method in BOTH {
        let connection = open(&sshd, &sshd.options(method)).await;
        fs::write(sshd.path("die"), "kill -TERM $$\n").unwrap();
        let script = sshd.path("die");
        let output = connection
            .run(&["exec", "sh", script.to_str().unwrap()], b"")
            .await
            .unwrap();
        assert_ne!(output.code, 0, "{method:?} {output:?}");
    }
}

#[tokio::test]
async fn what_a_command_may_write_and_how_long_it_may_run_is_bounded() {
    if !available() {
        return;
    }
    let sshd = Sshd::new();
    for method in BOTH {
        let mut options = sshd.options(method);
        let connection = open(&sshd, &options).await;
        let endless = connection.run(&["yes"], b"").await;
        assert!(
            matches!(endless, Err(SshError::Remote { .. })),
            "{method:?} {endless:?}"
        );
        options.command_timeout = Duration::from_millis(1500);
        let connection = open(&sshd, &options).await;
        let late = connection.run(&["sleep", "20"], b"").await;
        assert!(
            matches!(late, Err(SshError::Timeout { .. })),
            "{method:?} {late:?}"
        );
    }
}

#[tokio::test]
async fn an_unknown_host_is_shown_pinned_and_then_trusted() {
    if !available() {
        return;
    }
    for method in BOTH {
        let sshd = Sshd::with(&["ed25519", "ecdsa", "rsa"], "");
        let options = sshd.options(method);
        fs::remove_file(&options.known_hosts).unwrap();
        let expected = fingerprint(&sshd.path("host_ed25519"));
        match refused(&sshd, &options).await {
            SshError::UnknownHostKey {
                host,
                fingerprint,
                known_hosts,
                ..
            } => {
                assert_eq!(host, sshd.name());
                assert_eq!(fingerprint, expected, "{method:?}");
                assert_eq!(known_hosts, options.known_hosts.display().to_string());
            }
            other => panic!("{method:?}: {other:?}"),
        }
        let keys = host_keys(&sshd.target(), &options).await.unwrap();
        let shown: Vec<&str> = keys.iter().map(|key| key.fingerprint.as_str()).collect();
        let files = ["ed25519", "ecdsa", "rsa"]
            .map(|kind| fingerprint(&sshd.path(&format!("host_{kind}"))));
        assert_eq!(shown, files);
        pin(&options.known_hosts, &sshd.target(), &keys[0]).unwrap();
        assert_eq!(
            fs::read_to_string(&options.known_hosts).unwrap(),
            sshd.host_line("ed25519") + "\n"
        );
        drop(open(&sshd, &options).await);
    }
}

#[tokio::test]
async fn a_changed_host_key_names_file_line_and_both_fingerprints() {
    if !available() {
        return;
    }
    let sshd = Sshd::new();
    keygen(&sshd.path("old"), "ed25519", "");
    let old = format!("{} {}", sshd.name(), public(&sshd.path("old")));
    sshd.know_only(&["# comment".to_owned(), String::new(), old]);
    for method in BOTH {
        let options = sshd.options(method);
        assert_eq!(
            refused(&sshd, &options).await,
            SshError::HostKeyChanged {
                host: sshd.name(),
                file: options.known_hosts,
                line: 3,
                expected: fingerprint(&sshd.path("old")),
                found: fingerprint(&sshd.path("host_ed25519")),
            }
        );
    }
    // Only a key of another type is known, and the host has none of that type any more.
    keygen(&sshd.path("older"), "rsa", "");
    sshd.know_only(&[format!("{} {}", sshd.name(), public(&sshd.path("older")))]);
    let error = refused(&sshd, &sshd.options(Method::Ssh2)).await;
    assert!(
        matches!(error, SshError::HostKeyChanged { line: 1, .. }),
        "{error:?}"
    );
}

#[tokio::test]
async fn a_wrong_user_key_says_what_was_tried() {
    if !available() {
        return;
    }
    let sshd = Sshd::new();
    keygen(&sshd.path("stranger"), "ed25519", "");
    for method in BOTH {
        let mut options = sshd.options(method);
        options.identity = Some(sshd.path("stranger"));
        let error = refused(&sshd, &options).await;
        assert!(
            matches!(&error, SshError::Auth { .. }),
            "{method:?}: {error:?}"
        );
        assert!(!error.is_unreachable());
        assert!(
            method == Method::System || error.to_string().contains("stranger"),
            "{error}"
        );
    }
}

#[tokio::test]
async fn an_encrypted_key_is_used_through_the_agent_only() {
    if !available() {
        return;
    }
    let sshd = Sshd::new();
    keygen(&sshd.path("locked"), "ed25519", "secret words");
    fs::copy(sshd.path("locked.pub"), sshd.path("authorized_keys")).unwrap();
    for method in BOTH {
        let mut options = sshd.options(method);
        options.identity = Some(sshd.path("locked"));
        let error = refused(&sshd, &options).await;
        assert!(
            matches!(error, SshError::Auth { .. }),
            "{method:?}: {error:?}"
        );
        assert!(
            method == Method::System || error.to_string().contains("ssh-add"),
            "{error}"
        );
    }
    let socket = sshd.path("agent");
    let mut agent = Command::new("ssh-agent")
        .arg("-D")
        .arg("-a")
        .arg(&socket)
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    // It says where it listens once it does.
    agent
        .stdout
        .as_mut()
        .unwrap()
        .read_exact(&mut [0; 8])
        .unwrap();
    let add = |file: &str| {
        let status = Command::new("ssh-add")
            .arg("-q")
            .arg(sshd.path(file))
            .env("SSH_AUTH_SOCK", &socket)
            .stdin(Stdio::null())
            .status()
            .unwrap();
        assert!(status.success());
    };
    // More keys than sshd takes attempts: the named one must come first.
    for number in 0..7 {
        keygen(&sshd.path(&format!("more{number}")), "ed25519", "");
        add(&format!("more{number}"));
    }
    unlock(&sshd, "locked", "secret words");
    add("unlocked");
    for method in BOTH {
        let mut options = sshd.options(method);
        options.agent = Some(socket.clone());
        options.identity = Some(sshd.path("locked"));
        drop(open(&sshd, &options).await);
    }
    agent.kill().unwrap();
    agent.wait().unwrap();
}

/// Copies a key without its passphrase.
fn unlock(sshd: &Sshd, file: &str, passphrase: &str) {
    fs::copy(sshd.path(file), sshd.path("unlocked")).unwrap();
    fs::set_permissions(sshd.path("unlocked"), fs::Permissions::from_mode(0o600)).unwrap();
    let status = Command::new("ssh-keygen")
        .args(["-q", "-p", "-P", passphrase, "-N", "", "-f"])
        .arg(sshd.path("unlocked"))
        .stdout(Stdio::null())
        .status();
    assert!(status.unwrap().success());
}

#[tokio::test]
async fn hosts_that_are_away_are_told_from_hosts_that_refuse() {
    if !available() {
        return;
    }
    let sshd = Sshd::new();
    let free = TcpListener::bind("127.0.0.1:0").unwrap();
    let nobody = format!("127.0.0.1:{}", free.local_addr().unwrap().port())
        .parse()
        .unwrap();
    drop(free);
    for method in BOTH {
        let options = sshd.options(method);
        let error = Connection::open(&nobody, &options).await.unwrap_err();
        assert!(
            matches!(error, SshError::Unreachable { .. }),
            "{method:?}: {error:?}"
        );
        assert!(error.is_unreachable());
        assert!(error.to_string().contains("127.0.0.1"), "{error}");
        let nowhere = "no-such-host.invalid".parse().unwrap();
        let error = Connection::open(&nowhere, &options).await.unwrap_err();
        assert!(error.is_unreachable(), "{method:?}: {error:?}");
    }
}

#[tokio::test]
async fn a_silent_port_is_given_up() {
    if !available() {
        return;
    }
    let sshd = Sshd::new();
    let silent = TcpListener::bind("127.0.0.1:0").unwrap();
    let target = format!("127.0.0.1:{}", silent.local_addr().unwrap().port())
        .parse()
        .unwrap();
    for method in BOTH {
        let mut options = sshd.options(method);
        options.connect_timeout = Duration::from_secs(1);
        let error = Connection::open(&target, &options).await.unwrap_err();
        assert!(error.is_unreachable(), "{method:?}: {error:?}");
    }
}

#[tokio::test]
async fn hashed_known_hosts_are_understood() {
    if !available() {
        return;
    }
    let sshd = Sshd::new();
    let status = Command::new("ssh-keygen")
        .args(["-q", "-H", "-f"])
        .arg(sshd.path("known_hosts"))
        .stderr(Stdio::null())
        .status();
    assert!(status.unwrap().success());
    let text = fs::read_to_string(sshd.path("known_hosts")).unwrap();
    assert!(
        text.starts_with("|1|") && !text.contains("127.0.0.1"),
        "{text}"
    );
    for method in BOTH {
        drop(open(&sshd, &sshd.options(method)).await);
    }
    // A wrong key under a hashed name is a change, not an unknown host.
    keygen(&sshd.path("other"), "ed25519", "");
    let (names, _) = text.split_once(' ').unwrap();
    sshd.know_only(&[format!("{names} {}", public(&sshd.path("other")))]);
    for method in BOTH {
        let error = refused(&sshd, &sshd.options(method)).await;
        assert!(
            matches!(error, SshError::HostKeyChanged { line: 1, .. }),
            "{method:?}: {error:?}"
        );
    }
}

/// Trap (b): libssh2 alone negotiates ed25519, finds only other types pinned, and calls that a changed key.
#[tokio::test]
async fn the_host_key_is_of_a_type_that_is_known() {
    if !available() {
        return;
    }
    let sshd = Sshd::with(&["ed25519", "ecdsa", "rsa"], "");
    for kinds in [&["rsa", "ecdsa"][..], &["rsa"], &["ecdsa"], &["ed25519"]] {
        let lines: Vec<String> = kinds.iter().map(|kind| sshd.host_line(kind)).collect();
        sshd.know_only(&lines);
        for method in BOTH {
            drop(open(&sshd, &sshd.options(method)).await);
        }
    }
}

/// Trap (c): libssh2 does not find `@revoked` lines.
#[tokio::test]
async fn a_revoked_key_is_refused_by_both_methods_and_cannot_be_pinned() {
    if !available() {
        return;
    }
    let sshd = Sshd::new();
    for names in [sshd.name(), "*".to_owned()] {
        sshd.know_only(&[
            sshd.host_line("ed25519"),
            format!("@revoked {names} {}", sshd.host_key("ed25519")),
        ]);
        for method in BOTH {
            let error = refused(&sshd, &sshd.options(method)).await;
            assert!(
                matches!(error, SshError::Revoked { line: 2, .. }),
                "{method:?}: {error:?}"
            );
        }
    }
    let options = sshd.options(Method::Ssh2);
    let keys = host_keys(&sshd.target(), &options).await.unwrap();
    let pinned = pin(&options.known_hosts, &sshd.target(), &keys[0]);
    assert!(
        matches!(pinned, Err(SshError::Revoked { line: 2, .. })),
        "{pinned:?}"
    );
}

/// Trap (c): patterns and authorities are for the system's client, and the user is told.
#[tokio::test]
async fn patterns_and_authorities_use_the_system_client_and_say_so() {
    if !available() {
        return;
    }
    let sshd = Sshd::new();
    sshd.know_only(&[format!("[127.0.0.*]:* {}", sshd.host_key("ed25519"))]);
    let connection = open(&sshd, &sshd.options(Method::Ssh2)).await;
    assert_eq!(connection.remarks().len(), 1);
    assert!(
        connection.remarks()[0].contains("known_hosts:1 has a pattern"),
        "{:?}",
        connection.remarks()
    );
    echo(&connection, noise(1000)).await;

    keygen(&sshd.path("authority"), "ed25519", "");
    let status = Command::new("ssh-keygen")
        .args(["-q", "-s"])
        .arg(sshd.path("authority"))
        .args(["-I", "test", "-h", "-n", "127.0.0.1"])
        .arg(sshd.path("host_ed25519.pub"))
        .stderr(Stdio::null())
        .status()
        .unwrap();
    assert!(status.success());
    let config = fs::read_to_string(sshd.path("sshd_config")).unwrap();
    let certificate = sshd.path("host_ed25519-cert.pub");
    fs::write(
        sshd.path("sshd_config"),
        format!("{config}HostCertificate {}\n", certificate.display()),
    )
    .unwrap();
    sshd.know_only(&[format!(
        "@cert-authority [127.0.0.1]:* {}",
        public(&sshd.path("authority"))
    )]);
    let connection = open(&sshd, &sshd.options(Method::Ssh2)).await;
    assert!(
        connection.remarks()[0].contains("@cert-authority"),
        "{:?}",
        connection.remarks()
    );
}

#[tokio::test]
async fn an_alias_of_ssh_config_brings_address_port_key_and_known_hosts() {
    if !available() {
        return;
    }
    let sshd = Sshd::new();
    fs::rename(sshd.path("known_hosts"), sshd.path("elsewhere")).unwrap();
    let text = format!(
        "Host other\n  Port 1\nHost rob*\n  HostName 127.0.0.1\n  Port {}\n  IdentityFile {}\n  UserKnownHostsFile {}\nHost *\n  Port 2\n",
        sshd.port,
        sshd.path("user").display(),
        sshd.path("elsewhere").display()
    );
    fs::write(sshd.path("config"), &text).unwrap();
    let alias = "robot".parse().unwrap();
    let mut options = sshd.options(Method::Ssh2);
    options.config = Some(sshd.path("config"));
    options.identity = None;
    let connection = Connection::open(&alias, &options).await.unwrap();
    assert_eq!(
        (connection.peer().host.as_str(), connection.peer().port),
        ("127.0.0.1", sshd.port)
    );
    assert_eq!(connection.peer().address.unwrap().to_string(), "127.0.0.1");
    options.method = Method::System;
    let connection = Connection::open(&alias, &options).await.unwrap();
    assert_eq!(
        (connection.peer().host.as_str(), connection.peer().port),
        ("127.0.0.1", sshd.port)
    );

    fs::write(sshd.path("included"), &text).unwrap();
    fs::write(
        sshd.path("config"),
        format!("Include {}\n", sshd.path("included").display()),
    )
    .unwrap();
    drop(Connection::open(&alias, &options).await.unwrap());
    options.method = Method::Ssh2;
    let error = Connection::open(&alias, &options).await.unwrap_err();
    assert!(
        matches!(error, SshError::Config { line: 1, .. }),
        "{error:?}"
    );
    assert!(error.to_string().contains("client: system"), "{error}");
}

/// Trap (d): a host behind another.
#[tokio::test]
async fn a_host_behind_another_is_reached_through_it() {
    if !available() {
        return;
    }
    let (gate, inner) = (Sshd::new(), Sshd::new());
    fs::copy(gate.path("authorized_keys"), inner.path("authorized_keys")).unwrap();
    gate.know(&inner.host_line("ed25519"));
    let known = gate.path("known_hosts");
    let text = format!(
        "Host inner\n  HostName 127.0.0.1\n  Port {}\n  ProxyJump gate\nHost gate\n  HostName 127.0.0.1\n  Port {}\n\
         Host *\n  IdentityFile {}\n  UserKnownHostsFile {}\n",
        inner.port,
        gate.port,
        gate.path("user").display(),
        known.display()
    );
    fs::write(gate.path("config"), text).unwrap();
    let alias = "inner".parse().unwrap();
    for method in BOTH {
        let mut options = gate.options(method);
        options.config = Some(gate.path("config"));
        options.identity = None;
        let (at_gate, at_inner) = (gate.connections(), inner.connections());
        let connection = Connection::open(&alias, &options).await.unwrap();
        assert!(gate.connections() > at_gate && inner.connections() > at_inner);
        assert_eq!(connection.peer().port, inner.port);
        echo(&connection, noise(2_000_000)).await;
        let keys = host_keys(&alias, &options).await.unwrap();
        assert_eq!(
            keys[0].fingerprint,
            fingerprint(&inner.path("host_ed25519"))
        );
    }
}

/// Trap (a): a channel that nobody reads, and one that takes no input, hold up no other.
#[tokio::test]
async fn a_blocked_channel_does_not_stall_another() {
    if !available() {
        return;
    }
    let sshd = Sshd::new();
    for method in BOTH {
        let connection = open(&sshd, &sshd.options(method)).await;
        // `yes` writes without end and never reads.
        let channel = connection.exec(&["yes"]).await.unwrap();
        let (unread, mut to) = tokio::io::split(channel);
        let writer = tokio::spawn(async move { to.write_all(&noise(16_000_000)).await });
        for _ in 0..3 {
            echo(&connection, noise(3_000_000)).await;
        }
        assert!(!writer.is_finished());
        writer.abort();
        drop(writer.await);
        drop(unread);
        // And what was dropped in the middle leaves the session whole.
        echo(&connection, noise(3_000_000)).await;
    }
}

/// Trap (e): MaxSessions is 10 by default, and may be less.
#[tokio::test]
async fn twelve_channels_at_once_all_work() {
    if !available() {
        return;
    }
    for (method, max) in [(Method::Ssh2, 10), (Method::Ssh2, 2), (Method::System, 10)] {
        let sshd = Sshd::with(&["ed25519"], &format!("MaxSessions {max}"));
        let connection = open(&sshd, &sshd.options(method)).await;
        let tasks: Vec<_> = (0..12)
            .map(|number| {
                let connection = connection.clone();
                tokio::spawn(async move { echo(&connection, noise(200_000 + number)).await })
            })
            .collect();
        for task in tasks {
            task.await.unwrap();
        }
        if method == Method::Ssh2 {
            assert_eq!(sshd.connections(), 1, "all on one session");
        }
    }
}

#[tokio::test]
async fn a_host_that_drops_silent_clients_keeps_an_idle_session() {
    if !available() {
        return;
    }
    let sshd = Sshd::with(
        &["ed25519"],
        "ClientAliveInterval 3\nClientAliveCountMax 1\n",
    );
    let connection = open(&sshd, &sshd.options(Method::Ssh2)).await;
    echo(&connection, noise(10)).await;
    // Longer than the host waits for a sign of life: twice its interval.
    tokio::time::sleep(Duration::from_secs(9)).await;
    echo(&connection, noise(10)).await;
}

#[tokio::test]
async fn a_lost_connection_ends_every_channel_with_its_reason() {
    if !available() {
        return;
    }
    let sshd = Sshd::new();
    let connection = open(&sshd, &sshd.options(Method::Ssh2)).await;
    let mut channel = connection.exec(&["cat"]).await.unwrap();
    channel.write_all(b"x").await.unwrap();
    channel.read_exact(&mut [0]).await.unwrap();
    sshd.kill_connections();
    let error = channel.read_to_end(&mut Vec::new()).await.unwrap_err();
    let source = error.get_ref().unwrap().downcast_ref::<SshError>().unwrap();
    assert!(
        matches!(source, SshError::Closed { .. }) && source.is_unreachable(),
        "{source:?}"
    );
    let after = connection.run(&["true"], b"").await;
    assert!(matches!(after, Err(SshError::Closed { .. })), "{after:?}");
    // And one that was lost while nothing ran on it.
    let connection = open(&sshd, &sshd.options(Method::Ssh2)).await;
    sshd.kill_connections();
    let after = connection.run(&["true"], b"").await;
    assert!(matches!(after, Err(SshError::Closed { .. })), "{after:?}");
}

#[tokio::test]
async fn a_file_is_sent_whole_or_not_at_all() {
    if !available() {
        return;
    }
    let sshd = Sshd::new();
    let bytes = noise(3_000_000);
    fs::write(sshd.path("local"), &bytes).unwrap();
    fs::create_dir(sshd.path("there")).unwrap();
    let to = sshd.path("there/file");
    for method in BOTH {
        let connection = open(&sshd, &sshd.options(method)).await;
        fs::write(&to, "what was there").unwrap();
        let mut told = Vec::new();
        let mut progress = |sent| told.push(sent);
        connection
            .upload(
                &sshd.path("local"),
                to.to_str().unwrap(),
                0o755,
                &mut progress,
            )
            .await
            .unwrap();
        assert!(fs::read(&to).unwrap() == bytes);
        assert_eq!(
            fs::metadata(&to).unwrap().permissions().mode() & 0o7777,
            0o755
        );
        assert!(
            told.is_sorted() && told.last() == Some(&3_000_000),
            "{told:?}"
        );

        let nowhere = sshd.path("nowhere/file");
        let error = connection
            .upload(
                &sshd.path("local"),
                nowhere.to_str().unwrap(),
                0o644,
                &mut |_| {},
            )
            .await;
        assert!(matches!(error, Err(SshError::Remote { .. })), "{error:?}");
        // A place that cannot be moved to: nothing is left beside it.
        fs::create_dir_all(sshd.path("there/taken/local")).unwrap();
        let missing = connection
            .upload(
                &sshd.path("no such file"),
                to.to_str().unwrap(),
                0o644,
                &mut |_| {},
            )
            .await;
        assert!(
            matches!(missing, Err(SshError::Local { .. })),
            "{missing:?}"
        );
        let bad = connection
            .upload(&sshd.path("local"), "a;b", 0o644, &mut |_| {})
            .await;
        assert!(matches!(bad, Err(SshError::BadCommand { .. })), "{bad:?}");
        let mut left: Vec<_> = fs::read_dir(sshd.path("there"))
            .unwrap()
            .map(|entry| entry.unwrap().file_name())
            .collect();
        left.sort();
        assert_eq!(left, ["file", "taken"]);
    }
}
