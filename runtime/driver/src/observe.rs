//! Trace and timing files: what was executed, line by line. The formats stand in ARCHITECTURE.md.

use crate::scope::Case;
use ictus_core::{PhysicalTime, Program, ReactorId, Tag};
use std::fmt;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

/// Directories for trace and timing files; both exist.
#[derive(Clone, Debug, Default)]
pub struct Observation {
    /// Where `FEDERATE.trace` goes.
    pub trace: Option<PathBuf>,
    /// Where `FEDERATE.timing` goes.
    pub timing: Option<PathBuf>,
}

/// Writes the files of all federates of the process. The first error stays until the end.
pub(crate) struct Observer {
    federates: Vec<Files>,
    /// By reactor id: index into `federates`.
    federate_of: Vec<usize>,
    failure: Option<io::Error>,
}

struct Files {
    name: String,
    trace: Option<Box<dyn Write>>,
    timing: Option<Box<dyn Write>>,
}

/// One run of a reaction.
#[derive(Debug)]
pub(crate) struct Run<'a> {
    pub(crate) origin: Tag,
    pub(crate) tag: Tag,
    pub(crate) reactor: ReactorId,
    pub(crate) path: &'a str,
    pub(crate) index: u32,
    pub(crate) case: Case,
    pub(crate) effects: &'a str,
    pub(crate) start: PhysicalTime,
    pub(crate) end: PhysicalTime,
}

impl Observer {
    /// Creates the files, or `None` when none is wanted.
    pub(crate) fn open(observation: &Observation, program: &Program) -> io::Result<Option<Self>> {
        let Observation { trace, timing } = observation;
        if trace.is_none() && timing.is_none() {
            return Ok(None);
        }
        Self::with(program, |name| {
            Ok(Files {
                name: name.to_owned(),
                trace: create(trace.as_deref(), name, "trace")?,
                timing: create(timing.as_deref(), name, "timing")?,
            })
        })
        .map(Some)
    }

    /// Keeps the traces of all federates in memory, one after the other record by record.
    #[cfg(feature = "simulate")]
    pub(crate) fn in_memory(program: &Program, memory: &Memory) -> Self {
        let files = |name: &str| Files {
            name: name.to_owned(),
            trace: Some(Box::new(memory.clone())),
            timing: None,
        };
        let opened = Self::with(program, |name| Ok(files(name)));
        opened.unwrap_or_else(|_| unreachable!("memory opens"))
    }

    fn with(program: &Program, open: impl Fn(&str) -> io::Result<Files>) -> io::Result<Self> {
        let mut federates: Vec<Files> = Vec::new();
        let mut federate_of = Vec::new();
        for path in program.reactor_paths() {
            let name = federate_name(path);
            let known = federates.iter().position(|f| f.name == name);
            federate_of.push(known.unwrap_or(federates.len()));
            if known.is_none() {
                federates.push(open(name)?);
            }
        }
        Ok(Self {
            federates,
            federate_of,
            failure: None,
        })
    }

    pub(crate) fn run(&mut self, run: &Run<'_>) {
        let files = &mut self.federates[self.federate_of[run.reactor.index()]];
        let result = files.run(run);
        self.keep(result);
    }

    pub(crate) fn physical(&mut self, origin: Tag, tag: Tag, path: &str) {
        let (time, microstep) = after(origin, tag);
        self.note(path, format_args!("# physical {time} {microstep} {path}"));
    }

    /// A message for the input `path` that came after the input had been decided.
    pub(crate) fn tardy(&mut self, origin: Tag, (intended, actual): (Tag, Tag), path: &str) {
        let (time, microstep) = after(origin, actual);
        let (intended_time, intended_microstep) = after(origin, intended);
        self.note(
            path,
            format_args!("# tardy {time} {microstep} {path} {intended_time} {intended_microstep}"),
        );
    }

    /// A watchdog that expired at a physical time.
    pub(crate) fn watchdog(&mut self, origin: Tag, now: PhysicalTime, path: &str) {
        let time = now.since(origin.time.as_physical()).as_nanos();
        self.note(path, format_args!("# watchdog {time} {path}"));
    }

