//! What federates say of themselves as one page for Prometheus, where no daemon supervises them: federates that Compose has
//! started connect to a socket in a volume that they share with the collector.
//!
//! The collector is told, and asks nobody. It may come late, go away and come again: federates look for it, and counters are
//! cumulative.

use std::fs;
use std::io;
use std::net::SocketAddr;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use ictus_coord::plan::Plan;
use ictus_coord::report::{FederateMeasures, FederateStatus, FederationMeasures};
use ictus_deploy::compose::monitoring::{GRAFANA_DATASOURCE, PROMETHEUS_CONFIG, SOCKET_NAME};
use tokio::io::AsyncReadExt;
use tokio::net::{TcpListener, UnixListener, UnixStream};
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::Semaphore;
use tokio::time::sleep;

use crate::agent::RTI;
use crate::api::{ExitReason, FederationView, MemberView, State};
use crate::files;
use crate::metrics::{self, Snapshot};
use crate::scrape::{self, ACCEPT_PAUSE, Pages};
use crate::supervisor::exit::Ending;
use crate::supervisor::lines::Lines;

/// The longest line that is taken; longer ones say nothing.
const LINE_BYTES_MAX: usize = 64 * 1024;
/// What is read at a time.
const READ_BYTES: usize = 16 * 1024;
/// Connections beside one of each federate, for those that come again.
const MORE_CONNECTIONS: usize = 16;

/// What a collector is told.
#[derive(Clone, Debug)]
pub struct Options {
    /// The federation.
    pub plan: Plan,
    /// The shared directory: the socket is made in it, and what Prometheus and Grafana read.
    pub directory: PathBuf,
    /// Where `/metrics` is served.
    pub listen: SocketAddr,
}

/// Why a collector cannot work.
#[derive(Debug, thiserror::Error)]
pub enum CollectorError {
    /// A file of the shared directory cannot be made.
    #[error("cannot make {path}", path = path.display())]
    Directory {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// The address cannot be listened on.
    #[error("cannot listen on {address}")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// Why.
        source: io::Error,
    },
    /// The system refuses signals or a runtime.
    #[error("cannot wait for events")]
    System(#[from] io::Error),
}

/// Gathers and serves until SIGTERM or SIGINT.
///
/// # Errors
/// See [`CollectorError`].
pub fn run(options: Options) -> Result<(), CollectorError> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    runtime.block_on(async {
        let (mut terminate, mut interrupt) = (
            signal(SignalKind::terminate())?,
            signal(SignalKind::interrupt())?,
        );
        let collector = Collector::of(options.plan);
        provide(&options.directory)?;
        let socket = listen(&options.directory.join(SOCKET_NAME))?;
        // Last: who sees that it listens finds the files.
        let address = options.listen;
        let failed = |source| CollectorError::Listen { address, source };
        let listener = TcpListener::bind(address).await.map_err(failed)?;
        let pages = Pages::Collector(collector.clone());
        tokio::select! {
            () = scrape::serve(listener, pages) => {}
            () = accept(socket, collector) => {}
            _ = terminate.recv() => {}
            _ = interrupt.recv() => {}
        }
        Ok(())
    })
}

/// Lays down what Prometheus and Grafana read.
fn provide(directory: &Path) -> Result<(), CollectorError> {
    let files = [
        ("prometheus.yml", PROMETHEUS_CONFIG),
        ("grafana/datasources/ictus.yml", GRAFANA_DATASOURCE),
    ];
    for (name, text) in files {
        let path = directory.join(name);
        let parent = path.parent().unwrap_or(directory);
        let made = fs::create_dir_all(parent).and_then(|()| fs::write(&path, text));
        made.map_err(|source| CollectorError::Directory { path, source })?;
    }
    Ok(())
}

/// A socket to which every federate may connect, whoever runs it.
fn listen(path: &Path) -> Result<UnixListener, CollectorError> {
    let made = files::remove(path).and_then(|()| {
        let socket = UnixListener::bind(path)?;
        fs::set_permissions(path, fs::Permissions::from_mode(0o666))?;
        Ok(socket)
    });
    made.map_err(|source| CollectorError::Directory {
        path: path.to_path_buf(),
        source,
    })
}

async fn accept(socket: UnixListener, collector: Collector) {
    let slots = Arc::new(Semaphore::new(collector.federates() + MORE_CONNECTIONS));
    // Never closed.
    while let Ok(slot) = slots.clone().acquire_owned().await {
        match socket.accept().await {
            Ok((stream, _)) => {
                let collector = collector.clone();
                tokio::spawn(async move {
                    collector.listen_to(stream).await;
                    drop(slot);
                });
            }
            Err(error) => {
                tracing::warn!(%error, "cannot accept a federate");
                sleep(ACCEPT_PAUSE).await;
            }
        }
    }
}

