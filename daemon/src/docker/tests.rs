//! The engine of this machine, with programs of a hundred bytes; skipped where there is none.

use std::fs;
use std::io::{Read, Write};
use std::os::unix::net::{UnixListener, UnixStream};
use std::sync::mpsc;

use ictus_deploy::image::ImageConfig;
use tempfile::TempDir;

use super::*;
use crate::identity::random_id;

/// A program that says hello and exits with 7.
const GREETS: &[u8] = b"\xb8\x3c\x00\x00\x00\xbf\x07\x00\x00\x00\x0f\x05";
/// A program that says hello and sleeps.
const WAITS: &[u8] = b"\xb8\x22\x00\x00\x00\x0f\x05\xeb\xf7";
/// A program that says hello and writes into 128 MiB.
const FILLS: &[u8] = b"\xb8\x09\x00\x00\x00\x31\xff\xbe\x00\x00\x00\x08\xba\x03\x00\x00\x00\x41\xba\x22\x00\x00\x00\
\x41\xb8\xff\xff\xff\xff\x45\x31\xc9\x0f\x05\xb9\x00\x80\x00\x00\xc6\x00\x01\x48\x05\x00\x10\x00\x00\xff\xc9\x75\xf3\
\xb8\x3c\x00\x00\x00\xbf\x07\x00\x00\x00\x0f\x05";

/// A static program for x86-64 that says hello and goes on with these instructions.
fn program(then: &[u8]) -> Vec<u8> {
    let mut code = b"\xb8\x01\x00\x00\x00\xbf\x01\x00\x00\x00\x48\x8d\x35".to_vec();
    // The message stands behind the code; counted from the end of this instruction.
    let to_message = u32::try_from(5 + 2 + then.len()).unwrap();
    code.extend(to_message.to_le_bytes());
    code.extend(b"\xba\x06\x00\x00\x00\x0f\x05");
    code.extend(then);
    code.extend(b"hello\n");
    let mut bytes = b"\x7fELF\x02\x01\x01".to_vec();
    bytes.resize(16, 0);
    bytes.extend(2_u16.to_le_bytes());
    bytes.extend(62_u16.to_le_bytes());
    bytes.extend(1_u32.to_le_bytes());
    let wide = |bytes: &mut Vec<u8>, values: &[u64]| {
        bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
    };
    wide(&mut bytes, &[0x40_0078, 64, 0]);
    bytes.extend(0_u32.to_le_bytes());
    bytes.extend(
        [64_u16, 56, 1, 0, 0, 0]
            .iter()
            .flat_map(|value| value.to_le_bytes()),
    );
    bytes.extend([1_u32, 5].iter().flat_map(|value| value.to_le_bytes()));
    let length = 120 + code.len() as u64;
    wide(
        &mut bytes,
        &[0, 0x40_0000, 0x40_0000, length, length, 0x1000],
    );
    bytes.extend(code);
    bytes
}

/// An engine and a federation of its own in it.
#[derive(Clone)]
struct Rig {
    engine: Engine,
    federation: String,
}

impl Rig {
    async fn image(&self, then: &[u8]) -> String {
        self.engine.provide(self.archive(then).1).await.unwrap()
    }

    fn archive(&self, then: &[u8]) -> (TempDir, Archive) {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("program");
        fs::write(&path, program(then)).unwrap();
        let labels = BTreeMap::from([(label::FEDERATION.to_owned(), self.federation.clone())]);
        let archive = Archive::of(&path, &ImageConfig { labels }).unwrap();
        // Read again when it is written.
        (directory, archive)
    }

    fn spec(&self, image: &str) -> ContainerSpec {
        let instance = random_id().unwrap();
        ContainerSpec {
            name: ContainerSpec::name_of(&self.federation, "a", &instance),
            image: image.to_owned(),
            labels: BTreeMap::from([
                (label::FEDERATION.to_owned(), self.federation.clone()),
                (label::INSTANCE.to_owned(), instance),
            ]),
            entrypoint: vec!["/app".to_owned()],
            user: "65532:65532".to_owned(),
            workdir: "/".into(),
            read_only_root: true,
            ..ContainerSpec::default()
        }
    }

