//! The federates of a manifest, resolved: who is ours, who is foreign, which id each has, and what each
//! looks like.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use ictus_coord::describe::{
    ClassDescription, InstanceRequest, PortDescription, ProgramDescription, TypeIdentity,
};

use crate::check::{CheckOptions, Progress};
use crate::manifest::{Federate, Manifest, Program};
use crate::problem::{Place, Report};
use crate::program::{self, BuildError, PackageBuild};
use crate::suggest;

/// The most federates of a federation: LF's protocol counts them in 16 bits and reserves the last value.
const MAX_FEDERATES: usize = 65_534;

/// A federate whose names are resolved.
#[derive(Clone, Debug)]
pub(crate) struct Member<'a> {
    pub(crate) name: &'a str,
    pub(crate) federate: &'a Federate,
    pub(crate) origin: Origin<'a>,
    /// Absent as long as nothing is known of it, because its program was not or could not be asked.
    pub(crate) description: Option<ClassDescription>,
}

/// Where a federate's code comes from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Origin<'a> {
    /// A class of a program; either is absent when it is missing or unknown, which has been reported.
    Ours {
        program: Option<&'a str>,
        class: Option<&'a str>,
    },
    /// A prebuilt Lingua Franca federate; without a binary it is in an image.
    Foreign { binary: Option<&'a str> },
}

/// The members in order of their ids.
pub(crate) fn members<'a>(manifest: &'a Manifest, report: &mut Report) -> Vec<Member<'a>> {
    if manifest.federates.is_empty() && !report.is_broken(&["federates"]) {
        let fix = "add one: `NAME: { class: CLASS }`";
        report.add(
            "F023",
            Place::key(&["federates"]),
            "the federation has no federate",
            fix,
        );
    }
    let mut all: Vec<Member<'a>> = manifest
        .federates
        .0
        .iter()
        .map(|(name, federate)| Member {
            name,
            federate,
            origin: origin(manifest, name, federate, report),
            description: None,
        })
        .collect();
    if all.len() > MAX_FEDERATES {
        let message = format!("{} federates are more than {MAX_FEDERATES}", all.len());
        report.add("F005", Place::key(&["federates"]), message, "");
        all.truncate(MAX_FEDERATES);
    }
    in_order_of_ids(all, report)
}

fn origin<'a>(
    manifest: &'a Manifest,
    name: &str,
    federate: &'a Federate,
    report: &mut Report,
) -> Origin<'a> {
    let path = ["federates", name];
    let at = |key| ["federates", name, key];
    if let Some(kind) = foreign_key(federate) {
        let others = [
            ("image", federate.image.is_some()),
            ("build", federate.build.is_some()),
        ];
        for (key, _) in others.iter().filter(|(key, given)| *given && *key != kind) {
            let message = format!("`{name}` has both `{kind}` and `{key}`");
            report.add("F025", Place::key(&at(key)), message, "keep one of them");
        }
        let ours = [
            ("program", federate.program.is_some()),
            ("class", federate.class.is_some()),
            ("parameters", !federate.parameters.is_empty()),
        ];
        for (key, _) in ours.iter().filter(|(_, given)| *given) {
            let message = format!("`{key}` does not go with `{kind}`: `{name}` is foreign");
            let fix = format!("remove `{key}` or `{kind}`");
            report.add("F025", Place::key(&at(key)), message, fix);
        }
        if federate.id.is_none() && !report.is_broken(&at("id")) {
            let fix = "add `id:`, the federate id that was compiled in";
            report.add(
                "F025",
                Place::key(&path),
                format!("`{name}` has no `id`"),
                fix,
            );
        }
        return Origin::Foreign {
            binary: federate.binary.as_deref(),
        };
    }
    let foreign = [
        ("id", federate.id.is_some()),
        ("args", !federate.args.is_empty()),
        (
            "ports",
            !(federate.ports.inputs.is_empty() && federate.ports.outputs.is_empty()),
        ),
    ];
    for (key, _) in foreign.iter().filter(|(_, given)| *given) {
        let message = format!("`{key}` goes only with `binary`: `{name}` is not foreign");
        report.add(
            "F025",
            Place::key(&at(key)),
            message,
            format!("remove `{key}`"),
        );
    }
    if federate.class.is_none() && !report.is_broken(&path) {
        let fix = "add `class: CLASS`; a prebuilt Lingua Franca federate has `binary:` and `id:`";
        report.add(
            "F025",
            Place::key(&path),
            format!("`{name}` has no `class`"),
            fix,
        );
    }
    Origin::Ours {
        program: program_of(manifest, name, federate, report),
        class: federate.class.as_deref(),
    }
}

