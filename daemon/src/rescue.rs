//! A run whose record cannot be read: what the rest of its directory still tells.

use std::collections::BTreeMap;
use std::fs;
use std::net::SocketAddrV4;
use std::os::unix::net::UnixStream;
use std::path::PathBuf;

use ictus_deploy::Engine;

use crate::agent::RTI;
use crate::api::{Event, FederationView, MemberView, State};
use crate::docker::ContainerSpec;
use crate::stamp;
use crate::store::{Directory, Record, Supervised};
use crate::supervisor::spec::{PROTOCOL, Spec};

/// Makes the record again from the request, the supervisors' specs and the events; absent when they do not
/// tell enough.
#[expect(clippy::too_many_lines, reason = "an arm for each event")]
pub(crate) fn record(name: &str, directory: &Directory) -> Option<Record> {
    let request = directory.read_request().ok()?;
    let mut members = BTreeMap::new();
    let mut id = String::new();
    for path in specs(directory) {
        let spec = Spec::read(&path).ok()?;
        if spec.name == RTI {
            let mut args = spec.args.iter().skip_while(|arg| *arg != "-i");
            id = args.nth(1).cloned().unwrap_or_default();
        }
        let docker = request
            .part
            .as_ref()
            .is_some_and(|part| part.engine == Engine::Docker);
        let container = docker.then(|| ContainerSpec::name_of(name, &spec.name, &spec.instance));
        let supervised = Supervised {
            instance: spec.instance,
            socket: spec.socket,
            container,
            supervisor: None,
        };
        members.insert(spec.name, supervised);
    }
    let events = directory.events_kept();
    let mut view = FederationView {
        name: name.to_owned(),
        state: State::Starting,
        id,
        since_ns: events
            .first()
            .map_or_else(stamp::now_ns, |first| first.at_ns),
        manifest: request.manifest,
        directory: directory.path().to_path_buf(),
        rti_port: None,
        metrics: None,
        start_ns: None,
        rti: MemberView::default(),
        federates: Vec::new(),
        outcome: None,
        part: None,
        digest: String::new(),
        facets: BTreeMap::new(),
        generation: None,
    };
    for happening in events {
        let by_user = |by: &str| by == "user" && view.state == State::Running;
        match happening.event {
            Event::Listening { port } => view.rti_port = Some(port),
            Event::StartTag { start_ns } => view.start_ns = Some(start_ns),
            Event::Healthy => view.state = State::Running,
            Event::StopRequested { by } if by_user(&by) => view.state = State::Stopping,
            Event::Ended { outcome } => {
                view.state = State::Ended;
                view.outcome = Some(outcome);
            }
            Event::Started { .. }
            | Event::Joined { .. }
            | Event::Running { .. }
            | Event::Rejected { .. }
            | Event::StopRequested { .. }
            | Event::StopTag { .. }
            | Event::Resigned { .. }
            | Event::Lost { .. }
            | Event::Exited { .. }
            | Event::StpViolation { .. }
            | Event::FallingBehind { .. }
            | Event::CaughtUp { .. }
            | Event::ClockStep { .. }
            | Event::Signalled { .. }
            | Event::Foreign { .. } => {}
        }
    }
    Some(Record {
        protocol: PROTOCOL,
        members,
        rti: rti_of(directory),
        secrets: None,
        ports: BTreeMap::new(),
        view,
    })
}

/// Where the RTI listens on another host: a federate's command line says so.
fn rti_of(directory: &Directory) -> Option<SocketAddrV4> {
    let request = directory.read_request().ok()?;
    if request.part.is_none_or(|part| part.rti) {
        return None;
    }
    let specs = specs(directory).into_iter();
    let mut addresses = specs.filter_map(|path| {
        let spec = Spec::read(&path).ok()?;
        let mut args = spec.args.iter().skip_while(|arg| *arg != "--rti");
        args.nth(1)?.parse().ok()
    });
    addresses.next()
}

/// Supervisors of this run that live: their names and, as far as the system tells, their process ids. Specs
/// of any version are read, because all of them name the socket.
pub(crate) fn living(directory: &Directory) -> Vec<(String, Option<i32>)> {
    let spec = |path: PathBuf| -> Option<serde_json::Value> {
        serde_json::from_slice(&fs::read(path).ok()?).ok()
    };
    let specs = specs(directory).into_iter().filter_map(spec);
    specs
        .filter_map(|spec| {
            let stream = UnixStream::connect(spec.get("socket")?.as_str()?).ok()?;
            let peer = rustix::net::sockopt::socket_peercred(&stream).ok();
            let name = spec.get("name").and_then(serde_json::Value::as_str);
            let name = name.unwrap_or("a nameless member").to_owned();
            Some((name, peer.map(|peer| peer.pid.as_raw_nonzero().get())))
        })
        .collect()
}

fn specs(directory: &Directory) -> Vec<PathBuf> {
    let entries = fs::read_dir(directory.specs()).into_iter().flatten();
    let mut paths: Vec<_> = entries.flatten().map(|entry| entry.path()).collect();
    paths.sort();
    paths
}
