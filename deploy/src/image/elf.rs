//! What a program's ELF header tells: the architecture, and whether it needs a dynamic linker.

use std::fmt;
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// The longest header of a class (64 bits).
const HEADER_BYTES_MAX: usize = 64;
/// Program headers read at most; compilers make about ten.
const SEGMENTS_MAX: usize = 1024;
/// The longest path of an interpreter.
const INTERPRETER_BYTES_MAX: usize = 4096;
/// Type of a segment that names the interpreter.
const PT_INTERP: u32 = 3;
/// Types of a file that can be executed: at fixed addresses, and position independent.
const EXECUTABLE: [u16; 2] = [2, 3];

/// An architecture that programs are built for; shown as Docker names it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Architecture {
    /// 32-bit x86.
    X86,
    /// 64-bit x86.
    Amd64,
    /// 32-bit Arm.
    Arm,
    /// 64-bit Arm.
    Arm64,
    /// 64-bit RISC-V.
    Riscv64,
    /// 64-bit POWER, little-endian.
    Ppc64le,
    /// 64-bit IBM Z.
    S390x,
    /// 64-bit `LoongArch`.
    Loong64,
}

/// An architecture's names: Docker's, Rust's, the target to build for and Debian's cross compiler.
type Names = (Architecture, &'static str, &'static str, &'static str);

const NAMES: [Names; 8] = [
    (Architecture::X86, "386", "x86", "i686-unknown-linux-gnu"),
    (
        Architecture::Amd64,
        "amd64",
        "x86_64",
        "x86_64-unknown-linux-gnu",
    ),
    (
        Architecture::Arm,
        "arm",
        "arm",
        "armv7-unknown-linux-gnueabihf",
    ),
    (
        Architecture::Arm64,
        "arm64",
        "aarch64",
        "aarch64-unknown-linux-gnu",
    ),
    (
        Architecture::Riscv64,
        "riscv64",
        "riscv64",
        "riscv64gc-unknown-linux-gnu",
    ),
    (
        Architecture::Ppc64le,
        "ppc64le",
        "powerpc64",
        "powerpc64le-unknown-linux-gnu",
    ),
    (
        Architecture::S390x,
        "s390x",
        "s390x",
        "s390x-unknown-linux-gnu",
    ),
    (
        Architecture::Loong64,
        "loong64",
        "loongarch64",
        "loongarch64-unknown-linux-gnu",
    ),
];

/// What a program was built for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Machine {
    /// The processor.
    pub architecture: Architecture,
    /// The dynamic linker it asks for; absent in a static program.
    pub interpreter: Option<String>,
}

/// Why a file cannot run where it is to run.
#[derive(Debug, thiserror::Error)]
pub enum ElfError {
    /// The file cannot be opened or read.
    #[error("cannot read {path}", path = path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// The file is something else, a script for instance.
    #[error("{path} is not a program (an ELF file): {what}", path = path.display())]
    NotElf {
        /// The file.
        path: PathBuf,
        /// What it is instead, with what may be done.
        what: Flaw,
    },
    /// The program is for another processor.
    #[error(
        "{path} is built for {program}, but host `{host}` is {architecture}: \
         `rustup target add {target}`, then build it with `--target {target}`",
        path = path.display(), target = architecture.target()
    )]
    WrongArchitecture {
        /// The file.
        path: PathBuf,
        /// What it is built for.
        program: Architecture,
        /// The host's name.
        host: String,
        /// What the host is.
        architecture: Architecture,
    },
    /// The program needs a dynamic linker and libraries that an image made by Ictus does not have.
    #[error(
        "{path} is linked dynamically and needs {interpreter}, which its image would not have: build it with \
         RUSTFLAGS='-C target-feature=+crt-static' and `--target {target}`, or give it an image of its own (`image:`)",
        path = path.display(), target = architecture.target()
    )]
    Dynamic {
        /// The file.
        path: PathBuf,
        /// The dynamic linker.
        interpreter: String,
        /// What it is built for.
        architecture: Architecture,
    },
}

