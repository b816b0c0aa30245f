//! The command lines of the RTI, of our federates and of foreign ones.

use std::collections::{BTreeMap, BTreeSet};
use std::net::{Ipv4Addr, SocketAddrV4};
use std::path::{Path, PathBuf};

use ictus_deploy::placement::Security;
use ictus_deploy::{Engine, FederateKind, FederateRun, rti};

use crate::agent::{MemberId, RTI};
use crate::api::part::Part;
use crate::api::{ApiError, StartRequest};
use crate::host::{account, unnamed};
use crate::paths::Paths;
use crate::secrets;
use crate::store::{Directory, Record, Supervised};
use crate::supervisor::limits::Limits;
use crate::supervisor::log_path;
use crate::supervisor::process::own_executable;
use crate::supervisor::spec::{PROTOCOL, Spec};

/// How long a supervisor keeps an unread exit record in memory; it stays on disk.
const LINGER_MS: u32 = 5_000;
/// Variables of the daemon that federates see, too.
const PASSED_ON: [&str; 4] = ["HOME", "LANG", "PATH", "TZ"];

/// A run as far as command lines need it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Run<'a> {
    pub(crate) paths: &'a Paths,
    pub(crate) directory: &'a Directory,
    pub(crate) request: &'a StartRequest,
    pub(crate) record: &'a Record,
}

/// What a member's supervisor is to run.
///
/// # Errors
/// When the user that the manifest gives a federate is not there any more.
pub(crate) fn spec(
    run: &Run<'_>,
    (member, rti_port): (MemberId, Option<u16>),
    supervised: &Supervised,
) -> Result<Spec, ApiError> {
    let (directory, request) = (run.directory, run.request);
    let federate = match member {
        MemberId::Rti => None,
        MemberId::Federate(index) => Some(&request.federates[usize::from(index)]),
    };
    let name = federate.map_or(RTI, |run| &run.name).to_owned();
    // What the host's HOME and PATH say is of no use in a container.
    let mut env = if supervised.container.is_some() {
        BTreeMap::new()
    } else {
        passed_on()
    };
    let (program, args) = if let Some(federate) = federate {
        env.extend(federate.env.clone());
        env.extend(run.secret_files(federate, supervised.container.is_some()));
        (
            run.executable(federate),
            run.federate_args(federate, run.rti(rti_port)),
        )
    } else {
        (executable().to_path_buf(), run.rti_args())
    };
    let cwd = if request.part.is_some() {
        directory.work()
    } else {
        request.cwd.clone()
    };
    let limits = match federate {
        Some(federate) => run.limits(federate)?,
        None => Limits {
            account: unnamed(run.paths).filter(|_| supervised.container.is_none()),
            ..Limits::default()
        },
    };
    Ok(Spec {
        protocol: PROTOCOL,
        program,
        args,
        env,
        cwd,
        limits,
        status: federate.is_none_or(|run| run.kind == FederateKind::Ours),
        log: log_path(&directory.logs(), &name),
        log_size_max: request.settings.log_max_size,
        log_files_max: request.settings.log_max_files.max(1),
        socket: supervised.socket.clone(),
        exit_record: directory.exit_record(&name),
        linger_ms: LINGER_MS,
        instance: supervised.instance.clone(),
        name,
    })
}

/// This executable: the multi-call binary, which has the RTI and the supervisor.
pub(crate) fn executable() -> &'static Path {
    own_executable()
}

fn passed_on() -> BTreeMap<String, String> {
    let variable = |name: &str| Some((name.to_owned(), std::env::var(name).ok()?));
    PASSED_ON.into_iter().filter_map(variable).collect()
}

