//! A federation of one host as a compose file, for whoever has no daemon.
//!
//! The file is all that is needed beside its images: the plan stands in it and reaches federates as a variable, because
//! nobody knows where the output of a command goes, so that nothing can be laid beside it. It holds no time, random number
//! or hash of a program: the same manifest gives the same file. It is in the words that docker-compose 1.29 and Compose v2
//! share.

use std::path::{Path, PathBuf};
use std::rc::Rc;
use std::time::Duration;

use ictus_coord::plan::FederatePlan;
use serde_saphyr::RcAnchor;

use crate::check::{Checked, FederateKind, FederateRun};
use crate::manifest::COORDINATOR;
use crate::placement::SecretSource;
use crate::rti::arguments;

mod file;
pub mod image;
pub mod monitoring;

use file::{
    Build, Depends, File, Healthcheck, Line, Logging, Mount, MountedSecret, SecretFile, Service,
    Table, Variable,
};
use image::{ImageSource, Images};

/// The variable that has the plan.
pub const PLAN_VARIABLE: &str = "ICTUS_PLAN";
/// Where who runs a compose file says the federation's id, which only `authentication` requires.
pub const ID_VARIABLE: &str = "ICTUS_FEDERATION_ID";
/// The service that gathers measures.
const COLLECTOR: &str = "collector";
/// The RTI's port when the manifest names none: LF's. It is of the federation's own network.
const RTI_PORT: u16 = 15045;
/// The longest variable that the kernel hands over: 32 pages, with its name, `=` and a zero.
const VARIABLE_BYTES_MAX: usize = 32 * 4096 - PLAN_VARIABLE.len() - 2;
/// Where traces are written in a container.
const TRACE: &str = "/ictus/trace";
/// Where Compose lays secrets.
const SECRETS: &str = "/run/secrets";
/// What `/tmp` may take of the memory when the rest cannot be written.
const TMP: &str = "/tmp:rw,nosuid,nodev,mode=1777,size=64m";

/// What a compose file has besides the federation.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ComposeOptions {
    /// A collector of measures, Prometheus and Grafana.
    pub monitoring: bool,
    /// The directory of the host into which federates write their traces; relative to the file.
    pub trace: Option<PathBuf>,
}

/// A compose file and the images that it needs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Compose {
    /// The file.
    pub text: String,
    /// What must be loaded before it can be run; others are pulled.
    pub images: Vec<image::LocalImage>,
}

/// Why there is no compose file.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ComposeError {
    /// The federation is spread.
    #[error("a compose file is for one host, and this federation runs on {}: {}", .0.len(), .0.join(", "))]
    SeveralHosts(Vec<String>),
    /// The plan does not fit into a variable.
    #[error("the plan has {0} bytes, and a container's variable holds {VARIABLE_BYTES_MAX}")]
    LargePlan(usize),
    /// A service of the monitoring has the name of a federate.
    #[error("a federate is called `{0}`, as a service of `--monitoring`")]
    NameTaken(String),
    /// What is checked without build has no federates to run.
    #[error("the programs were not asked for their federates")]
    NotBuilt,
    /// A path of the manifest is no text.
    #[error("{} cannot stand in a compose file: it is not Unicode", .0.display())]
    NotUnicode(PathBuf),
    /// The file cannot be written down.
    #[error("the compose file cannot be written down: {0}")]
    Unwritable(String),
}

impl Compose {
    /// The compose file of a federation.
    ///
    /// Laws: the same federation and options give the same text; no value of a secret is in it.
    ///
    /// # Errors
    /// See [`ComposeError`].
    pub fn of(checked: &Checked, options: &ComposeOptions) -> Result<Self, ComposeError> {
        if let Some(placement) = &checked.placement
            && placement.hosts.len() > 1
        {
            let hosts = placement.hosts.iter().map(|host| host.name.clone());
            return Err(ComposeError::SeveralHosts(hosts.collect()));
        }
        if checked.federates.len() != checked.plan.federates.len() {
            return Err(ComposeError::NotBuilt);
        }
        let mut writer = Writer::new(checked, options)?;
        let mut services = vec![(COORDINATOR.to_owned(), writer.rti())];
        for (run, federate) in checked.federates.iter().zip(&checked.plan.federates) {
            services.push((run.name.clone(), writer.federate(run, federate)?));
        }
        let mut volumes = Vec::new();
        if writer.collects() {
            monitoring::add(&mut writer, &mut services, &mut volumes)?;
        }
        let file = File {
            plan: writer.plan.clone(),
            services: Table(services),
            volumes: Table(volumes),
            secrets: Table(writer.secrets.clone()),
        };
        Ok(Self {
            text: format!("{}{}", header(checked, options), file.yaml()?),
            images: writer.images.into_needed(),
        })
    }
}

