//! A program as a container image, made without an engine: an archive that `docker load` takes.
//!
//! The image holds one layer: the program as `/app` and the empty directories `/ictus` and `/tmp`. Times, owners and order are
//! fixed, so the image's id is a function of the program's bytes and of the labels, whoever makes it and wherever.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Cursor, Read, Write};
use std::path::{Path, PathBuf};

use serde::Serialize;
use sha2::{Digest, Sha256};
use tar::{Builder, EntryType, Header};

pub mod elf;

use elf::{Architecture, ElfError, Machine};

/// Where the program stands in its image.
pub const PROGRAM: &str = "/app";
/// Who owns what is in the image, and who runs it unless somebody else is named: nobody in particular.
pub const USER: u32 = 65532;

/// When everything was made: always then.
const CREATED: &str = "1970-01-01T00:00:00Z";
/// What an archive's files are padded to.
const BLOCK_BYTES: usize = 512;
/// Directories of the image and their modes; after the program in the order of names.
const DIRECTORIES: [(&str, u32); 2] = [("ictus/", 0o755), ("tmp/", 0o1777)];
/// Digits of the id in the image's name.
const TAG_DIGITS: usize = 16;

/// What an image says of itself beside its program.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ImageConfig {
    /// Its labels.
    pub labels: BTreeMap<String, String>,
}

/// An image that can be written any number of times.
#[derive(Clone, Debug)]
pub struct Archive {
    program: PathBuf,
    program_bytes: u64,
    machine: Machine,
    diff_id: String,
    config: Vec<u8>,
    id: String,
    name: Option<String>,
}

