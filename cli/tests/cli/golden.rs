//! Help and errors, word for word: `tests/golden/NAME.txt`. `UPDATE_GOLDEN=1` writes what is said now.

use std::fs;
use std::path::Path;

use crate::environment::Environment;

#[track_caller]
fn check(name: &str, environment: &Environment, args: &[&str]) {
    let said = environment.run(args);
    let found = format!("$ ictus {}\n{said}", args.join(" "));
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/golden/{name}.txt"));
    if std::env::var_os("UPDATE_GOLDEN").is_some() {
        fs::write(&path, &found).unwrap();
    }
    let expected = fs::read_to_string(&path).unwrap_or_default();
    assert_eq!(
        found,
        expected,
        "{} differs; UPDATE_GOLDEN=1 rewrites it",
        path.display()
    );
}

#[test]
fn help() {
    let environment = Environment::new();
    check("help", &environment, &["-h"]);
    check("help_up", &environment, &["help", "up"]);
    check("help_down", &environment, &["down", "-h"]);
    check("help_logs", &environment, &["logs", "-h"]);
    check("help_timing", &environment, &["timing", "-h"]);
    check("help_verify", &environment, &["verify", "-h"]);
    check("help_plan", &environment, &["plan", "-h"]);
}

#[test]
fn wrong_command_lines_exit_with_64() {
    let environment = Environment::new();
    check("no_command", &environment, &[]);
    check("unknown_command", &environment, &["upp"]);
    check("unknown_option", &environment, &["up", "--attached"]);
    check("bad_timeout", &environment, &["up", "--timeout", "soon"]);
    check("bad_set", &environment, &["up", "--set", "half"]);
}

#[test]
fn there_is_nothing() {
    let environment = Environment::new();
    check("no_manifest", &environment, &["check"]);
    check("nothing_runs", &environment, &["ps"]);
    check("nothing_to_take_down", &environment, &["down"]);
    check("nothing_of_that_name", &environment, &["logs", "diamond"]);
    check("no_such_code", &environment, &["explain", "F999"]);
    assert!(
        !environment.state().exists(),
        "asking leaves nothing behind"
    );
}

#[test]
fn what_compose_runs_is_listed_and_told_apart() {
    let environment = Environment::new();
    for name in ["one", "two"] {
        let directory = environment.state().join("compose").join(name);
        fs::create_dir_all(&directory).unwrap();
        fs::write(directory.join("compose.yaml"), "services: {}\n").unwrap();
    }
    check("stacks", &environment, &["ps"]);
    check("stacks_json", &environment, &["ps", "-o", "json"]);
    check("stack_json", &environment, &["ps", "one", "-o", "json"]);
    check("stack_watch", &environment, &["ps", "one", "--watch"]);
    check("which_stack", &environment, &["down"]);
    check("not_for_a_stack", &environment, &["stop", "two"]);
    // Taken down, and known by its name as long as its directory is there.
    fs::remove_file(environment.state().join("compose/one/compose.yaml")).unwrap();
    check("stack_is_down", &environment, &["down", "one"]);
    let nobody = environment.run(&["down", "", "--purge"]);
    assert_eq!(nobody.code, 1, "{nobody}");
    assert!(environment.state().join("compose/one").exists());
}

#[test]
fn hosts_are_listed_and_the_unit_printed() {
    let environment = Environment::new();
    let listed = environment.run(&["host", "ls"]).ok();
    assert!(
        listed.out.is_empty() && listed.err.contains("host add"),
        "{listed}"
    );
    let list = r#"{ "ann@nuc": { "client": "ssh2" }, "bob@pi": { "client": "system", "identity": "/k" } }"#;
    fs::create_dir(environment.state()).unwrap();
    fs::write(environment.state().join("hosts.json"), list).unwrap();
    let listed = environment.run(&["host", "ls"]).ok();
    let lines: Vec<_> = listed
        .out
        .lines()
        .map(|line| line.split_whitespace().collect::<Vec<_>>())
        .collect();
    assert_eq!(lines[0], ["HOST", "BY", "KEY"]);
    assert_eq!(lines[1], ["ann@nuc", "ssh2", "-"]);
    assert_eq!(lines[2], ["bob@pi", "the", "system's", "ssh", "/k"]);
    let unit = environment.run(&["host", "unit"]).ok();
    assert!(
        unit.out.contains("\n[Service]\n") && unit.out.contains("\nExecStart="),
        "{unit}"
    );
}

#[test]
fn mistakes_of_a_manifest() {
    let environment = Environment::new();
    let text = "ictus: v1\nfederation: bad\nfederates:\n  a: { clas: A }\nconections: []\n";
    environment.write("bad.yaml", text);
    check(
        "bad_manifest",
        &environment,
        &["check", "--no-build", "bad.yaml"],
    );
    check(
        "bad_manifest_json",
        &environment,
        &["check", "--no-build", "bad.yaml", "-o", "json"],
    );
    let text = "ictus: v1\nfederation: x\nprograms: { p: { binary: FIXTURE_PROGRAM } }\n\
                federates: { a: { class: Source } }\n";
    environment.write("endless.yaml", text);
    check(
        "verify_needs_a_timeout",
        &environment,
        &["verify", "-q", "endless.yaml"],
    );
}

