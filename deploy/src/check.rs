//! The one entry: a manifest's path in, a checked federation or every mistake out.

use std::collections::{BTreeMap, BTreeSet};
use std::net::{IpAddr, SocketAddr, ToSocketAddrs};
use std::path::{Path, PathBuf};
use std::sync::mpsc;
use std::thread;
use std::time::Duration;

use ictus_coord::plan::{ClockSync, Plan};
use serde::{Deserialize, Serialize};

use crate::document::{Node, SyntaxError, Value};
use crate::federation::{self, Executables, Member, Origin, Workshop};
use crate::hosts::{Outside, Seating};
use crate::manifest::{self, Manifest, TimeSpan};
use crate::needs::{self, Outfit};
use crate::offsets::Offsets;
use crate::placement::{Needs, Placement};
use crate::problem::{Place, Problem, Problems, Report};
use crate::timing::TimingSpec;
use crate::{causality, lets, offsets, plan, policy, reactions, structure, wiring};

/// The longest manifest that is read, in bytes.
const MAX_MANIFEST: u64 = 1 << 20;

/// How long the addresses of a name are waited for.
const LOOK_UP: Duration = Duration::from_secs(5);

/// How much [`check`] may do.
#[derive(Clone, Debug)]
pub struct CheckOptions {
    /// Build and describe the programs. False (`--no-build`): no code of the manifest runs, neither a
    /// build script nor a program, and ports, types and loops are not checked.
    pub build: bool,
    /// Build with `--release`; else the `dev` profile.
    pub release: bool,
    /// How long one `PROGRAM --describe` may take.
    pub describe_timeout: Duration,
    /// Cargo's target directory; absent: `CARGO_TARGET_DIR` of the environment or cargo's own choice.
    pub target_dir: Option<PathBuf>,
    /// Values for names of the manifest's `let`, as written there (`--set half="0 ms"`).
    pub overrides: BTreeMap<String, String>,
    /// Everything will run in containers (`ictus compose`), whatever the manifest says: programs are built static, and
    /// what only containers give is there.
    pub contained: bool,
}

impl Default for CheckOptions {
    /// Builds in release, ten seconds for a describe, no overrides.
    fn default() -> Self {
        Self {
            build: true,
            release: true,
            describe_timeout: Duration::from_secs(10),
            target_dir: None,
            overrides: BTreeMap::new(),
            contained: false,
        }
    }
}

/// What [`check`] is doing; for a progress line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Progress {
    /// Cargo is about to build a program.
    Building {
        /// The manifest's name of the program.
        program: String,
    },
    /// Cargo finished one package of a build.
    Compiled {
        /// The manifest's name of the program.
        program: String,
        /// The package that cargo finished.
        package: String,
    },
    /// The program's executable is there.
    Built {
        /// The manifest's name of the program.
        program: String,
        /// Its executable.
        executable: PathBuf,
    },
    /// The program has said what its federates look like.
    Described {
        /// The manifest's name of the program.
        program: String,
        /// How many federates it described.
        federates: usize,
    },
}

/// A federation without a mistake, ready to run.
#[derive(Clone, Debug, PartialEq)]
pub struct Checked {
    /// The manifest, as an absolute path.
    pub manifest: PathBuf,
    /// The resolved plan. After a check without build it is provisional: widths, default serializers and
    /// types are not known, so nothing may be run from it.
    pub plan: Plan,
    /// The STP offsets with what they are made of; also under centralized coordination, where they play no part,
    /// as far as they can be solved.
    pub offsets: Option<Offsets>,
    /// One per federate of the plan, in its order. Empty after a check without build.
    pub federates: Vec<FederateRun>,
    /// Who starts it.
    pub deploy: Deploy,
    /// Which member runs on which host; absent: all on this machine, as processes.
    pub placement: Option<Placement>,
    /// What the manifest says about the run itself.
    pub settings: Settings,
    /// What `ictus timing` prints, resolved to reactor paths and reaction indices. Empty after a check
    /// without build.
    pub timing: TimingSpec,
    /// The executable that has every class, for the run in one process; absent when federates come from
    /// several programs or one is foreign.
    pub one_program: Option<PathBuf>,
    /// What is legal but probably not meant.
    pub warnings: Vec<Problem>,
}

