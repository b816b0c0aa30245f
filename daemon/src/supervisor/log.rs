//! Log files of bounded size: each line with its time and stream.
//!
//! A line is `TIME STREAM TEXT`: TIME as [`stamp::text`] writes it, STREAM `out`, `err`, or `ictus` for the
//! supervisor's own remarks; `out+` and `err+` go on from the line before, which was too long for one.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use super::lines::{Lines, Piece};
use crate::stamp;

/// The longest piece of a line in a log file.
const PIECE_BYTES_MAX: usize = 8 * 1024;
/// How many first lines the exit record shows.
const FIRST_LINES_MAX: usize = 20;
/// The longest line the exit record shows.
const FIRST_LINE_CHARS_MAX: usize = 400;

/// Where a line came from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Stream {
    Out,
    Err,
}

/// The log of one process.
#[derive(Debug)]
pub(crate) struct Log {
    files: Files,
    out: Lines,
    err: Lines,
    first_out: Vec<String>,
    first_err: Vec<String>,
}

impl Log {
    /// Opens the log for appending.
    pub(crate) fn open(path: &Path, size_max: u64, files_max: u32) -> io::Result<Self> {
        Ok(Self {
            files: Files::open(path, size_max, files_max)?,
            out: Lines::new(PIECE_BYTES_MAX),
            err: Lines::new(PIECE_BYTES_MAX),
            first_out: Vec::new(),
            first_err: Vec::new(),
        })
    }

    /// Writes what came from a stream; an unfinished line waits for its end.
    pub(crate) fn push(&mut self, stream: Stream, bytes: &[u8]) {
        let (lines, first, name) = match stream {
            Stream::Out => (&mut self.out, &mut self.first_out, "out"),
            Stream::Err => (&mut self.err, &mut self.first_err, "err"),
        };
        lines.push(bytes, |piece| self.files.piece(name, piece, first));
    }

    /// Writes unfinished lines; nothing more comes from the process.
    pub(crate) fn finish(&mut self) {
        self.out
            .finish(|piece| self.files.piece("out", piece, &mut self.first_out));
        self.err
            .finish(|piece| self.files.piece("err", piece, &mut self.first_err));
    }

    /// Writes a remark of the supervisor.
    pub(crate) fn remark(&mut self, text: &str) {
        self.files.line("ictus", text);
    }

    /// The first lines of standard error, or of standard output when there were none.
    pub(crate) fn first_lines(&self) -> &[String] {
        if self.first_err.is_empty() {
            &self.first_out
        } else {
            &self.first_err
        }
    }

    /// Lines that the disk did not take.
    pub(crate) fn lost(&self) -> u64 {
        self.files.lost
    }
}

#[derive(Debug)]
struct Files {
    path: PathBuf,
    size_max: u64,
    files_max: u32,
    file: File,
    size: u64,
    lost: u64,
    /// Lines lost since the disk last took one.
    lost_recently: u64,
}

impl Files {
    fn open(path: &Path, size_max: u64, files_max: u32) -> io::Result<Self> {
        let file = OpenOptions::new().append(true).create(true).open(path)?;
        let size = file.metadata()?.len();
        let path = path.to_path_buf();
        Ok(Self {
            path,
            size_max,
            files_max,
            file,
            size,
            lost: 0,
            lost_recently: 0,
        })
    }

    fn piece(&mut self, stream: &str, piece: Piece<'_>, first: &mut Vec<String>) {
        let text = printable(piece.bytes);
        if first.len() < FIRST_LINES_MAX {
            first.push(text.chars().take(FIRST_LINE_CHARS_MAX).collect());
        }
        if piece.continued {
            self.line(&format!("{stream}+"), &text);
        } else {
            self.line(stream, &text);
        }
    }

    fn line(&mut self, stream: &str, text: &str) {
        let time = stamp::text(stamp::now_ns());
        if self.lost_recently > 0 {
            let remark = format!("{time} ictus {} lines lost\n", self.lost_recently);
            if self.write(remark.as_bytes()).is_ok() {
                self.lost_recently = 0;
            }
        }
        if self
            .write(format!("{time} {stream} {text}\n").as_bytes())
            .is_err()
        {
            self.lost += 1;
            self.lost_recently += 1;
        }
    }

    fn write(&mut self, line: &[u8]) -> io::Result<()> {
        let bytes = u64::try_from(line.len()).unwrap_or(u64::MAX);
        if self.size > 0 && self.size.saturating_add(bytes) > self.size_max {
            self.rotate()?;
        }
        self.file.write_all(line)?;
        self.size += bytes;
        Ok(())
    }

    fn rotate(&mut self) -> io::Result<()> {
        for number in (1..self.files_max).rev() {
            let older = if number == 1 {
                self.path.clone()
            } else {
                numbered(&self.path, number - 1)
            };
            match fs::rename(older, numbered(&self.path, number)) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                Ok(()) | Err(_) => {}
            }
        }
        let mut options = OpenOptions::new();
        self.file = options
            .write(true)
            .truncate(true)
            .create(true)
            .open(&self.path)?;
        self.size = 0;
        Ok(())
    }
}

/// `NAME.log.3` for `NAME.log`.
pub(crate) fn numbered(path: &Path, number: u32) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(format!(".{number}"));
    PathBuf::from(name)
}

/// Makes text of any bytes: invalid UTF-8 and control characters but tab are written as `\x1b`.
fn printable(bytes: &[u8]) -> String {
    let bytes = bytes.strip_suffix(b"\r").unwrap_or(bytes);
    let mut text = String::with_capacity(bytes.len());
    for chunk in bytes.utf8_chunks() {
        for character in chunk.valid().chars() {
            if character.is_control() && character != '\t' {
                text.extend(character.escape_default());
            } else {
                text.push(character);
            }
        }
        for byte in chunk.invalid() {
            text.push_str(&format!("\\x{byte:02x}"));
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::Path;

    use super::{Log, Stream, numbered, printable};

    #[test]
    fn junk_becomes_text() {
        assert_eq!(
            printable(b"a\tb\xff\xfe\x1b[0mz\r"),
            "a\tb\\xff\\xfe\\u{1b}[0mz"
        );
    }

    fn size(path: &Path) -> u64 {
        fs::metadata(path).map_or(0, |found| found.len())
    }

    #[test]
    fn files_are_bounded_in_size_and_number() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("a.log");
        let mut log = Log::open(&path, 1000, 3).unwrap();
        for _ in 0..200 {
            log.push(Stream::Out, b"0123456789012345678901234567890123456789\n");
        }
        log.finish();
        for file in [path.clone(), numbered(&path, 1), numbered(&path, 2)] {
            assert!((1..=1000).contains(&size(&file)), "{file:?}");
        }
        assert!(!numbered(&path, 3).exists());
        assert_eq!(log.lost(), 0);
    }

    #[test]
    fn an_endless_line_is_cut_and_the_first_lines_are_kept() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("a.log");
        let mut log = Log::open(&path, 1 << 20, 1).unwrap();
        log.push(Stream::Out, b"one\n");
        log.push(Stream::Err, &[b'x'; 20_000]);
        log.finish();
        let text = fs::read_to_string(&path).unwrap();
        let streams: Vec<_> = text
            .lines()
            .map(|line| line.split(' ').nth(1).unwrap())
            .collect();
        assert_eq!(streams, ["out", "err", "err+", "err+"]);
        assert_eq!(log.first_lines().len(), 3);
        assert!(log.first_lines()[0].starts_with("xxx"));
    }
}
