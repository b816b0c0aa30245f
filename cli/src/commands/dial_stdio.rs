//! `ictusd dial-stdio`: standard input and output become a connection to this user's daemon. What ssh runs; with `--viewer`
//! in `authorized_keys`, for whoever may only look.

use std::io::{self, Read, Write};
use std::net::Shutdown;
use std::os::unix::net::UnixStream;
use std::thread;

use clap::Args;
use ictusd::paths::viewer_socket;

use crate::error::CliError;
use crate::session::Session;

/// The line after which the daemon's bytes begin; what a shell prints before it is no answer.
pub(crate) const MAGIC: &str = "ictus-dial-stdio-1";

/// Connect standard input and output to this user's daemon
#[derive(Debug, Args)]
pub(crate) struct DialStdio {
    /// As whoever may only look
    #[arg(long)]
    viewer: bool,
}

/// Takes no address: it connects to this user's daemon and to nothing else.
pub(crate) fn run(as_whom: &DialStdio) -> Result<(), CliError> {
    let session = Session::new()?;
    session.block_on(session.daemon())?;
    let socket = session.paths.socket_in_lock();
    let mut socket = socket.unwrap_or_else(|| session.paths.socket());
    if as_whom.viewer {
        socket = viewer_socket(&socket);
    }
    let daemon = UnixStream::connect(&socket).map_err(CliError::failed)?;
    relay(daemon).map_err(CliError::failed)
}

/// Copies both ways until the daemon has said everything; the end of what comes in is passed on.
fn relay(daemon: UnixStream) -> io::Result<()> {
    let mut out = io::stdout().lock();
    writeln!(out, "{MAGIC}")?;
    out.flush()?;
    let (mut from, mut to) = (daemon.try_clone()?, daemon);
    // Not waited for: it may stand in a read when all is said, and ends with the process.
    thread::spawn(move || {
        let mut input = io::stdin().lock();
        pass(&mut input, &mut to).ok();
        to.shutdown(Shutdown::Write).ok();
    });
    match pass(&mut from, &mut out) {
        // Nobody reads any more.
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        other => other,
    }
}

/// Copies, and lets nothing wait: events are small.
fn pass(from: &mut impl Read, to: &mut impl Write) -> io::Result<()> {
    let mut buffer = vec![0; 64 << 10];
    loop {
        match from.read(&mut buffer) {
            Ok(0) => return Ok(()),
            Ok(count) => {
                to.write_all(&buffer[..count])?;
                to.flush()?;
            }
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
}
