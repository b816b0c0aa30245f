//! Timing reports from files written by hand: every figure below can be worked out on paper.
#![allow(clippy::unwrap_used, missing_docs, reason = "tests may fail loudly")]

use std::fs;
use std::path::PathBuf;

use ictus_coord::plan::Plan;
use ictus_deploy::TimingSpec;
use ictus_deploy::timing::{
    ChainSpec, HopSpec, OrderSpec, PairsSpec, ReactionRef, TimingError, report, report_runs,
};

const MS: i64 = 1_000_000;

fn reaction(path: &str, index: u32, name: &str) -> ReactionRef {
    let federate = path.split('.').next().unwrap().to_owned();
    ReactionRef {
        federate,
        path: path.to_owned(),
        index,
        name: name.to_owned(),
    }
}

fn hop(reactions: Vec<ReactionRef>, delay_ns: i64, sampled: bool) -> HopSpec {
    HopSpec {
        reactions,
        delay_ns,
        delay_microsteps: 0,
        sampled,
    }
}

fn plan() -> Plan {
    Plan {
        federation: "diamond".to_owned(),
        timeout_ns: Some(400 * MS),
        extensions: true,
        ..Plan::default()
    }
}

/// Lines `time_ms microstep path index start_us end_us`, as a timing file.
fn write(dir: &tempfile::TempDir, federate: &str, lines: &[(i64, u32, &str, u32, i64, i64)]) {
    let text: String = lines
        .iter()
        .map(|(time, microstep, path, index, start, end)| {
            let (time, start, end) = (time * MS, start * 1_000, end * 1_000);
            format!("{time}\t{microstep}\t{path}\t{index}\t{start}\t{end}\n")
        })
        .collect();
    fs::write(
        dir.path().join(format!("{federate}.timing")),
        format!("# header\n{text}"),
    )
    .unwrap();
}

/// A diamond of four ticks with 10 ms on the way: tick 1 runs the second reaction first, tick 2 lacks one, and
/// tick 4 is cut by the end.
fn diamond() -> (tempfile::TempDir, TimingSpec) {
    let dir = tempfile::tempdir().unwrap();
    let ticks = [
        (0, 0, 50, 1_050),
        (100, 0, 100_060, 101_060),
        (200, 0, 200_070, 201_070),
    ];
    let mut a: Vec<_> = ticks
        .iter()
        .map(|&(t, m, s, e)| (t, m, "a", 0, s, e))
        .collect();
    a.push((400, 0, "a", 0, 400_080, 401_080));
    write(&dir, "a", &a);
    write(
        &dir,
        "d",
        &[
            (10, 0, "d", 0, 12_000, 13_000),
            (10, 0, "d", 1, 13_000, 14_050),
            (110, 0, "d", 1, 112_000, 113_000),
            (110, 0, "d", 0, 113_000, 114_060),
            (210, 0, "d", 0, 212_000, 214_070),
        ],
    );
    let (gamma, delta) = (reaction("d", 0, "on_gamma"), reaction("d", 1, "on_delta"));
    let spec = TimingSpec {
        order: vec![OrderSpec {
            first: gamma.clone(),
            second: delta.clone(),
        }],
        pairs: Vec::new(),
        end_to_end: vec![ChainSpec {
            name: "a to d".to_owned(),
            source: reaction("a", 0, "tick"),
            hops: vec![hop(vec![gamma, delta], 10 * MS, false)],
        }],
    };
    (dir, spec)
}

#[test]
fn the_diamond_is_reported() {
    let (dir, spec) = diamond();
    let found = report(dir.path(), &spec, &plan()).unwrap();
    let order = found.order[0].runs[0];
    assert_eq!(
        (
            order.tags,
            order.first_first,
            order.second_first,
            order.missing
        ),
        (3, 1, 1, 1)
    );
    let run = found.end_to_end[0].runs[0];
    assert_eq!((run.ticks, run.missing, run.unfinished), (4, 0, 1));
    let full = run.full.unwrap();
    assert_eq!((full.count, full.std_ms.to_bits()), (3, 0.0_f64.to_bits()));
    assert_eq!(
        found.to_string(),
        "\
order at each tag: d.on_gamma before d.on_delta
  33.3 % of 3 tags, 1 the other way, 1 missing

end to end: a to d
                                    n     mean      std      p50      p99      max  ms
  end to end                        3   14.000    0.000   14.000   14.000   14.000
  timer floor                       4    0.065    0.013    0.060    0.080    0.080
  4 ticks, 0 missing, 1 cut by the end"
    );
    let json = serde_json::to_value(&found).unwrap();
    assert_eq!(json["end_to_end"][0]["runs"][0]["full"]["count"], 3);
}

