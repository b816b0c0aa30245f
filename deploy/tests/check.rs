//! `check` from the outside: manifests against a program that describes itself, and a corpus of bad ones.
#![allow(
    clippy::unwrap_used,
    clippy::panic,
    missing_docs,
    reason = "tests may fail loudly"
)]

use std::fs;
use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use ictus_coord::describe::{InstanceDescriptions, InstanceRequest, ProgramDescription};
use ictus_coord::measure::Upstream;
use ictus_coord::plan::{ClockPlan, ClockSync, Coordination, FORMAT, OnFailure, Wire};
use ictus_coord::report::{FederateMeasures, FederationMeasures};
use ictus_deploy::placement::{Realtime, RealtimePolicy, SecretSource, SshClient, Volume, Way};
use ictus_deploy::timing::suggest;
use ictus_deploy::{
    CheckOptions, Checked, Engine, FederateKind, Needs, PortRange, Problems, Progress, check,
};

#[path = "../testdata/classes.rs"]
mod classes;

/// A folder with a manifest and `bin/NAME` for every name the fake program knows.
struct Bench {
    dir: tempfile::TempDir,
}

impl Bench {
    fn new(manifest: &str) -> Self {
        let dir = tempfile::tempdir().unwrap();
        fs::write(dir.path().join("federation.yaml"), manifest).unwrap();
        fs::write(
            dir.path().join("radar.env"),
            "# of the radar\nGAIN='3'\nRUST_LOG=warn\n",
        )
        .unwrap();
        fs::write(
            dir.path().join("bad.env"),
            "A=1\nexport B=hunter2\nC\nA=hunter2\n",
        )
        .unwrap();
        fs::create_dir(dir.path().join("chart")).unwrap();
        fs::write(dir.path().join("chart/Dockerfile"), "FROM scratch\n").unwrap();
        fs::create_dir(dir.path().join("bin")).unwrap();
        let names = [
            "fake", "tools", "camera", "hang", "crash", "garbage", "flood", "old", "short",
        ];
        let first = dir.path().join("bin/fake");
        for name in names {
            let path = dir.path().join("bin").join(name);
            // A link, not a copy: it has a name of its own and costs nothing.
            if name == "fake" {
                fs::copy(fake_program(), &path).unwrap();
            } else {
                fs::hard_link(&first, &path).unwrap();
            }
        }
        Self { dir }
    }

    fn check(&self, options: &CheckOptions) -> Result<Checked, Problems> {
        check(
            &self.dir.path().join("federation.yaml"),
            options,
            &mut |_| {},
        )
    }

    /// What a person sees, with the folder taken out.
    fn shown(&self, options: &CheckOptions) -> String {
        let text = match self.check(options) {
            Ok(checked) => {
                let warnings: Vec<String> =
                    checked.warnings.iter().map(ToString::to_string).collect();
                format!("no mistake\n{}", warnings.join("\n\n"))
            }
            Err(problems) => problems.to_string(),
        };
        let dir = self.dir.path().display().to_string();
        text.replace(&format!("{dir}/./"), "")
            .replace(&format!("{dir}/"), "")
            + "\n"
    }
}

/// The example `fake_program`, which cargo builds beside the tests.
fn fake_program() -> PathBuf {
    let test = std::env::current_exe().unwrap();
    let profile = test.parent().unwrap().parent().unwrap();
    profile.join("examples/fake_program")
}

fn testdata() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("testdata")
}

/// The example of every key, with a program of ours in place of the cargo package.
fn example() -> String {
    let text = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("example.yaml"));
    let text = text.unwrap();
    let changed = text.replace("{ package: ./acc, bin: acc }", "{ binary: bin/fake }");
    assert_ne!(text, changed);
    changed
}

