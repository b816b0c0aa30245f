//! The command line of a federate program.

use std::net::Ipv4Addr;
use std::path::PathBuf;
use thiserror::Error;

/// What the program is asked to do.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Command {
    /// Describe the classes, or the instances requested in a file.
    Describe(Option<PathBuf>),
    /// Run federates of a plan.
    Run(Box<RunArgs>),
    /// Print the usage.
    Help,
}

/// How to run.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct RunArgs {
    pub(crate) plan: PathBuf,
    /// The environment variable that has the plan in place of a file.
    pub(crate) plan_env: Option<String>,
    pub(crate) federates: Vec<String>,
    pub(crate) rti: Option<String>,
    pub(crate) federation_id: Option<String>,
    pub(crate) trace: Option<PathBuf>,
    pub(crate) timing: Option<PathBuf>,
    pub(crate) status_fd: Option<u32>,
    /// The Unix socket that takes status lines in place of a descriptor.
    pub(crate) status_socket: Option<PathBuf>,
    /// Where other federates reach this one, when it is not the address by which it reaches the RTI.
    pub(crate) data_address: Option<Ipv4Addr>,
    /// The TCP port at which other federates reach this one, and the UDP port of its clock; 0: any.
    pub(crate) data_port: u16,
    /// From where other federates connect; empty: from everywhere.
    pub(crate) allow: Vec<Ipv4Addr>,
    /// Whether memory is locked before anything runs.
    pub(crate) lock_memory: bool,
    /// Where certificate and key are; absent: connections are in the clear.
    pub(crate) tls: Option<PathBuf>,
}

/// Why a command line is refused.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub(crate) enum ArgsError {
    #[error("unknown option {0}")]
    Unknown(String),
    #[error("{0} needs a value")]
    MissingValue(String),
    #[error("--status-fd needs a descriptor number, not {0:?}")]
    BadDescriptor(String),
    #[error("--data-address needs an IPv4 address of this host, not {0:?}")]
    BadAddress(String),
    #[error("--data-port needs a port (0 to 65535), not {0:?}")]
    BadPort(String),
    #[error("--allow needs IPv4 addresses with commas between them, not {0:?}")]
    BadPeer(String),
    #[error("nothing to do: give --plan FILE, or --describe")]
    Nothing,
}

pub(crate) const USAGE: &str = "\
usage: PROGRAM --plan PLAN.json [--federate NAME]... [--rti HOST:PORT] [-i ID]
               [--data-address IPv4] [--data-port PORT] [--allow IPv4[,IPv4]...]
               [--tls DIR] [--trace DIR] [--timing DIR] [--status-fd N]
               [--lock-memory]
       PROGRAM --plan-env VARIABLE [--status-socket PATH] [...]
       PROGRAM --describe [INSTANCES.json]

Without --rti the whole plan runs in this process. With --rti each named federate joins the RTI as itself.
Usually `ictus up FEDERATION.yaml` starts programs; by hand, `ictus check -o json` prints the plan.
";

pub(crate) fn parse(args: impl IntoIterator<Item = String>) -> Result<Command, ArgsError> {
    let mut run = RunArgs::default();
    let mut has_plan = false;
    let mut args = args.into_iter();
    while let Some(arg) = args.next() {
        let mut value = || {
            args.next()
                .ok_or_else(|| ArgsError::MissingValue(arg.clone()))
        };
        match arg.as_str() {
            "--describe" => return Ok(Command::Describe(args.next().map(PathBuf::from))),
            "-h" | "--help" => return Ok(Command::Help),
            "--plan" => {
                run.plan = value()?.into();
                has_plan = true;
            }
            "--plan-env" => {
                run.plan_env = Some(value()?);
                has_plan = true;
            }
            "--status-socket" => run.status_socket = Some(value()?.into()),
            "--federate" => run.federates.push(value()?),
            "--rti" | "-r" => run.rti = Some(value()?),
            "-i" | "--id" => run.federation_id = Some(value()?),
            "--trace" => run.trace = Some(value()?.into()),
            "--timing" => run.timing = Some(value()?.into()),
            "--tls" => run.tls = Some(value()?.into()),
            "--status-fd" => {
                let text = value()?;
                run.status_fd = Some(text.parse().map_err(|_| ArgsError::BadDescriptor(text))?);
            }
            "--lock-memory" => run.lock_memory = true,
            "--data-address" => {
                let text = value()?;
                let address = text.parse().map_err(|_| ArgsError::BadAddress(text))?;
                run.data_address = Some(address);
            }
            "--data-port" => {
                let text = value()?;
                run.data_port = text.parse().map_err(|_| ArgsError::BadPort(text))?;
            }
            "--allow" => {
                for text in value()?.split(',') {
                    let address = text.trim().parse();
                    let address = address.map_err(|_| ArgsError::BadPeer(text.to_owned()))?;
                    run.allow.push(address);
                }
            }
            _ => return Err(ArgsError::Unknown(arg)),
        }
    }
    if has_plan {
        Ok(Command::Run(Box::new(run)))
    } else {
        Err(ArgsError::Nothing)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn words(line: &str) -> Result<Command, ArgsError> {
        parse(line.split_whitespace().map(str::to_owned))
    }

    #[test]
    fn command_lines() {
        assert_eq!(words("--describe"), Ok(Command::Describe(None)));
        assert_eq!(
            words("--describe f.json"),
            Ok(Command::Describe(Some("f.json".into())))
        );
        assert_eq!(words(""), Err(ArgsError::Nothing));
        assert_eq!(
            words("--plan"),
            Err(ArgsError::MissingValue("--plan".into()))
        );
        assert_eq!(words("--plna x"), Err(ArgsError::Unknown("--plna".into())));
        let run = RunArgs {
            plan: "p.json".into(),
            federates: vec!["a".into(), "b".into()],
            rti: Some("127.0.0.1:15045".into()),
            federation_id: Some("x".into()),
            status_fd: Some(3),
            lock_memory: true,
            data_port: 15_046,
            tls: Some("tls/a".into()),
            ..RunArgs::default()
        };
        let line = "--plan p.json --federate a --federate b --rti 127.0.0.1:15045 -i x --status-fd 3 --lock-memory \
                    --data-port 15046 --tls tls/a";
        assert_eq!(words(line), Ok(Command::Run(Box::new(run))));
        let run = RunArgs {
            plan_env: Some("ICTUS_PLAN".into()),
            status_socket: Some("/s".into()),
            ..RunArgs::default()
        };
        let line = "--plan-env ICTUS_PLAN --status-socket /s";
        assert_eq!(words(line), Ok(Command::Run(Box::new(run))));
        assert_eq!(
            words("--plan p --allow 10.0.0.1,10.0.0."),
            Err(ArgsError::BadPeer("10.0.0.".into()))
        );
        assert_eq!(
            words("--plan p --data-address robot.local"),
            Err(ArgsError::BadAddress("robot.local".into()))
        );
        assert_eq!(
            words("--plan p --data-port 65536"),
            Err(ArgsError::BadPort("65536".into()))
        );
        assert_eq!(
            words("--plan p --status-fd x"),
            Err(ArgsError::BadDescriptor("x".into()))
        );
    }
}
