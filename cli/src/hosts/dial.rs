//! The way to the daemon of another host: `ictusd dial-stdio` over ssh.

use std::fmt;
use std::io;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use ictus_deploy::placement::SshClient;
use ictus_deploy::ssh::{Connection, Method, Options, SshError, Target};
use ictusd::client::{Client, ClientError, Dial, Dialled, Duplex};
use ictusd::installation::PROGRAM;
use tokio::io::AsyncReadExt;

use super::INSTALLED;
use crate::commands::dial_stdio::MAGIC;
use crate::error::{CliError, Kind};

/// How long its daemon may take to be found or started.
const GREETING_MAX: Duration = Duration::from_secs(20);
/// Bytes of a shell's banner that are passed over.
const BANNER_BYTES_MAX: usize = 64 << 10;

/// A host's ssh connection; every call has a channel of its own.
struct Host {
    name: String,
    connection: Connection,
    /// Its ictusd: whoever logs in may have one of its own, which comes before the host's.
    program: &'static str,
}

impl fmt::Debug for Host {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Host").field(&self.name).finish()
    }
}

/// A target as a person writes it.
pub(crate) fn target(text: &str) -> Result<Target, CliError> {
    text.parse()
        .map_err(|error: SshError| CliError::failed(error))
}

/// Usual places, and who speaks ssh.
pub(crate) fn options(client: SshClient, identity: Option<&Path>) -> Options {
    Options {
        method: match client {
            SshClient::Ssh2 => Method::Ssh2,
            SshClient::System => Method::System,
        },
        identity: identity.map(Path::to_path_buf),
        ..Options::from_environment()
    }
}

pub(super) async fn connect(
    name: &str,
    at: &str,
    client: SshClient,
    identity: Option<&Path>,
) -> Result<Client, CliError> {
    let opened = Connection::open(&target(at)?, &options(client, identity)).await;
    let connection = opened.map_err(|error| unreachable_host(name, &error))?;
    let mut dial = Host {
        name: name.to_owned(),
        connection,
        program: INSTALLED,
    };
    // Whether anybody answers is known before anything is asked of it.
    let mut greeted = dial.dial().await.map(drop);
    if greeted.is_err() && !dial.has(INSTALLED).await && dial.has(PROGRAM).await {
        dial.program = PROGRAM;
        greeted = dial.dial().await.map(drop);
    }
    greeted.map_err(ClientError::Far)?;
    Ok(Client::over(Arc::new(dial)))
}

/// An error of ssh as a command's.
pub(crate) fn unreachable_host(name: &str, error: &SshError) -> CliError {
    let mut message = error.to_string();
    let mut source = std::error::Error::source(error);
    while let Some(error) = source {
        message.push_str(&format!(": {error}"));
        source = error.source();
    }
    CliError::new(Kind::Unreachable, format!("host `{name}`: {message}"))
}

impl Host {
    /// Whether a file is there.
    async fn has(&self, path: &str) -> bool {
        let looked = self.connection.run(&["test", "-e", path], &[]).await;
        looked.is_ok_and(|output| output.code == 0)
    }

    /// A channel on which the daemon answers next.
    async fn greeted(&self) -> io::Result<Box<dyn Duplex>> {
        let channel = self.connection.exec(&[self.program, "dial-stdio"]).await;
        let mut channel = channel.map_err(io::Error::other)?;
        let greeting = async {
            let (mut line, mut read) = (Vec::new(), 0);
            loop {
                let byte = channel.read_u8().await?;
                read += 1;
                if byte != b'\n' {
                    line.push(byte);
                } else if line == MAGIC.as_bytes() {
                    return Ok(());
                } else {
                    line.clear();
                }
                if read > BANNER_BYTES_MAX {
                    return Err(io::Error::other("its shell prints without end"));
                }
            }
        };
        match tokio::time::timeout(GREETING_MAX, greeting).await {
            Ok(Ok(())) => Ok(Box::new(channel)),
            Ok(Err(error)) if error.kind() == io::ErrorKind::UnexpectedEof => {
                let complaint = tokio::time::timeout(GREETING_MAX, channel.complaint()).await;
                let complaint = complaint.unwrap_or_default();
                let mut what =
                    format!("no ictusd answers there; `ictus host add` puts it at ~/{INSTALLED}");
                let said = complaint
                    .lines()
                    .find_map(|line| line.strip_prefix("error: "));
                if let Some(line) = said.or_else(|| complaint.lines().last()) {
                    let line: String = line.chars().filter(|it| !it.is_control()).collect();
                    what = format!("{line} ({what})");
                }
                Err(io::Error::new(io::ErrorKind::NotFound, what))
            }
            Ok(Err(error)) => Err(error),
            Err(_) => {
                let what = format!(
                    "its ictusd did not answer within {} s",
                    GREETING_MAX.as_secs()
                );
                Err(io::Error::new(io::ErrorKind::TimedOut, what))
            }
        }
    }
}

impl Dial for Host {
    fn dial(&self) -> Dialled<'_> {
        Box::pin(async {
            let greeted = self.greeted().await;
            greeted.map_err(|error| {
                let message = format!("host `{}`: {error}", self.name);
                io::Error::new(error.kind(), message)
            })
        })
    }
}
