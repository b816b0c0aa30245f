//! `ictus init`: a small federation to start from.

use std::fs;
use std::path::{Path, PathBuf};

use clap::Args;
use serde_json::json;

use crate::error::CliError;
use crate::ui::Ui;

/// The crate that programs link, in the source tree that this executable was built from.
const DRIVER: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../runtime/driver");

const MANIFEST: &str = include_str!("../../templates/federation.yaml");
const PROGRAM: &str = include_str!("../../templates/main.rs");

/// Write a small federation to start from: a manifest and a cargo package with two reactor classes
#[derive(Debug, Args)]
pub(crate) struct Init {
    /// Where; made if it is not there
    #[arg(default_value = ".")]
    directory: PathBuf,
}

impl Init {
    pub(crate) fn run(&self, ui: &mut Ui) -> Result<(), CliError> {
        let absolute = std::path::absolute(&self.directory).map_err(CliError::failed)?;
        let name = package_name(&absolute);
        let driver = Path::new(DRIVER).canonicalize().map_err(|error| {
            CliError::failed(error).hint(format!("the runtime's sources were at {DRIVER}"))
        })?;
        let package = format!(
            "[package]\nname = \"{name}\"\nversion = \"0.1.0\"\nedition = \"2024\"\n\n[dependencies]\n\
             ictus = {{ path = \"{}\" }}\n\n[workspace]\n",
            driver.display()
        );
        let files = [
            ("federation.yaml", MANIFEST.replace("NAME", &name)),
            ("Cargo.toml", package),
            ("src/main.rs", PROGRAM.to_owned()),
            (".gitignore", "/target\n".to_owned()),
        ];
        let paths: Vec<_> = files
            .iter()
            .map(|(path, _)| self.directory.join(path))
            .collect();
        if let Some(there) = paths.iter().find(|path| path.exists()) {
            let error = CliError::failed(format!("{} is already there", there.display()));
            return Err(error.hint("give an empty directory: `ictus init DIR`"));
        }
        fs::create_dir_all(self.directory.join("src")).map_err(CliError::failed)?;
        for (path, (_, text)) in paths.iter().zip(&files) {
            fs::write(path, text).map_err(|error| {
                CliError::failed(format!("cannot write {}: {error}", path.display()))
            })?;
            ui.stage("wrote", &path.display().to_string());
        }
        let manifest = paths[0].display().to_string();
        ui.result(&json!({ "files": paths }), || {
            format!("  ictus up {manifest}\n  ictus logs -f {name}\n  ictus down {name}")
        })
    }
}

/// The directory's name as cargo takes it.
fn package_name(directory: &Path) -> String {
    let name = directory
        .file_name()
        .map(|name| name.to_string_lossy().to_ascii_lowercase());
    let plain = |c: char| if c.is_ascii_alphanumeric() { c } else { '-' };
    let name: String = name.unwrap_or_default().chars().map(plain).collect();
    let name = name.trim_matches('-');
    match name.chars().next() {
        Some(first) if first.is_ascii_alphabetic() => name.to_owned(),
        Some(_) => format!("federation-{name}"),
        None => "federation".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::package_name;

    #[test]
    fn directories_become_package_names() {
        assert_eq!(package_name(Path::new("/x/My Robot")), "my-robot");
        assert_eq!(package_name(Path::new("/x/7up")), "federation-7up");
        assert_eq!(package_name(Path::new("/")), "federation");
    }
}