/// What is wrong with a file that should be a program.
#[derive(Debug, thiserror::Error)]
pub enum Flaw {
    /// It ends too early or cannot be read.
    #[error("its header cannot be read")]
    Unreadable(#[from] io::Error),
    /// It begins with `#!`.
    #[error("it is a script, which needs an image with its interpreter (`image:` or `build:`)")]
    Script,
    /// It begins with something else.
    #[error("it begins with other bytes")]
    OtherMagic,
    /// A field of the header makes no sense.
    #[error("its header is damaged ({0})")]
    Damaged(&'static str),
    /// It is an object file, a library or a core dump.
    #[error("it is an object file, a library or a core dump")]
    NotExecutable,
    /// It is for a processor that Ictus does not know.
    #[error("it is for machine {0}, which Ictus does not know")]
    UnknownMachine(u16),
}

impl Architecture {
    /// The one this program was built for.
    #[must_use]
    pub fn own() -> Option<Self> {
        Self::from_rust(std::env::consts::ARCH)
    }

    /// Takes Rust's name of it: `x86_64`, `aarch64`.
    #[must_use]
    pub fn from_rust(name: &str) -> Option<Self> {
        NAMES
            .into_iter()
            .find(|names| names.2 == name)
            .map(|names| names.0)
    }

    /// Takes Docker's name of it: `amd64`, `arm64`.
    #[must_use]
    pub fn from_docker(name: &str) -> Option<Self> {
        NAMES
            .into_iter()
            .find(|names| names.1 == name)
            .map(|names| names.0)
    }

    /// Rust's name of it: `x86_64`, `aarch64`.
    #[must_use]
    pub fn rust_name(self) -> &'static str {
        self.names().2
    }

    /// The target that cargo builds for it.
    #[must_use]
    pub fn target(self) -> &'static str {
        self.names().3
    }

    fn names(self) -> Names {
        let found = NAMES.into_iter().find(|names| names.0 == self);
        found.unwrap_or(NAMES[1])
    }

    /// Word size and byte order decide for some numbers.
    fn of(number: u16, wide: bool, little: bool) -> Option<Self> {
        match (number, wide, little) {
            (3, false, true) => Some(Self::X86),
            (62, true, true) => Some(Self::Amd64),
            (40, false, true) => Some(Self::Arm),
            (183, true, true) => Some(Self::Arm64),
            (243, true, true) => Some(Self::Riscv64),
            (21, true, true) => Some(Self::Ppc64le),
            (22, true, false) => Some(Self::S390x),
            (258, true, true) => Some(Self::Loong64),
            _ => None,
        }
    }
}

impl fmt::Display for Architecture {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.names().1)
    }
}

impl Machine {
    /// Reads a program's header.
    ///
    /// # Errors
    /// When the file cannot be read or is no program.
    pub fn of(path: &Path) -> Result<Self, ElfError> {
        let at = || path.to_path_buf();
        let file =
            File::open(path).map_err(|source| ElfError::Unreadable { path: at(), source })?;
        Self::read(file).map_err(|what| ElfError::NotElf { path: at(), what })
    }

    /// The same from anything; reads no more than headers, whatever they say.
    ///
    /// # Errors
    /// See [`Flaw`].
    pub fn read(mut file: impl Read + Seek) -> Result<Self, Flaw> {
        let header = Header::read(&mut file)?;
        let architecture = Architecture::of(header.machine, header.wide, header.little)
            .ok_or(Flaw::UnknownMachine(header.machine))?;
        let interpreter = header.interpreter(&mut file)?;
        if !EXECUTABLE.contains(&header.kind) || header.entry == 0 {
            return Err(Flaw::NotExecutable);
        }
        Ok(Self {
            architecture,
            interpreter,
        })
    }

    /// Whether a host can execute it.
    ///
    /// # Errors
    /// [`ElfError::WrongArchitecture`].
    pub fn check_host(
        &self,
        path: &Path,
        host: &str,
        architecture: Architecture,
    ) -> Result<(), ElfError> {
        if self.architecture == architecture {
            return Ok(());
        }
        Err(ElfError::WrongArchitecture {
            path: path.to_path_buf(),
            program: self.architecture,
            host: host.to_owned(),
            architecture,
        })
    }

    /// Whether it runs in an image that holds nothing else.
    ///
    /// # Errors
    /// [`ElfError::Dynamic`].
    pub fn check_alone(&self, path: &Path) -> Result<(), ElfError> {
        let Some(interpreter) = self.interpreter.clone() else {
            return Ok(());
        };
        Err(ElfError::Dynamic {
            path: path.to_path_buf(),
            interpreter,
            architecture: self.architecture,
        })
    }
}

/// The fields of an ELF header that matter here.
struct Header {
    wide: bool,
    little: bool,
    kind: u16,
    machine: u16,
    entry: u64,
    segments_at: u64,
    segment_bytes: u16,
    segments: u16,
}

