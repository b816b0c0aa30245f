//! Runs the tables in `testdata/`: who sends what, `----`, what everybody then receives.
//!
//! A file holds scenarios, each headed by `== TITLE` and settings, one a line:
//! `federates N`, `edge A -> B [after MS]`, `ours ID...` (sends CAPABILITIES), `ahead ID...` (and RUNS_AHEAD), `option dnet off`, `option clock K`,
//! `option multiple MS`, `option auth` (nonces are the connection's number), `option continue ID...`. A step is some input lines, `----`, and the expected lines up to the next blank one. Every
//! input line is one read and one round:
//!
//! * `start`: all federates join in order; what they receive is not shown. Times are milliseconds after the start.
//! * `connect NAME [from SOCKET-ADDRESS to ADDRESS]`; `NAME: MESSAGE; MESSAGE`; `NAME bytes HEX HEX`; `NAME eof`; `NAME reset`.
//! * `wait MS`: time passes and deadlines are looked at. `stop`: a signal asks the RTI to stop.
//!
//! A tag is `10` (milliseconds), `10:1` (with a microstep), `10-` (the last tag before 10), FOREVER or NEVER.
//! `UPDATE_TABLES=1` writes what happens into the files.

#![allow(clippy::unwrap_used, clippy::panic, missing_docs, reason = "a test")]

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::net::{IpAddr, SocketAddrV4};
use std::path::PathBuf;

use ictus_coord::auth::Proof;
use ictus_coord::rti::{Closing, ConnectionId, Disconnect, Newcomer, Rti, RtiConfig, RtiEvent};
use ictus_coord::topology::{FederateId, Topology};
use ictus_coord::wire::{
    NO_CLOCK_SYNC, PortAbsent, RejectReason, TaggedMessage, ToFederate, ToRti,
};
use ictus_core::{Delay, Duration, LogicalTime, PhysicalTime, Tag};

const MS: i64 = 1_000_000;
const FEDERATION: &str = "test";

/// An RTI and the connections of one scenario.
struct World {
    rti: Rti,
    now: PhysicalTime,
    /// The start time in nanoseconds, 0 before it is known.
    origin: i64,
    federates: u16,
    edges: Vec<(u16, u16, Delay)>,
    ours: Vec<u16>,
    ahead: Vec<u16>,
    connections: BTreeMap<String, ConnectionId>,
    /// Bytes of each connection that the RTI has not taken yet.
    unread: BTreeMap<String, Vec<u8>>,
    finished: bool,
    /// Connections so far.
    connected: u8,
}

impl World {
    fn new(settings: &[&str]) -> Self {
        let mut config = RtiConfig::new(FEDERATION, 2);
        let (mut edges, mut ours, mut ahead) = (Vec::new(), Vec::new(), Vec::new());
        for setting in settings {
            match *setting.split_whitespace().collect::<Vec<_>>() {
                ["federates", n] => config.federates = n.parse().unwrap(),
                ["edge", from, "->", to] => {
                    edges.push((from.parse().unwrap(), to.parse().unwrap(), Delay::None));
                }
                ["edge", from, "->", to, "after", ms] => {
                    let delay = Delay::after(Duration::from_millis(ms.parse().unwrap()));
                    edges.push((from.parse().unwrap(), to.parse().unwrap(), delay));
                }
                ["ours", ref ids @ ..] => {
                    ours.extend(ids.iter().map(|id| id.parse::<u16>().unwrap()));
                }
                ["ahead", ref ids @ ..] => {
                    ahead.extend(ids.iter().map(|id| id.parse::<u16>().unwrap()));
                }
                ["option", "dnet", "off"] => config.dnet = false,
                ["option", "auth"] => config.authentication = true,
                ["option", "continue", ref ids @ ..] => {
                    config.continue_without = ids.iter().map(|id| id.parse().unwrap()).collect();
                }
                ["option", "clock", k] => config.clock_exchanges = k.parse().unwrap(),
                ["option", "multiple", ms] => {
                    config.start_multiple = Some(Duration::from_millis(ms.parse().unwrap()));
                }
                _ => panic!("unknown setting `{setting}`"),
            }
        }
        Self {
            federates: config.federates,
            rti: Rti::new(config),
            now: PhysicalTime::from_nanos(0),
            origin: 0,
            edges,
            ours,
            ahead,
            connections: BTreeMap::new(),
            unread: BTreeMap::new(),
            finished: false,
            connected: 0,
        }
    }

