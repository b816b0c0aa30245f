//! The values of secrets, read from this machine's environment and files when a federation is planned or started.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::io::{self, Read};
use std::os::unix::ffi::OsStringExt;
use std::path::Path;

use ictus_deploy::FederateRun;
use ictus_deploy::placement::SecretSource;
use ictusd::api::secret::{SECRET_BYTES_MAX, SecretValue, SecretValues};

use crate::error::CliError;

/// What was found.
#[derive(Debug, Default)]
pub(crate) struct Secrets {
    pub(crate) values: SecretValues,
    /// What was not, and why.
    pub(crate) missing: Vec<Missing>,
}

/// A secret without a value.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Missing {
    federate: String,
    name: String,
    why: String,
    fix: String,
}

impl Secrets {
    /// Reads the values that federates need.
    pub(crate) fn read<'a>(runs: impl IntoIterator<Item = &'a FederateRun>) -> Self {
        let mut secrets = Self::default();
        for run in runs {
            for (name, source) in &run.needs.secrets {
                let read = read(name, source, &|name| std::env::var_os(name));
                match read {
                    Ok(value) => {
                        let values = &mut secrets.values.0;
                        let values: &mut BTreeMap<_, _> =
                            values.entry(run.name.clone()).or_default();
                        values.insert(name.clone(), value);
                    }
                    Err((why, fix)) => secrets.missing.push(Missing {
                        federate: run.name.clone(),
                        name: name.clone(),
                        why,
                        fix,
                    }),
                }
            }
        }
        secrets
    }

    /// The values, if all are there: nothing is started without them.
    pub(crate) fn complete(self) -> Result<SecretValues, CliError> {
        match self.missing.first() {
            None => Ok(self.values),
            Some(missing) => Err(CliError::failed(missing.to_string()).hint(missing.fix.clone())),
        }
    }
}

impl std::fmt::Display for Missing {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self {
            federate,
            name,
            why,
            ..
        } = self;
        write!(
            f,
            "secret `{name}` of federate `{federate}` has no value: {why}"
        )
    }
}

/// A value; or why there is none, and what to do.
fn read(
    name: &str,
    source: &SecretSource,
    variable: &dyn Fn(&str) -> Option<OsString>,
) -> Result<SecretValue, (String, String)> {
    let (bytes, place) = match source {
        SecretSource::Environment => {
            let value = variable(name).ok_or_else(|| {
                (
                    format!("the environment variable {name} is not set"),
                    format!(
                        "set it for this command, or name a file: `{{ name: {name}, file: ... }}`"
                    ),
                )
            })?;
            (value.into_vec(), format!("the environment variable {name}"))
        }
        SecretSource::File(path) => {
            let place = path.display().to_string();
            let bytes = read_file(path).map_err(|error| {
                (
                    format!("{place} cannot be read: {error}"),
                    "paths start at the manifest's folder, or at `~/`".to_owned(),
                )
            })?;
            (bytes, place)
        }
    };
    let value = SecretValue::new(bytes);
    let fault = match value.bytes().len() {
        0 => "is empty".to_owned(),
        1..=SECRET_BYTES_MAX => return Ok(value),
        _ => format!("has more than {SECRET_BYTES_MAX} bytes"),
    };
    Err((
        format!("{place} {fault}"),
        "give it a value of 1 byte to 64 KiB".to_owned(),
    ))
}

/// As much of a file as tells that it is too long.
fn read_file(path: &Path) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let most = u64::try_from(SECRET_BYTES_MAX).unwrap_or(u64::MAX) + 1;
    let file = std::fs::File::open(path)?;
    if !file.metadata()?.is_file() {
        return Err(io::Error::other("it is no file"));
    }
    file.take(most).read_to_end(&mut bytes)?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_missing_value_names_its_variable_or_file() {
        let variable = |name: &str| match name {
            "SET" => Some(OsString::from("canary")),
            "EMPTY" => Some(OsString::new()),
            _ => None,
        };
        let of = |name: &str| read(name, &SecretSource::Environment, &variable);
        assert_eq!(of("SET").unwrap().bytes(), b"canary");
        let why = |name: &str| of(name).unwrap_err().0;
        assert_eq!(why("UNSET"), "the environment variable UNSET is not set");
        assert_eq!(why("EMPTY"), "the environment variable EMPTY is empty");
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("token");
        let of = || read("T", &SecretSource::File(path.clone()), &variable);
        let place = path.display();
        let why = || of().unwrap_err().0;
        assert!(why().starts_with(&format!("{place} cannot be read: No such file")));
        std::fs::write(&path, b"").unwrap();
        assert_eq!(why(), format!("{place} is empty"));
        std::fs::write(&path, vec![7; SECRET_BYTES_MAX + 1]).unwrap();
        assert_eq!(why(), format!("{place} has more than 65536 bytes"));
        // To the byte: a line's end is part of it.
        std::fs::write(&path, b"x\n").unwrap();
        assert_eq!(of().unwrap().bytes(), b"x\n");
    }
}