/// A tag that D never saw shows as missing, not as a latency of two periods.
#[test]
fn a_lost_sample_is_missing() {
    let (dir, mut spec) = diamond();
    let path = dir.path().join("d.timing");
    let text = fs::read_to_string(&path).unwrap();
    let kept: Vec<&str> = text
        .lines()
        .filter(|line| !line.starts_with("110000000"))
        .collect();
    fs::write(&path, kept.join("\n") + "\n").unwrap();
    let run = report(dir.path(), &spec, &plan()).unwrap().end_to_end[0].runs[0];
    assert_eq!((run.ticks, run.missing, run.unfinished), (4, 1, 1));
    // Without the second hop's delay nothing changes: the first tag at which D runs is taken.
    spec.end_to_end[0].hops[0].delay_ns = 0;
    let run = report(dir.path(), &spec, &plan()).unwrap().end_to_end[0].runs[0];
    assert_eq!(run.full.unwrap().max_ms.to_bits(), 14.0_f64.to_bits());
}

/// The planner's timer runs first at a tag, so the sample of a tag is taken one period later.
#[test]
fn a_sampled_hop_is_strictly_later() {
    let dir = tempfile::tempdir().unwrap();
    write(
        &dir,
        "lidar",
        &[
            (0, 0, "lidar", 0, 100, 110),
            (100, 0, "lidar", 0, 100_100, 100_110),
        ],
    );
    write(
        &dir,
        "planner",
        &[
            (0, 0, "planner", 0, 50, 60),
            (0, 0, "planner", 1, 400, 410),
            (100, 0, "planner", 0, 100_050, 100_060),
            (100, 0, "planner", 1, 100_400, 100_410),
        ],
    );
    write(
        &dir,
        "vehicle",
        &[
            (0, 0, "vehicle", 0, 500, 900),
            (100, 0, "vehicle", 0, 100_500, 100_900),
        ],
    );
    let spec = TimingSpec {
        end_to_end: vec![ChainSpec {
            name: "lidar to command".to_owned(),
            source: reaction("lidar", 0, "tick"),
            hops: vec![
                hop(vec![reaction("planner", 1, "on_input")], 0, false),
                hop(vec![reaction("planner", 0, "tick")], 0, true),
                hop(vec![reaction("vehicle", 0, "on_first")], 0, false),
            ],
        }],
        ..TimingSpec::default()
    };
    let run = report(dir.path(), &spec, &plan()).unwrap().end_to_end[0].runs[0];
    assert_eq!((run.ticks, run.missing, run.unfinished), (2, 0, 1));
    assert_eq!(run.full.unwrap().max_ms.to_bits(), 100.8_f64.to_bits());
}

#[test]
fn pairs_that_change_their_order_between_runs_drift() {
    let planner = |dir: &tempfile::TempDir, flip: bool| {
        let mut lines = Vec::new();
        for tick in 0..5 {
            let (time, base) = (tick * 100, tick * 100_000);
            let (x, y) = if flip && tick < 3 {
                (200, 100)
            } else {
                (100, 200)
            };
            lines.push((time, 0, "p", 0, base, base + 10));
            lines.push((time, 0, "p.cache[0]", 0, base + x, base + x + 10));
            lines.push((time, 0, "p.cache[1]", 0, base + y, base + y + 10));
        }
        write(dir, "p", &lines);
    };
    let (steady, changed) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    planner(&steady, false);
    planner(&changed, true);
    let spec = TimingSpec {
        pairs: vec![PairsSpec {
            name: "inputs".to_owned(),
            tick: reaction("p", 0, "tick"),
            reactions: vec![
                reaction("p.cache[0]", 0, "keep"),
                reaction("p.cache[1]", 0, "keep"),
            ],
        }],
        ..TimingSpec::default()
    };
    let dirs = |all: &[&tempfile::TempDir]| -> Vec<PathBuf> {
        all.iter().map(|dir| dir.path().to_path_buf()).collect()
    };
    let same = report_runs(&dirs(&[&steady, &steady]), &spec, &plan()).unwrap();
    assert_eq!((same.pairs[0].drifting, same.pairs[0].flipped), (0, 0));
    let other = report_runs(&dirs(&[&steady, &changed]), &spec, &plan()).unwrap();
    assert_eq!(
        other.to_string(),
        "\
order of pairs: inputs (4, 4 ticks)
  p.cache[0].keep before p.cache[1].keep  100.0 %  25.0 %  drift 75.0
  1 of 1 pairs drift, 1 flip"
    );
}

#[test]
fn wrong_files_are_named() {
    let (dir, spec) = diamond();
    fs::write(dir.path().join("x.timing"), "0\t0\ta\tone\n").unwrap();
    let error = report(dir.path(), &spec, &plan()).unwrap_err().to_string();
    assert!(
        error.ends_with("x.timing:1: not a timing record: no index"),
        "{error}"
    );
    let nothing = report(dir.path(), &TimingSpec::default(), &plan());
    assert!(matches!(nothing, Err(TimingError::NothingAsked)));
}