#[test]
fn the_example_is_a_federation() {
    let bench = Bench::new(&example());
    let checked = bench
        .check(&CheckOptions::default())
        .unwrap_or_else(|p| panic!("{p}"));
    let plan = &checked.plan;
    let names = plan.federates.iter().map(|one| one.name.as_str());
    assert!(names.eq(["radar", "planner", "logger", "camera", "viewer", "chart"]));
    assert_eq!(plan.timeout_ns, Some(10_000_000_000));
    assert!(plan.extensions);
    let wires: Vec<String> = plan
        .connections
        .iter()
        .map(|wire| {
            format!(
                "{}.{}[{}] {} {}.{}[{}] after {:?} {} #{}",
                wire.from.federate,
                wire.from.port,
                wire.from.channel,
                if wire.physical { "~>" } else { "->" },
                wire.to.federate,
                wire.to.port,
                wire.to.channel,
                wire.after_ns,
                wire.serializer,
                wire.port_id
            )
        })
        .collect();
    assert_eq!(
        wires,
        [
            "0.object[0] -> 1.object[0] after Some(5000000) postcard #0",
            "1.command[0] -> 2.command[0] after None native #0",
            "1.command[0] -> 2.copy[0] after None native #1",
            "1.wish[0] -> 3.trigger[0] after Some(0) native #0",
            "3.frame[0] ~> 1.frame[0] after None native #4",
            "0.points[0] -> 2.points[0] after None postcard #2",
            "0.points[1] -> 2.points[1] after None postcard #3",
        ]
    );
    assert_eq!(checked.one_program, None);
    assert_eq!(
        checked.federates[3].kind,
        FederateKind::Foreign {
            args: vec!["-x".into()]
        }
    );
    assert_eq!(checked.federates[0].env["RUST_LOG"], "info");
    assert_eq!(plan.federates[0].parameters["seed"], 7);
    let chain = &checked.timing.end_to_end[0];
    assert_eq!(
        (chain.source.path.as_str(), chain.source.index),
        ("radar", 0)
    );
    let hops: Vec<_> = chain
        .hops
        .iter()
        .map(|hop| {
            (
                hop.delay_ns,
                hop.delay_microsteps,
                hop.sampled,
                hop.reactions.len(),
            )
        })
        .collect();
    assert_eq!(hops, [(5_000_000, 0, true, 1), (0, 0, false, 2)]);
}

/// What the manifest says of coordination, clocks and policies stands in the plan.
#[test]
fn the_example_is_decentralized() {
    let bench = Bench::new(&example());
    let checked = bench
        .check(&CheckOptions::default())
        .unwrap_or_else(|p| panic!("{p}"));
    let plan = &checked.plan;
    assert_eq!(plan.coordination, Coordination::Decentralized);
    assert_eq!((plan.wire, plan.authentication), (Wire::V0_12, true));
    let clock = ClockPlan {
        sync: ClockSync::On,
        max_error_ns: Some(500_000),
        ..ClockPlan::default()
    };
    assert_eq!(plan.clock, clock);
    let listen = checked.settings.metrics_listen;
    assert_eq!(listen, Some("127.0.0.1:9464".parse().unwrap()));
    let [radar, planner, logger, camera, _viewer, _chart] = plan.federates.as_slice() else {
        panic!("{plan:?}")
    };
    assert_eq!(radar.test_clock_offset_ns, -50_000_000);
    assert_eq!(radar.test_clock_drift_ppb, 50_000);
    assert_eq!(planner.max_stp_violations, Some(10));
    assert_eq!(logger.max_stp_violations, None);
    assert_eq!(logger.on_failure, OnFailure::Continue);
    assert_eq!(planner.on_failure, OnFailure::StopFederation);
    let offsets = [radar, planner, logger, camera].map(|one| one.stp_offset_ns);
    assert_eq!(offsets, [0, 500_000, 7_500_000, 6_000_000]);
    let wires: Vec<_> = plan
        .connections
        .iter()
        .map(|wire| (wire.stp_offset_ns, wire.absent_after_ns))
        .collect();
    let own = (Some(8_000_000), 1_000_000);
    let points = (Some(5_500_000), 0);
    assert_eq!(
        wires,
        [
            (Some(500_000), 0),
            own,
            own,
            (None, 0),
            (None, 0),
            points,
            points
        ]
    );
    assert_eq!(
        checked.offsets.unwrap().to_string(),
        "\
radar 0 ms: no input to wait for
planner 0.5 ms = radar offset 0 + radar launch lag 1.0 + network 4.0 + clock 0.5 - after 5.0
logger 7.5 ms = planner offset 0.5 + planner launch lag 2.0 + network 4.0 + clock 1.0 - after 0
camera 6.0 ms as declared; required 6.0 ms = planner offset 0.5 + planner launch lag 2.0 + network 3.0 + clock 0.5 \
         - after 0\n\
viewer 0 ms: no input to wait for
chart 0 ms: no input to wait for"
    );
    let warnings: Vec<&str> = checked.warnings.iter().map(|one| one.code).collect();
    assert_eq!(warnings, ["W003"], "only `max_lead` has no effect");
}