impl Header {
    fn read(file: &mut (impl Read + Seek)) -> Result<Self, Flaw> {
        let mut bytes = [0; HEADER_BYTES_MAX];
        let count = read_up_to(file, &mut bytes)?;
        let bytes = &bytes[..count];
        if bytes.starts_with(b"#!") {
            return Err(Flaw::Script);
        }
        if !bytes.starts_with(b"\x7fELF") {
            return Err(Flaw::OtherMagic);
        }
        let wide = match bytes.get(4) {
            Some(1) => false,
            Some(2) => true,
            _ => return Err(Flaw::Damaged("class")),
        };
        let little = match bytes.get(5) {
            Some(1) => true,
            Some(2) => false,
            _ => return Err(Flaw::Damaged("byte order")),
        };
        let fields = Fields { bytes, little };
        let (entry, segments_at, sizes) = if wide {
            (fields.u64(24), fields.u64(32), 54)
        } else {
            (
                fields.u32(24).map(u64::from),
                fields.u32(28).map(u64::from),
                42,
            )
        };
        let short = || Flaw::Damaged("it is cut short");
        Ok(Self {
            wide,
            little,
            kind: fields.u16(16).ok_or_else(short)?,
            machine: fields.u16(18).ok_or_else(short)?,
            entry: entry.ok_or_else(short)?,
            segments_at: segments_at.ok_or_else(short)?,
            segment_bytes: fields.u16(sizes).ok_or_else(short)?,
            segments: fields.u16(sizes + 2).ok_or_else(short)?,
        })
    }

    fn interpreter(&self, file: &mut (impl Read + Seek)) -> Result<Option<String>, Flaw> {
        let (segment_bytes, segments) =
            (usize::from(self.segment_bytes), usize::from(self.segments));
        let smallest = if self.wide { 56 } else { 32 };
        if segments == 0 {
            return Ok(None);
        }
        if segment_bytes != smallest || segments > SEGMENTS_MAX {
            return Err(Flaw::Damaged("program headers"));
        }
        let mut table = vec![0; segment_bytes * segments];
        file.seek(SeekFrom::Start(self.segments_at))?;
        file.read_exact(&mut table)?;
        for bytes in table.chunks_exact(segment_bytes) {
            let fields = Fields {
                bytes,
                little: self.little,
            };
            if fields.u32(0) != Some(PT_INTERP) {
                continue;
            }
            let (at, length) = if self.wide {
                (fields.u64(8), fields.u64(32))
            } else {
                (fields.u32(4).map(u64::from), fields.u32(16).map(u64::from))
            };
            let length = length.and_then(|length| usize::try_from(length).ok());
            let (Some(at), Some(length @ 1..=INTERPRETER_BYTES_MAX)) = (at, length) else {
                return Err(Flaw::Damaged("interpreter"));
            };
            let mut path = vec![0; length];
            file.seek(SeekFrom::Start(at))?;
            file.read_exact(&mut path)?;
            let end = path.iter().position(|byte| *byte == 0).unwrap_or(length);
            return Ok(Some(String::from_utf8_lossy(&path[..end]).into_owned()));
        }
        Ok(None)
    }
}

/// Integers at offsets.
struct Fields<'a> {
    bytes: &'a [u8],
    little: bool,
}

impl Fields<'_> {
    fn u16(&self, at: usize) -> Option<u16> {
        let bytes = self.array(at)?;
        Some(if self.little {
            u16::from_le_bytes(bytes)
        } else {
            u16::from_be_bytes(bytes)
        })
    }

    fn u32(&self, at: usize) -> Option<u32> {
        let bytes = self.array(at)?;
        Some(if self.little {
            u32::from_le_bytes(bytes)
        } else {
            u32::from_be_bytes(bytes)
        })
    }

    fn u64(&self, at: usize) -> Option<u64> {
        let bytes = self.array(at)?;
        Some(if self.little {
            u64::from_le_bytes(bytes)
        } else {
            u64::from_be_bytes(bytes)
        })
    }

    fn array<const N: usize>(&self, at: usize) -> Option<[u8; N]> {
        self.bytes.get(at..at + N)?.try_into().ok()
    }
}