    async fn containers(&self) -> Vec<Container> {
        self.engine
            .list(&[(label::FEDERATION, &self.federation)])
            .await
            .unwrap()
    }

    async fn ended(&self, id: &str) -> Container {
        let mut ends = pin!(self.engine.docker.wait_container(id, None));
        // The exit code is an error for the client when it is not 0.
        timeout(ANSWER_MAX, ends.next()).await.unwrap();
        self.engine.inspect(id).await.unwrap().unwrap()
    }
}

/// Runs a test in the engine of this machine and checks that it left nothing. Without an engine it is skipped, which a
/// line tells; not where everything must be tested.
async fn in_engine<F: Future<Output = ()> + Send + 'static>(test: impl FnOnce(Rig) -> F) {
    let engine = match Engine::connect().await {
        Ok(engine) if cfg!(target_arch = "x86_64") => engine,
        Ok(_) => return,
        Err(error) if std::env::var("CI").as_deref() == Ok("true") => panic!("{error}"),
        Err(error) => return eprintln!("skipped: {error}"),
    };
    let rig = Rig {
        engine,
        federation: format!("test-{}", &random_id().unwrap()[..12]),
    };
    let result = tokio::spawn(test(rig.clone())).await;
    let left = rig.containers().await;
    for container in &left {
        rig.engine.remove(&container.id).await.unwrap();
    }
    rig.engine
        .remove_images((label::FEDERATION, &rig.federation))
        .await
        .unwrap();
    result.unwrap();
    assert_eq!(left, []);
}

#[tokio::test]
async fn an_image_has_one_id_and_runs() {
    in_engine(|rig| async move {
        let (_directory, archive) = rig.archive(GREETS);
        let (expected, reference) = (archive.id().to_owned(), archive.reference());
        assert!(!rig.engine.has_image(&reference).await.unwrap());
        assert_eq!(rig.engine.load(archive.clone()).await.unwrap(), expected);
        assert_eq!(rig.engine.load(archive).await.unwrap(), expected);
        let image = rig.engine.inspect_image(&reference).await.unwrap().unwrap();
        assert_eq!(
            (image.architecture.as_str(), image.user.as_str()),
            ("amd64", "65532:65532")
        );
        assert_eq!(image.entrypoint, ["/app"]);
        let id = rig.engine.run(&rig.spec(&reference)).await.unwrap();
        let ended = rig.ended(&id).await;
        assert_eq!(
            (ended.running, ended.exit_code, ended.oom_killed),
            (false, Some(7), false)
        );
        assert_eq!(rig.engine.log_tail(&id).await, "hello");
        // While a container uses it, it stays.
        assert_eq!(
            rig.engine
                .remove_images((label::FEDERATION, &rig.federation))
                .await
                .unwrap(),
            0
        );
        rig.engine.remove(&id).await.unwrap();
        rig.engine.remove(&id).await.unwrap();
        assert_eq!(
            rig.engine
                .remove_images((label::FEDERATION, &rig.federation))
                .await
                .unwrap(),
            1
        );
        assert!(!rig.engine.has_image(&reference).await.unwrap());
    })
    .await;
}

#[tokio::test]
async fn a_container_is_seen_with_its_labels_and_its_process() {
    in_engine(|rig| async move {
        let spec = rig.spec(&rig.image(WAITS).await);
        let id = rig.engine.run(&spec).await.unwrap();
        let seen = rig.engine.inspect(&spec.name).await.unwrap().unwrap();
        assert_eq!(
            (seen.id.as_str(), seen.running, seen.exit_code),
            (id.as_str(), true, None)
        );
        assert_eq!(seen.labels, spec.labels);
        let status = fs::read_to_string(format!("/proc/{}/status", seen.pid.unwrap())).unwrap();
        for line in [
            "Uid:\t65532\t65532",
            "CapBnd:\t0000000000000000",
            "NoNewPrivs:\t1",
        ] {
            assert!(status.contains(line), "{status}");
        }
        rig.engine.remove(&id).await.unwrap();
        assert_eq!(rig.engine.inspect(&id).await.unwrap(), None);
    })
    .await;
}