/// Why there is no archive.
#[derive(Debug, thiserror::Error)]
pub enum ImageError {
    /// The file cannot run in an image of its own.
    #[error(transparent)]
    Program(#[from] ElfError),
    /// The program cannot be read.
    #[error("cannot read {path}", path = path.display())]
    Unreadable {
        /// The program.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// The program became another one while it was written; what was written is of no use.
    #[error("{path} changed while it was read: do it again when its build has ended", path = path.display())]
    Changed {
        /// The program.
        path: PathBuf,
    },
    /// The archive cannot be written.
    #[error("cannot write the image of {path}", path = path.display())]
    Unwritable {
        /// The program.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
}

#[derive(Serialize)]
struct Config<'a> {
    architecture: String,
    config: Run<'a>,
    created: &'static str,
    history: [History; 1],
    os: &'static str,
    rootfs: RootFs<'a>,
}

#[derive(Serialize)]
#[serde(rename_all = "PascalCase")]
struct Run<'a> {
    entrypoint: [&'static str; 1],
    labels: &'a BTreeMap<String, String>,
    user: String,
    working_dir: &'static str,
}

#[derive(Serialize)]
struct History {
    created: &'static str,
    created_by: &'static str,
}

#[derive(Serialize)]
struct RootFs<'a> {
    diff_ids: [&'a str; 1],
    r#type: &'static str,
}

#[derive(Serialize)]
#[serde(rename_all = "PascalCase")]
struct Manifest {
    config: String,
    layers: [String; 1],
    repo_tags: [String; 1],
}

impl Archive {
    /// Reads a program and settles its image.
    ///
    /// Laws: the same bytes and labels give the same id; other bytes or labels give another one.
    ///
    /// # Errors
    /// When the program cannot be read, is none, or needs a dynamic linker.
    pub fn of(program: &Path, config: &ImageConfig) -> Result<Self, ImageError> {
        let unreadable = |source| ImageError::Unreadable {
            path: program.to_path_buf(),
            source,
        };
        let machine = Machine::of(program)?;
        machine.check_alone(program)?;
        let program_bytes = std::fs::metadata(program).map_err(unreadable)?.len();
        let mut layer = Hashing::new(layer(program, program_bytes).map_err(unreadable)?);
        io::copy(&mut layer, &mut io::sink()).map_err(unreadable)?;
        if layer.bytes != layer_bytes(program_bytes) {
            return Err(ImageError::Changed {
                path: program.to_path_buf(),
            });
        }
        let diff_id = format!("sha256:{}", layer.digest());
        let described = Config {
            architecture: machine.architecture.to_string(),
            config: Run {
                entrypoint: [PROGRAM],
                labels: &config.labels,
                user: format!("{USER}:{USER}"),
                working_dir: "/",
            },
            created: CREATED,
            history: [History {
                created: CREATED,
                created_by: "ictus",
            }],
            os: "linux",
            rootfs: RootFs {
                diff_ids: [&diff_id],
                r#type: "layers",
            },
        };
        let config = to_json(program, &described)?;
        Ok(Self {
            id: format!("sha256:{}", hex(&Sha256::digest(&config))),
            program: program.to_path_buf(),
            program_bytes,
            machine,
            diff_id,
            config,
            name: None,
        })
    }

    /// The image's id, `sha256:` and 64 hexadecimal digits: the digest of its configuration. Engines that keep images in
    /// containerd's store give it another one, so what is asked for is [`Self::reference`].
    #[must_use]
    pub fn id(&self) -> &str {
        &self.id
    }

    /// The same image, loaded under another name.
    #[must_use]
    pub fn named(self, name: &str) -> Self {
        let name = Some(name.to_owned());
        Self { name, ..self }
    }

    /// The name under which it is loaded: `ictus:` and the beginning of its id, unless it was given another.
    #[must_use]
    pub fn reference(&self) -> String {
        if let Some(name) = &self.name {
            return name.clone();
        }
        let digits = self.id.trim_start_matches("sha256:");
        format!("ictus:{}", &digits[..TAG_DIGITS])
    }

    /// The id of its one layer.
    #[must_use]
    pub fn diff_id(&self) -> &str {
        &self.diff_id
    }

    /// What the program was built for.
    #[must_use]
    pub fn architecture(&self) -> Architecture {
        self.machine.architecture
    }

    /// Bytes of its layer: what the image takes on disk.
    #[must_use]
    pub fn layer_bytes(&self) -> u64 {
        layer_bytes(self.program_bytes)
    }

    /// Writes the archive, as `docker load` takes it. The same image gives the same bytes.
    ///
    /// # Errors
    /// When it cannot be written, or the program is no longer what it was; what was written is then of no use.
    pub fn write_to(&self, out: impl Write) -> Result<(), ImageError> {
        let at = || self.program.clone();
        let unwritable = |source| ImageError::Unwritable { path: at(), source };
        let config = format!("{}.json", self.id.trim_start_matches("sha256:"));
        let layer_name = format!("{}/layer.tar", self.diff_id.trim_start_matches("sha256:"));
        let manifest = [Manifest {
            config: config.clone(),
            layers: [layer_name.clone()],
            repo_tags: [self.reference()],
        }];
        let manifest = to_json(&self.program, &manifest)?;
        let layer = layer(&self.program, self.program_bytes)
            .map_err(|source| ImageError::Unreadable { path: at(), source })?;
        let mut layer = Hashing::new(layer);
        let mut archive = Builder::new(out);
        let mut append = |name: &str, bytes: u64, content: &mut dyn Read| {
            let header = header(name, EntryType::Regular, 0o644, bytes)?;
            archive.append(&header, content)
        };
        append(
            &config,
            self.config.len() as u64,
            &mut self.config.as_slice(),
        )
        .map_err(unwritable)?;
        append(&layer_name, self.layer_bytes(), &mut layer).map_err(unwritable)?;
        if format!("sha256:{}", layer.digest()) != self.diff_id {
            return Err(ImageError::Changed { path: at() });
        }
        append(
            "manifest.json",
            manifest.len() as u64,
            &mut manifest.as_slice(),
        )
        .map_err(unwritable)?;
        archive
            .into_inner()
            .and_then(|mut out| out.flush())
            .map_err(unwritable)
    }
}

fn to_json(program: &Path, value: &impl Serialize) -> Result<Vec<u8>, ImageError> {
    serde_json::to_vec(value).map_err(|error| ImageError::Unwritable {
        path: program.to_path_buf(),
        source: error.into(),
    })
}

fn header(name: &str, kind: EntryType, mode: u32, bytes: u64) -> io::Result<Header> {
    let mut header = Header::new_ustar();
    header.set_path(name)?;
    header.set_entry_type(kind);
    header.set_mode(mode);
    header.set_uid(USER.into());
    header.set_gid(USER.into());
    header.set_mtime(0);
    header.set_size(bytes);
    header.set_cksum();
    Ok(header)
}

/// The layer as a stream; its length is [`layer_bytes`].
fn layer(program: &Path, program_bytes: u64) -> io::Result<impl Read> {
    let first = header(
        PROGRAM.trim_start_matches('/'),
        EntryType::Regular,
        0o755,
        program_bytes,
    )?;
    let mut rest = vec![0; padding(program_bytes)];
    for (name, mode) in DIRECTORIES {
        rest.extend(header(name, EntryType::Directory, mode, 0)?.as_bytes());
    }
    // Two empty blocks end an archive.
    rest.extend([0; 2 * BLOCK_BYTES]);
    let program = File::open(program)?.take(program_bytes);
    Ok(Cursor::new(*first.as_bytes())
        .chain(program)
        .chain(Cursor::new(rest)))
}

fn padding(bytes: u64) -> usize {
    // Below the block's size.
    let over = usize::try_from(bytes % BLOCK_BYTES as u64).unwrap_or(0);
    (BLOCK_BYTES - over) % BLOCK_BYTES
}

fn layer_bytes(program_bytes: u64) -> u64 {
    let blocks = 1 + DIRECTORIES.len() + 2;
    program_bytes + (padding(program_bytes) + blocks * BLOCK_BYTES) as u64
}

/// Hashes and counts what is read through it.
struct Hashing<R> {
    inner: R,
    hash: Sha256,
    bytes: u64,
}

impl<R> Hashing<R> {
    fn new(inner: R) -> Self {
        Self {
            inner,
            hash: Sha256::new(),
            bytes: 0,
        }
    }

    fn digest(self) -> String {
        hex(&self.hash.finalize())
    }
}

impl<R: Read> Read for Hashing<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let count = self.inner.read(buffer)?;
        self.hash.update(&buffer[..count]);
        self.bytes += count as u64;
        Ok(count)
    }
}