/// The line of the issue, word for word.
#[test]
fn a_breakdown_names_every_term() {
    let bench = Bench::new(
        "ictus: v1\nfederation: f\ncoordination: decentralized\n\
         programs: { fake: { binary: bin/fake } }\n\
         bounds:\n  launch_lag: 200 us\n  latency: 600 us\n  clock_error: 100 us\n  \
         links: { planner -> brake: { launch_lag: 2 ms, latency: 3 ms, clock_error: 500 us } }\n\
         federates:\n  lidar: { class: Relay }\n  planner: { class: Relay }\n  brake: { class: Relay }\n\
         connections:\n  - { from: lidar.out, to: planner.input }\n  \
         - { from: planner.out, to: brake.input }\n",
    );
    let checked = bench.check(&CheckOptions::default());
    let offsets = checked.unwrap_or_else(|p| panic!("{p}")).offsets.unwrap();
    assert_eq!(
        offsets.to_string().lines().last().unwrap(),
        "brake 6.4 ms = planner offset 0.9 + planner launch lag 2.0 + network 3.0 + clock 0.5 - after 0"
    );
}

/// Which member runs where, and what it needs there.
#[test]
#[expect(clippy::too_many_lines, reason = "every key of the example")]
fn the_example_is_placed() {
    let bench = Bench::new(&example());
    let checked = bench
        .check(&CheckOptions::default())
        .unwrap_or_else(|p| panic!("{p}"));
    let placement = checked.placement.unwrap();
    let names: Vec<&str> = placement
        .hosts
        .iter()
        .map(|host| host.name.as_str())
        .collect();
    assert_eq!(names, ["bench", "nuc", "vision"]);
    assert_eq!(
        (placement.rti, placement.federates),
        (1, vec![1, 0, 0, 0, 2, 2])
    );
    let nuc = &placement.hosts[1];
    assert_eq!(nuc.address, Ipv4Addr::new(10, 0, 0, 11));
    assert_eq!(nuc.engine, Engine::Docker);
    let range = PortRange {
        first: 15_045,
        last: 15_099,
    };
    assert_eq!(nuc.ports, Some(range));
    let Way::Ssh {
        target,
        client,
        identity,
    } = &nuc.way
    else {
        panic!("{nuc:?}")
    };
    assert_eq!(
        (target.as_str(), *client),
        ("robot@10.0.0.11", SshClient::Ssh2)
    );
    assert!(identity.as_ref().unwrap().ends_with(".ssh/id_robots"));
    assert_eq!(placement.hosts[0].way, Way::Local);

    let radar = &checked.federates[0];
    let maps = Volume {
        host: "/data/maps".into(),
        at: "/maps".into(),
        read_only: true,
    };
    let home = PathBuf::from(std::env::var_os("HOME").unwrap());
    let secrets = [
        ("MAP_KEY".to_owned(), SecretSource::Environment),
        ("TOKEN".to_owned(), SecretSource::File(home.join(".radar"))),
    ];
    let needs = Needs {
        cpus: vec![0, 1],
        memory: Some(256 << 20),
        pids: Some(64),
        user: Some("1000:1000".into()),
        devices: vec!["/dev/ttyUSB0".into()],
        volumes: vec![maps],
        realtime: Some(Realtime {
            policy: RealtimePolicy::Fifo,
            priority: 60,
            lock_memory: true,
        }),
        secrets: secrets.into(),
        image: None,
        build: None,
    };
    assert_eq!(radar.needs, needs);
    assert_eq!(radar.env["GAIN"], "3");
    assert_eq!(radar.env["RUST_LOG"], "info", "`env` comes before files");
    let viewer = &checked.federates[4];
    assert_eq!(
        viewer.needs.image.as_deref(),
        Some("registry.lan/viewer:1.2")
    );
    assert_eq!(viewer.executable, PathBuf::new());
    let chart = checked.federates[5].needs.build.as_ref().unwrap();
    assert!(chart.context.is_absolute() && chart.context.ends_with("chart"));
    assert_eq!(chart.dockerfile, "Dockerfile");
    let portable: Vec<bool> = checked.federates.iter().map(|run| run.portable).collect();
    assert_eq!(
        portable,
        [true, true, false, false, false, false],
        "radar's program is the planner's too"
    );
}

