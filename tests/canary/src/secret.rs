//! A federate with a secret.

use std::os::unix::fs::MetadataExt;

use ictus::prelude::*;

/// Counts ticks as long as its secret is where it should be, as long as it should be, and nobody else's.
#[reactor]
pub struct Keeper {
    #[param(default = 1)]
    bytes: u64,
    #[timer(period = 10.ms())]
    tick: Timer,
    out: Output<u64>,
    ticks: u64,
}

#[reactions]
impl Keeper {
    #[reaction]
    fn tick(&mut self, _tick: &Timer, out: &mut Output<u64>) {
        let path = std::env::var("TOKEN_FILE").unwrap_or_default();
        let found = std::fs::metadata(&path).map(|file| (file.len(), file.mode() & 0o777));
        assert!(
            matches!(found, Ok((bytes, 0o400)) if bytes == self.bytes),
            "the secret at `{path}` is {found:?}"
        );
        assert!(
            std::fs::read(&path).is_ok_and(|secret| !secret.is_empty()),
            "the secret at `{path}` cannot be read"
        );
        self.ticks += 1;
        out.set(self.ticks);
    }
}