/// How one federate is run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FederateRun {
    /// Index into the plan's federates and id on the wire.
    pub id: u16,
    /// The federate's name.
    pub name: String,
    /// The program to execute, an absolute path; empty when it is in an image ([`Needs::image`]).
    pub executable: PathBuf,
    /// Who wrote it.
    pub kind: FederateKind,
    /// Environment variables to add, those of files included.
    pub env: BTreeMap<String, String>,
    /// What it needs from its host.
    #[serde(default)]
    pub needs: Needs,
    /// Whether the program goes to another host or into a container, for this federate or another one: built from a
    /// package it is static then.
    #[serde(default)]
    pub portable: bool,
}

/// Who starts a federation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Deploy {
    /// The daemon of each host.
    #[default]
    Ictusd,
    /// docker-compose on this machine, without a daemon.
    Compose,
}

/// Whose command line a federate's program understands.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FederateKind {
    /// Ours: `--plan`, `--federate`, `--rti`, `--status-fd`, ...
    Ours,
    /// A prebuilt Lingua Franca federate: only what LF's launch script gives (`-i ID`), then these.
    Foreign {
        /// Further arguments, from the manifest.
        args: Vec<String>,
    },
}

/// What the manifest says about the run itself.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Settings {
    /// The RTI's TCP port; absent: any free one.
    pub rti_port: Option<u16>,
    /// How long federates may take to join.
    pub join_timeout: Duration,
    /// How long an ordered stop may take before processes are killed.
    pub stop_grace: Duration,
    /// Bytes of one log file before it is rotated.
    pub log_max_size: u64,
    /// Log files kept per federate.
    pub log_max_files: u32,
    /// Whether clocks are compared with the RTI's before the start.
    pub clock: ClockSync,
    /// Where the daemon serves metrics over TCP; absent: nowhere.
    #[serde(default)]
    pub metrics_listen: Option<SocketAddr>,
}

impl Default for Settings {
    /// Any port, 30 s to join, 5 s to stop, three logs of 10 MiB, no clock exchanges, no metrics over TCP.
    fn default() -> Self {
        Self {
            rti_port: None,
            join_timeout: Duration::from_secs(30),
            stop_grace: Duration::from_secs(5),
            log_max_size: 10 << 20,
            log_max_files: 3,
            clock: ClockSync::Off,
            metrics_listen: None,
        }
    }
}

/// Reads a manifest, builds and describes its programs, and checks everything that can be known before a
/// run.
///
/// # Errors
/// Every mistake found, in the order of the manifest's lines.
pub fn check(
    manifest: &Path,
    options: &CheckOptions,
    progress: &mut dyn FnMut(Progress),
) -> Result<Checked, Problems> {
    let text = match read(manifest) {
        Ok(text) => text,
        Err(error) => {
            let mut report = Report::new(manifest, "");
            report.add("F001", Place::key::<&str>(&[]), error, "");
            return Err(report.finish().0);
        }
    };
    let mut report = Report::new(manifest, &text);
    let absolute = std::path::absolute(manifest).unwrap_or_else(|_| manifest.to_path_buf());
    let checked = check_text(&text, &absolute, options, (&mut report, progress));
    let (problems, warnings) = report.finish();
    match checked {
        Some(checked) if problems.0.is_empty() => Ok(Checked {
            warnings,
            ..checked
        }),
        Some(_) | None => Err(problems),
    }
}

/// The JSON Schema of the manifest.
#[must_use]
pub fn schema() -> serde_json::Value {
    manifest::schema()
}