    fn note(&mut self, path: &str, line: fmt::Arguments<'_>) {
        let name = federate_name(path);
        let federate = self.federates.iter_mut().find(|f| f.name == name);
        if let Some(trace) = federate.and_then(|f| f.trace.as_mut()) {
            let result = writeln!(trace, "{line}");
            self.keep(result);
        }
    }

    pub(crate) fn stop(&mut self, origin: Tag, tag: Tag) {
        let (time, microstep) = after(origin, tag);
        let result = self
            .traces()
            .try_for_each(|trace| writeln!(trace, "# stop {time} {microstep}"));
        self.keep(result);
    }

    /// Lets readers of a running federation see what was written so far.
    pub(crate) fn flush(&mut self) {
        let files = self.federates.iter_mut();
        let writers = files.flat_map(|f| f.trace.iter_mut().chain(&mut f.timing));
        let result = { writers }.try_for_each(|writer| writer.flush());
        self.keep(result);
    }

    pub(crate) fn end(mut self, origin: Tag, tag: Tag, reason: &str) -> io::Result<()> {
        let (time, microstep) = after(origin, tag);
        let reason = reason.replace(['\n', '\r'], " ");
        let result = self.traces().try_for_each(|trace| {
            writeln!(trace, "# end {time} {microstep} {reason}")?;
            trace.flush()
        });
        self.keep(result);
        let timings = self.federates.iter_mut().filter_map(|f| f.timing.as_mut());
        let result = { timings }.try_for_each(|timing| timing.flush());
        self.keep(result);
        self.failure.map_or(Ok(()), Err)
    }

    fn traces(&mut self) -> impl Iterator<Item = &mut Box<dyn Write>> {
        self.federates.iter_mut().filter_map(|f| f.trace.as_mut())
    }

    fn keep(&mut self, result: io::Result<()>) {
        if let Err(error) = result {
            self.failure.get_or_insert(error);
        }
    }
}

impl Files {
    fn run(&mut self, run: &Run<'_>) -> io::Result<()> {
        let time = run.tag.time.since(run.origin.time).as_nanos();
        let (microstep, path, index) = (run.tag.microstep, run.path, run.index);
        if let Some(trace) = &mut self.trace {
            let kind = match run.case {
                Case::Body => "body",
                Case::Deadline => "deadline",
                Case::Stp => "stp",
            };
            let effects = if run.effects.is_empty() {
                "-"
            } else {
                run.effects
            };
            writeln!(
                trace,
                "{time}\t{microstep}\t{path}\t{index}\t{kind}\t{effects}"
            )?;
        }
        if let Some(timing) = &mut self.timing {
            let origin = run.origin.time.as_physical();
            let (start, end) = (run.start.since(origin), run.end.since(origin));
            let (start, end) = (start.as_nanos(), end.as_nanos());
            writeln!(
                timing,
                "{time}\t{microstep}\t{path}\t{index}\t{start}\t{end}"
            )?;
        }
        Ok(())
    }
}

/// A tag as the trace shows it: nanoseconds after the start tag, and the microstep.
fn after(origin: Tag, tag: Tag) -> (i64, u32) {
    (tag.time.since(origin.time).as_nanos(), tag.microstep)
}

/// The first element of a path: a federate is a top-level instance.
fn federate_name(path: &str) -> &str {
    path.split_once('.').map_or(path, |(first, _)| first)
}

fn create(
    directory: Option<&Path>,
    federate: &str,
    extension: &str,
) -> io::Result<Option<Box<dyn Write>>> {
    let Some(directory) = directory else {
        return Ok(None);
    };
    let file = File::create(directory.join(format!("{federate}.{extension}")))?;
    Ok(Some(Box::new(BufWriter::new(file))))
}

/// Bytes that outlive the observer that wrote them.
#[cfg(feature = "simulate")]
#[derive(Clone, Debug, Default)]
pub(crate) struct Memory(std::rc::Rc<std::cell::RefCell<Vec<u8>>>);

#[cfg(feature = "simulate")]
impl Memory {
    /// What was written so far.
    pub(crate) fn text(&self) -> String {
        String::from_utf8_lossy(&self.0.borrow()).into_owned()
    }
}

#[cfg(feature = "simulate")]
impl Write for Memory {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.borrow_mut().extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
