//! A program on its way to a host: compressed, where the host can unpack it.

use std::fs::File;
use std::io;
use std::path::Path;

use flate2::Compression;
use flate2::write::GzEncoder;
use ictus_deploy::ssh::Connection;
use tempfile::NamedTempFile;

use super::run;
use crate::error::CliError;
use crate::hosts::unreachable_host;

/// The mode of a program.
const MODE: u32 = 0o755;

/// Told the bytes that were sent, and of how many.
type Told<'a> = &'a mut (dyn FnMut(u64, u64) + Send);

/// Sends a program to `to` there, which is replaced in one step or not at all; gives the bytes that were sent.
pub(super) async fn send(
    (host, connection): (&str, &Connection),
    program: &Path,
    to: &str,
    told: Told<'_>,
) -> Result<u64, CliError> {
    let gzip = connection.run(&["gzip", "--version"], &[]).await;
    let gzip = gzip.map_err(|error| unreachable_host(host, &error))?;
    if gzip.code != 0 {
        return upload((host, connection), program, to, told).await;
    }
    let packed = pack(program).map_err(CliError::failed)?;
    // Its random name is as good there as here.
    let name = packed.path().file_stem().unwrap_or_default();
    let beside = format!("{to}.{}", name.to_string_lossy());
    let there = format!("{beside}.gz");
    let sent = upload((host, connection), packed.path(), &there, told).await?;
    let unpacked = async {
        run(host, connection, &["gzip", "-d", &there]).await?;
        // On the disk before it has its name.
        let of = format!("of={beside}");
        let sync = ["dd", "if=/dev/null", &of, "conv=notrunc,fsync"];
        run(host, connection, &sync).await?;
        run(host, connection, &["mv", "-f", &beside, to]).await
    };
    if let Err(error) = unpacked.await {
        // The first error is the one to tell.
        let remove = ["rm", "-f", &beside, &there];
        connection.run(&remove, &[]).await.ok();
        return Err(error);
    }
    Ok(sent)
}

async fn upload(
    (host, connection): (&str, &Connection),
    file: &Path,
    to: &str,
    told: Told<'_>,
) -> Result<u64, CliError> {
    let whole = std::fs::metadata(file).map_or(0, |found| found.len());
    let mut told = |sent| told(sent, whole);
    let sent = connection.upload(file, to, MODE, &mut told).await;
    sent.map_err(|error| unreachable_host(host, &error))?;
    Ok(whole)
}

/// The file, compressed, under a name of its own.
fn pack(program: &Path) -> io::Result<NamedTempFile> {
    let mut packed = tempfile::Builder::new()
        .prefix("part-")
        .suffix(".gz")
        .tempfile()?;
    let mut encoder = GzEncoder::new(&mut packed, Compression::fast());
    io::copy(&mut File::open(program)?, &mut encoder)?;
    encoder.finish()?;
    Ok(packed)
}