    fn topology(&self) -> Topology {
        let id = FederateId::new;
        let edges = self
            .edges
            .iter()
            .map(|&(a, b, delay)| (id(a), id(b), delay));
        Topology::new(usize::from(self.federates), edges)
    }

    /// Carries out one input line and returns what it caused.
    fn step(&mut self, line: &str) -> String {
        if let Some((name, messages)) = line.split_once(": ") {
            let mut bytes = Vec::new();
            for message in messages.split("; ") {
                self.encode(name, message, &mut bytes);
            }
            self.deliver(name, &bytes);
            return self.round();
        }
        match *line.split_whitespace().collect::<Vec<_>>() {
            ["start"] => {
                self.start();
                return String::new();
            }
            ["connect", name] => {
                let peer = format!("192.0.2.7:{}", 40000 + self.connections.len());
                self.connect(name, &peer, None);
            }
            ["connect", name, "from", peer, "to", local] => {
                self.connect(name, peer, Some(local.parse().unwrap()));
            }
            ["certificate", name, "of", federate] => {
                let federate = federate.parse().unwrap();
                self.rti.certify(self.connections[name], federate);
            }
            ["stop"] => self.rti.request_stop(self.now),
            ["wait", ms] => {
                self.now = self.now + Duration::from_millis(ms.parse().unwrap());
                self.rti.handle_timeout(self.now);
            }
            [name, "eof"] => {
                self.rti
                    .disconnect(self.now, self.connections[name], &Disconnect::Eof);
            }
            [name, "reset"] => {
                self.rti
                    .disconnect(self.now, self.connections[name], &Disconnect::Reset);
            }
            [name, "bytes", ref hex @ ..] => {
                let bytes: Vec<u8> = hex
                    .iter()
                    .map(|byte| u8::from_str_radix(byte, 16).unwrap())
                    .collect();
                self.deliver(name, &bytes);
            }
            _ => panic!("unknown input `{line}`"),
        }
        self.round()
    }

    fn connect(&mut self, name: &str, peer: &str, local: Option<IpAddr>) {
        let number = self.connected;
        self.connected += 1;
        let newcomer = Newcomer {
            peer: peer.to_owned(),
            local,
            nonce: Some([number; 8]),
        };
        let id = self.rti.connect(self.now, newcomer);
        self.connections.insert(name.to_owned(), id);
    }

    fn deliver(&mut self, name: &str, bytes: &[u8]) {
        let unread = self.unread.entry(name.to_owned()).or_default();
        unread.extend_from_slice(bytes);
        let taken = self.rti.receive(self.now, self.connections[name], unread);
        unread.drain(..taken);
    }

    fn start(&mut self) {
        for id in 0..self.federates {
            let name = id.to_string();
            self.step(&format!("connect {name}"));
            let capabilities = if self.ahead.contains(&id) {
                "CAPABILITIES 7; "
            } else if self.ours.contains(&id) {
                "CAPABILITIES 3; "
            } else {
                ""
            };
            let line = format!(
                "{name}: FED_IDS {id} {FEDERATION}; STRUCTURE; UDP_PORT none; {capabilities}TIMESTAMP 0"
            );
            self.step(&line);
        }
        assert!(self.origin > 0, "the federation starts");
    }