#[tokio::test]
async fn memory_that_is_used_up_is_told() {
    in_engine(|rig| async move {
        let mut spec = rig.spec(&rig.image(FILLS).await);
        spec.memory = Some(16 << 20);
        let id = rig.engine.run(&spec).await.unwrap();
        let ended = rig.ended(&id).await;
        assert_eq!((ended.exit_code, ended.oom_killed), (Some(137), true));
        rig.engine.remove(&id).await.unwrap();
    })
    .await;
}

#[tokio::test]
async fn an_image_that_is_not_there_is_named_and_nothing_is_left() {
    in_engine(|rig| async move {
        let why = rig
            .engine
            .run(&rig.spec("no-such-image:1"))
            .await
            .unwrap_err()
            .to_string();
        assert!(
            why.contains("image no-such-image:1 is not on this host"),
            "{why}"
        );
    })
    .await;
}

#[tokio::test]
async fn an_image_of_another_architecture_is_refused() {
    in_engine(|rig| async move {
        let directory = tempfile::tempdir().unwrap();
        let mut bytes = program(GREETS);
        bytes[18] = 183;
        let path = directory.path().join("program");
        fs::write(&path, bytes).unwrap();
        let labels = BTreeMap::from([(label::FEDERATION.to_owned(), rig.federation.clone())]);
        let image = rig
            .engine
            .provide(Archive::of(&path, &ImageConfig { labels }).unwrap())
            .await
            .unwrap();
        let why = rig
            .engine
            .run(&rig.spec(&image))
            .await
            .unwrap_err()
            .to_string();
        assert!(
            why.contains("is built for arm64, but this host is amd64"),
            "{why}"
        );
    })
    .await;
}

#[tokio::test]
async fn what_cannot_start_is_removed_and_its_first_cause_told() {
    in_engine(|rig| async move {
        let image = rig.image(GREETS).await;
        let mut spec = rig.spec(&image);
        spec.entrypoint = vec!["/no/such/program".to_owned()];
        let why = rig.engine.run(&spec).await.unwrap_err().to_string();
        assert!(
            why.starts_with(&format!("cannot start container `{}`", spec.name)),
            "{why}"
        );
        assert!(why.contains("/no/such/program"), "{why}");
        let mut spec = rig.spec(&image);
        spec.mounts = vec![Binding::same(Path::new("/no/such/directory"), true)];
        let why = rig.engine.run(&spec).await.unwrap_err().to_string();
        assert!(
            why.contains("/no/such/directory") && why.contains("correct `volumes:`"),
            "{why}"
        );
    })
    .await;
}

#[tokio::test]
async fn a_name_in_use_is_left_alone_unless_it_is_of_this_instance() {
    in_engine(|rig| async move {
        let mut foreign = rig.spec(&rig.image(WAITS).await);
        let spec = foreign.clone();
        foreign.labels.remove(label::INSTANCE);
        let id = rig.engine.run(&foreign).await.unwrap();
        let why = rig.engine.run(&spec).await.unwrap_err().to_string();
        assert!(why.contains("it is left alone"), "{why}");
        assert!(rig.engine.inspect(&id).await.unwrap().unwrap().running);
        rig.engine.remove(&id).await.unwrap();
        // Made by a call whose answer was lost.
        let lost = rig.engine.create(&spec).await.unwrap();
        let again = rig.engine.run(&spec).await.unwrap();
        assert_ne!(lost, again);
        assert_eq!(rig.containers().await.len(), 1);
        rig.engine.remove(&again).await.unwrap();
    })
    .await;
}

