//! Sending a file: into a temporary one beside its place, synced there, then moved over it.

use std::path::Path;

use tokio::fs::File;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::time::timeout;

use super::Connection;
use super::error::SshError;
use super::target::command_line;

/// Bytes that are read at once.
const CHUNK: usize = 64 << 10;

impl Connection {
    /// Sends a file to the path `to` on the host, with `mode`; what is at `to` is replaced in one step, also when it is running.
    ///
    /// `to` is one word of a command line: a leading `~/` is the home directory; its directory must exist. `progress` gets the bytes sent so
    /// far, which never grow less. The host needs `install`, `dd`, `chmod`, `mv` and `rm`.
    ///
    /// # Errors
    /// [`SshError::Local`] when `from` cannot be read, [`SshError::Remote`] when the host cannot write (a full disk, no directory);
    /// then `to` is as it was.
    pub async fn upload(
        &self,
        from: &Path,
        to: &str,
        mode: u32,
        progress: &mut (dyn FnMut(u64) + Send),
    ) -> Result<(), SshError> {
        // As the first word it may not be an option either.
        command_line(&[to])?;
        let file = File::open(from)
            .await
            .map_err(|error| local(from, &error))?;
        let temporary = temporary(to);
        let mode = format!("{:o}", mode & 0o7777);
        let done = async {
            // Nobody else may read it before it is complete.
            self.must(&["install", "-m", "600", "/dev/null", &temporary])
                .await?;
            self.send(file, from, &temporary, progress).await?;
            self.must(&["chmod", &mode, &temporary]).await?;
            self.must(&["mv", "-f", &temporary, to]).await
        }
        .await;
        if let Err(error) = &done
            && !error.is_unreachable()
        {
            // The first error is the one to tell.
            drop(self.run(&["rm", "-f", &temporary], b"").await);
        }
        done
    }

    async fn send(
        &self,
        mut file: File,
        from: &Path,
        to: &str,
        progress: &mut (dyn FnMut(u64) + Send),
    ) -> Result<(), SshError> {
        // `dd` starts where the home directory is, and its `of=` knows no `~/`.
        let output = format!("of={}", to.strip_prefix("~/").unwrap_or(to));
        let command = ["dd", &output, "bs=65536", "conv=fsync"];
        let mut channel = self.exec(&command).await?;
        let mut chunk = vec![0; CHUNK];
        let mut sent = 0;
        let mut broken = None;
        loop {
            let count = file
                .read(&mut chunk)
                .await
                .map_err(|error| local(from, &error))?;
            if count == 0 {
                break;
            }
            // Each chunk is bounded, not the whole: a slow line is no error.
            match timeout(self.bound(), channel.write_all(&chunk[..count])).await {
                Ok(Ok(())) => {}
                Ok(Err(error)) => {
                    broken = Some(error);
                    break;
                }
                Err(_) => return Err(self.late(&format!("taking `{}`", from.display()))),
            }
            sent += u64::try_from(count).unwrap_or_default();
            progress(sent);
        }
        let output = self
            .finish(channel, &command.join(" "), Vec::new(), self.bound())
            .await?;
        match broken {
            None if output.code == 0 => Ok(()),
            None => Err(self.failed(&command, &output)),
            Some(_) if output.code != 0 => Err(self.failed(&command, &output)),
            Some(error) => Err(SshError::Closed {
                host: self.peer().to_string(),
                cause: error.to_string(),
            }),
        }
    }

    async fn must(&self, command: &[&str]) -> Result<(), SshError> {
        let output = self.run(command, b"").await?;
        if output.code == 0 {
            Ok(())
        } else {
            Err(self.failed(command, &output))
        }
    }
}

/// A name beside `to` that nobody else uses.
fn temporary(to: &str) -> String {
    use std::hash::{BuildHasher as _, RandomState};
    // The standard library's keys are random; the number only has to differ from that of another upload.
    format!(
        "{to}.part-{:016x}",
        RandomState::new().hash_one(std::process::id())
    )
}

fn local(from: &Path, error: &std::io::Error) -> SshError {
    SshError::Local {
        what: format!("cannot read `{}`", from.display()),
        cause: error.to_string(),
    }
}