fn read(path: &Path) -> Result<String, String> {
    let cannot = |error: std::io::Error| format!("cannot read the manifest: {error}");
    let metadata = std::fs::metadata(path).map_err(cannot)?;
    if metadata.is_dir() {
        return Err("cannot read the manifest: it is a folder".to_owned());
    }
    if metadata.len() > MAX_MANIFEST {
        return Err(format!("the manifest is longer than {MAX_MANIFEST} bytes"));
    }
    std::fs::read_to_string(path).map_err(cannot)
}

/// Checks a manifest's text; everything wrong is in the report. Absent when the text cannot be read at all.
fn check_text(
    text: &str,
    absolute: &Path,
    options: &CheckOptions,
    (report, progress): (&mut Report, &mut dyn FnMut(Progress)),
) -> Option<Checked> {
    let manifest = form(text, options, report)?;
    let mut members = federation::members(&manifest, report);
    for member in members.iter_mut().filter(|member| member.is_foreign()) {
        member.description = Some(federation::foreign_description(member.federate));
    }
    let dir = absolute.parent().unwrap_or(absolute);
    let outside = Outside {
        dir,
        home: std::env::var_os("HOME").map(PathBuf::from),
        look_up: &look_up,
        read: &read_small,
    };
    let contained = options.contained || manifest.deploy == Deploy::Compose;
    let seating = Seating::of(&manifest, &members, &outside, report).contained(contained);
    let outfits = needs::outfits(&members, &seating, &outside, report);
    let portable = portable(&members, &seating);
    let workshop = Workshop {
        manifest: &manifest,
        dir,
        options,
        portable: &portable,
    };
    let mut executables = Executables::default();
    if options.build {
        executables = workshop.build(&members, report, progress);
        workshop.describe(&mut members, &executables, report, progress);
    } else {
        workshop.inspect(report);
    }
    let federates = match options.build {
        true => runs(&members, &executables, outfits, &seating),
        false => Vec::new(),
    };
    seating.one_host(&manifest, report);
    let checked = conclude((absolute, &manifest), &members, &executables, report);
    Some(Checked {
        federates,
        placement: seating.placement(),
        ..checked
    })
}

/// The programs that go to another host or into a container with one federate at least.
fn portable<'a>(members: &[Member<'a>], seating: &Seating<'_>) -> BTreeSet<&'a str> {
    let travelling = members.iter().enumerate();
    let travelling = travelling.filter(|(index, _)| seating.travels(*index));
    travelling
        .filter_map(|(_, member)| member.origin.program())
        .collect()
}

/// The addresses of a name, within [`LOOK_UP`].
fn look_up(name: &str) -> Result<Vec<IpAddr>, String> {
    let (sender, receiver) = mpsc::channel();
    let name = name.to_owned();
    thread::spawn(move || {
        let all = (name.as_str(), 0).to_socket_addrs();
        let all = all.map(|all| all.map(|one| one.ip()).collect());
        // Nobody may be waiting any more.
        drop(sender.send(all.map_err(|error| error.to_string())));
    });
    receiver
        .recv_timeout(LOOK_UP)
        .unwrap_or_else(|_| Err(format!("no answer within {} s", LOOK_UP.as_secs())))
}

/// A file's text, if it is a file and not longer than [`MAX_MANIFEST`].
fn read_small(path: &Path) -> Result<String, String> {
    let metadata = std::fs::metadata(path).map_err(|error| error.to_string())?;
    if !metadata.is_file() {
        return Err("it is not a file".to_owned());
    }
    if metadata.len() > MAX_MANIFEST {
        return Err(format!("it is longer than {MAX_MANIFEST} bytes"));
    }
    std::fs::read_to_string(path).map_err(|error| error.to_string())
}