/// What is known of the federation.
#[derive(Clone, Debug)]
pub(crate) struct Collector(Arc<Mutex<Known>>);

#[derive(Debug)]
struct Known {
    plan: Plan,
    federates: Vec<MemberView>,
    measures: Vec<FederateMeasures>,
    /// Connections of each federate.
    connected: Vec<u32>,
}

impl Collector {
    /// One that has heard nothing.
    pub(crate) fn of(plan: Plan) -> Self {
        let names = plan.federates.iter().map(|federate| federate.name.as_str());
        let view = |name: &str| member(name, "waiting");
        Self(Arc::new(Mutex::new(Known {
            federates: names.clone().map(view).collect(),
            measures: names.map(FederateMeasures::of).collect(),
            connected: vec![0; plan.federates.len()],
            plan,
        })))
    }

    fn federates(&self) -> usize {
        self.with(|known| known.plan.federates.len())
    }

    fn with<T>(&self, work: impl FnOnce(&mut Known) -> T) -> T {
        work(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Takes lines until the other end closes. Who speaks is who its first line says.
    async fn listen_to(&self, mut stream: UnixStream) {
        let (mut lines, mut who) = (Lines::new(LINE_BYTES_MAX), None);
        let mut buffer = vec![0; READ_BYTES];
        while let Ok(count @ 1..) = stream.read(&mut buffer).await {
            lines.push(&buffer[..count], |piece| {
                if piece.whole && !piece.continued {
                    self.take(&mut who, piece.bytes);
                }
            });
        }
        if let Some(index) = who {
            self.with(|known| known.gone(index));
        }
    }

    /// Takes a line; one of another shape, or of nobody in the plan, says nothing.
    fn take(&self, who: &mut Option<usize>, line: &[u8]) {
        let Ok(status) = serde_json::from_slice::<FederateStatus>(line) else {
            return;
        };
        self.with(|known| {
            if who.is_none() {
                *who = known.find(line);
                if let Some(connected) = who.and_then(|index| known.connected.get_mut(index)) {
                    *connected += 1;
                }
            }
            if let Some(index) = *who {
                known.take(index, status);
            }
        });
    }

    /// The page for Prometheus.
    pub(crate) fn page(&self) -> String {
        metrics::page(&[self.with(|known| known.snapshot())])
    }
}

impl Known {
    /// Whom a line is from: each says so.
    fn find(&self, line: &[u8]) -> Option<usize> {
        #[derive(serde::Deserialize)]
        struct From {
            federate: String,
        }
        let from: From = serde_json::from_slice(line).ok()?;
        let mut federates = self.federates.iter();
        federates.position(|member| member.name == from.federate)
    }

    fn take(&mut self, index: usize, status: FederateStatus) {
        let (Some(view), Some(measures)) =
            (self.federates.get_mut(index), self.measures.get_mut(index))
        else {
            return;
        };
        let state = match &status {
            FederateStatus::Joined { .. } | FederateStatus::Start { .. } => "joined",
            FederateStatus::Ended { .. } => "ended",
            FederateStatus::Running { .. }
            | FederateStatus::Progress { .. }
            | FederateStatus::Measures { .. }
            | FederateStatus::Upstream { .. }
            | FederateStatus::Downstream { .. }
            | FederateStatus::Clock { .. }
            | FederateStatus::StpViolation { .. }
            | FederateStatus::FallingBehind { .. }
            | FederateStatus::CaughtUp { .. }
            | FederateStatus::ClockStep { .. } => "running",
        };
        state.clone_into(&mut view.state);
        view.exit = None;
        if let FederateStatus::Ended { code, .. } = &status {
            let code = i32::from(*code);
            view.exit = Some(ExitReason::of(&Ending::Exited { code }));
        }
        let plan = &self.plan;
        measures.take(status, |id| {
            let peer = plan.federates.get(usize::from(id));
            peer.map(|peer| peer.name.as_str())
        });
    }

    /// A connection was closed. Without a last word, how its federate ended is not known.
    fn gone(&mut self, index: usize) {
        let Some(connected) = self.connected.get_mut(index) else {
            return;
        };
        *connected = connected.saturating_sub(1);
        if let (0, Some(view)) = (*connected, self.federates.get_mut(index))
            && view.state != "ended"
        {
            "ended".clone_into(&mut view.state);
            view.exit = Some(ExitReason::Unknown);
        }
    }

    fn snapshot(&self) -> Snapshot {
        // Nothing of theirs runs without it, and it says nothing here itself.
        let serving = self.federates.iter().any(MemberView::lives);
        let name = self.plan.federation.clone();
        Snapshot {
            view: FederationView {
                name: name.clone(),
                state: State::Running,
                id: String::new(),
                since_ns: 0,
                manifest: PathBuf::new(),
                directory: PathBuf::new(),
                rti_port: None,
                metrics: None,
                start_ns: None,
                rti: member(RTI, if serving { "running" } else { "ended" }),
                federates: self.federates.clone(),
                outcome: None,
                part: None,
                digest: String::new(),
                facets: std::collections::BTreeMap::default(),
                generation: None,
            },
            measures: FederationMeasures {
                federation: name,
                federates: self.measures.clone(),
            },
            plan: Some(self.plan.clone()),
        }
    }
}

fn member(name: &str, state: &str) -> MemberView {
    MemberView {
        name: name.to_owned(),
        state: state.to_owned(),
        ..MemberView::default()
    }
}

#[cfg(test)]
mod tests {
    use ictus_coord::plan::FederatePlan;
    use ictus_metrics::Page;
    use tokio::io::AsyncWriteExt;

    use super::*;

    fn collector() -> Collector {
        let federate = |name: &str| FederatePlan {
            name: name.to_owned(),
            ..FederatePlan::default()
        };
        Collector::of(Plan {
            federation: "pair".to_owned(),
            federates: vec![federate("a"), federate("b")],
            ..Plan::default()
        })
    }

    fn value(collector: &Collector, name: &str, labels: &[(&str, &str)]) -> Option<f64> {
        let page = Page::parse(&collector.page()).unwrap();
        let has = |sample: &&ictus_metrics::Sample| {
            let is = |(key, value): &(&str, &str)| {
                let mut all = sample.labels.iter();
                all.any(|(have, text)| have == key && text == value)
            };
            sample.name == name && labels.iter().all(is)
        };
        page.samples().iter().find(has).map(|sample| sample.value)
    }

    /// What is said on a connection; it is closed then.
    async fn say(collector: &Collector, lines: &str) {
        let (ours, mut theirs) = UnixStream::pair().unwrap();
        theirs.write_all(lines.as_bytes()).await.unwrap();
        drop(theirs);
        collector.listen_to(ours).await;
    }

    #[tokio::test]
    async fn what_federates_say_is_on_the_page() {
        let collector = collector();
        let up = |name: &'static str| [("federation", "pair"), ("federate", name)];
        assert_eq!(value(&collector, "ictus_federate_up", &up("a")), Some(0.0));
        let (ours, mut theirs) = UnixStream::pair().unwrap();
        let listening = {
            let collector = collector.clone();
            tokio::spawn(async move { collector.listen_to(ours).await })
        };
        let lines = "garbage\n{\"event\":\"running\",\"federate\":\"nobody\"}\n\
            {\"event\":\"measures\",\"federate\":\"a\",\"own\":{\"tags_completed\":7,\"reactions\":9}}\n";
        theirs.write_all(lines.as_bytes()).await.unwrap();
        // Until it was taken.
        while value(&collector, "ictus_federate_up", &up("a")) == Some(0.0) {
            tokio::task::yield_now().await;
        }
        assert_eq!(
            value(&collector, "ictus_tags_completed_total", &up("a")),
            Some(7.0)
        );
        assert_eq!(value(&collector, "ictus_federate_up", &up("b")), Some(0.0));
        drop(theirs);
        listening.await.unwrap();
        assert_eq!(value(&collector, "ictus_federate_up", &up("a")), Some(0.0));
    }

    #[tokio::test]
    async fn a_last_word_says_how_it_ended() {
        let collector = collector();
        let ended = "{\"event\":\"ended\",\"federate\":\"b\",\"elapsed_ns\":1,\"microstep\":0,\"code\":11,\"reason\":\"x\"}\n";
        say(&collector, ended).await;
        say(&collector, "{\"event\":\"running\",\"federate\":\"a\"}\n").await;
        let exits = |name: &'static str, reason: &'static str| {
            let labels = [("federate", name), ("reason", reason)];
            value(&collector, "ictus_federate_exits_total", &labels)
        };
        assert_eq!(exits("b", "peer_failed"), Some(1.0));
        assert_eq!(exits("a", "unknown"), Some(1.0));
    }

    #[test]
    fn the_shared_directory_has_what_others_read() {
        let directory = tempfile::tempdir().unwrap();
        for _ in 0..2 {
            provide(directory.path()).unwrap();
        }
        let read = |name: &str| fs::read_to_string(directory.path().join(name)).unwrap();
        assert_eq!(read("prometheus.yml"), PROMETHEUS_CONFIG);
        assert_eq!(read("grafana/datasources/ictus.yml"), GRAFANA_DATASOURCE);
    }
}