/// A manifest of two federates, with more lines.
fn pair(more: &str) -> String {
    format!(
        "ictus: v1\nfederation: f\nprograms: {{ fake: {{ binary: bin/fake }} }}\n\
         federates: {{ a: {{ class: Relay }}, b: {{ class: Relay }} }}\n\
         connections: [{{ from: a.out, to: b.input }}]\n{more}"
    )
}

#[test]
fn one_host_has_everything_and_no_address() {
    let place = |more: &str| {
        let checked = Bench::new(&pair(more)).check(&CheckOptions::default());
        checked.unwrap_or_else(|p| panic!("{p}")).placement
    };
    assert_eq!(place(""), None);
    let placement = place("hosts: { nuc: { ssh: robot@nuc } }\n").unwrap();
    assert_eq!(placement.hosts[0].address, Ipv4Addr::LOCALHOST);
    assert_eq!((placement.rti, placement.federates), (0, vec![0, 0]));
    // Of two, the one on which nothing runs plays no part.
    let two = "hosts: { nuc: { ssh: robot@nuc }, bench: { local: true } }\nsecurity: trusted-network\n\
               defaults: { host: bench }\n";
    let placement = place(two).unwrap();
    assert_eq!(placement.hosts.len(), 1);
    assert_eq!(placement.hosts[0].way, Way::Local);
    // The address in `ssh` is the default; hosts on one machine may all be loopback.
    let three = "hosts: { c: { ssh: x@127.0.0.2:2201 }, b: { ssh: \"127.0.0.3\", ports: 15045 } }\n\
                 security: trusted-network\nrti: { host: b, port: 15045 }\ndefaults: { host: c }\n";
    let placement = place(three).unwrap();
    let addresses: Vec<u8> = placement
        .hosts
        .iter()
        .map(|host| host.address.octets()[3])
        .collect();
    assert_eq!(addresses, [3, 2]);
    assert_eq!((placement.rti, placement.federates), (0, vec![1, 1]));
}

#[test]
fn a_host_of_another_architecture_gets_no_program() {
    let other = match std::env::consts::ARCH {
        "aarch64" => "amd64",
        _ => "arm64",
    };
    let hosts = format!("hosts: {{ pi: {{ ssh: pi@10.0.0.7, arch: {other} }} }}\n");
    let shown = Bench::new(&pair(&hosts)).shown(&CheckOptions::default());
    let said = format!("`a` runs on `pi`, which is {other}");
    assert!(shown.contains(&said) && shown.contains("[F039]"), "{shown}");
    assert!(shown.contains("`rustup target add "), "{shown}");
    assert!(shown.contains("`apt-get install gcc-"), "{shown}");
}

/// The interpreter that a 64-bit ELF file names: the dynamic linker, if it needs one.
fn has_interpreter(executable: &Path) -> bool {
    let bytes = fs::read(executable).unwrap();
    let number = |at: usize, length: usize| {
        let digits = bytes[at..at + length].iter().rev();
        digits.fold(0_usize, |sum, byte| sum * 256 + usize::from(*byte))
    };
    let (table, size, count) = (number(0x20, 8), number(0x36, 2), number(0x38, 2));
    (0..count).any(|index| number(table + index * size, 4) == 3)
}

