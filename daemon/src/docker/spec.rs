//! What a container is made of, and how the engine is told.

use std::collections::{BTreeMap, HashMap};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use bollard::models::{
    ContainerCreateBody, DeviceMapping, HostConfig, HostConfigLogConfig, Mount, MountType,
    ResourcesUlimits, RestartPolicy, RestartPolicyNameEnum,
};
use ictus_deploy::Needs;

/// The labels of everything that is ours. A label alone proves nothing: anybody may copy it.
pub(crate) mod label {
    /// The federation.
    pub(crate) const FEDERATION: &str = "ictus.federation";
    /// The member: a federate's name, or `rti`.
    pub(crate) const MEMBER: &str = "ictus.member";
    /// The instance id of the record.
    pub(crate) const INSTANCE: &str = "ictus.instance";
    /// The run.
    pub(crate) const GENERATION: &str = "ictus.generation";
}

/// What the container's own log may take: the supervisor says next to nothing there, members' logs are files.
const LOG_BYTES_MAX: &str = "64k";
/// What `/tmp` may take of the memory when the rest cannot be written.
const TMP_OPTIONS: &str = "rw,nosuid,nodev,mode=1777,size=64m";

/// A container to be made.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct ContainerSpec {
    /// Its name; unique on the host.
    pub(crate) name: String,
    /// The image, by id or reference.
    pub(crate) image: String,
    /// Its labels; [`label::INSTANCE`] is among them.
    pub(crate) labels: BTreeMap<String, String>,
    /// The whole command line; the image's own is not used.
    pub(crate) entrypoint: Vec<String>,
    /// Added to the image's environment.
    pub(crate) env: BTreeMap<String, String>,
    /// `UID:GID`, or names that the image knows.
    pub(crate) user: String,
    /// The working directory.
    pub(crate) workdir: PathBuf,
    /// Files and directories of the host that it sees.
    pub(crate) mounts: Vec<Binding>,
    /// Processors it may run on; empty: all.
    pub(crate) cpus: Vec<u32>,
    /// Bytes of memory.
    pub(crate) memory: Option<u64>,
    /// Processes and threads.
    pub(crate) pids: Option<u32>,
    /// Device files.
    pub(crate) devices: Vec<PathBuf>,
    /// The highest realtime priority it may ask for.
    pub(crate) realtime: Option<u8>,
    /// Whether it may lock its memory.
    pub(crate) lock_memory: bool,
    /// Capabilities beside none.
    pub(crate) capabilities: Vec<String>,
    /// Whether nothing but its mounts and `/tmp` can be written.
    pub(crate) read_only_root: bool,
}

/// A file or directory of the host in a container.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Binding {
    /// On the host.
    pub(crate) host: PathBuf,
    /// In the container.
    pub(crate) inside: PathBuf,
    /// Whether it can only be read.
    pub(crate) read_only: bool,
}

impl Binding {
    /// The same path inside and outside.
    pub(crate) fn same(path: &Path, read_only: bool) -> Self {
        Self {
            host: path.to_path_buf(),
            inside: path.to_path_buf(),
            read_only,
        }
    }
}

impl ContainerSpec {
    /// Takes over what the manifest says that a federate needs; its user and secrets are the caller's.
    pub(crate) fn needs(&mut self, needs: &Needs) {
        self.cpus.clone_from(&needs.cpus);
        self.memory = needs.memory;
        self.pids = needs.pids;
        self.devices.clone_from(&needs.devices);
        let volumes = needs.volumes.iter().map(|volume| Binding {
            host: volume.host.clone(),
            inside: volume.at.clone(),
            read_only: volume.read_only,
        });
        self.mounts.extend(volumes);
        if let Some(realtime) = needs.realtime {
            self.realtime = Some(realtime.priority);
            self.lock_memory = realtime.lock_memory;
            self.capabilities.push("SYS_NICE".to_owned());
        }
    }

    /// The name of a member's container: `ictus-FEDERATION-MEMBER-` and the beginning of its instance id.
    pub(crate) fn name_of(federation: &str, member: &str, instance: &str) -> String {
        let end = instance
            .char_indices()
            .nth(8)
            .map_or(instance.len(), |(at, _)| at);
        format!("ictus-{federation}-{member}-{}", &instance[..end])
    }

    /// The same in the engine's words.
    pub(super) fn body(&self) -> ContainerCreateBody {
        ContainerCreateBody {
            user: Some(self.user.clone()),
            env: Some(
                self.env
                    .iter()
                    .map(|(name, value)| format!("{name}={value}"))
                    .collect(),
            ),
            // Not the image's: it would become arguments of ours.
            cmd: Some(Vec::new()),
            image: Some(self.image.clone()),
            working_dir: Some(self.workdir.to_string_lossy().into_owned()),
            entrypoint: Some(self.entrypoint.clone()),
            labels: Some(self.labels.clone().into_iter().collect()),
            host_config: Some(self.host_config()),
            ..ContainerCreateBody::default()
        }
    }