    /// Drains the RTI and tells what came out.
    fn round(&mut self) -> String {
        self.rti.drain(self.now);
        let mut events = String::new();
        while let Some(event) = self.rti.poll_event() {
            if let RtiEvent::Started { start } = event {
                self.origin = start.as_nanos();
            }
            writeln!(events, "* {}", tell_event(&event)).unwrap();
        }
        let mut changed = Vec::new();
        while let Some(id) = self.rti.poll_output() {
            changed.push(id);
        }
        let mut received = String::new();
        let names: Vec<_> = self
            .connections
            .iter()
            .map(|(name, &id)| (name.clone(), id))
            .collect();
        for (name, id) in names {
            if changed.contains(&id) {
                let said = self.take(id);
                if !said.is_empty() {
                    writeln!(received, "{name} <- {}", said.join("; ")).unwrap();
                }
            }
        }
        if let (Some(code), false) = (self.rti.finished(), self.finished) {
            self.finished = true;
            writeln!(events, "* finished {code}").unwrap();
        }
        received + &events
    }

    /// What waits for a connection, taken; a connection that is to close is closed, as a driver and a peer would.
    fn take(&mut self, id: ConnectionId) -> Vec<String> {
        let mut said = Vec::new();
        loop {
            let bytes = self.rti.output(id).chunk().to_vec();
            if bytes.is_empty() {
                break;
            }
            let mut at = 0;
            while let Some((message, length)) = ToFederate::decode(&bytes[at..]).unwrap() {
                said.push(self.tell(&message));
                at += length;
            }
            assert_eq!(at, bytes.len(), "a chunk ends with a whole message");
            self.rti.output(id).advance(at);
        }
        match self.rti.output(id).closing() {
            Closing::Open => {}
            Closing::AfterFlush | Closing::Now => {
                said.push("close".to_owned());
                self.rti.disconnect(self.now, id, &Disconnect::Eof);
                self.connections.retain(|_, &mut other| other != id);
            }
        }
        said
    }

    fn encode(&self, name: &str, message: &str, out: &mut Vec<u8>) {
        let words: Vec<_> = message.split_whitespace().collect();
        let tag = |text: &str| self.parse_tag(text);
        match *words {
            ["FED_IDS", federate] => {
                ToRti::FederateIds {
                    federate: federate.parse().unwrap(),
                    federation: b"",
                }
                .encode(out);
            }
            ["FED_IDS", federate, id] => {
                let federation = id.as_bytes();
                ToRti::FederateIds {
                    federate: federate.parse().unwrap(),
                    federation,
                }
                .encode(out);
            }
            ["STRUCTURE"] => {
                let id = FederateId::new(name.parse().unwrap());
                ToRti::NeighborStructure(self.topology().neighbor_structure(id)).encode(out);
            }
            ["UDP_PORT", "none"] => ToRti::UdpPort(NO_CLOCK_SYNC).encode(out),
            ["UDP_PORT", port] => ToRti::UdpPort(port.parse().unwrap()).encode(out),
            ["CAPABILITIES", bits] => ToRti::Capabilities(bits.parse().unwrap()).encode(out),
            ["TIMESTAMP", ms] => {
                ToRti::Timestamp(PhysicalTime::from_nanos(ms.parse::<i64>().unwrap() * MS))
                    .encode(out);
            }
            ["T3"] => ToRti::ClockSyncT3 {
                federate: name.parse().unwrap(),
            }
            .encode(out),
            ["MSG", to, at] => {
                let federate = to.parse().unwrap();
                ToRti::TaggedMessage(TaggedMessage {
                    port: 0,
                    federate,
                    tag: tag(at),
                    payload: b"x",
                })
                .encode(out);
            }
            ["ABS", to, at] => {
                let federate = to.parse().unwrap();
                ToRti::PortAbsent(PortAbsent {
                    port: 0,
                    federate,
                    tag: tag(at),
                })
                .encode(out);
            }
            ["NET", at] => ToRti::NextEventTag(tag(at)).encode(out),
            ["LTC", at] => ToRti::LatestTagConfirmed(tag(at)).encode(out),
            ["STOP_REQUEST", at] => ToRti::StopRequest(tag(at)).encode(out),
            ["STOP_REPLY", at] => ToRti::StopRequestReply(tag(at)).encode(out),
            ["RESIGN"] => ToRti::Resign.encode(out),
            ["FAILED"] => ToRti::Failed.encode(out),
            _ => encode_set_up(&words, out),
        }
    }