impl Run<'_> {
    /// Where the RTI is reached from this host.
    fn rti(&self, port: Option<u16>) -> SocketAddrV4 {
        let address = self.request.part.as_ref().map(|part| part.address);
        let here = SocketAddrV4::new(
            address.unwrap_or(Ipv4Addr::LOCALHOST),
            port.or(self.record.view.rti_port).unwrap_or(0),
        );
        self.record.rti.unwrap_or(here)
    }

    /// What a federate executes: a blob that was sent, or the path of the manifest.
    pub(super) fn executable(&self, federate: &FederateRun) -> PathBuf {
        let part = self.request.part.as_ref();
        let blob = part.and_then(|part| part.programs.get(&federate.name));
        blob.map_or_else(
            || federate.executable.clone(),
            |digest| self.paths.blobs().join(digest),
        )
    }

    /// The variables that name the files of a federate's secrets.
    fn secret_files(&self, federate: &FederateRun, contained: bool) -> BTreeMap<String, String> {
        let kept = self.record.secrets.as_ref();
        let names = federate.needs.secrets.keys();
        let files = names.filter_map(|name| {
            let file = secrets::file(kept?, &federate.name, name, contained);
            Some((format!("{name}_FILE"), file.to_string_lossy().into_owned()))
        });
        files.collect()
    }

    /// What a federate is bound to before its program is executed; the rest is its container's.
    fn limits(&self, federate: &FederateRun) -> Result<Limits, ApiError> {
        let needs = &federate.needs;
        let part = self.request.part.as_ref();
        let contained = part.is_some_and(|part| part.engine == Engine::Docker);
        // Whoever is not there any more is not root instead.
        let account = account(self.paths, self.request, federate)?;
        Ok(Limits {
            cpus: match contained {
                true => Vec::new(),
                false => needs.cpus.clone(),
            },
            realtime: needs.realtime,
            account: account.filter(|_| !contained),
            no_core: !needs.secrets.is_empty(),
        })
    }

    fn rti_args(&self) -> Vec<String> {
        let request = self.request;
        let mut args = rti_args(request, &self.record.view.id, self.record.view.rti_port);
        if let Some(part) = &request.part {
            args.extend(["--bind".to_owned(), part.address.to_string()]);
            args.extend(["--allow".to_owned(), allowed(part)]);
            if let Some(port) = self.record.view.rti_port.filter(|_| part.ports.is_some()) {
                // The same number as for TCP: one rule lets both in.
                args.extend(["--clock-port".to_owned(), port.to_string()]);
            }
        }
        args.extend(self.tls_args(RTI));
        args
    }

    /// Where a member's certificate and key are, if it has any.
    pub(super) fn papers(&self, member: &str) -> Option<PathBuf> {
        let part = self.request.part.as_ref();
        part.filter(|part| part.security == Security::Mtls)
            .map(|_| self.directory.papers(member))
    }

    fn tls_args(&self, member: &str) -> Vec<String> {
        let directory = self.papers(member);
        let directory = directory.map(|path| path.to_string_lossy().into_owned());
        directory.map_or_else(Vec::new, |path| vec!["--tls".to_owned(), path])
    }

    fn federate_args(&self, run: &FederateRun, rti: SocketAddrV4) -> Vec<String> {
        let (directory, id) = (self.directory, self.record.view.id.as_str());
        let path = |path: &Path| path.to_string_lossy().into_owned();
        let rti = rti.to_string();
        match &run.kind {
            FederateKind::Foreign { args } => {
                let ours = ["-i", id, "--rti", &rti].map(str::to_owned);
                ours.into_iter().chain(args.iter().cloned()).collect()
            }
            FederateKind::Ours => {
                let (plan, timing) = (path(&directory.plan()), path(&directory.timing()));
                let mut args = vec!["--plan", &plan, "--federate", &run.name];
                args.extend(["--rti", &rti, "-i", id, "--timing", &timing]);
                let mut args: Vec<_> = args.into_iter().map(str::to_owned).collect();
                if run.needs.realtime.is_some_and(|it| it.lock_memory) {
                    args.push("--lock-memory".to_owned());
                }
                if let Some(part) = &self.request.part {
                    args.extend(["--data-address".to_owned(), part.address.to_string()]);
                    args.extend(["--allow".to_owned(), allowed(part)]);
                }
                if let Some(port) = self.record.ports.get(&run.name) {
                    args.extend(["--data-port".to_owned(), port.to_string()]);
                }
                args.extend(self.tls_args(&run.name));
                if self.request.trace {
                    args.extend(["--trace".to_owned(), path(&directory.trace())]);
                }
                args
            }
        }
    }
}

/// The addresses of the federation's hosts: nobody else has anything to say to its members. The loopback address is
/// this host's own, when all share it.
fn allowed(part: &Part) -> String {
    let addresses: BTreeSet<Ipv4Addr> = part.hosts.values().map(|host| host.address).collect();
    let addresses: Vec<_> = addresses.iter().map(ToString::to_string).collect();
    addresses.join(",")
}

fn rti_args(request: &StartRequest, federation_id: &str, prepared: Option<u16>) -> Vec<String> {
    let port = prepared.or(request.settings.rti_port).unwrap_or(0);
    rti::arguments(&request.plan, federation_id, port)
}

#[cfg(test)]
mod tests {
    use ictus_coord::plan::{ClockPlan, ClockSync, FederatePlan, OnFailure, Plan, Wire};
    use ictus_deploy::{Settings, TimingSpec};
    use ictus_rti::{Command, Options};

    use super::*;

    /// What the plan asks of the RTI, it is told in options that it has.
    #[test]
    fn the_rti_is_told_what_the_plan_says() {
        let federate = |on_failure| FederatePlan {
            on_failure,
            ..FederatePlan::default()
        };
        let plan = Plan {
            authentication: true,
            wire: Wire::V0_13,
            failure_timeout_ns: 3_000_000_000,
            clock: ClockPlan {
                sync: ClockSync::On,
                period_ns: 5_000_000,
                trials: 7,
                ..ClockPlan::default()
            },
            federates: vec![
                federate(OnFailure::StopFederation),
                federate(OnFailure::Continue),
            ],
            ..Plan::default()
        };
        let run = |id| FederateRun {
            id,
            name: format!("f{id}"),
            executable: "/bin/f".into(),
            kind: FederateKind::Ours,
            env: BTreeMap::new(),
            needs: ictus_deploy::Needs::default(),
            portable: false,
        };
        let request = StartRequest {
            manifest: "/f.yaml".into(),
            cwd: "/".into(),
            plan,
            federates: vec![run(0), run(1)],
            settings: Settings::default(),
            timing: TimingSpec::default(),
            trace: false,
            part: None,
        };
        let args = rti_args(&request, "x", None);
        assert_eq!(
            args.join(" "),
            "rti -i x -n 2 -p 0 -c on period 5000000 exchanges-per-interval 7 -a --wire 0.13 --failure-timeout 3000 --continue 1"
        );
        let options = args.into_iter().skip(1).map(Into::into);
        assert!(matches!(Options::parse(options), Ok(Command::Run(_))));
    }
}