#[tokio::test]
async fn an_engine_that_is_absent_stopped_or_not_ours_is_told_apart() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("docker.sock");
    let absent = Engine::connect_to(&path).await.unwrap_err().to_string();
    assert!(
        absent.contains("is not there") && absent.contains("apt-get install"),
        "{absent}"
    );
    drop(UnixListener::bind(&path).unwrap());
    let stopped = Engine::connect_to(&path).await.unwrap_err().to_string();
    assert!(
        stopped.contains("does not run") && stopped.contains("systemctl start docker"),
        "{stopped}"
    );
    let denied = unreachable(&path, &io::ErrorKind::PermissionDenied.into()).to_string();
    assert!(denied.contains("usermod -aG docker"), "{denied}");
    let elsewhere = socket(Some("tcp://10.0.0.1:2375".to_owned()))
        .unwrap_err()
        .to_string();
    assert!(elsewhere.contains("tcp://10.0.0.1:2375"), "{elsewhere}");
    assert_eq!(
        socket(Some("unix:///run/d.sock".to_owned())).unwrap(),
        Path::new("/run/d.sock")
    );
    assert_eq!(socket(None).unwrap(), Path::new(SOCKET));
}

/// Answers as an engine with two images that were sent; gives what it is asked to remove.
fn with_sent_images(listener: UnixListener) -> mpsc::Receiver<String> {
    let (sender, removed) = mpsc::channel();
    let answer = |request: &str| {
        let image = |tag: &str| {
            format!(
                r#"{{"Id":"sha256:1","ParentId":"","RepoTags":["ictus-sent:f-{tag}"],"RepoDigests":[],"Created":0,
                "Size":1,"SharedSize":0,"Labels":{{}},"Containers":0}}"#
            )
        };
        match request {
            request if request.contains("/version") => {
                r#"{"Version":"28.0.0","ApiVersion":"1.48"}"#.to_owned()
            }
            request if request.contains("/info") => "{}".to_owned(),
            request if request.starts_with("DELETE") => "[]".to_owned(),
            _ => format!("[{},{}]", image(&"0".repeat(16)), image(&"1".repeat(16))),
        }
    };
    let serve = move |mut stream: UnixStream, sender: mpsc::Sender<String>| {
        let mut request = [0; 4096];
        while let Ok(count @ 1..) = stream.read(&mut request) {
            let request = String::from_utf8_lossy(&request[..count]);
            let body = answer(&request);
            if request.starts_with("DELETE") {
                sender.send(request.into_owned()).unwrap();
            }
            write!(stream, "HTTP/1.1 200 OK\r\nContent-Type: application/json\r\nContent-Length: {}\r\n\r\n{body}", body.len())
                .unwrap();
        }
    };
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let sender = sender.clone();
            std::thread::spawn(move || serve(stream.unwrap(), sender));
        }
    });
    removed
}

#[tokio::test]
async fn an_image_that_is_needed_meanwhile_is_not_removed() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("docker.sock");
    let removed = with_sent_images(UnixListener::bind(&path).unwrap());
    let engine = Engine::connect_to(&path).await.unwrap();
    let asked = std::cell::Cell::new(0);
    // A change begins after the first one went.
    let needed = |_: &str| asked.replace(asked.get() + 1) > 0;
    engine.remove_sent(needed).await.unwrap();
    let removed: Vec<_> = removed.try_iter().collect();
    assert_eq!((asked.get(), removed.len()), (2, 1), "{removed:?}");
}

#[tokio::test]
async fn an_engine_that_is_too_old_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("docker.sock");
    let listener = UnixListener::bind(&path).unwrap();
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let (mut stream, mut request) = (stream.unwrap(), [0; 4096]);
            if stream.read(&mut request).unwrap() > 0 {
                let body = r#"{"Version":"19.03.15","ApiVersion":"1.40"}"#;
                write!(stream, "HTTP/1.1 200 OK\r\nContent-Type: application/json\r\nContent-Length: {}\r\n\r\n{body}", body.len())
                    .unwrap();
            }
        }
    });
    let old = Engine::connect_to(&path).await.unwrap_err().to_string();
    assert_eq!(
        old,
        "the Docker engine is too old (version 19.03.15, API 1.40): Docker 20.10 (API 1.41) or newer is needed; upgrade it \
         (`sudo apt-get install --only-upgrade docker.io`, or docker-ce from docs.docker.com/engine/install)"
    );
    assert!(is_new_enough("1.41") && is_new_enough("2.0"));
    assert!(!is_new_enough("1.9") && !is_new_enough("") && !is_new_enough("x.y"));
}
