//! What each federate needs from its host, and whether the host's engine can give it.

use std::collections::BTreeMap;
use std::path::{Component, Path, PathBuf};

use crate::env_file::{self, is_variable};
use crate::federation::{Member, Origin};
use crate::hosts::{Outside, Seating};
use crate::manifest::{Secret, VolumeText};
use crate::placement::{Engine, ImageBuild, Needs, Realtime, SecretSource, Volume};
use crate::problem::{Place, Report};

/// The least memory that the docker engine accepts, in bytes.
const LEAST_MEMORY: u64 = 6 << 20;
/// Where containers have what is ours.
const OURS: [&str; 4] = ["/ictus", "/.ictus", "/app", "/run/secrets"];

/// What a federate is given besides its program.
#[derive(Clone, Debug, Default)]
pub(crate) struct Outfit {
    /// What it needs from its host.
    pub(crate) needs: Needs,
    /// Its environment variables.
    pub(crate) env: BTreeMap<String, String>,
}

/// The outfits of the members, in their order; what is wrong is reported.
pub(crate) fn outfits(
    members: &[Member<'_>],
    seating: &Seating<'_>,
    outside: &Outside<'_>,
    report: &mut Report,
) -> Vec<Outfit> {
    let one = |(index, member)| {
        engine(member, (index, seating), report);
        outfit(member, outside, report)
    };
    members.iter().enumerate().map(one).collect()
}

fn outfit(member: &Member<'_>, outside: &Outside<'_>, report: &mut Report) -> Outfit {
    let federate = member.federate;
    let at = |key| ["federates", member.name, key];
    let env = env(member, outside, report);
    let secrets = secrets(member, (outside, &env), report);
    if let Some(memory) = federate.memory.filter(|memory| memory.0 < LEAST_MEMORY) {
        let message = format!("{} bytes are too little for a container", memory.0);
        report.add(
            "F036",
            Place::value(&at("memory")),
            message,
            "give it at least `6 MiB`",
        );
    }
    if let Some(user) = federate.user.as_ref().filter(|user| !is_user(user)) {
        let message = format!("`{user}` is no user");
        let fix = "write `UID`, `UID:GID`, or names: `\"1000:1000\"`";
        report.add("F036", Place::value(&at("user")), message, fix);
    }
    if let Some(image) = federate.image.as_ref().filter(|image| !is_image(image)) {
        let message = format!("`{image}` is no name of an image");
        let fix = "write it as `registry/name:tag`";
        report.add("F036", Place::value(&at("image")), message, fix);
    }
    let locked = federate.realtime.is_some_and(|it| it.lock_memory);
    if locked && matches!(member.origin, Origin::Foreign { .. }) {
        let message = "a prebuilt federate cannot be told to lock its memory";
        let place = ["federates", member.name, "realtime", "lock_memory"];
        let fix = "leave it out: only programs of Ictus lock their own";
        report.add("F036", Place::value(&place), message, fix);
    }
    let realtime = federate.realtime.and_then(|realtime| {
        Some(Realtime {
            policy: realtime.policy?,
            priority: realtime.priority?,
            lock_memory: realtime.lock_memory,
        })
    });
    let needs = Needs {
        cpus: cpus(member, report),
        memory: federate.memory.map(|memory| memory.0),
        pids: federate.pids,
        user: federate.user.clone(),
        devices: devices(member, report),
        volumes: volumes(member, report),
        realtime,
        secrets,
        image: federate.image.clone(),
        build: build(member, outside, report),
    };
    Outfit { needs, env }
}

/// The folder of which its image is built; one without a Dockerfile is reported.
fn build(member: &Member<'_>, outside: &Outside<'_>, report: &mut Report) -> Option<ImageBuild> {
    let build = member.federate.build.as_ref()?;
    let context = outside.dir.join(build.context.as_ref()?);
    let dockerfile = build.dockerfile.clone();
    let dockerfile = dockerfile.unwrap_or_else(|| "Dockerfile".to_owned());
    let inside = Path::new(&dockerfile)
        .components()
        .all(|part| matches!(part, Component::Normal(_)));
    if !inside || (outside.read)(&context.join(&dockerfile)).is_err() {
        let path = ["federates", member.name, "build"];
        let message = format!("there is no `{dockerfile}` in {}", context.display());
        let fix = "write `build: { context: FOLDER, dockerfile: FILE-IN-IT }`";
        report.add("F036", Place::key(&path), message, fix);
        return None;
    }
    Some(ImageBuild {
        context,
        dockerfile,
    })
}

/// Reports what only another engine gives.
fn engine(member: &Member<'_>, (index, seating): (usize, &Seating<'_>), report: &mut Report) {
    let federate = member.federate;
    if seating.engine(index) != Some(Engine::Process) {
        return;
    }
    let at = |key| ["federates", member.name, key];
    let host = seating.host_name(index);
    let contained = [
        ("memory", federate.memory.is_some()),
        ("pids", federate.pids.is_some()),
        ("devices", !federate.devices.is_empty()),
        ("volumes", !federate.volumes.is_empty()),
        ("image", federate.image.is_some()),
        ("build", federate.build.is_some()),
    ];
    for (key, _) in contained.iter().filter(|(_, given)| *given) {
        let (message, fix) = match host {
            Some(host) => (
                format!("`{key}` needs engine docker, and host `{host}` runs processes"),
                format!("write `engine: docker` at `hosts.{host}`, or remove `{key}`"),
            ),
            None => (
                format!("`{key}` needs engine docker, and without `hosts` federates are processes"),
                "add `hosts: { here: { local: true, engine: docker } }` or `deploy: compose`, or remove it".to_owned(),
            ),
        };
        report.add("F035", Place::key(&at(key)), message, fix);
    }
    if federate.user.is_some() {
        let host = host.unwrap_or("this machine");
        let message = format!("`user` needs a daemon that runs as root on `{host}`");
        let fix = "remove it, or take engine docker";
        report.warn("W006", Place::key(&at("user")), message, fix);
    }
}