/// Everything that follows once it is known what the federates look like.
fn conclude(
    (path, manifest): (&Path, &Manifest),
    members: &[Member<'_>],
    executables: &Executables,
    report: &mut Report,
) -> Checked {
    let mut wires = wiring::wire(manifest, members, report);
    causality::check(members, &wires, report);
    policy::check(manifest, members, report);
    let offsets = offsets::resolve(manifest, members, &mut wires, report);
    let timing = reactions::resolve(manifest, members, &wires, report);
    Checked {
        manifest: path.to_path_buf(),
        plan: plan::resolve(manifest, members, (wires, offsets.as_ref())),
        offsets,
        federates: Vec::new(),
        deploy: manifest.deploy,
        placement: None,
        settings: settings(manifest),
        timing,
        one_program: one_program(members, executables),
        warnings: Vec::new(),
    }
}

/// The manifest's form: YAML, `let`, keys and kinds of values.
fn form(text: &str, options: &CheckOptions, report: &mut Report) -> Option<Manifest> {
    let root = match Node::parse(text) {
        Ok(root) => root,
        Err(error) => {
            let fix = syntax_fix(text, &error);
            let place = Place::exact::<&str>(&[], error.site);
            report.add("F001", place, error.message, fix);
            return None;
        }
    };
    report.set_root(root.clone());
    if !matches!(root.value, Value::Map(_)) {
        let message = format!("a manifest is a mapping, found {}", root.kind());
        let fix = "start with `ictus: v1` and `federation: NAME`";
        report.add("F005", Place::value::<&str>(&[]), message, fix);
        return None;
    }
    let root = lets::substitute(&root, &options.overrides, report);
    let root = structure::prune(&manifest::schema(), &root, report);
    match Manifest::deserialize(&root) {
        Ok(manifest) => Some(manifest),
        Err(error) => {
            report.add("F005", Place::value::<&str>(&[]), error.to_string(), "");
            None
        }
    }
}

/// What most often stands behind an error of syntax.
fn syntax_fix(text: &str, error: &SyntaxError) -> &'static str {
    let row = usize::try_from(error.site.line)
        .unwrap_or(0)
        .saturating_sub(1);
    let line = text.lines().nth(row).unwrap_or_default();
    if error.message.contains("tab") {
        return "indent with spaces";
    }
    let channel = line.split_once('[').is_some_and(|(before, after)| {
        before.ends_with(|c: char| c.is_ascii_alphanumeric() || c == '_')
            && after.starts_with(|c: char| c.is_ascii_digit())
    });
    if channel && error.message.contains("flow") {
        return "quote a port with a channel: `\"federate.port[0]\"`";
    }
    if error.message.contains("did not find expected") {
        return "look before this place for a bracket, brace or quote that is not closed";
    }
    ""
}

