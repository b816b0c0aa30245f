//! What a program says of itself: `PROGRAM --describe [INSTANCES.json]`, JSON on standard output.

use crate::assembly::{Assembler, AssemblyError};
use crate::class::Class;
use crate::clock::SystemClock;
use crate::scope::DeclaredPort;
use ictus_coord::describe::{
    ClassDescription, InstanceDescriptions, InstanceRequest, PortDescription, ProgramDescription,
    ReactionDescription,
};
use ictus_coord::plan::{FORMAT, FederatePlan, Plan};
use ictus_core::{PortKind, Program};
use serde::Serialize;
use std::io::Write;
use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use thiserror::Error;

/// Why a program cannot describe itself.
#[derive(Debug, Error)]
enum DescribeError {
    /// The file of requests cannot be read.
    #[error("cannot read {path}: {source}")]
    Read {
        path: String,
        source: std::io::Error,
    },
    /// The file holds something else.
    #[error("{path} is not a list of instances: {source}")]
    Parse {
        path: String,
        source: serde_json::Error,
    },
    /// Standard output cannot be written.
    #[error("cannot write the description: {0}")]
    Write(#[from] std::io::Error),
}

/// Answers `--describe [FILE]` on standard output.
pub(crate) fn describe_main(classes: &[Class], file: Option<&Path>) -> ExitCode {
    match answer(classes, file) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            // Nobody reads standard error: the exit code still tells.
            drop(writeln!(std::io::stderr(), "ictus: {error}"));
            ExitCode::FAILURE
        }
    }
}

fn answer(classes: &[Class], file: Option<&Path>) -> Result<(), DescribeError> {
    let Some(file) = file else {
        return print(&program(classes));
    };
    let path = || file.display().to_string();
    let text = std::fs::read(file).map_err(|source| DescribeError::Read {
        path: path(),
        source,
    })?;
    let requests: Vec<InstanceRequest> =
        serde_json::from_slice(&text).map_err(|source| DescribeError::Parse {
            path: path(),
            source,
        })?;
    let instances = requests.into_iter().map(|r| instance(classes, r)).collect();
    print(&InstanceDescriptions {
        ictus: FORMAT.to_owned(),
        instances,
    })
}

fn print(description: &impl Serialize) -> Result<(), DescribeError> {
    let mut text = serde_json::to_vec_pretty(description).map_err(std::io::Error::from)?;
    text.push(b'\n');
    let mut out = std::io::stdout().lock();
    out.write_all(&text)?;
    Ok(out.flush()?)
}

/// Describes every class with its default parameters.
#[must_use]
pub fn program(classes: &[Class]) -> ProgramDescription {
    let described = classes.iter().map(|class| {
        let request = InstanceRequest {
            name: class.name().to_owned(),
            class: class.name().to_owned(),
            parameters: serde_json::Map::new(),
        };
        instance(classes, request)
    });
    ProgramDescription {
        ictus: FORMAT.to_owned(),
        classes: described.collect(),
    }
}

/// Describes one instance; what is wrong with it stands in the description.
#[must_use]
pub fn instance(classes: &[Class], request: InstanceRequest) -> ClassDescription {
    let class = request.class.clone();
    let known = classes.iter().find(|c| c.name() == class);
    let parameters = known.map(Class::parameters).unwrap_or_default();
    match build(classes, request) {
        Ok(description) => ClassDescription {
            class,
            parameters,
            ..description
        },
        Err(error) => {
            // The one who asks knows the federate and the class of a parameter.
            let text = if let AssemblyError::Parameter { source, .. } = error {
                source.to_string()
            } else {
                error.to_string()
            };
            ClassDescription {
                class,
                parameters,
                error: Some(text),
                ..ClassDescription::default()
            }
        }
    }
}

fn build(classes: &[Class], request: InstanceRequest) -> Result<ClassDescription, AssemblyError> {
    let plan = Plan {
        federation: request.name.clone(),
        fast: true,
        extensions: false,
        federates: vec![FederatePlan {
            name: request.name,
            class: Some(request.class),
            parameters: request.parameters,
            ..FederatePlan::default()
        }],
        ..Plan::default()
    };
    let mut assembler = Assembler::new(&plan, Arc::new(SystemClock::new()));
    let reactor = assembler.instantiate(0, classes)?;
    let mut ports = std::mem::take(&mut assembler.elaboration.ports);
    ports.retain(|port| port.reactor == reactor);
    let program = assembler.finish()?.program;
    let of = |kind| ports.iter().filter(move |port| port.kind == kind);
    Ok(ClassDescription {
        inputs: of(PortKind::Input).map(describe_port).collect(),
        outputs: of(PortKind::Output).map(describe_port).collect(),
        zero_delay: zero_delay(&program, &ports),
        physical: program.has_physical_actions(),
        reactions: reactions(&program),
        ..ClassDescription::default()
    })
}

fn describe_port(port: &DeclaredPort) -> PortDescription {
    let width = u32::try_from(port.channels.len()).unwrap_or(u32::MAX);
    let serializers = port.typed.serializers();
    PortDescription {
        name: port.name.to_owned(),
        width: port.multi.then_some(width),
        type_identity: port.typed.identity(),
        serializers: serializers.into_iter().map(str::to_owned).collect(),
    }
}

fn zero_delay(program: &Program, ports: &[DeclaredPort]) -> Vec<(String, String)> {
    let of = |kind| ports.iter().filter(move |port| port.kind == kind);
    let mut pairs = Vec::new();
    for input in of(PortKind::Input) {
        for output in of(PortKind::Output) {
            let mut outputs = output.channels.iter();
            let depends = outputs.any(|out| {
                let mut inputs = input.channels.iter();
                inputs.any(|input| program.depends_without_delay(*input, *out))
            });
            if depends {
                pairs.push((input.name.to_owned(), output.name.to_owned()));
            }
        }
    }
    pairs
}

fn reactions(program: &Program) -> Vec<ReactionDescription> {
    let root = program.reactor_paths().next().unwrap_or_default();
    let described = program.reactions().iter().map(|reaction| {
        let path = program.reactor_path(reaction.spec.reactor);
        let below = path.strip_prefix(root).unwrap_or(path);
        ReactionDescription {
            path: below.strip_prefix('.').unwrap_or(below).to_owned(),
            index: reaction.index,
            name: reaction.spec.name.clone(),
        }
    });
    described.collect()
}