/// The key that makes a federate foreign.
fn foreign_key(federate: &Federate) -> Option<&'static str> {
    let keys = [
        ("binary", federate.binary.is_some()),
        ("image", federate.image.is_some()),
        ("build", federate.build.is_some()),
    ];
    keys.into_iter()
        .find(|(_, given)| *given)
        .map(|(key, _)| key)
}

/// The program that a federate names, or the only one there is.
fn program_of<'a>(
    manifest: &'a Manifest,
    name: &str,
    federate: &'a Federate,
    report: &mut Report,
) -> Option<&'a str> {
    let path = ["federates", name, "program"];
    match (&federate.program, manifest.programs.0.as_slice()) {
        (Some(program), _) if manifest.programs.get(program).is_some() => Some(program),
        (Some(program), _) => {
            if !report.is_broken(&["programs", program.as_str()]) {
                let fix = suggest::fix(program, manifest.programs.names());
                report.add(
                    "F009",
                    Place::value(&path),
                    format!("unknown program `{program}`"),
                    fix,
                );
            }
            None
        }
        (None, [(only, _)]) => Some(only),
        (None, several) => {
            if !report.is_broken(&["federates", name]) && !report.is_broken(&["programs"]) {
                let fix = match several {
                    [] => "add `programs: { NAME: { package: FOLDER } }`".to_owned(),
                    _ => suggest::fix("", manifest.programs.names()),
                };
                let message = format!("`{name}` does not say which program has its class");
                report.add("F009", Place::key(&path[..2]), message, fix);
            }
            None
        }
    }
}

/// Foreign federates stand at the ids they were compiled with; ours fill the rest in order.
fn in_order_of_ids<'a>(all: Vec<Member<'a>>, report: &mut Report) -> Vec<Member<'a>> {
    let count = all.len();
    let mut places: Vec<Option<Member<'a>>> = vec![None; count];
    let mut free = Vec::new();
    for member in all {
        let wanted = match member.origin {
            Origin::Foreign { .. } => member.federate.id,
            Origin::Ours { .. } => None,
        };
        let Some(id) = wanted else {
            free.push(member);
            continue;
        };
        let path = ["federates", member.name, "id"];
        match places.get_mut(usize::from(id)) {
            Some(place @ None) => *place = Some(member),
            Some(Some(other)) => {
                let message = format!("id {id} is taken by `{}`", other.name);
                report.add(
                    "F020",
                    Place::value(&path),
                    message,
                    "ids of foreign federates differ",
                );
                free.push(member);
            }
            None => {
                let message = format!("id {id} is not below {count}, the number of federates");
                let fix = "compile the federate with an id that this federation has";
                report.add("F020", Place::value(&path), message, fix);
                free.push(member);
            }
        }
    }
    let mut free = free.into_iter();
    places
        .into_iter()
        .filter_map(|place| place.or_else(|| free.next()))
        .collect()
}

/// Where the programs' executables are, by the manifest's name; foreign ones by their federate's name.
#[derive(Clone, Debug, Default)]
pub(crate) struct Executables {
    pub(crate) programs: BTreeMap<String, PathBuf>,
    pub(crate) foreign: BTreeMap<String, PathBuf>,
}

/// What building and describing needs to know.
#[derive(Debug)]
pub(crate) struct Workshop<'a> {
    pub(crate) manifest: &'a Manifest,
    /// The manifest's folder.
    pub(crate) dir: &'a Path,
    pub(crate) options: &'a CheckOptions,
    /// The programs that must run on any host of their architecture.
    pub(crate) portable: &'a BTreeSet<&'a str>,
}