/// A program that goes to another host needs nothing there; it may use procedural macros. One that stays is as ever.
#[test]
fn a_program_that_travels_is_static() {
    let manifest = "ictus: v1\nfederation: f\nprograms: { p: { package: broken } }\n\
                    federates: { a: { class: Relay }, b: { class: Relay, MORE } }\nHOSTS\n";
    let describe = |bench: &Bench| {
        let classes = ProgramDescription {
            ictus: FORMAT.to_owned(),
            classes: classes::classes(),
        };
        let request = |name: &str| InstanceRequest {
            name: name.to_owned(),
            class: "Relay".to_owned(),
            parameters: serde_json::Map::new(),
        };
        let instances = InstanceDescriptions {
            ictus: FORMAT.to_owned(),
            instances: ["a", "b"]
                .map(|name| classes::instance(&request(name)))
                .into(),
        };
        let main = format!(
            "fn main() {{ let one = std::env::args().count() == 2; noop::noop!();\n\
             println!(\"{{}}\", if one {{ r####\"{}\"#### }} else {{ r####\"{}\"#### }}); }}\n",
            serde_json::to_string(&classes).unwrap(),
            serde_json::to_string(&instances).unwrap(),
        );
        package(bench, &main);
        let dir = bench.dir.path().join("broken");
        fs::create_dir_all(dir.join("noop/src")).unwrap();
        let noop = "[package]\nname = \"noop\"\nedition = \"2024\"\n[lib]\nproc-macro = true\n";
        fs::write(dir.join("noop/Cargo.toml"), noop).unwrap();
        let source = "#[proc_macro]\npub fn noop(_: proc_macro::TokenStream) -> proc_macro::TokenStream { Default::default() }\n";
        fs::write(dir.join("noop/src/lib.rs"), source).unwrap();
        let mut cargo = fs::read_to_string(dir.join("Cargo.toml")).unwrap();
        cargo.push_str("members = [\"noop\"]\n[dependencies]\nnoop = { path = \"noop\" }\n");
        fs::write(dir.join("Cargo.toml"), cargo).unwrap();
    };
    let table = [
        ("", "", false),
        ("hosts: { here: { local: true } }", "", false),
        ("hosts: { here: { local: true, engine: docker } }", "", true),
        (
            "hosts: { here: { local: true, address: 10.0.0.1 }, far: { ssh: x@10.0.0.2 } }\n\
             security: trusted-network\ndefaults: { host: here }",
            "host: far",
            true,
        ),
    ];
    let target = tempfile::tempdir().unwrap();
    for (hosts, more, portable) in table {
        let bench = Bench::new(&manifest.replace("HOSTS", hosts).replace("MORE", more));
        describe(&bench);
        let options = CheckOptions {
            target_dir: Some(target.path().to_owned()),
            release: false,
            ..CheckOptions::default()
        };
        let checked = bench.check(&options).unwrap_or_else(|p| panic!("{p}"));
        for run in &checked.federates {
            assert_eq!(run.portable, portable, "{hosts}");
            assert_eq!(has_interpreter(&run.executable), !portable, "{hosts}");
        }
        assert_eq!(
            checked.one_program.as_ref(),
            Some(&checked.federates[0].executable)
        );
    }
}

/// Under centralized coordination nothing is asked and nothing is written into the plan; what can be solved is told.
#[test]
fn centralized_plans_have_no_offsets() {
    let text = example().replace("coordination: decentralized", "coordination: centralized");
    let checked = Bench::new(&text).check(&CheckOptions::default());
    let checked = checked.unwrap_or_else(|p| panic!("{p}"));
    assert!(
        checked
            .plan
            .federates
            .iter()
            .all(|one| one.stp_offset_ns == 0)
    );
    assert_eq!(checked.offsets.unwrap().federates[2].used_ns, 7_500_000);
    let without = text.replace("\n  clock_error: 500 us ", "\n  # ");
    assert_ne!(text, without);
    let checked = Bench::new(&without).check(&CheckOptions::default());
    assert_eq!(checked.unwrap_or_else(|p| panic!("{p}")).offsets, None);
}