    fn parse_tag(&self, text: &str) -> Tag {
        match text {
            "FOREVER" => return Tag::FOREVER,
            "NEVER" => return Tag::NEVER,
            _ => {}
        }
        let at = |ms: &str| LogicalTime::from_nanos(self.origin + ms.parse::<i64>().unwrap() * MS);
        if let Some(ms) = text.strip_suffix('-') {
            Tag::new(at(ms), 0).latest_earlier()
        } else if let Some((ms, microstep)) = text.split_once(':') {
            Tag::new(
                at(ms),
                if microstep == "max" {
                    u32::MAX
                } else {
                    microstep.parse().unwrap()
                },
            )
        } else {
            Tag::new(at(text), 0)
        }
    }

    fn tell_tag(&self, tag: Tag) -> String {
        if tag == Tag::FOREVER {
            return "FOREVER".to_owned();
        }
        if tag == Tag::NEVER {
            return "NEVER".to_owned();
        }
        let nanos = tag.time.as_nanos() - self.origin;
        match tag.microstep {
            u32::MAX if (nanos + 1) % MS == 0 => format!("{}-", (nanos + 1) / MS),
            u32::MAX => format!("{}:max", tell_ms(nanos)),
            0 => tell_ms(nanos),
            microstep => format!("{}:{microstep}", tell_ms(nanos)),
        }
    }

    fn tell(&self, message: &ToFederate<'_>) -> String {
        match message {
            ToFederate::Ack => "ACK".to_owned(),
            ToFederate::Reject(reason) => format!("REJECT {}", reason.code()),
            ToFederate::Timestamp(time) => format!("TIMESTAMP {}", tell_ms(time.as_nanos())),
            ToFederate::TaggedMessage(message) => format!("MSG {}", self.tell_tag(message.tag)),
            ToFederate::PortAbsent(absent) => format!("ABS {}", self.tell_tag(absent.tag)),
            ToFederate::TagAdvanceGrant(tag) => format!("TAG {}", self.tell_tag(*tag)),
            ToFederate::ProvisionalTagAdvanceGrant(tag) => format!("PTAG {}", self.tell_tag(*tag)),
            ToFederate::DownstreamNextEventTag(tag) => format!("DNET {}", self.tell_tag(*tag)),
            ToFederate::StopRequest(tag) => format!("STOP_REQUEST {}", self.tell_tag(*tag)),
            ToFederate::StopGranted(tag) => format!("STOP_GRANTED {}", self.tell_tag(*tag)),
            ToFederate::ClockSyncT1(time) => format!("T1 {}", tell_ms(time.as_nanos())),
            ToFederate::ClockSyncT4(time) => format!("T4 {}", tell_ms(time.as_nanos())),
            ToFederate::AddressQueryReply { port, address } => {
                let [a, b, c, d] = address;
                format!("ADDRESS {a}.{b}.{c}.{d}:{port}")
            }
            ToFederate::RtiResponse { nonce, hmac } => {
                let proves = |federate: &u16| {
                    Proof::Rti {
                        federate: *federate,
                        nonce: [9; 8],
                    }
                    .verify(FEDERATION.as_bytes(), hmac)
                };
                let proven = (0..10).find(proves).expect("the RTI knows the key");
                format!("RTI_RESPONSE {} {proven}", nonce[0])
            }
            ToFederate::Failed => "FAILED".to_owned(),
            ToFederate::DownstreamConfirmed(tag) => format!("CONFIRMED {}", self.tell_tag(*tag)),
            ToFederate::FederateLost { federate, promise } => {
                format!("LOST {federate} {}", self.tell_tag(*promise))
            }
        }
    }
}