/// How each member is run; of those whose program is not there, nothing.
fn runs(
    members: &[Member<'_>],
    executables: &Executables,
    outfits: Vec<Outfit>,
    seating: &Seating<'_>,
) -> Vec<FederateRun> {
    let portable = portable(members, seating);
    let run = |((id, member), outfit): ((u16, &Member<'_>), Outfit)| {
        let (executable, kind, sent) = match member.origin {
            Origin::Ours { program, .. } => (
                executables.programs.get(program?)?.clone(),
                FederateKind::Ours,
                portable.contains(program?),
            ),
            Origin::Foreign { binary } => {
                let args = member.federate.args.clone();
                let kind = FederateKind::Foreign { args };
                match binary {
                    Some(_) => {
                        let executable = executables.foreign.get(member.name)?.clone();
                        (executable, kind, seating.travels(usize::from(id)))
                    }
                    None => (PathBuf::new(), kind, false),
                }
            }
        };
        Some(FederateRun {
            id,
            name: member.name.to_owned(),
            executable,
            kind,
            env: outfit.env,
            needs: outfit.needs,
            portable: sent,
        })
    };
    (0_u16..)
        .zip(members)
        .zip(outfits)
        .filter_map(run)
        .collect()
}

/// The one executable that has the class of every federate.
fn one_program(members: &[Member<'_>], executables: &Executables) -> Option<PathBuf> {
    let mut paths = members
        .iter()
        .map(|member| executables.programs.get(member.program()?));
    let first = paths.next()??;
    paths.all(|path| path == Some(first)).then(|| first.clone())
}

fn settings(manifest: &Manifest) -> Settings {
    let basic = Settings::default();
    let defaults = &manifest.defaults;
    let span = |span: Option<TimeSpan>, otherwise: Duration| {
        span.map_or(otherwise, |span| {
            ictus_core::Duration::from_nanos(span.0).to_std()
        })
    };
    let port = match manifest.rti.port {
        Some(manifest::Port::Number(port)) => Some(port),
        Some(manifest::Port::Word(_)) | None => None,
    };
    Settings {
        rti_port: port,
        join_timeout: span(defaults.join_timeout, basic.join_timeout),
        stop_grace: span(defaults.stop_grace, basic.stop_grace),
        log_max_size: defaults
            .logs
            .max_size
            .map_or(basic.log_max_size, |size| size.0),
        log_max_files: defaults.logs.max_files.unwrap_or(basic.log_max_files),
        clock: manifest.clock.sync,
        metrics_listen: manifest.metrics.listen.map(|address| address.0),
    }
}

#[cfg(test)]
#[path = "../testdata/classes.rs"]
mod classes;

#[cfg(test)]
mod tests {
    use ictus_coord::describe::InstanceRequest;
    use proptest::prelude::*;
    use serde_json::Value as Json;

    use super::*;

    const EXAMPLE: &str = include_str!("../example.yaml");

    /// A whole check in which nothing runs: classes come from the table of the tests.
    fn check_described(text: &str) -> Problems {
        let mut report = Report::new(Path::new("federation.yaml"), text);
        let options = CheckOptions::default();
        if let Some(manifest) = form(text, &options, &mut report) {
            let mut members = federation::members(&manifest, &mut report);
            for member in &mut members {
                member.description = Some(match member.origin {
                    Origin::Foreign { .. } => federation::foreign_description(member.federate),
                    Origin::Ours { class, .. } => classes::instance(&InstanceRequest {
                        name: member.name.to_owned(),
                        class: class.unwrap_or_default().to_owned(),
                        parameters: federation::parameters(member.federate),
                    }),
                });
            }
            let path = Path::new("/nowhere/federation.yaml");
            let outside = Outside {
                dir: Path::new("/nowhere"),
                home: Some("/home/x".into()),
                look_up: &|name| match name {
                    "bench.lan" => Ok(vec![IpAddr::from([10, 0, 0, 12])]),
                    _ => Err("unknown".to_owned()),
                },
                read: &|_| Ok("A=1\n".to_owned()),
            };
            let seating = Seating::of(&manifest, &members, &outside, &mut report);
            needs::outfits(&members, &seating, &outside, &mut report);
            let executables = Executables::default();
            let checked = conclude((path, &manifest), &members, &executables, &mut report);
            assert_eq!(checked.plan.federates.len(), members.len());
        }
        report.finish().0
    }

    /// The paths of all properties of a schema, with `*` for names and positions.
    fn properties(root: &Json, schema: &Json, path: &str, found: &mut BTreeSet<String>) {
        let pointer = schema.get("$ref").and_then(Json::as_str).unwrap_or("#");
        let schema = if pointer == "#" {
            schema
        } else {
            root.pointer(&pointer[1..]).unwrap()
        };
        for (name, below) in schema
            .get("properties")
            .and_then(Json::as_object)
            .into_iter()
            .flatten()
        {
            let path = format!("{path}.{name}");
            properties(root, below, &path, found);
            found.insert(path);
        }
        for key in ["additionalProperties", "items"] {
            if let Some(below) = schema.get(key).filter(|below| below.is_object()) {
                properties(root, below, &format!("{path}.*"), found);
            }
        }
    }

    /// The paths of all keys of a document that the schema's paths cover.
    fn keys(node: &Node, path: &str, known: &BTreeSet<String>, found: &mut BTreeSet<String>) {
        match &node.value {
            Value::Map(entries) => {
                for (key, below) in entries {
                    let named = format!("{path}.{}", key.name);
                    let path = if known.contains(&named) {
                        named
                    } else {
                        format!("{path}.*")
                    };
                    keys(below, &path, known, found);
                    found.insert(path);
                }
            }
            Value::List(items) => {
                for item in items {
                    keys(item, &format!("{path}.*"), known, found);
                }
            }
            Value::Null | Value::Bool(_) | Value::Integer(_) | Value::Float(_) | Value::Text(_) => {
            }
        }
    }

    #[test]
    fn the_example_has_every_key() {
        assert_eq!(check_described(EXAMPLE), Problems::default());
        let schema = schema();
        let mut known = BTreeSet::new();
        properties(&schema, &schema, "", &mut known);
        assert!(known.len() > 40, "{known:?}");
        let mut used = BTreeSet::new();
        keys(&Node::parse(EXAMPLE).unwrap(), "", &known, &mut used);
        assert_eq!(
            known.difference(&used).collect::<Vec<_>>(),
            Vec::<&String>::new()
        );
    }

    #[test]
    fn the_schema_describes_every_key() {
        fn undescribed(schema: &Json, path: &str, found: &mut Vec<String>) {
            for (name, below) in schema
                .get("properties")
                .and_then(Json::as_object)
                .into_iter()
                .flatten()
            {
                if below.get("description").is_none() {
                    found.push(format!("{path}.{name}"));
                }
            }
            for (name, below) in schema
                .get("$defs")
                .and_then(Json::as_object)
                .into_iter()
                .flatten()
            {
                undescribed(below, name, found);
            }
        }
        let mut found = Vec::new();
        undescribed(&schema(), "", &mut found);
        assert_eq!(found, Vec::<String>::new());
    }

    #[test]
    fn a_flood_of_mistakes_has_an_end() {
        let mut text = EXAMPLE.to_owned();
        for index in 0..5_000 {
            text.push_str(&format!("k{index}: 1\n"));
        }
        let problems = check_described(&text);
        assert!(problems.0.len() < 300);
        assert!(
            problems.to_string().contains("4800 more"),
            "{}",
            problems.0.len()
        );
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(512))]

        /// Whatever is cut out of a manifest, doubled or written into it: an answer, never a panic, and
        /// every problem has a place in the text.
        #[test]
        fn mutations_never_panic(
            edits in prop::collection::vec((any::<u16>(), 0_usize..24, "[ -~\n\t{}\\[\\]:.$\u{e9}]{0,12}"), 1..6),
        ) {
            let mut text: Vec<char> = EXAMPLE.chars().collect();
            for (at, length, insert) in edits {
                let at = usize::from(at) % text.len();
                let end = (at + length).min(text.len());
                text.splice(at..end, insert.chars());
            }
            let text: String = text.into_iter().collect();
            let lines = text.lines().count() + 1;
            for problem in check_described(&text).0 {
                prop_assert!(usize::try_from(problem.line).unwrap() <= lines, "{problem}");
                prop_assert!(problem.column >= 1);
            }
        }

        /// Whole lines moved, dropped and doubled keep more of the form than single characters do.
        #[test]
        fn shuffled_lines_never_panic(
            edits in prop::collection::vec((any::<u16>(), any::<u16>(), 0_u8..3), 1..8),
        ) {
            let mut lines: Vec<&str> = EXAMPLE.lines().collect();
            for (from, to, kind) in edits {
                let (from, to) = (usize::from(from) % lines.len(), usize::from(to) % lines.len());
                match kind {
                    0 => drop(lines.remove(from)),
                    1 => lines.insert(to, lines[from]),
                    _ => lines.swap(from, to),
                }
            }
            check_described(&lines.join("\n"));
        }
    }
}