#[test]
fn let_values_can_be_overridden() {
    let bench = Bench::new(&example());
    let mut options = CheckOptions::default();
    options.overrides.insert("half".into(), "0 ms".into());
    let checked = bench.check(&options).unwrap_or_else(|p| panic!("{p}"));
    assert_eq!(checked.plan.connections[0].after_ns, Some(0));
    options.overrides.insert("hafl".into(), "0 ms".into());
    let shown = bench.shown(&options);
    assert!(shown.contains("did you mean `half`?"), "{shown}");
}

#[test]
fn without_build_nothing_runs() {
    let bench = Bench::new(&example().replace("bin/fake", "bin/hang"));
    let options = CheckOptions {
        build: false,
        ..CheckOptions::default()
    };
    let checked = bench.check(&options).unwrap_or_else(|p| panic!("{p}"));
    assert!(checked.federates.is_empty());
    assert_eq!(checked.plan.federates.len(), 6);
}

/// Every `testdata/bad/NAME.yaml` gives the text of `NAME.txt`; `UPDATE=1` writes it anew.
#[test]
fn bad_manifests_are_explained() {
    let options = CheckOptions {
        describe_timeout: Duration::from_millis(1500),
        ..CheckOptions::default()
    };
    let mut paths: Vec<PathBuf> = fs::read_dir(testdata().join("bad"))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| {
            path.extension()
                .is_some_and(|extension| extension == "yaml")
        })
        .collect();
    paths.sort();
    assert!(paths.len() >= 20);
    let mut wrong = String::new();
    for path in paths {
        let shown = Bench::new(&fs::read_to_string(&path).unwrap()).shown(&options);
        let golden = path.with_extension("txt");
        if std::env::var_os("UPDATE").is_some() {
            fs::write(&golden, &shown).unwrap();
        } else if fs::read_to_string(&golden).unwrap_or_default() != shown {
            wrong.push_str(&format!("=== {}\n{shown}\n", golden.display()));
        }
    }
    assert!(wrong.is_empty(), "{wrong}\nUPDATE=1 accepts what is shown");
}

/// A cargo package without dependencies, so that building it takes a second.
fn package(bench: &Bench, main: &str) {
    let dir = bench.dir.path().join("broken");
    fs::create_dir_all(dir.join("src")).unwrap();
    let manifest = "[package]\nname = \"broken\"\nedition = \"2024\"\n[workspace]\n";
    fs::write(dir.join("Cargo.toml"), manifest).unwrap();
    fs::write(dir.join("src/main.rs"), main).unwrap();
}

#[test]
fn a_program_that_does_not_build_shows_its_first_error() {
    let bench = Bench::new(
        "ictus: v1\nfederation: bad\nprograms: { broken: { package: broken } }\n\
         federates: { a: { class: Relay } }\n",
    );
    package(&bench, "fn main() { one(); two(); }\n");
    let target_dir = Some(bench.dir.path().join("target"));
    let options = CheckOptions {
        target_dir,
        release: false,
        ..CheckOptions::default()
    };
    let shown = bench.shown(&options);
    assert!(
        shown.starts_with("federation.yaml:3:13: program `broken` cannot be built"),
        "{shown}"
    );
    assert!(shown.contains("cannot find function `one`"), "{shown}");
    assert!(!shown.contains("cannot find function `two`"), "{shown}");

    package(&bench, "fn main() { println!(\"hello\"); }\n");
    let shown = bench.shown(&options);
    assert!(shown.contains("the output begins with `hello"), "{shown}");

    fs::write(bench.dir.path().join("broken/Cargo.toml"), "[package\n").unwrap();
    let shown = bench.shown(&options);
    assert!(shown.contains("cannot be built: error: "), "{shown}");
}