/// What a reader of the file should know.
fn header(checked: &Checked, options: &ComposeOptions) -> String {
    let name = checked.manifest.file_name().unwrap_or_default();
    // A line of its own, whatever the name.
    let name: String = name
        .to_string_lossy()
        .chars()
        .filter(|it| !it.is_control())
        .collect();
    let monitoring = if options.monitoring {
        " --monitoring"
    } else {
        ""
    };
    let id = if checked.plan.authentication {
        format!(
            "# {ID_VARIABLE} must have the federation's id, which is its key: the same for all, known to nobody else.\n"
        )
    } else {
        String::new()
    };
    format!(
        "# Made by `ictus compose {name}{monitoring}`: change the manifest, not this file. Its images `{}/...`\n\
         # are of this machine and cannot be pulled: `ictus compose {name}{monitoring} --build` makes and loads them.\n{id}",
        image::REPOSITORY,
    )
}

/// What services have in common, and what they add to the file.
#[derive(Debug)]
struct Writer<'a> {
    checked: &'a Checked,
    options: &'a ComposeOptions,
    plan: RcAnchor<String>,
    id: String,
    images: Images,
    secrets: Vec<(String, SecretFile)>,
}

impl<'a> Writer<'a> {
    fn new(checked: &'a Checked, options: &'a ComposeOptions) -> Result<Self, ComposeError> {
        let plan = serde_json::to_string(&checked.plan)
            .map_err(|error| ComposeError::Unwritable(error.to_string()))?;
        if plan.len() > VARIABLE_BYTES_MAX {
            return Err(ComposeError::LargePlan(plan.len()));
        }
        Ok(Self {
            checked,
            options,
            plan: RcAnchor(Rc::new(literal(&plan))),
            id: federation_id(checked),
            images: Images::default(),
            secrets: Vec::new(),
        })
    }

    fn image(&mut self, what: &str, source: ImageSource) -> String {
        self.images
            .need(&self.checked.plan.federation, what, source)
    }

    /// Whether there is a collector: when monitoring is asked for, or metrics are to be served.
    fn collects(&self) -> bool {
        self.options.monitoring || self.checked.settings.metrics_listen.is_some()
    }

    fn port(&self) -> u16 {
        self.checked.settings.rti_port.unwrap_or(RTI_PORT)
    }

    fn rti(&mut self) -> Service {
        let port = self.port();
        // Its own words are not of the manifest; the id comes as it is, for Compose to fill in.
        let mut command = arguments(&self.checked.plan, &self.id, port);
        let join_timeout = self
            .checked
            .settings
            .join_timeout
            .as_millis()
            .max(1)
            .to_string();
        let more = ["--bind", "0.0.0.0", "--join-timeout", &join_timeout];
        command.extend(more.map(str::to_owned));
        Service {
            image: self.image("ictus", ImageSource::Ictus),
            command: Line(command),
            healthcheck: Some(Healthcheck::of_port(port)),
            ..self.service()
        }
    }

    fn federate(
        &mut self,
        run: &FederateRun,
        federate: &FederatePlan,
    ) -> Result<Service, ComposeError> {
        let rti = format!("{COORDINATOR}:{}", self.port());
        let source = ImageSource::Program(run.executable.clone());
        let (image, command) = match &run.kind {
            FederateKind::Ours => {
                let program = federate.program.as_deref().unwrap_or_default();
                let image = self.image(&format!("program.{program}"), source);
                (image, self.our_command(run, &rti))
            }
            FederateKind::Foreign { args } => {
                let what = format!("federate.{}", run.name);
                let image = match (&run.needs.image, &run.needs.build) {
                    (Some(image), _) => image.clone(),
                    (None, Some(_)) => image::reference(&self.checked.plan.federation, &what),
                    (None, None) => self.image(&what, source),
                };
                let command = ["-i", &self.id, "--rti", &rti].map(str::to_owned);
                let args = args.iter().map(|arg| literal(arg));
                (image, command.into_iter().chain(args).collect())
            }
        };
        let mut service = Service {
            image,
            command: Line(command),
            depends_on: Table(vec![(COORDINATOR.to_owned(), Depends::HEALTHY)]),
            ..self.service()
        };
        for (name, value) in &run.env {
            let value = Variable::Text(literal(value));
            service.environment.insert(name.clone(), value);
        }
        if run.kind == FederateKind::Ours {
            let plan = Variable::Plan(self.plan.clone());
            service.environment.insert(PLAN_VARIABLE.to_owned(), plan);
            self.traces(&mut service)?;
            if self.collects() {
                service.volumes.push(monitoring::shared(false));
            }
        }
        if let Some(build) = &run.needs.build {
            service.build = Some(Build {
                context: text(&build.context)?,
                dockerfile: literal(&build.dockerfile),
            });
        }
        if run.needs.has_image() {
            // What somebody else's image writes where, we do not know.
            (service.read_only, service.tmpfs) = (false, Line::default());
        }
        needs(run, &mut service)?;
        self.add_secrets(run, &mut service)?;
        Ok(service)
    }

