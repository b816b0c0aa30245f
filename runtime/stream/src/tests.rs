//! Both ends over pipes in memory that pass on as little as a byte at a time, and over sockets.

use super::*;
use proptest::prelude::*;
use std::cell::RefCell;
use std::collections::VecDeque;
use std::io::{self, ErrorKind, Read, Write};
use std::rc::Rc;

/// What has been written in one direction, and how much a call passes on.
#[derive(Debug, Default)]
struct Line {
    bytes: VecDeque<u8>,
    /// Everything that ever went over it.
    seen: Vec<u8>,
    shut: bool,
    reset: bool,
    /// What calls pass on, in turn, of reading and of writing; 0: nothing now. Empty: all.
    steps: [VecDeque<usize>; 2],
    capacity: usize,
}

impl Line {
    fn step(&mut self, writing: usize) -> usize {
        let steps = &mut self.steps[writing];
        let step = steps.pop_front();
        steps.extend(step);
        step.unwrap_or(usize::MAX)
    }
}

/// One end of two lines.
#[derive(Clone, Debug)]
struct Pipe {
    incoming: Rc<RefCell<Line>>,
    outgoing: Rc<RefCell<Line>>,
}

impl Read for Pipe {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let mut line = self.incoming.borrow_mut();
        if line.reset {
            return Err(ErrorKind::ConnectionReset.into());
        }
        if line.bytes.is_empty() && line.shut {
            return Ok(0);
        }
        let count = buffer.len().min(line.bytes.len()).min(line.step(0));
        if count == 0 {
            return Err(ErrorKind::WouldBlock.into());
        }
        for (place, byte) in buffer.iter_mut().zip(line.bytes.drain(..count)) {
            *place = byte;
        }
        Ok(count)
    }
}