fn cpus(member: &Member<'_>, report: &mut Report) -> Vec<u32> {
    let mut cpus: Vec<u32> = Vec::new();
    for (index, cpu) in member.federate.cpus.iter().enumerate() {
        let path = ["federates", member.name, "cpus", &index.to_string()];
        if cpus.contains(cpu) && !report.is_broken(&path[..3]) {
            let message = format!("processor {cpu} stands here twice");
            report.add("F036", Place::value(&path), message, "remove one");
        }
        cpus.push(*cpu);
    }
    cpus.sort_unstable();
    cpus
}

fn devices(member: &Member<'_>, report: &mut Report) -> Vec<PathBuf> {
    let mut devices = Vec::new();
    for (index, text) in member.federate.devices.iter().enumerate() {
        let path = ["federates", member.name, "devices", &index.to_string()];
        devices.extend(absolute(text, &path, report));
    }
    devices
}

fn volumes(member: &Member<'_>, report: &mut Report) -> Vec<Volume> {
    let mut volumes: Vec<Volume> = Vec::new();
    for (index, volume) in member.federate.volumes.iter().enumerate() {
        let VolumeText {
            host: Some(host),
            at: Some(inside),
            read_only,
        } = volume
        else {
            continue;
        };
        let index = index.to_string();
        let path = ["federates", member.name, "volumes", &index];
        let place = [&path[..], &["at"]].concat();
        let host = absolute(host, &[&path[..], &["host"]].concat(), report);
        let inside = absolute(inside, &place, report);
        let (Some(host), Some(at)) = (host, inside) else {
            continue;
        };
        let ours = OURS.iter().find(|ours| at.starts_with(ours));
        if let Some(ours) = ours {
            let message = format!("`{}` lies in `{ours}`, which is Ictus'", at.display());
            report.add(
                "F036",
                Place::value(&place),
                message,
                "choose another place",
            );
        } else if at.parent().is_none() {
            let message = "a volume at `/` would hide the program itself";
            report.add(
                "F036",
                Place::value(&place),
                message,
                "choose another place",
            );
        } else if volumes.iter().any(|before| before.at == at) {
            let message = format!("two volumes are at `{}`", at.display());
            report.add(
                "F036",
                Place::value(&place),
                message,
                "choose another place",
            );
        }
        volumes.push(Volume {
            host,
            at,
            read_only: *read_only,
        });
    }
    volumes
}

/// A path on a host, without `.` and double slashes.
fn absolute<S: AsRef<str>>(text: &str, path: &[S], report: &mut Report) -> Option<PathBuf> {
    let wrong = if !text.starts_with('/') {
        Some("is not an absolute path")
    } else if text.split('/').any(|step| step == "..") {
        Some("has a `..`")
    } else if text.contains(|c: char| c == ':' || c == ',' || c.is_control()) {
        Some("has a colon, comma or control character")
    } else {
        None
    };
    let Some(wrong) = wrong else {
        return Some(PathBuf::from(text).components().collect());
    };
    if !report.is_broken(path) {
        let fix = "a path on a host is whole: `/data/maps`";
        report.add("F036", Place::value(path), format!("`{text}` {wrong}"), fix);
    }
    None
}