impl Workshop<'_> {
    /// Checks that programs are well formed and are there, without running anything.
    pub(crate) fn inspect(&self, report: &mut Report) {
        for (name, program) in &self.manifest.programs.0 {
            if let Some(source) = source(name, program, report) {
                let missing = match source {
                    Source::Package(dir, _) => !self.dir.join(dir).join("Cargo.toml").is_file(),
                    Source::Binary(path) => program::existing(&self.dir.join(path)).is_err(),
                };
                if missing {
                    let path = self.dir.join(source.path()).display().to_string();
                    report_source(name, source, &format!("{path} is not there"), report);
                }
            }
        }
    }

    /// Builds every program that is used, and finds the executables of foreign federates.
    pub(crate) fn build(
        &self,
        members: &[Member<'_>],
        report: &mut Report,
        progress: &mut dyn FnMut(Progress),
    ) -> Executables {
        let mut executables = Executables::default();
        let used: BTreeSet<&str> = members.iter().filter_map(Member::program).collect();
        for (name, program) in &self.manifest.programs.0 {
            let Some(source) = source(name, program, report) else {
                continue;
            };
            if !used.contains(name.as_str()) {
                let message = format!("no federate uses the program `{name}`");
                report.warn("W002", Place::key(&["programs", name]), message, "");
                continue;
            }
            let built = match source {
                Source::Package(package, bin) => {
                    let dir = self.dir.join(package);
                    let wanted = PackageBuild {
                        program: name,
                        dir: &dir,
                        bin,
                        portable: self.portable.contains(name.as_str()),
                    };
                    program::build(wanted, self.options, progress)
                }
                Source::Binary(path) => program::existing(&self.dir.join(path)),
            };
            match built {
                Ok(executable) => {
                    progress(Progress::Built {
                        program: name.clone(),
                        executable: executable.clone(),
                    });
                    executables.programs.insert(name.clone(), executable);
                }
                Err(error) => report_build(name, source, &error, report),
            }
        }
        for member in members {
            if let Origin::Foreign {
                binary: Some(binary),
            } = member.origin
            {
                match program::existing(&self.dir.join(binary)) {
                    Ok(path) => {
                        executables.foreign.insert(member.name.to_owned(), path);
                    }
                    Err(error) => {
                        let place = Place::value(&["federates", member.name, "binary"]);
                        report.add(
                            "F027",
                            place,
                            error.to_string(),
                            "paths start at the manifest",
                        );
                    }
                }
            }
        }
        executables
    }

    /// Asks every program what its federates look like.
    pub(crate) fn describe(
        &self,
        members: &mut [Member<'_>],
        executables: &Executables,
        report: &mut Report,
        progress: &mut dyn FnMut(Progress),
    ) {
        for (name, executable) in &executables.programs {
            let timeout = self.options.describe_timeout;
            let place = Place::key(&["programs", name]);
            let classes = match program::describe_classes(executable, timeout) {
                Ok(classes) => classes,
                Err(error) => {
                    let message = format!("program `{name}` cannot be described: {error}");
                    let fix = format!("run `{} --describe` by hand", executable.display());
                    report.add("F022", place, message, fix);
                    continue;
                }
            };
            let mut asked = Vec::new();
            let mut requests = Vec::new();
            for (index, member) in members.iter().enumerate() {
                if member.program() == Some(name)
                    && let Some(request) = request(member, &classes, report)
                {
                    asked.push(index);
                    requests.push(request);
                }
            }
            if requests.is_empty() {
                continue;
            }
            match program::describe_instances(executable, &requests, timeout) {
                Ok(descriptions) => {
                    let federates = asked.len();
                    for (index, description) in asked.into_iter().zip(descriptions.instances) {
                        if let Some(member) = members.get_mut(index) {
                            accept(member, description, report);
                        }
                    }
                    progress(Progress::Described {
                        program: name.clone(),
                        federates,
                    });
                }
                Err(error) => {
                    let message = format!("program `{name}` cannot be described: {error}");
                    let fix = format!("run `{} --describe` by hand", executable.display());
                    report.add("F022", place, message, fix);
                }
            }
        }
    }
}

impl<'a> Origin<'a> {
    /// The program that has the class.
    pub(crate) fn program(&self) -> Option<&'a str> {
        match self {
            Self::Ours { program, .. } => *program,
            Self::Foreign { .. } => None,
        }
    }
}

impl Member<'_> {
    /// The program that has the member's class.
    pub(crate) fn program(&self) -> Option<&str> {
        self.origin.program()
    }

    /// Whether it is a prebuilt Lingua Franca federate.
    pub(crate) fn is_foreign(&self) -> bool {
        matches!(self.origin, Origin::Foreign { .. })
    }
}

/// What the manifest says of a foreign federate, in the form in which ours describe themselves. Unknown
/// types and fingerprints are empty.
pub(crate) fn foreign_description(federate: &Federate) -> ClassDescription {
    let port = |name: &str, type_name: &Option<String>, width: Option<u16>| PortDescription {
        name: name.to_owned(),
        width: width.map(u32::from),
        type_identity: TypeIdentity {
            name: type_name.clone().unwrap_or_default(),
            fingerprint: String::new(),
        },
        serializers: vec!["native".to_owned()],
    };
    let inputs = federate.ports.inputs.0.iter();
    let outputs = federate.ports.outputs.0.iter();
    ClassDescription {
        inputs: inputs
            .map(|(name, p)| port(name, &p.type_name, p.width))
            .collect(),
        outputs: outputs
            .map(|(name, p)| port(name, &p.type_name, p.width))
            .collect(),
        ..ClassDescription::default()
    }
}

/// Where a program comes from.
#[derive(Clone, Copy, Debug)]
enum Source<'a> {
    /// A package's folder and the binary named.
    Package(&'a str, Option<&'a str>),
    /// An executable.
    Binary(&'a str),
}

impl<'a> Source<'a> {
    fn path(self) -> &'a str {
        match self {
            Self::Package(path, _) | Self::Binary(path) => path,
        }
    }
}