/// Bytes as hexadecimal digits.
#[must_use]
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use std::fs;

    use proptest::prelude::*;
    use tempfile::TempDir;

    use super::elf::tests::program;
    use super::*;

    fn file(bytes: &[u8]) -> (TempDir, PathBuf) {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("program");
        fs::write(&path, bytes).unwrap();
        (directory, path)
    }

    fn labels(value: &str) -> ImageConfig {
        ImageConfig {
            labels: BTreeMap::from([("ictus.federation".to_owned(), value.to_owned())]),
        }
    }

    fn written(archive: &Archive) -> Vec<u8> {
        let mut bytes = Vec::new();
        archive.write_to(&mut bytes).unwrap();
        bytes
    }

    type Entry = (String, u32, u64, u64, Vec<u8>);

    fn entries(archive: &[u8]) -> Vec<Entry> {
        let mut found = Vec::new();
        for entry in tar::Archive::new(archive).entries().unwrap() {
            let mut entry = entry.unwrap();
            let mut bytes = Vec::new();
            entry.read_to_end(&mut bytes).unwrap();
            let path = entry.path().unwrap().to_string_lossy().into_owned();
            let header = entry.header();
            let (mode, time) = (header.mode().unwrap(), header.mtime().unwrap());
            found.push((path, mode, time, header.uid().unwrap(), bytes));
        }
        found
    }

    #[test]
    fn the_archive_holds_what_an_engine_reads() {
        let bytes = program(183, None, b"text");
        let (_directory, path) = file(&bytes);
        let archive = Archive::of(&path, &labels("f")).unwrap();
        assert_eq!(archive.architecture(), Architecture::Arm64);
        let outer = entries(&written(&archive));
        let names: Vec<_> = outer.iter().map(|entry| entry.0.as_str()).collect();
        let digits = archive.id().trim_start_matches("sha256:");
        assert_eq!(names[0], format!("{digits}.json"));
        assert_eq!(names[2], "manifest.json");
        let manifest: serde_json::Value = serde_json::from_slice(&outer[2].4).unwrap();
        assert_eq!(manifest[0]["Config"], names[0]);
        assert_eq!(manifest[0]["Layers"][0], names[1]);
        assert_eq!(manifest[0]["RepoTags"][0], archive.reference());
        let config: serde_json::Value = serde_json::from_slice(&outer[0].4).unwrap();
        assert_eq!(hex(&Sha256::digest(&outer[0].4)), digits);
        assert_eq!(config["architecture"], "arm64");
        assert_eq!(config["config"]["Entrypoint"][0], "/app");
        assert_eq!(config["config"]["User"], "65532:65532");
        assert_eq!(config["config"]["Labels"]["ictus.federation"], "f");
        assert_eq!(config["rootfs"]["diff_ids"][0], archive.diff_id());
        let layer = &outer[1].4;
        assert_eq!(
            format!("sha256:{}", hex(&Sha256::digest(layer))),
            archive.diff_id()
        );
        assert_eq!(layer.len() as u64, archive.layer_bytes());
        let owner = u64::from(USER);
        let directory = |name: &str, mode| (name.to_owned(), mode, 0, owner, Vec::new());
        let expected = [
            ("app".to_owned(), 0o755, 0, owner, bytes),
            directory("ictus/", 0o755),
            directory("tmp/", 0o1777),
        ];
        assert_eq!(entries(layer), expected);
    }

    #[test]
    fn a_program_that_changes_meanwhile_is_noticed() {
        let (_directory, path) = file(&program(62, None, b"old"));
        let archive = Archive::of(&path, &ImageConfig::default()).unwrap();
        for other in [&b"new"[..], b"", b"longer"] {
            fs::write(&path, program(62, None, other)).unwrap();
            // What it had more is not read.
            let noticed = archive.write_to(io::sink());
            assert!(
                matches!(noticed, Err(ImageError::Changed { .. })),
                "{noticed:?}"
            );
        }
    }

    #[test]
    fn a_full_disk_is_an_error() {
        struct Full;
        impl Write for Full {
            fn write(&mut self, _: &[u8]) -> io::Result<usize> {
                Err(io::ErrorKind::StorageFull.into())
            }
            fn flush(&mut self) -> io::Result<()> {
                Ok(())
            }
        }
        let (_directory, path) = file(&program(62, None, b""));
        let archive = Archive::of(&path, &ImageConfig::default()).unwrap();
        assert!(matches!(
            archive.write_to(Full),
            Err(ImageError::Unwritable { .. })
        ));
    }

    #[test]
    fn what_needs_a_linker_gets_no_image() {
        let (_directory, path) = file(&program(62, Some("/lib64/ld.so"), b""));
        let why = Archive::of(&path, &ImageConfig::default()).unwrap_err();
        assert!(why.to_string().contains("/lib64/ld.so"), "{why}");
    }

    proptest! {
        /// Law: the same program and labels give the same bytes and id, wherever the program stands and whenever.
        #[test]
        fn an_image_is_a_function_of_its_program(text in proptest::collection::vec(any::<u8>(), 0..2000)) {
            let bytes = program(62, None, &text);
            let ((_one, one), (_two, two)) = (file(&bytes), file(&bytes));
            let old = File::options().write(true).open(&two).unwrap();
            old.set_modified(std::time::UNIX_EPOCH).unwrap();
            let (one, two) = (Archive::of(&one, &labels("f")).unwrap(), Archive::of(&two, &labels("f")).unwrap());
            prop_assert_eq!(one.id(), two.id());
            prop_assert_eq!(written(&one), written(&two));
        }

        /// Law: another program or label gives another id.
        #[test]
        fn another_program_is_another_image(
            text in proptest::collection::vec(any::<u8>(), 1..600), at in any::<prop::sample::Index>(), flip in 1_u8..,
        ) {
            let mut other = text.clone();
            let at = at.index(other.len());
            other[at] ^= flip;
            let ((_one, one), (_two, two)) = (file(&program(62, None, &text)), file(&program(62, None, &other)));
            let (of_one, of_two) = (Archive::of(&one, &labels("f")).unwrap(), Archive::of(&two, &labels("f")).unwrap());
            prop_assert_ne!(of_one.id(), of_two.id());
            let relabelled = Archive::of(&one, &labels("g")).unwrap();
            prop_assert_ne!(of_one.id(), relabelled.id());
            prop_assert_eq!(of_one.diff_id(), relabelled.diff_id());
        }
    }
}
