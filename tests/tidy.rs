//! The house rules that a compiler does not check: import arrows, file length, leftovers, links.

#![expect(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use serde_json::Value;
use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Who may import whom among our crates (ARCHITECTURE.md); `tests` imports everything and is not listed.
const ARROWS: &[(&str, &[&str])] = &[
    ("ictus-core", &[]),
    ("ictus-macros", &[]),
    ("ictus-coord", &["ictus-core"]),
    ("ictus-clock", &["ictus-core", "ictus-coord"]),
    ("ictus-stream", &[]),
    ("ictus-sim", &["ictus-core", "ictus-coord"]),
    ("ictus-metrics", &["ictus-core"]),
    (
        "ictus",
        &[
            "ictus-core",
            "ictus-coord",
            "ictus-clock",
            "ictus-macros",
            "ictus-metrics",
            "ictus-sim",
            "ictus-stream",
        ],
    ),
    (
        "ictus-rti",
        &[
            "ictus-core",
            "ictus-coord",
            "ictus-clock",
            "ictus-metrics",
            "ictus-stream",
        ],
    ),
    ("ictus-deploy", &["ictus-core", "ictus-coord"]),
    (
        "ictusd",
        &[
            "ictus-core",
            "ictus-coord",
            "ictus-clock",
            "ictus-deploy",
            "ictus-metrics",
            "ictus-rti",
            "ictus-stream",
        ],
    ),
    (
        "ictus-cli",
        &[
            "ictus-core",
            "ictus-coord",
            "ictus-deploy",
            "ictus-metrics",
            "ictus-rti",
            "ictus-stream",
            "ictusd",
        ],
    ),
];

/// Crates that may depend on tokio.
const ASYNC: &[&str] = &["ictus-deploy", "ictusd", "ictus-cli"];

/// Lines of code, tests not counted, that a file may have.
const FILE_LINES_MAX: usize = 700;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .parent()
        .unwrap()
        .to_owned()
}

fn tracked(ending: &str) -> Vec<PathBuf> {
    let output = Command::new("git")
        .args(["ls-files", "--cached", "--others", "--exclude-standard"])
        .current_dir(root())
        .output()
        .unwrap();
    assert!(output.status.success(), "git ls-files");
    let names = String::from_utf8(output.stdout).unwrap();
    let paths = names
        .lines()
        .filter(|name| name.ends_with(ending))
        .map(|name| root().join(name));
    paths.filter(|path| path.exists()).collect()
}

fn metadata() -> Value {
    cargo_metadata(&["--no-deps"])
}

fn cargo_metadata(arguments: &[&str]) -> Value {
    let output = Command::new(env!("CARGO"))
        .args(["metadata", "--format-version", "1", "--offline"])
        .args(arguments)
        .current_dir(root())
        .output()
        .unwrap();
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    serde_json::from_slice(&output.stdout).unwrap()
}

/// The direct dependencies of a package, development ones left out.
fn dependencies(package: &Value) -> BTreeSet<&str> {
    let dependencies = package["dependencies"].as_array().unwrap().iter();
    dependencies
        .filter(|d| d["kind"] != "dev")
        .map(|d| d["name"].as_str().unwrap())
        .collect()
}

/// Every crate of others stands in exactly one row of ARCHITECTURE.md's table, and nothing else does.
#[test]
fn every_dependency_has_its_row() {
    let manifest = fs::read_to_string(root().join("Cargo.toml")).unwrap();
    let manifest: toml::Table = toml::from_str(&manifest).unwrap();
    let dependencies = manifest["workspace"]["dependencies"].as_table().unwrap();
    let others = dependencies
        .iter()
        .filter(|(_, how)| how.get("path").is_none());
    let mut others: Vec<&str> = others.map(|(name, _)| name.as_str()).collect();
    others.sort_unstable();
    let text = fs::read_to_string(root().join("ARCHITECTURE.md")).unwrap();
    let section = text
        .split("\n## ")
        .find(|it| it.starts_with("Dependencies\n"));
    let rows = section
        .unwrap()
        .lines()
        .filter(|line| line.starts_with("| `"));
    let first = rows.map(|row| row.split('|').nth(1).unwrap());
    // Words in backticks; what is in parentheses is a feature.
    let names = first.flat_map(|cell| cell.split(", "));
    let mut named: Vec<&str> = names
        .map(|name| {
            name.trim()
                .trim_start_matches('`')
                .split('`')
                .next()
                .unwrap()
        })
        .collect();
    named.sort_unstable();
    assert_eq!(named, others);
}

#[test]
fn imports_follow_the_arrows() {
    let metadata = metadata();
    let ours: BTreeSet<&str> = ARROWS.iter().map(|(name, _)| *name).collect();
    for package in metadata["packages"].as_array().unwrap() {
        let name = package["name"].as_str().unwrap();
        let Some((_, allowed)) = ARROWS.iter().find(|(known, _)| *known == name) else {
            continue;
        };
        for dependency in dependencies(package) {
            assert!(
                !ours.contains(dependency) || allowed.contains(&dependency),
                "{name} may not import {dependency}: the arrows are in ARCHITECTURE.md"
            );
            assert!(
                dependency != "tokio" || ASYNC.contains(&name),
                "{name} may not use tokio"
            );
        }
    }
}