/// What a federate says before it joins, and to find its peers.
fn encode_set_up(words: &[&str], out: &mut Vec<u8>) {
    match *words {
        ["ADVERTISE", port] => {
            ToRti::AddressAdvertisement {
                port: port.parse().unwrap(),
            }
            .encode(out);
        }
        ["DATA_ADDRESS", address] => {
            let address: SocketAddrV4 = address.parse().unwrap();
            ToRti::DataAddress {
                port: address.port().into(),
                address: address.ip().octets(),
            }
            .encode(out);
        }
        ["NONCE", federate] => ToRti::FederateNonce {
            federate: federate.parse().unwrap(),
            nonce: [9; 8],
        }
        .encode(out),
        ["PROOF", number, key] => {
            let nonce = [number.parse().unwrap(); 8];
            let hmac = Proof::Federate { nonce }.sign(key.as_bytes());
            ToRti::FederateResponse { hmac }.encode(out);
        }
        ["REJECT", code] => {
            let reason = RejectReason::from_code(code.parse().unwrap());
            ToRti::Reject(reason).encode(out);
        }
        ["ADDRESS_QUERY", id] => ToRti::AddressQuery {
            federate: id.parse().unwrap(),
            transient: None,
        }
        .encode(out),
        _ => panic!("unknown message `{}`", words.join(" ")),
    }
}

fn tell_ms(nanos: i64) -> String {
    if nanos % MS == 0 {
        (nanos / MS).to_string()
    } else {
        format!("{nanos}ns")
    }
}

fn tell_event(event: &RtiEvent) -> String {
    match event {
        RtiEvent::Joined { federate } => format!("joined {federate}"),
        RtiEvent::Started { start } => format!("started {}", tell_ms(start.as_nanos())),
        RtiEvent::StopRequested {
            federate: Some(federate),
        } => format!("stop requested by {federate}"),
        RtiEvent::StopRequested { federate: None } => "stop requested by the RTI".to_owned(),
        RtiEvent::StopUnanswered { federates } => format!("stop unanswered by {federates:?}"),
        RtiEvent::StopAgreed { elapsed, microstep } => {
            format!("stop agreed {}:{microstep}", tell_ms(elapsed.as_nanos()))
        }
        RtiEvent::Resigned { federate } => format!("resigned {federate}"),
        RtiEvent::Lost { federate, reason } => format!("lost {federate}: {reason}"),
        RtiEvent::Rejected { reason, .. } => format!("rejected: {reason}"),
        RtiEvent::Ended { code } => format!("ended {code}"),
    }
}

/// Runs a file's scenarios and returns the file with what was received.
fn run(text: &str) -> String {
    let mut out = String::new();
    let mut world: Option<World> = None;
    let mut settings: Vec<&str> = Vec::new();
    let mut inputs: Vec<&str> = Vec::new();
    let mut skipping = false;
    for line in text.lines() {
        if skipping && !line.is_empty() {
            continue;
        }
        skipping = false;
        writeln!(out, "{line}").unwrap();
        if line.starts_with("==") {
            world = None;
            settings.clear();
        } else if line == "----" {
            let world = world.get_or_insert_with(|| World::new(&settings));
            for input in inputs.drain(..) {
                out.push_str(&world.step(input));
            }
            skipping = true;
        } else if ["federates ", "edge ", "ours ", "ahead ", "option "]
            .iter()
            .any(|s| line.starts_with(s))
        {
            settings.push(line);
        } else if !line.is_empty() && !line.starts_with('#') {
            inputs.push(line);
        }
    }
    out
}

#[test]
fn scenarios() {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("testdata");
    let mut files: Vec<_> = std::fs::read_dir(folder)
        .unwrap()
        .map(|f| f.unwrap().path())
        .collect();
    files.retain(|path| path.extension().is_some_and(|extension| extension == "txt"));
    files.sort();
    assert!(!files.is_empty());
    for path in files {
        let expected = std::fs::read_to_string(&path).unwrap();
        let found = run(&expected);
        if std::env::var_os("UPDATE_TABLES").is_some() {
            std::fs::write(&path, found).unwrap();
        } else {
            for (number, (found, expected)) in found.lines().zip(expected.lines()).enumerate() {
                assert_eq!(found, expected, "{}:{}", path.display(), number + 1);
            }
            assert_eq!(found, expected, "{}", path.display());
        }
    }
}
