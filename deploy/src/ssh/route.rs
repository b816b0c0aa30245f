//! From what a person writes to where we connect: the target, ssh_config and the defaults put together.

use std::fs;
use std::path::{Path, PathBuf};

use super::Options;
use super::config;
use super::error::SshError;
use super::identity::DEFAULT_FILES;
use super::target::Target;

/// Everything needed to reach one host.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Route {
    /// The name or address to connect to, and the one that known_hosts knows.
    pub(super) host: String,
    pub(super) port: u16,
    pub(super) user: String,
    /// Key files, in the order to try them.
    pub(super) identities: Vec<PathBuf>,
    /// Somebody named the key files: that one is missing is worth telling.
    pub(super) identities_named: bool,
    /// The agent may use only these.
    pub(super) only_identities: bool,
    pub(super) agent: Option<PathBuf>,
    pub(super) known_hosts: Vec<PathBuf>,
    /// The hosts on the way, the first one first.
    pub(super) jumps: Vec<Target>,
}

impl Route {
    /// Puts target, ssh_config and defaults together; the more particular one wins.
    pub(super) fn new(target: &Target, options: &Options) -> Result<Self, SshError> {
        let home = options.home.as_deref();
        let file = options.config.as_deref();
        let config = match file {
            Some(file) => config::read(file, &target.host, home)?,
            None => config::HostConfig::default(),
        };
        let file = file.unwrap_or(Path::new("ssh_config"));
        let here = |what: String| SshError::Config {
            file: file.to_owned(),
            line: 0,
            what,
        };
        // What comes out of a file is checked like what a person types.
        let as_written = Target {
            user: target.user.clone().or(config.user),
            host: config.host_name.unwrap_or_else(|| target.host.clone()),
            port: target.port.or(config.port),
        };
        let checked: Target = as_written
            .to_string()
            .parse()
            .map_err(|error: SshError| here(error.to_string()))?;
        let jumps = jumps(config.proxy_jump.as_deref()).map_err(here)?;
        let mut known_hosts = config.known_hosts.unwrap_or_default();
        if !known_hosts.contains(&options.known_hosts) {
            known_hosts.push(options.known_hosts.clone());
        }
        let user = checked.user.or_else(local_user).ok_or_else(|| {
            here(format!("no user for host `{target}`: this machine does not know yours; write `user@{target}`"))
        })?;
        let (identities, identities_named) = match (&options.identity, home) {
            (Some(identity), _) => (vec![identity.clone()], true),
            (None, _) if !config.identities.is_empty() => (config.identities, true),
            (None, Some(home)) => (
                DEFAULT_FILES
                    .iter()
                    .map(|name| home.join(".ssh").join(name))
                    .collect(),
                false,
            ),
            (None, None) => (Vec::new(), false),
        };
        Ok(Self {
            host: checked.host,
            port: checked.port.unwrap_or(22),
            user,
            identities,
            identities_named,
            only_identities: options.identity.is_some(),
            agent: options.agent.clone(),
            known_hosts,
            jumps,
        })
    }

    /// The host for messages: with its port when that is unusual.
    pub(super) fn name(&self) -> String {
        let port = (self.port != 22).then_some(self.port);
        let target = Target {
            user: None,
            host: self.host.clone(),
            port,
        };
        if port.is_none() {
            self.host.clone()
        } else {
            target.to_string()
        }
    }
}

/// The hosts of a `ProxyJump` value.
pub(super) fn jumps(value: Option<&str>) -> Result<Vec<Target>, String> {
    let Some(value) = value.filter(|value| !value.eq_ignore_ascii_case("none")) else {
        return Ok(Vec::new());
    };
    let jumps = value.split(',').map(|jump| jump.trim().parse::<Target>());
    jumps
        .collect::<Result<_, _>>()
        .map_err(|error| format!("`ProxyJump {value}`: {error}"))
}

/// The name of the user that we run as.
fn local_user() -> Option<String> {
    let uid = rustix::process::getuid().as_raw().to_string();
    let passwd = fs::read_to_string("/etc/passwd").unwrap_or_default();
    let named = passwd.lines().find_map(|line| {
        let mut fields = line.split(':');
        let name = fields.next()?;
        (fields.nth(1)? == uid).then(|| name.to_owned())
    });
    named.or_else(|| std::env::var("USER").ok())
}