#[test]
fn every_crate_has_its_arrows() {
    let metadata = metadata();
    for package in metadata["packages"].as_array().unwrap() {
        let name = package["name"].as_str().unwrap();
        let ours = name == "ictus" || name.starts_with("ictus-") || name == "ictusd";
        let known = name == "ictus-tests" || ARROWS.iter().any(|(known, _)| *known == name);
        assert!(!ours || known, "{name} is missing in tests/tidy.rs");
    }
}

#[test]
fn dependencies_follow_deny_toml() {
    let rules = fs::read_to_string(root().join("deny.toml")).unwrap();
    let rules: toml::Table = rules.parse().unwrap();
    let allowed: Vec<&str> = rules["licenses"]["allow"]
        .as_array()
        .unwrap()
        .iter()
        .map(|licence| licence.as_str().unwrap())
        .collect();
    let banned = rules["bans"]["deny"].as_array().unwrap();
    let platform = format!("{}-unknown-linux-gnu", std::env::consts::ARCH);
    let metadata = cargo_metadata(&["--filter-platform", &platform]);
    let packages = metadata["packages"].as_array().unwrap();
    assert!(packages.len() > 100, "dependencies are listed");
    for package in packages {
        let name = package["name"].as_str().unwrap();
        for ban in banned {
            assert_ne!(ban["name"].as_str(), Some(name), "{:?}", ban["reason"]);
        }
        let source = package["source"].as_str();
        let crates_io = source.is_none_or(|s| s.starts_with("registry+"));
        assert!(crates_io, "{name} comes from {source:?}");
        let licence = package["license"].as_str().unwrap_or_default();
        let licence = spdx::Expression::parse_mode(licence, spdx::ParseMode::LAX).unwrap();
        let permitted = licence.evaluate(|requirement| {
            let id = requirement.license.id();
            id.is_some_and(|id| allowed.contains(&id.name))
        });
        assert!(permitted, "{name} is under {licence}");
    }
}

/// Lines that are not blank, not comments and not in the test module at the end.
fn code_lines(text: &str) -> usize {
    let body = text.split("\n#[cfg(test)]\nmod tests {").next().unwrap();
    let lines = body.lines().map(str::trim);
    lines
        .filter(|line| !line.is_empty() && !line.starts_with("//"))
        .count()
}

#[test]
fn files_are_short() {
    for path in tracked(".rs") {
        let lines = code_lines(&fs::read_to_string(&path).unwrap());
        assert!(
            lines <= FILE_LINES_MAX,
            "{} has {lines} lines of code, {FILE_LINES_MAX} are allowed: is there a second subject in it?",
            path.display()
        );
    }
}

#[test]
fn nothing_is_left_over() {
    let marks = [
        ["FIX", "ME"].concat(),
        ["TO", "DO:"].concat(),
        ["XX", "X:"].concat(),
    ];
    for path in tracked(".rs")
        .into_iter()
        .chain(tracked(".md"))
        .chain(tracked(".toml"))
    {
        let text = fs::read_to_string(&path).unwrap();
        for mark in &marks {
            assert!(!text.contains(mark), "{} contains {mark}", path.display());
        }
    }
}

#[test]
fn links_resolve() {
    for path in tracked(".md") {
        let text = fs::read_to_string(&path).unwrap();
        for target in text
            .split("](")
            .skip(1)
            .filter_map(|rest| rest.split(')').next())
        {
            let file = target.split('#').next().unwrap();
            if file.is_empty() || target.contains("://") {
                continue;
            }
            let linked = path.parent().unwrap().join(file);
            assert!(
                linked.exists(),
                "{}: link to {target} leads nowhere",
                path.display()
            );
        }
    }
}

#[test]
fn every_module_file_is_used() {
    let sources = tracked(".rs");
    let texts: Vec<String> = sources
        .iter()
        .map(|p| fs::read_to_string(p).unwrap())
        .collect();
    for path in &sources {
        let stem = path.file_stem().unwrap().to_str().unwrap();
        let root_file = ["lib", "main", "build"].contains(&stem)
            || path
                .parent()
                .is_some_and(|dir| dir.join("Cargo.toml").exists())
            || path.parent().is_some_and(|dir| {
                ["tests", "bin", "examples"]
                    .iter()
                    .any(|n| dir.ends_with(n))
            });
        let declared = texts
            .iter()
            .any(|text| text.contains(&format!("mod {stem};")));
        assert!(
            root_file || declared,
            "{} is part of no crate",
            path.display()
        );
    }
}

#[test]
fn every_failure_has_its_tests() {
    let text = fs::read_to_string(root().join("ARCHITECTURE.md")).unwrap();
    let heading = "## What happens when something fails";
    let section = text.split(heading).nth(1).unwrap();
    let section = section.split("\n## ").next().unwrap();
    let rows = section
        .lines()
        .filter(|line| line.starts_with("| "))
        .skip(1);
    let sources: String = tracked(".rs")
        .iter()
        .map(|path| fs::read_to_string(path).unwrap())
        .collect();
    let mut count = 0;
    for row in rows {
        let cell = row.trim_end_matches('|').rsplit('|').next().unwrap();
        let names: Vec<&str> = cell.split('`').skip(1).step_by(2).collect();
        assert!(!names.is_empty(), "no test shows: {row}");
        for name in names {
            let test = format!("fn {name}(");
            assert!(sources.contains(&test), "no test is called {name}: {row}");
        }
        count += 1;
    }
    assert!(count > 15, "{count} rows");
}
