//! The sweep with real processes, as a user runs it.

#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use std::fs;
use std::process::Command;

#[test]
fn a_sweep_writes_its_results() {
    let out = tempfile::tempdir().unwrap();
    let output = Command::new(env!("CARGO_BIN_EXE_inconsistency"))
        .args(["sweep", "--sequences", "20", "--periods", "1 ns,1 ms"])
        .args(["--offsets", "0", "--systems", "centralized,decentralized"])
        .arg("--out")
        .arg(out.path())
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    let csv = fs::read_to_string(out.path().join("runs.csv")).unwrap();
    let rows: Vec<Vec<&str>> = csv
        .lines()
        .skip(1)
        .map(|line| line.split(',').collect())
        .collect();
    assert_eq!(rows.len(), 2 * 3, "{csv}");
    for row in rows {
        // On a busy host a message may be later than the end; not where the end waits for it.
        let all = row[0] != "centralized" || (row[3], row[4], row[9]) == ("20", "0", "0");
        assert!(all, "every sequence came in order: {csv}");
        let offset = match row[0] {
            "centralized" => "",
            "decentralized" => "0",
            _ => "6000000",
        };
        assert_eq!(row[2], offset, "{csv}");
    }
    for chart in ["offset.svg", "period.svg"] {
        let svg = fs::read_to_string(out.path().join(chart)).unwrap();
        assert!(svg.contains("<polyline"), "{svg}");
    }
}
