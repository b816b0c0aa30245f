//! A program that only describes itself, for tests of `check`: the classes of `example.yaml` and a few that
//! are wrong on purpose. Named `hang`, `crash`, `garbage`, `flood`, `old` or `short` it misbehaves so.

use std::io::Write;
use std::process::ExitCode;

use ictus_coord::describe::{InstanceDescriptions, InstanceRequest, ProgramDescription};
use ictus_coord::plan::FORMAT;

#[path = "../testdata/classes.rs"]
mod classes;

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().collect();
    let name = arguments
        .first()
        .and_then(|path| path.rsplit('/').next())
        .unwrap_or_default();
    let mut out = std::io::stdout();
    let requests = arguments.get(2).and_then(|path| std::fs::read(path).ok());
    let requests: Vec<InstanceRequest> = requests
        .and_then(|bytes| serde_json::from_slice(&bytes).ok())
        .unwrap_or_default();
    let mut instances: Vec<_> = requests.iter().map(classes::instance).collect();
    let mut version = FORMAT.to_owned();
    match name {
        "hang" => loop {
            std::thread::park();
        },
        "crash" => {
            drop(writeln!(
                std::io::stderr(),
                "could not open the map\nno such file"
            ));
            return ExitCode::FAILURE;
        }
        "garbage" => {
            drop(writeln!(out, "Hello, I am a program!"));
            return ExitCode::SUCCESS;
        }
        "flood" => while out.write_all(&[b' '; 4096]).is_ok() {},
        "old" => "v0".clone_into(&mut version),
        "short" => drop(instances.pop()),
        _ => {}
    }
    let json = if arguments.len() > 2 {
        serde_json::to_string(&InstanceDescriptions {
            ictus: version,
            instances,
        })
    } else {
        serde_json::to_string(&ProgramDescription {
            ictus: version,
            classes: classes::classes(),
        })
    };
    drop(writeln!(out, "{}", json.unwrap_or_default()));
    ExitCode::SUCCESS
}