    fn our_command(&self, run: &FederateRun, rti: &str) -> Vec<String> {
        let mut command = vec![
            "--plan-env",
            PLAN_VARIABLE,
            "--federate",
            &run.name,
            "--rti",
            rti,
            "-i",
            &self.id,
        ];
        if self.options.trace.is_some() {
            command.extend(["--trace", TRACE]);
        }
        if self.collects() {
            command.extend(["--status-socket", monitoring::SOCKET]);
        }
        command.into_iter().map(str::to_owned).collect()
    }

    fn traces(&self, service: &mut Service) -> Result<(), ComposeError> {
        if let Some(directory) = &self.options.trace {
            service.volumes.push(Mount::bind(text(directory)?, TRACE));
        }
        Ok(())
    }

    /// A service that may do nothing that was not asked for.
    fn service(&self) -> Service {
        let settings = &self.checked.settings;
        Service {
            restart: "no",
            read_only: true,
            tmpfs: Line::of([TMP]),
            cap_drop: Line::of(["ALL"]),
            security_opt: Line::of(["no-new-privileges:true"]),
            // A dump of memory would hold secrets; a pipe gets one in spite of 0, but not of 1 byte.
            ulimits: [("core", 1)].into(),
            stop_grace_period: Some(span(settings.stop_grace)),
            logging: Logging::files(settings.log_max_size, settings.log_max_files),
            ..Service::default()
        }
    }

    /// Files that Compose lays into the container; the variable names each.
    fn add_secrets(
        &mut self,
        run: &FederateRun,
        service: &mut Service,
    ) -> Result<(), ComposeError> {
        for (name, source) in &run.needs.secrets {
            let file = match source {
                SecretSource::File(path) => text(path)?,
                // Compose 1.29 knows files only.
                SecretSource::Environment => {
                    format!("${{{name}_FILE:?the file that has the secret {name}}}")
                }
            };
            // Two federates may have the same name for different files.
            let key = format!("{}.{name}", run.name);
            let target = key.clone();
            let place = Variable::Text(format!("{SECRETS}/{target}"));
            service.environment.insert(format!("{name}_FILE"), place);
            service.secrets.push(MountedSecret {
                source: key.clone(),
                target,
            });
            self.secrets.push((key, SecretFile { file }));
        }
        Ok(())
    }
}

/// What the manifest says that a federate needs.
fn needs(run: &FederateRun, service: &mut Service) -> Result<(), ComposeError> {
    let needs = &run.needs;
    let cpus: Vec<_> = needs.cpus.iter().map(u32::to_string).collect();
    service.cpuset = (!cpus.is_empty()).then(|| cpus.join(","));
    service.mem_limit = needs.memory;
    // The same: no swap, so that the limit is one.
    service.memswap_limit = needs.memory;
    service.pids_limit = needs.pids;
    service.user = needs.user.as_deref().map(literal);
    for device in &needs.devices {
        let device = text(device)?;
        service.devices.push(format!("{device}:{device}:rw"));
    }
    for volume in &needs.volumes {
        let mount = Mount::bind(text(&volume.host)?, text(&volume.at)?);
        service.volumes.push(mount.read_only(volume.read_only));
    }
    if let Some(realtime) = needs.realtime {
        service.ulimits.insert("rtprio", realtime.priority.into());
        if realtime.lock_memory {
            service.ulimits.insert("memlock", -1);
        }
    }
    Ok(())
}

/// The federation's id. It is the key of `authentication`, so it is asked for then; otherwise it only tells federations
/// apart that meet on a network, and this one has its own.
fn federation_id(checked: &Checked) -> String {
    let name = &checked.plan.federation;
    if checked.plan.authentication {
        format!("${{{ID_VARIABLE}:?the key of the federation {name}}}")
    } else {
        format!("${{{ID_VARIABLE}:-{name}}}")
    }
}

/// A text that Compose takes as it is.
fn literal(text: &str) -> String {
    text.replace('$', "$$")
}

fn text(path: &Path) -> Result<String, ComposeError> {
    let text = path.to_str().map(literal);
    text.ok_or_else(|| ComposeError::NotUnicode(path.to_path_buf()))
}

/// A time in Compose's words, in whole seconds where it is so many, and rounded up to milliseconds elsewhere.
fn span(span: Duration) -> String {
    let ms = span.as_nanos().div_ceil(1_000_000);
    if ms.is_multiple_of(1000) {
        format!("{}s", ms / 1000)
    } else {
        format!("{ms}ms")
    }
}