impl Write for Pipe {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut line = self.outgoing.borrow_mut();
        let room = line.capacity - line.bytes.len().min(line.capacity);
        let count = bytes.len().min(room).min(line.step(1));
        if count == 0 {
            return Err(ErrorKind::WouldBlock.into());
        }
        line.bytes.extend(&bytes[..count]);
        line.seen.extend(&bytes[..count]);
        Ok(count)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

fn pipes(steps: &[usize], capacity: usize) -> (Pipe, Pipe) {
    let line = || {
        let line = Line {
            steps: [0, 1].map(|_| steps.iter().copied().collect()),
            capacity,
            ..Line::default()
        };
        Rc::new(RefCell::new(line))
    };
    let (there, back) = (line(), line());
    let near = Pipe {
        incoming: Rc::clone(&back),
        outgoing: Rc::clone(&there),
    };
    let far = Pipe {
        incoming: there,
        outgoing: back,
    };
    (near, far)
}

fn credentials(authority: &Authority, member: Member) -> Credentials {
    Credentials::of(&authority.certify(member).unwrap()).unwrap()
}

/// A federate that connects and the RTI that accepts, over these pipes.
fn pair((near, far): (Pipe, Pipe)) -> (Stream<Pipe>, Stream<Pipe>) {
    let authority = Authority::new("run").unwrap();
    let federate = credentials(&authority, Member::Federate(3));
    let rti = credentials(&authority, Member::Rti);
    (
        federate.connect(near, Member::Rti).unwrap(),
        rti.accept(far).unwrap(),
    )
}

/// Reads into `all` until there is no more now; the end, if that has come.
fn drain(stream: &mut Stream<Pipe>, all: &mut Vec<u8>) -> Option<io::Result<()>> {
    let mut buffer = [0; 10_000];
    loop {
        match stream.read(&mut buffer) {
            Ok(0) => return Some(Ok(())),
            Ok(count) => all.extend(&buffer[..count]),
            Err(error) if error.kind() == ErrorKind::WouldBlock => return None,
            Err(error) => return Some(Err(error)),
        }
    }
}

/// Lets both ends go on until one of them has ended.
fn shake(near: &mut Stream<Pipe>, far: &mut Stream<Pipe>) -> (Option<TlsError>, Option<TlsError>) {
    let mut nothing = Vec::new();
    let _begin = near.flush();
    for _ in 0..1000 {
        for end in [&mut *near, &mut *far] {
            let _wait = end.flush();
            let _ended = drain(end, &mut nothing);
        }
        let failed = near.failure().is_some() || far.failure().is_some();
        if failed || (near.is_open() && far.is_open()) {
            // What one end says last, the other hears.
            let _told = (drain(near, &mut nothing), drain(far, &mut nothing));
            break;
        }
    }
    assert!(nothing.is_empty());
    (near.failure().cloned(), far.failure().cloned())
}

/// Sends `text` from one end to the other, ends, and gives what came and how that ended.
fn send(near: &mut Stream<Pipe>, far: &mut Stream<Pipe>, text: &[u8]) -> Vec<u8> {
    let (mut written, mut read) = (0, Vec::new());
    let mut back = Vec::new();
    for _ in 0..2_000_000 {
        if written < text.len() {
            match near.write(&text[written..]) {
                Ok(count) => written += count,
                Err(error) => assert_eq!(error.kind(), ErrorKind::WouldBlock),
            }
        } else if near.finish().is_ok() {
            near.tcp().outgoing.borrow_mut().shut = true;
        }
        assert!(drain(near, &mut back).is_none());
        let _wait = far.flush();
        if let Some(end) = drain(far, &mut read) {
            end.unwrap();
            return read;
        }
    }
    panic!("{written} of {} written, {} read", text.len(), read.len());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// However the socket cuts what is written, the same bytes come, and then the end.
    #[test]
    fn the_same_bytes_come_and_then_the_end(
        steps in proptest::collection::vec(0_usize..40_000, 0..6),
        capacity in 1_usize..100_000,
        length in 0_usize..600_000,
    ) {
        prop_assume!(steps.is_empty() || steps.iter().any(|step| *step > 0));
        let (mut near, mut far) = pair(pipes(&steps, capacity));
        let text: Vec<u8> = (0..=250).cycle().take(length).collect();
        prop_assert!(send(&mut near, &mut far, &text) == text);
        prop_assert_eq!(far.peer(), Some(Member::Federate(3)));
        prop_assert_eq!(near.peer(), Some(Member::Rti));
        prop_assert!(!near.owes() && near.owed() == 0);
    }

    /// Whatever comes instead of TLS, it is an error and nothing is handed on.
    #[test]
    fn any_bytes_are_survived(bytes: Vec<u8>) {
        let (near, far) = pipes(&[], 1 << 20);
        let (_, mut far) = pair((near.clone(), far));
        near.outgoing.borrow_mut().bytes.extend(&bytes);
        near.outgoing.borrow_mut().shut = true;
        let mut read = Vec::new();
        let end = drain(&mut far, &mut read);
        prop_assert!(end.unwrap().is_err());
        prop_assert!(read.is_empty() && !far.is_open());
    }
}

#[test]
fn a_byte_at_a_time_is_enough() {
    let (mut near, mut far) = pair(pipes(&[1, 0], 1));
    assert_eq!(send(&mut near, &mut far, b"tag"), b"tag");
}

/// More than the socket takes is not taken: what waits stays with who writes.
#[test]
fn a_reader_that_takes_nothing_holds_the_writer_up() {
    let (mut near, mut far) = pair(pipes(&[], 64 << 10));
    assert_eq!(shake(&mut near, &mut far), (None, None));
    let text = vec![7; 4 << 20];
    let mut written = 0;
    while let Ok(count) = near.write(&text[written..]) {
        written += count;
    }
    assert!(written <= 512 << 10, "{written}");
    assert!(near.owes() && near.owed() > 0);
    assert_eq!(
        send(&mut near, &mut far, &text[written..]).len(),
        text.len()
    );
}

#[test]
fn what_is_written_is_on_no_wire() {
    let canary = b"canary: nobody in between reads this";
    let (near, far) = pipes(&[], 1 << 20);
    let wire = (Rc::clone(&near.outgoing), Rc::clone(&far.outgoing));
    let (mut near, mut far) = pair((near, far));
    assert_eq!(send(&mut near, &mut far, canary), canary);
    for line in [wire.0, wire.1] {
        let seen = &line.borrow().seen;
        assert!(seen.len() > 500, "both ends have spoken");
        assert!(!seen.windows(6).any(|window| window == b"canary"));
    }
    // In the clear it is.
    let (near, _far) = pipes(&[], 1 << 20);
    let line = Rc::clone(&near.outgoing);
    assert_eq!(Stream::plain(near).write(canary).unwrap(), canary.len());
    assert_eq!(line.borrow().seen, canary);
}

#[test]
fn an_end_that_nobody_said_is_told_from_one_that_was() {
    let (mut near, mut far) = pair(pipes(&[], 1 << 20));
    assert_eq!(shake(&mut near, &mut far), (None, None));
    assert_eq!(near.write(b"last").unwrap(), 4);
    near.tcp().outgoing.borrow_mut().shut = true;
    let mut buffer = [0; 100];
    // Data first, and the end is not waited for.
    assert_eq!(far.read(&mut buffer).unwrap(), 4);
    assert!(far.has_more());
    let end = far.read(&mut buffer).unwrap_err();
    assert_eq!(end.kind(), ErrorKind::UnexpectedEof);
    assert!(far.failure().is_none() && !far.has_more());
}

#[test]
fn what_is_changed_on_the_way_is_found_out() {
    let (mut near, mut far) = pair(pipes(&[], 1 << 20));
    assert_eq!(shake(&mut near, &mut far), (None, None));
    near.write(b"stop at tag 5").unwrap();
    let line = Rc::clone(&near.tcp().outgoing);
    if let Some(byte) = line.borrow_mut().bytes.back_mut() {
        *byte ^= 1;
    }
    let mut read = Vec::new();
    let end = drain(&mut far, &mut read).unwrap().unwrap_err();
    assert_eq!(end.kind(), ErrorKind::InvalidData);
    assert!(read.is_empty());
}

/// Who has connected, who was to be reached, and who was there: what each end finds.
#[test]
fn nobody_is_taken_for_another() {
    let (run, other) = (
        Authority::new("run").unwrap(),
        Authority::new("run").unwrap(),
    );
    let rti = || credentials(&run, Member::Rti);
    let federate = |id| credentials(&run, Member::Federate(id));
    let shake = |from: Credentials, to, at: Credentials| {
        let (near, far) = pipes(&[], 1 << 20);
        shake(
            &mut from.connect(near, to).unwrap(),
            &mut at.accept(far).unwrap(),
        )
    };
    assert_eq!(shake(federate(3), Member::Rti, rti()), (None, None));
    assert_eq!(
        shake(federate(3), Member::Federate(4), federate(4)),
        (None, None)
    );
    // Another member is there than the one that was to be reached.
    let (near, far) = shake(federate(3), Member::Rti, federate(4));
    assert_eq!(near, Some(TlsError::Another(Member::Rti)));
    assert!(matches!(far, Some(TlsError::Refused(_))), "{far:?}");
    let (near, _) = shake(federate(3), Member::Federate(5), federate(4));
    assert_eq!(near, Some(TlsError::Another(Member::Federate(5))));
    // Of another run, although its name is the same.
    let stranger = credentials(&other, Member::Federate(3));
    let (near, far) = shake(federate(3), Member::Rti, credentials(&other, Member::Rti));
    assert_eq!(near, Some(TlsError::NotOfThisRun));
    assert!(matches!(far, Some(TlsError::Refused(_))), "{far:?}");
    let mixed = credentials_of_two(&run, &other);
    let (near, far) = shake(mixed, Member::Rti, rti());
    assert_eq!(far, Some(TlsError::NotOfThisRun));
    assert!(matches!(near, Some(TlsError::Refused(_))), "{near:?}");
    drop(stranger);
    // The RTI connects to nobody.
    let (_, far) = shake(rti(), Member::Federate(4), federate(4));
    assert_eq!(far, Some(TlsError::NoFederate));
}

/// One who trusts the first run, and shows a certificate of the second.
fn credentials_of_two(trusts: &Authority, shows: &Authority) -> Credentials {
    let member = Member::Federate(3);
    let papers = Papers {
        authority: trusts.certify(member).unwrap().authority,
        ..shows.certify(member).unwrap()
    };
    Credentials::of(&papers).unwrap()
}

#[test]
fn one_that_shows_no_certificate_is_refused() {
    use rustls::pki_types::{CertificateDer, ServerName, pem::PemObject as _};
    let authority = Authority::new("run").unwrap();
    let papers = authority.certify(Member::Rti).unwrap();
    let mut roots = rustls::RootCertStore::empty();
    roots
        .add(CertificateDer::from_pem_slice(papers.authority.as_bytes()).unwrap())
        .unwrap();
    let provider = std::sync::Arc::new(rustls::crypto::ring::default_provider());
    let config = rustls::ClientConfig::builder_with_provider(provider)
        .with_protocol_versions(&[&rustls::version::TLS13])
        .unwrap()
        .with_root_certificates(roots)
        .with_no_client_auth();
    let name = ServerName::try_from(Member::Rti.name("run")).unwrap();
    let connection = rustls::ClientConnection::new(config.into(), name).unwrap();
    let (near, far) = pipes(&[], 1 << 20);
    let mut near = Stream::secure(
        near,
        tls::Tls::new(connection.into(), Some(Member::Rti), "run"),
    );
    let mut far = Credentials::of(&papers).unwrap().accept(far).unwrap();
    let (_, found) = shake(&mut near, &mut far);
    assert_eq!(found, Some(TlsError::NoCertificate));
}

#[test]
fn the_clear_and_tls_do_not_understand_each_other() {
    let (near, far) = pipes(&[], 1 << 20);
    let (_, mut far) = pair((near.clone(), far));
    // FED_IDS of federate 3.
    Stream::plain(near)
        .write(&[1, 3, 0, 4, b'r', b'u', b'n', b'!'])
        .unwrap();
    let end = drain(&mut far, &mut Vec::new()).unwrap().unwrap_err();
    assert_eq!(end.kind(), ErrorKind::InvalidData);
    assert_eq!(far.failure(), Some(&TlsError::NotTls));
}

#[test]
fn papers_are_private_and_belong_to_one_member() {
    use std::os::unix::fs::PermissionsExt as _;
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("f3");
    let authority = Authority::new("0123456789abcdef0123456789abcdef").unwrap();
    let papers = authority.certify(Member::Federate(3)).unwrap();
    for _again in 0..2 {
        papers.write(&path).unwrap();
    }
    for (name, mode) in Papers::FILES
        .map(|name| (name, 0o600))
        .into_iter()
        .chain([("", 0o700)])
    {
        let metadata = std::fs::metadata(path.join(name)).unwrap();
        assert_eq!(metadata.permissions().mode() & 0o777, mode, "{name}");
    }
    let key: Vec<_> = papers
        .key
        .lines()
        .filter(|line| !line.starts_with('-'))
        .collect();
    assert!(
        !format!("{papers:?}").contains(key[0]),
        "a key is not shown"
    );
    let loaded = Credentials::load(&path, Member::Federate(3)).unwrap();
    assert_eq!(loaded.member(), Member::Federate(3));
    let error = Credentials::load(&path, Member::Rti).unwrap_err();
    assert_eq!(
        error.to_string(),
        "the certificate is federate 3's, and this is the RTI"
    );
    std::fs::remove_file(path.join("key.pem")).unwrap();
    let error = Credentials::load(&path, Member::Federate(3)).unwrap_err();
    assert!(error.to_string().contains("key.pem"), "{error}");
    let swapped = Papers {
        key: papers.certificate.clone(),
        ..papers.clone()
    };
    assert!(matches!(
        Credentials::of(&swapped),
        Err(CredentialsError::NotPem { what: "key", .. })
    ));
    let of_another = authority.certify(Member::Rti).unwrap().key;
    let swapped = Papers {
        key: of_another,
        ..papers
    };
    assert!(matches!(
        Credentials::of(&swapped),
        Err(CredentialsError::Unusable(_))
    ));
}

#[test]
fn a_run_has_a_name_that_can_stand_in_a_certificate() {
    for bad in ["", "a.b", "Run", "a b", &"x".repeat(64)] {
        assert!(
            matches!(Authority::new(bad), Err(AuthorityError::Run(_))),
            "{bad}"
        );
    }
}
