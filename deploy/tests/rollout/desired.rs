//! What the digest of a manifest depends on, and what not.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};

use ictus_coord::plan::{FederatePlan, Plan};
use ictus_deploy::placement::{SecretSource, Security, Way};
use ictus_deploy::rollout::{Desired, DesiredError, ProgramFile};
use ictus_deploy::{
    Checked, Engine, FederateKind, FederateRun, HostSpec, Needs, Placement, Settings, TimingSpec,
};

fn host(name: &str, last: u8) -> HostSpec {
    HostSpec {
        name: name.to_owned(),
        way: Way::Ssh {
            target: format!("robot@10.0.0.{last}"),
            client: ictus_deploy::placement::SshClient::Ssh2,
            identity: Some(PathBuf::from("/home/ann/.ssh/id")),
        },
        address: Ipv4Addr::new(10, 0, 0, last),
        engine: Engine::Process,
        ports: None,
    }
}

fn run(id: u16, name: &str) -> FederateRun {
    serde_json::from_value(serde_json::json!({
        "id": id,
        "name": name,
        "executable": "/home/ann/target/demo",
        "kind": FederateKind::Ours,
        "env": {},
    }))
    .unwrap()
}

fn checked() -> Checked {
    let federate = |name: &str| FederatePlan {
        name: name.to_owned(),
        program: Some("demo".to_owned()),
        ..FederatePlan::default()
    };
    Checked {
        manifest: PathBuf::from("/home/ann/federation.yaml"),
        plan: Plan {
            federation: "demo".to_owned(),
            federates: vec![federate("a"), federate("b")],
            ..Plan::default()
        },
        offsets: None,
        federates: vec![run(0, "a"), run(1, "b")],
        deploy: ictus_deploy::Deploy::default(),
        placement: Some(Placement {
            hosts: vec![host("nuc", 1), host("pi", 2)],
            rti: 0,
            federates: vec![0, 1],
            security: Security::Mtls,
        }),
        settings: Settings::default(),
        timing: TimingSpec::default(),
        one_program: None,
        warnings: Vec::new(),
    }
}

fn file(_: &Path) -> io::Result<ProgramFile> {
    Ok(ProgramFile {
        digest: "5ee".to_owned(),
        bytes: 9,
        arch: "x86_64".to_owned(),
    })
}

fn desired(checked: &Checked) -> Desired {
    Desired::of(checked, false, &mut file).unwrap()
}

/// The facets that a change touches.
fn touched(change: impl FnOnce(&mut Checked)) -> Vec<String> {
    let (before, mut after) = (desired(&checked()), checked());
    change(&mut after);
    let after = desired(&after);
    let all = before.facets.keys().chain(after.facets.keys());
    let touched: BTreeSet<&String> = all
        .filter(|key| before.facets.get(*key) != after.facets.get(*key))
        .collect();
    assert_eq!(touched.is_empty(), before.digest == after.digest);
    touched.into_iter().cloned().collect()
}

#[test]
fn each_host_has_its_part_and_programs() {
    let desired = desired(&checked());
    let nuc = &desired.hosts["nuc"];
    assert_eq!(
        (nuc.rti, nuc.federates.as_slice()),
        (true, ["a".to_owned()].as_slice())
    );
    assert_eq!(
        (nuc.blobs[0].bytes, nuc.blobs[0].digest.as_str()),
        (9, "5ee")
    );
    assert!(!desired.hosts["pi"].rti);
    assert_eq!((desired.federates(), desired.digest.len()), (2, 64));
    let mut here = checked();
    here.placement.as_mut().unwrap().hosts[0].way = Way::Local;
    assert!(self::desired(&here).hosts["nuc"].blobs.is_empty());
    let mut one = checked();
    one.placement.as_mut().unwrap().federates = vec![0, 0];
    assert_eq!(
        self::desired(&one).hosts["nuc"].blobs[0].federates,
        ["a", "b"]
    );
}

#[test]
fn paths_of_this_machine_and_secrets_do_not_count() {
    let secret = |source: SecretSource| {
        move |it: &mut Checked| {
            it.federates[0].needs.secrets = BTreeMap::from([("TOKEN".to_owned(), source)]);
        }
    };
    assert_eq!(
        touched(|it| it.manifest = "/elsewhere.yaml".into()),
        Vec::<String>::new()
    );
    assert_eq!(
        touched(|it| it.federates[0].executable = "/elsewhere".into()),
        Vec::<String>::new()
    );
    assert_eq!(
        touched(|it| it.placement.as_mut().unwrap().hosts[0].way = Way::Local),
        Vec::<String>::new()
    );
    assert_eq!(
        touched(secret(SecretSource::Environment)),
        ["federate/a/environment"]
    );
    let (mut one, mut other) = (checked(), checked());
    secret(SecretSource::Environment)(&mut one);
    secret(SecretSource::File("/home/ann/token".into()))(&mut other);
    assert_eq!(desired(&one), desired(&other));
}

#[test]
fn what_matters_counts_where_it_belongs() {
    let parameter = |it: &mut Checked| {
        it.plan.federates[1]
            .parameters
            .insert("gain".to_owned(), 2.into());
    };
    assert_eq!(touched(parameter), ["federate/b/parameters"]);
    assert_eq!(
        touched(|it| it.placement.as_mut().unwrap().security = Security::TrustedNetwork),
        ["security"]
    );
    assert_eq!(
        touched(|it| it.placement.as_mut().unwrap().federates[1] = 0),
        ["federate/b/host"]
    );
    assert_eq!(
        touched(|it| it.placement.as_mut().unwrap().rti = 1),
        ["rti/host"]
    );
    assert_eq!(
        touched(|it| it.placement.as_mut().unwrap().hosts[1].engine = Engine::Docker),
        ["host/pi"]
    );
    assert_eq!(touched(|it| it.plan.keepalive = true), ["coordination"]);
    assert_eq!(
        touched(|it| it.federates[0].needs = Needs {
            pids: Some(9),
            ..Needs::default()
        }),
        ["federate/a/needs"]
    );
    assert_eq!(
        touched(|it| {
            it.federates[0].env.insert("A".into(), "1".into());
        }),
        ["federate/a/environment"]
    );
    assert_eq!(touched(|it| it.settings.stop_grace *= 2), ["settings"]);
    let traced = Desired::of(&checked(), true, &mut file).unwrap();
    assert_ne!(traced.digest, desired(&checked()).digest);
}

#[test]
fn what_cannot_be_asked_for_says_why() {
    let mut nowhere = checked();
    nowhere.placement = None;
    assert!(matches!(
        Desired::of(&nowhere, false, &mut file),
        Err(DesiredError::NoHosts)
    ));
    let mut unbuilt = checked();
    unbuilt.federates.pop();
    let error = Desired::of(&unbuilt, false, &mut file).unwrap_err();
    assert_eq!(
        error.to_string(),
        "federate `b` was not built; check with building"
    );
    let mut gone = |_: &Path| Err(io::Error::from(io::ErrorKind::NotFound));
    let error = Desired::of(&checked(), false, &mut gone).unwrap_err();
    assert_eq!(
        error.to_string(),
        "cannot read the program of federate `a`, /home/ann/target/demo"
    );
}