/// The two federations of the evaluation, as far as they can be read without their programs.
#[test]
fn the_shipped_manifests_have_the_form_of_their_papers() {
    let compose = Path::new(env!("CARGO_MANIFEST_DIR")).join("../compose");
    let read = |name: &str| {
        let options = CheckOptions {
            build: false,
            ..CheckOptions::default()
        };
        let manifest = compose.join(name).join("federation.yaml");
        check(&manifest, &options, &mut |_| {}).unwrap_or_else(|p| panic!("{p}"))
    };
    let diamond = read("diamond").plan;
    assert_eq!((diamond.federates.len(), diamond.connections.len()), (4, 4));
    assert!(
        diamond
            .connections
            .iter()
            .all(|wire| wire.after_ns == Some(5_000_000))
    );
    let autoware = read("autoware").plan;
    assert_eq!(
        (autoware.federates.len(), autoware.connections.len()),
        (24, 29)
    );
    let class = |name: &str| {
        autoware
            .federates
            .iter()
            .filter(|one| one.class.as_deref() == Some(name))
            .count()
    };
    let kinds = [
        "Sensor",
        "Transform",
        "Fusion",
        "Cyclic",
        "Intersection",
        "Command",
    ];
    assert_eq!(kinds.map(class), [6, 9, 5, 1, 1, 2]);
}

/// Foreign federates stand at the ids they were compiled with; ours fill the gaps in order.
#[test]
fn foreign_ids_come_first() {
    let bench = Bench::new(
        "ictus: v1\nfederation: f\nprograms: { fake: { binary: bin/fake } }\nfederates:\n  \
         a: { class: Relay }\n  x: { binary: bin/camera, id: 0 }\n  b: { class: Relay }\n  \
         y: { binary: bin/camera, id: 2, ports: { inputs: { i: { id: 7 } } } }\n\
         connections:\n  - { from: a.out, to: [b.input, y.i] }\n",
    );
    let mut said = Vec::new();
    let manifest = bench.dir.path().join("federation.yaml");
    let checked = check(&manifest, &CheckOptions::default(), &mut |one| {
        said.push(one);
    });
    let checked = checked.unwrap_or_else(|p| panic!("{p}"));
    let names: Vec<&str> = checked
        .federates
        .iter()
        .map(|run| run.name.as_str())
        .collect();
    assert_eq!(names, ["x", "a", "y", "b"]);
    let ids: Vec<u16> = checked.federates.iter().map(|run| run.id).collect();
    assert_eq!(ids, [0, 1, 2, 3]);
    let ports: Vec<(u16, u16)> = checked
        .plan
        .connections
        .iter()
        .map(|wire| (wire.to.federate, wire.port_id))
        .collect();
    assert_eq!(ports, [(3, 0), (2, 7)]);
    let executable = bench.dir.path().canonicalize().unwrap().join("bin/fake");
    let program = "fake".to_owned();
    assert_eq!(
        said,
        [
            Progress::Built {
                program: program.clone(),
                executable
            },
            Progress::Described {
                program,
                federates: 2
            }
        ]
    );
}

/// What `ictus timing --suggest` prints without synchronized clocks is a section with which the manifest has no mistake.
#[test]
fn a_suggestion_can_be_pasted() {
    let manifest = "ictus: v1\nfederation: f\nprograms: { fake: { binary: bin/fake } }\n\
        coordination: decentralized\nfederates:\n  a: { class: Relay }\n  b: { class: Relay, OFFSET }\n\
        connections:\n  - { from: a.out, to: b.input }\n";
    let first = Bench::new(&manifest.replace("OFFSET", "stp_offset: 50 ms"));
    let plan = first.check(&CheckOptions::default()).unwrap().plan;
    let mut upstream = Upstream::default();
    upstream
        .arrival
        .record(ictus_core::Duration::from_nanos(2_000_000));
    let mut measures = FederateMeasures::of("b");
    measures.upstreams.insert("a".to_owned(), upstream);
    let measures = FederationMeasures {
        federation: "f".to_owned(),
        federates: vec![measures],
    };
    let section = suggest(&plan, &measures, 20).to_string();
    let pasted = manifest.replace("OFFSET", "stp_offset: auto") + &section + "\n";
    let checked = Bench::new(&pasted).check(&CheckOptions::default());
    let plan = checked.unwrap_or_else(|p| panic!("{section}\n{p}")).plan;
    assert_eq!(plan.federates[1].stp_offset_ns, 2_400_000);
}