    fn host_config(&self) -> HostConfig {
        let cpus: Vec<_> = self.cpus.iter().map(u32::to_string).collect();
        let log = HashMap::from([
            ("max-size".to_owned(), LOG_BYTES_MAX.to_owned()),
            ("max-file".to_owned(), "1".to_owned()),
        ]);
        let tmp = || HashMap::from([("/tmp".to_owned(), TMP_OPTIONS.to_owned())]);
        let memory = self
            .memory
            .map(|bytes| i64::try_from(bytes).unwrap_or(i64::MAX));
        HostConfig {
            network_mode: Some("host".to_owned()),
            mounts: Some(self.mounts.iter().map(mount).collect()),
            cpuset_cpus: (!cpus.is_empty()).then(|| cpus.join(",")),
            memory,
            // The same as `memory`: no swap, so that the limit is one.
            memory_swap: memory,
            pids_limit: self.pids.map(i64::from),
            devices: Some(self.devices.iter().map(|path| device(path)).collect()),
            group_add: Some(groups(&self.devices)),
            ulimits: Some(self.ulimits()),
            cap_drop: Some(vec!["ALL".to_owned()]),
            cap_add: Some(self.capabilities.clone()),
            security_opt: Some(vec!["no-new-privileges".to_owned()]),
            readonly_rootfs: Some(self.read_only_root),
            tmpfs: self.read_only_root.then(tmp),
            init: Some(false),
            restart_policy: Some(RestartPolicy {
                name: Some(RestartPolicyNameEnum::NO),
                maximum_retry_count: None,
            }),
            auto_remove: Some(false),
            log_config: Some(HostConfigLogConfig {
                typ: Some("json-file".to_owned()),
                config: Some(log),
            }),
            ..HostConfig::default()
        }
    }

    fn ulimits(&self) -> Vec<ResourcesUlimits> {
        let limit = |name: &str, value| ResourcesUlimits {
            name: Some(name.to_owned()),
            soft: Some(value),
            hard: Some(value),
        };
        // A dump of memory would hold secrets; a pipe gets one in spite of 0, but not of 1 byte.
        let mut limits = vec![limit("core", 1)];
        limits.extend(
            self.realtime
                .map(|priority| limit("rtprio", priority.into())),
        );
        limits.extend(self.lock_memory.then(|| limit("memlock", -1)));
        limits
    }
}

fn mount(binding: &Binding) -> Mount {
    Mount {
        typ: Some(MountType::BIND),
        source: Some(binding.host.to_string_lossy().into_owned()),
        target: Some(binding.inside.to_string_lossy().into_owned()),
        read_only: Some(binding.read_only),
        ..Mount::default()
    }
}

fn device(path: &Path) -> DeviceMapping {
    let path = path.to_string_lossy().into_owned();
    DeviceMapping {
        path_on_host: Some(path.clone()),
        path_in_container: Some(path),
        cgroup_permissions: Some("rw".to_owned()),
    }
}

/// The groups that own device files: a user who is not root reaches them only so.
fn groups(devices: &[PathBuf]) -> Vec<String> {
    let owners = devices
        .iter()
        .filter_map(|path| Some(path.metadata().ok()?.gid()));
    let mut owners: Vec<_> = owners.filter(|gid| *gid != 0).collect();
    owners.sort_unstable();
    owners.dedup();
    owners.iter().map(u32::to_string).collect()
}

#[cfg(test)]
mod tests {
    use ictus_deploy::placement::{Realtime, RealtimePolicy, Volume};

    use super::*;

    #[test]
    fn a_container_may_do_nothing_that_was_not_asked_for() {
        let host = ContainerSpec::default().host_config();
        assert_eq!(host.cap_drop, Some(vec!["ALL".to_owned()]));
        assert_eq!(
            host.security_opt,
            Some(vec!["no-new-privileges".to_owned()])
        );
        assert_eq!(host.cap_add, Some(Vec::new()));
        assert_eq!(
            (host.privileged, host.pid_mode, host.init),
            (None, None, Some(false))
        );
        assert_eq!(
            (host.memory, host.cpuset_cpus, host.pids_limit),
            (None, None, None)
        );
    }

    #[test]
    fn needs_become_limits() {
        let mut spec = ContainerSpec::default();
        spec.needs(&Needs {
            cpus: vec![0, 2],
            memory: Some(64 << 20),
            pids: Some(30),
            devices: vec!["/dev/null".into()],
            volumes: vec![Volume {
                host: "/data".into(),
                at: "/d".into(),
                read_only: true,
            }],
            realtime: Some(Realtime {
                policy: RealtimePolicy::Fifo,
                priority: 10,
                lock_memory: true,
            }),
            ..Needs::default()
        });
        let host = spec.host_config();
        assert_eq!(host.cpuset_cpus.as_deref(), Some("0,2"));
        assert_eq!(
            (host.memory, host.memory_swap),
            (Some(64 << 20), Some(64 << 20))
        );
        assert_eq!(host.pids_limit, Some(30));
        assert_eq!(host.cap_add, Some(vec!["SYS_NICE".to_owned()]));
        let limits: Vec<_> = host
            .ulimits
            .unwrap()
            .into_iter()
            .map(|it| (it.name.unwrap(), it.hard.unwrap()))
            .collect();
        let expected = [("core", 1), ("rtprio", 10), ("memlock", -1)];
        assert_eq!(
            limits,
            expected.map(|(name, value)| (name.to_owned(), value))
        );
        let mounts = host.mounts.unwrap();
        assert_eq!(
            (mounts[0].target.as_deref(), mounts[0].read_only),
            (Some("/d"), Some(true))
        );
        assert_eq!(
            host.devices.unwrap()[0].path_on_host.as_deref(),
            Some("/dev/null")
        );
    }

    #[test]
    fn names_hold_the_beginning_of_the_instance() {
        assert_eq!(
            ContainerSpec::name_of("f", "a", "0123456789abcdef"),
            "ictus-f-a-01234567"
        );
        assert_eq!(ContainerSpec::name_of("f", "rti", "x"), "ictus-f-rti-x");
    }
}