fn source<'a>(name: &str, program: &'a Program, report: &mut Report) -> Option<Source<'a>> {
    let path = ["programs", name];
    match (&program.package, &program.binary) {
        (Some(package), None) => Some(Source::Package(package, program.bin.as_deref())),
        (None, Some(binary)) => {
            if program.bin.is_some() {
                let message = "`bin` goes only with `package`";
                report.add(
                    "F027",
                    Place::key(&["programs", name, "bin"]),
                    message,
                    "remove it",
                );
            }
            Some(Source::Binary(binary))
        }
        (Some(_), Some(_)) => {
            let message = format!("program `{name}` has both `package` and `binary`");
            report.add("F027", Place::key(&path), message, "keep one of them");
            None
        }
        (None, None) => {
            if !report.is_broken(&path) {
                let message = format!("program `{name}` has neither `package` nor `binary`");
                let fix = "add `package: FOLDER` (a cargo package) or `binary: FILE`";
                report.add("F027", Place::key(&path), message, fix);
            }
            None
        }
    }
}

fn report_build(name: &str, source: Source<'_>, error: &BuildError, report: &mut Report) {
    match error {
        BuildError::NoPackage { .. } | BuildError::NoBinary { .. } => {
            report_source(name, source, &error.to_string(), report);
        }
        BuildError::NoTarget { .. } | BuildError::ManyTargets { .. } => {
            let fix = "name one: `bin: NAME`";
            report.add(
                "F027",
                Place::key(&["programs", name]),
                error.to_string(),
                fix,
            );
        }
        BuildError::NoCargo(_) | BuildError::NoTriple(_) | BuildError::Failed(_) => {
            let message = format!("program `{name}` cannot be built: {error}");
            let fix = format!("run `cargo build` in `{}` to see everything", source.path());
            report.add("F021", Place::key(&["programs", name]), message, fix);
        }
    }
}

fn report_source(name: &str, source: Source<'_>, message: &str, report: &mut Report) {
    let key = match source {
        Source::Package(..) => "package",
        Source::Binary(_) => "binary",
    };
    let place = Place::value(&["programs", name, key]);
    report.add(
        "F027",
        place,
        message,
        "paths start at the manifest's folder",
    );
}

/// The question to put for a member; absent when its class is unknown or its parameters are wrong.
fn request(
    member: &Member<'_>,
    classes: &ProgramDescription,
    report: &mut Report,
) -> Option<InstanceRequest> {
    let Origin::Ours {
        class: Some(class), ..
    } = member.origin
    else {
        return None;
    };
    let Some(description) = classes.classes.iter().find(|known| known.class == class) else {
        let fix = suggest::fix(
            class,
            classes.classes.iter().map(|known| known.class.as_str()),
        );
        let place = Place::value(&["federates", member.name, "class"]);
        report.add("F010", place, format!("unknown class `{class}`"), fix);
        return None;
    };
    let mut good = true;
    let known = &description.parameters;
    for name in member.federate.parameters.names() {
        if !known.iter().any(|parameter| parameter.name == name) {
            let fix = match known.as_slice() {
                [] => "it has no parameters: remove it".to_owned(),
                some => suggest::fix(name, some.iter().map(|parameter| parameter.name.as_str())),
            };
            let place = Place::key(&["federates", member.name, "parameters", name]);
            report.add(
                "F024",
                place,
                format!("`{class}` has no parameter `{name}`"),
                fix,
            );
            good = false;
        }
    }
    for parameter in known.iter().filter(|parameter| parameter.required) {
        let name = parameter.name.as_str();
        if member.federate.parameters.get(name).is_none() {
            let message = format!(
                "`{class}` needs the parameter `{name}: {}`",
                parameter.type_name
            );
            let fix = format!("add `parameters: {{ {name}: ... }}`");
            report.add(
                "F024",
                Place::key(&["federates", member.name]),
                message,
                fix,
            );
            good = false;
        }
    }
    good.then(|| InstanceRequest {
        name: member.name.to_owned(),
        class: class.to_owned(),
        parameters: parameters(member.federate),
    })
}

/// The parameters as the plan has them.
pub(crate) fn parameters(federate: &Federate) -> serde_json::Map<String, serde_json::Value> {
    federate.parameters.0.iter().cloned().collect()
}

fn accept(member: &mut Member<'_>, description: ClassDescription, report: &mut Report) {
    if let Some(error) = &description.error {
        let name = member.name;
        let given = !member.federate.parameters.is_empty();
        let place = match given {
            true => Place::key(&["federates", name, "parameters"]),
            false => Place::key(&["federates", name]),
        };
        report.add(
            "F024",
            place,
            format!("`{name}` cannot be built: {error}"),
            "",
        );
        return;
    }
    member.description = Some(description);
}
