//! `ictusd dial-stdio`: standard input and output become a connection to this user's daemon. What ssh runs.

use ictusd::paths::Paths;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::UnixStream;

use crate::error::CliError;
use crate::session::Session;

/// The line after which the daemon's bytes begin; what a shell prints before it is no answer.
pub(crate) const MAGIC: &str = "ictus-dial-stdio-1";

/// Takes no address: it connects to this user's daemon and to nothing else.
pub(crate) fn run() -> Result<(), CliError> {
    let session = Session::new()?;
    session.block_on(async {
        let paths = Paths::from_env()?;
        session.daemon().await?;
        let socket = paths.socket_in_lock().unwrap_or_else(|| paths.socket());
        let daemon = UnixStream::connect(&socket)
            .await
            .map_err(CliError::failed)?;
        relay(daemon).await.map_err(CliError::failed)
    })
}

/// Copies both ways; the end of either direction is passed on.
async fn relay(daemon: UnixStream) -> std::io::Result<()> {
    let (mut input, mut output) = (tokio::io::stdin(), tokio::io::stdout());
    output.write_all(format!("{MAGIC}\n").as_bytes()).await?;
    output.flush().await?;
    let (mut from_daemon, mut to_daemon) = daemon.into_split();
    let up = async {
        tokio::io::copy(&mut input, &mut to_daemon).await?;
        to_daemon.shutdown().await
    };
    let down = async {
        let mut buffer = vec![0; 64 << 10];
        loop {
            let count = from_daemon.read(&mut buffer).await?;
            if count == 0 {
                return output.shutdown().await;
            }
            output.write_all(&buffer[..count]).await?;
            // Events are small, and nobody wants to wait for the next one.
            output.flush().await?;
        }
    };
    tokio::pin!(up, down);
    tokio::select! {
        // Nothing comes any more; an answer still may.
        sent = &mut up => { sent?; down.await }
        received = &mut down => received,
    }
}