/// Reads until the buffer is full or the file ends.
fn read_up_to(file: &mut impl Read, buffer: &mut [u8]) -> io::Result<usize> {
    let mut count = 0;
    while count < buffer.len() {
        match file.read(&mut buffer[count..]) {
            Ok(0) => break,
            Ok(more) => count += more,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    Ok(count)
}

#[cfg(test)]
pub(super) mod tests {
    use std::io::Cursor;

    use proptest::prelude::*;

    use super::*;

    /// A 64-bit little-endian program of this machine with this text after its header.
    pub(in crate::image) fn program(
        machine: u16,
        interpreter: Option<&str>,
        text: &[u8],
    ) -> Vec<u8> {
        let mut bytes = b"\x7fELF\x02\x01\x01".to_vec();
        bytes.resize(16, 0);
        bytes.extend(2_u16.to_le_bytes());
        bytes.extend(machine.to_le_bytes());
        bytes.extend(1_u32.to_le_bytes());
        for wide in [0x40_0000_u64, 64, 0] {
            bytes.extend(wide.to_le_bytes());
        }
        bytes.extend(0_u32.to_le_bytes());
        for half in [64_u16, 56, 1, 0, 0, 0] {
            bytes.extend(half.to_le_bytes());
        }
        assert_eq!(bytes.len(), 64);
        let named = interpreter.unwrap_or_default();
        bytes.extend(if interpreter.is_some() { PT_INTERP } else { 1 }.to_le_bytes());
        bytes.extend(0_u32.to_le_bytes());
        for wide in [120, 0, 0, named.len() as u64 + 1, 0, 1_u64] {
            bytes.extend(wide.to_le_bytes());
        }
        bytes.extend(named.as_bytes());
        bytes.push(0);
        bytes.extend(text);
        bytes
    }

    fn flaw(bytes: &[u8]) -> String {
        Machine::read(Cursor::new(bytes)).unwrap_err().to_string()
    }

    #[test]
    fn architecture_and_interpreter_are_read() {
        for (number, name) in [(62, "amd64"), (183, "arm64"), (243, "riscv64")] {
            let machine = Machine::read(Cursor::new(program(number, None, b""))).unwrap();
            assert_eq!(machine.architecture.to_string(), name);
            assert_eq!(machine.interpreter, None);
            machine.check_alone(Path::new("/p")).unwrap();
        }
        let linker = "/lib64/ld-linux-x86-64.so.2";
        let machine = Machine::read(Cursor::new(program(62, Some(linker), b""))).unwrap();
        assert_eq!(machine.interpreter.as_deref(), Some(linker));
        let why = machine
            .check_alone(Path::new("/p"))
            .unwrap_err()
            .to_string();
        assert!(why.contains(linker) && why.contains("crt-static"), "{why}");
    }

    #[test]
    fn this_test_is_for_this_machine() {
        let own = Machine::of(&std::env::current_exe().unwrap()).unwrap();
        assert_eq!(Some(own.architecture), Architecture::own());
    }

    #[test]
    fn another_architecture_names_both_and_the_fix() {
        let machine = Machine::read(Cursor::new(program(183, None, b""))).unwrap();
        machine
            .check_host(Path::new("/p"), "robot", Architecture::Arm64)
            .unwrap();
        let why = machine.check_host(Path::new("/p"), "robot", Architecture::Amd64);
        assert_eq!(
            why.unwrap_err().to_string(),
            "/p is built for arm64, but host `robot` is amd64: `rustup target add x86_64-unknown-linux-gnu`, \
             then build it with `--target x86_64-unknown-linux-gnu`"
        );
    }

    #[test]
    fn what_is_no_program_is_said_in_words() {
        assert!(flaw(b"#!/bin/sh\n").contains("script"));
        assert!(flaw(b"MZ").contains("other bytes"));
        assert!(flaw(b"").contains("other bytes"));
        assert!(flaw(b"\x7fELF\x02\x01").contains("cut short"));
        assert!(flaw(b"\x7fELF\x09\x01").contains("class"));
        assert!(flaw(&program(9999, None, b"")).contains("machine 9999"));
        let whole = program(62, Some("/ld"), b"");
        assert!(flaw(&whole[..100]).contains("cannot be read"));
        let mut object = program(62, None, b"");
        object[16] = 1;
        assert!(flaw(&object).contains("object file"));
    }

    proptest! {
        /// Law: any bytes give a machine or a flaw.
        #[test]
        fn reading_is_total(bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
            let _flaw_or_not = Machine::read(Cursor::new(&bytes));
            let mut elf = b"\x7fELF".to_vec();
            elf.extend(bytes);
            let _flaw_or_not = Machine::read(Cursor::new(elf));
        }

        /// Law: neither does any change of a good header.
        #[test]
        fn damage_is_survived(at in 4_usize..120, byte in any::<u8>(), end in 0_usize..140) {
            let mut bytes = program(62, Some("/lib/ld.so"), b"");
            bytes[at] = byte;
            bytes.truncate(end.max(1));
            let _flaw_or_not = Machine::read(Cursor::new(bytes));
        }
    }
}