/// The variables of the files in their order, then those of `env`.
fn env(
    member: &Member<'_>,
    outside: &Outside<'_>,
    report: &mut Report,
) -> BTreeMap<String, String> {
    let mut all = BTreeMap::new();
    for (index, file) in member.federate.env_file.iter().enumerate() {
        let path = ["federates", member.name, "env_file", &index.to_string()];
        if report.is_broken(&path) {
            continue;
        }
        let place = || Place::value(&path);
        let text = match outside.path(file) {
            Some(path) => (outside.read)(&path),
            None => Err("HOME is not set".to_owned()),
        };
        let text = match text {
            Ok(text) => text,
            Err(why) => {
                let message = format!("`{file}` cannot be read: {why}");
                report.add(
                    "F037",
                    place(),
                    message,
                    "paths start at the manifest's folder",
                );
                continue;
            }
        };
        let (variables, faults) = env_file::parse(&text);
        for (line, fault) in faults {
            let fix = "a line is `KEY=VALUE`; spaces at the ends of a value, `#` and line ends stand in quotes";
            report.add("F037", place(), format!("{file}:{line}: {fault}"), fix);
        }
        all.extend(variables);
    }
    let own = member.federate.env.0.iter();
    all.extend(own.map(|(name, value)| (name.clone(), value.to_string())));
    all
}

fn secrets(
    member: &Member<'_>,
    (outside, env): (&Outside<'_>, &BTreeMap<String, String>),
    report: &mut Report,
) -> BTreeMap<String, SecretSource> {
    let mut secrets = BTreeMap::new();
    for (index, secret) in member.federate.secrets.iter().enumerate() {
        let index = index.to_string();
        let path = ["federates", member.name, "secrets", &index];
        if report.is_broken(&path) {
            continue;
        }
        let (name, source) = match secret {
            Secret::Name(name) => (name, Some(SecretSource::Environment)),
            Secret::Entry(entry) => {
                let (Some(name), Some(file)) = (&entry.name, &entry.file) else {
                    continue;
                };
                (name, outside.path(file).map(SecretSource::File))
            }
        };
        let Some(source) = source else {
            let message = format!("the file of `{name}` cannot be found: HOME is not set");
            report.add(
                "F038",
                Place::value(&path),
                message,
                "write an absolute path",
            );
            continue;
        };
        let file = format!("{name}_FILE");
        let wrong = if !is_variable(name) || name.len() > 64 {
            let fix =
                "a secret's name is a letter or `_`, then letters, digits and `_`; at most 64";
            Some((format!("`{name}` cannot be the name of a secret"), fix))
        } else if secrets.contains_key(name) {
            Some((
                format!("the secret `{name}` stands here twice"),
                "remove one",
            ))
        } else if env.contains_key(name) || env.contains_key(&file) {
            let taken = if env.contains_key(name) { name } else { &file };
            let fix =
                "a secret is handed over as a file, never in the environment: remove it there";
            Some((format!("`{taken}` stands in the environment too"), fix))
        } else {
            None
        };
        if let Some((message, fix)) = wrong {
            report.add("F038", Place::value(&path), message, fix);
        }
        secrets.insert(name.clone(), source);
    }
    secrets
}

/// `USER[:GROUP]`, each a number or a name as Linux has them.
fn is_user(text: &str) -> bool {
    let part = |text: &str| {
        let digits = !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
        let mut bytes = text.bytes();
        let first = bytes.next();
        let name = first.is_some_and(|first| first.is_ascii_alphabetic() || first == b'_')
            && text.len() <= 32
            && bytes.all(|byte| byte.is_ascii_alphanumeric() || b"_-.".contains(&byte));
        name || (digits && text.parse::<u32>().is_ok_and(|id| id < u32::MAX))
    };
    match text.split_once(':') {
        Some((user, group)) => part(user) && part(group),
        None => part(text),
    }
}

/// Whether a text can be an image reference: what it means, the engine says.
fn is_image(text: &str) -> bool {
    let mut bytes = text.bytes();
    bytes
        .next()
        .is_some_and(|first| first.is_ascii_alphanumeric())
        && text.len() <= 512
        && bytes.all(|byte| byte.is_ascii_alphanumeric() || b"._-/:@".contains(&byte))
}