/// An option that would do nothing is refused, before anything is built.
#[test]
fn verify_with_an_offset_that_nobody_waits() {
    let environment = Environment::new();
    check(
        "verify_offset_without_effect",
        &environment,
        &[
            "verify",
            "--modes",
            "one,centralized",
            "--stp-offset",
            "50ms",
        ],
    );
    check(
        "verify_offset_too_long",
        &environment,
        &[
            "verify",
            "--modes",
            "one,decentralized",
            "--stp-offset",
            "2h",
        ],
    );
}

/// A declared offset of a federate that waits for nobody is shown with what becomes of it.
#[test]
fn a_plan_with_an_offset_without_effect() {
    let environment = Environment::new();
    fs::create_dir(environment.path("acc")).unwrap();
    environment.write("acc/Cargo.toml", "");
    let text = CHAIN
        .replace("COORDINATION", "decentralized")
        .replace("{ class: Lidar }", "{ class: Lidar, stp_offset: 3 ms }");
    environment.write("chain.yaml", &text);
    let said = environment.run(&["plan", "--no-build", "chain.yaml"]).ok();
    let line = "\nlidar 0 ms (declared 3.0 has no effect): no input to wait for\n";
    assert!(said.out.contains(line), "{said}");
    assert!(
        said.out.contains("\nplanner 0.9 ms = lidar offset 0 + "),
        "{said}"
    );
    assert!(
        said.err.contains("`lidar` has no input to wait for [W003]"),
        "{said}"
    );
}

const CHAIN: &str = "\
ictus: v1
federation: chain
coordination: COORDINATION
programs: { acc: { package: acc } }
timeout: 10 s
bounds:
  launch_lag: 200 us
  latency: 600 us
  clock_error: 100 us
  links:
    planner -> brake: { launch_lag: 2 ms, latency: 3 ms, clock_error: 500 us }
federates:
  lidar: { class: Lidar }
  planner: { class: Planner }
  brake: { class: Brake, on_failure: continue }
  logger: { class: Logger, stp_offset: 2 ms }
connections:
  - { from: lidar.points, to: planner.points }
  - { from: planner.command, to: [brake.command, logger.command] }
  - { from: brake.state, to: planner.state, after: 20 ms }
  - { from: brake.raw, to: logger.raw, physical: true, after: 0 s }
";

/// Nothing is built: what the programs would say of themselves plays no part in offsets.
#[test]
fn plans_with_their_offsets() {
    let environment = Environment::new();
    fs::create_dir(environment.path("acc")).unwrap();
    environment.write("acc/Cargo.toml", "");
    for coordination in ["decentralized", "centralized"] {
        let text = CHAIN.replace("COORDINATION", coordination);
        environment.write("chain.yaml", &text);
        let name = format!("plan_{coordination}");
        check(&name, &environment, &["plan", "--no-build", "chain.yaml"]);
    }
    let said = environment.run(&["plan", "--no-build", "chain.yaml", "-o", "json"]);
    let answer: serde_json::Value = serde_json::from_str(&said.ok().out).unwrap();
    assert_eq!(answer["plan"]["connections"][5], serde_json::Value::Null);
    assert_eq!(answer["plan"]["federates"][2]["on_failure"], "continue");
    assert_eq!(answer["offsets"]["federates"][2]["required_ns"], 6_400_000);
    let cycle = CHAIN
        .replace("COORDINATION", "decentralized")
        .replace("20 ms", "2 ms");
    environment.write("cycle.yaml", &cycle);
    check(
        "plan_cycle",
        &environment,
        &["plan", "--no-build", "cycle.yaml"],
    );
}

#[test]
fn init_writes_what_check_accepts_and_overwrites_nothing() {
    let environment = Environment::new();
    check("init", &environment, &["init", "robot"]);
    environment.run(&["check", "--no-build", "robot"]).ok();
    check("init_again", &environment, &["init", "robot"]);
}

#[test]
fn a_run_directory_that_is_too_deep() {
    let environment = Environment::new();
    let deep = environment.path(&"d".repeat(120));
    let said = environment
        .command(&["ps"])
        .env("ICTUS_STATE_DIR", &deep)
        .output()
        .unwrap();
    assert_eq!(said.status.code(), Some(1));
    let said = String::from_utf8(said.stderr).unwrap();
    assert!(
        said.contains("too long for sockets") && said.contains("\nhint: "),
        "{said}"
    );
}

#[test]
fn results_go_to_standard_output_and_a_closed_one_is_no_error() {
    let environment = Environment::new();
    let said = environment.run(&["schema"]).ok();
    let schema: serde_json::Value = serde_json::from_str(&said.out).unwrap();
    assert!(schema.is_object());
    assert_eq!(said.err, "");
    let mut command = environment.command(&["schema"]);
    let mut child = command
        .stdout(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    drop(child.stdout.take());
    assert!(child.wait().unwrap().success());
}

#[test]
fn the_rti_goes_by_its_own_name_too() {
    let environment = Environment::new();
    let link = environment.path("ictus-rti");
    std::os::unix::fs::symlink(env!("CARGO_BIN_EXE_ictus"), &link).unwrap();
    let said = std::process::Command::new(&link)
        .arg("--help")
        .output()
        .unwrap();
    let own = environment.run(&["rti", "--help"]).ok();
    assert_eq!(String::from_utf8(said.stdout).unwrap(), own.out);
    assert!(own.out.contains("--number_of_federates"), "{own}");
}
