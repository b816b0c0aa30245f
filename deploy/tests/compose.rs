//! Compose files as text: what stands in them, and who gets none.

#![expect(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use std::path::PathBuf;

use ictus_coord::plan::{FederatePlan, Plan};
use ictus_deploy::compose::image::{ImageSource, REPOSITORY};
use ictus_deploy::compose::{Compose, ComposeError, ComposeOptions};
use ictus_deploy::placement::ImageBuild;
use ictus_deploy::{Checked, Deploy, FederateKind, FederateRun, Placement, Settings, TimingSpec};
use proptest::prelude::*;

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

fn checked(federation: &str, names: &[&str]) -> Checked {
    let federate = |name: &&str| FederatePlan {
        name: (*name).to_owned(),
        program: Some("demo".to_owned()),
        ..FederatePlan::default()
    };
    Checked {
        manifest: PathBuf::from("/home/ann/federation.yaml"),
        plan: Plan {
            federation: federation.to_owned(),
            federates: names.iter().map(federate).collect(),
            ..Plan::default()
        },
        offsets: None,
        federates: (0_u16..)
            .zip(names)
            .map(|(id, name)| run(id, name))
            .collect(),
        deploy: Deploy::default(),
        placement: None,
        settings: Settings::default(),
        timing: TimingSpec::default(),
        one_program: None,
        warnings: Vec::new(),
    }
}

fn plain(checked: &Checked) -> Result<Compose, ComposeError> {
    Compose::of(checked, &ComposeOptions::default())
}

#[test]
fn images_are_named_after_federation_and_program_and_each_is_made_once() {
    let compose = plain(&checked("demo", &["a", "b"])).unwrap();
    let names: Vec<_> = compose.images.iter().map(|it| &it.reference).collect();
    let expected = ["ictus", "program.demo"].map(|what| format!("{REPOSITORY}:demo.{what}"));
    assert_eq!(names, expected.each_ref());
    assert_eq!(compose.images[0].source, ImageSource::Ictus);
    assert!(expected.iter().all(|name| compose.text.contains(name)));
    // A name that is too long for a tag has a digest in its place.
    let long = plain(&checked(&"x".repeat(64), &[&"y".repeat(64)])).unwrap();
    let mut long = long.images.iter().map(|it| it.reference.len());
    assert!(long.all(|length| length <= REPOSITORY.len() + 1 + 128));
}

#[test]
fn the_id_is_asked_for_when_it_is_a_key() {
    let mut federation = checked("demo", &["a"]);
    let open = plain(&federation).unwrap().text;
    assert!(open.contains("${ICTUS_FEDERATION_ID:-demo}"), "{open}");
    federation.plan.authentication = true;
    let closed = plain(&federation).unwrap().text;
    assert!(!closed.contains(":-demo"), "{closed}");
    assert!(closed.contains("${ICTUS_FEDERATION_ID:?"), "{closed}");
}

#[test]
fn what_cannot_be_a_compose_file_is_refused() {
    let mut federation = checked("demo", &["prometheus"]);
    let options = ComposeOptions {
        monitoring: true,
        trace: None,
    };
    assert_eq!(
        Compose::of(&federation, &options),
        Err(ComposeError::NameTaken("prometheus".to_owned()))
    );
    assert!(plain(&federation).is_ok());
    let text = serde_json::Value::from("x".repeat(200_000));
    let parameters = &mut federation.plan.federates[0].parameters;
    parameters.insert("map".to_owned(), text);
    assert!(matches!(
        plain(&federation),
        Err(ComposeError::LargePlan(200_000..))
    ));
    let mut federation = checked("demo", &["a"]);
    let host = |name: &str| serde_json::json!({ "name": name, "way": "local", "address": "10.0.0.1", "engine": "docker", "ports": null });
    let placement =
        serde_json::json!({ "hosts": [host("h1"), host("h2")], "rti": 0, "federates": [1] });
    federation.placement = Some(serde_json::from_value::<Placement>(placement).unwrap());
    let said = plain(&federation).unwrap_err().to_string();
    assert!(said.ends_with("runs on 2: h1, h2"), "{said}");
    federation.placement = None;
    federation.federates.clear();
    assert_eq!(plain(&federation), Err(ComposeError::NotBuilt));
}

proptest! {
    /// Whatever a variable has: Compose reads it back as it was, and fills in nothing.
    #[test]
    fn variables_arrive_as_they_are(value in "(?s)[ -~\n\t\u{e9}]{0,20}|\\$\\{[A-Z]{1,3}\\}|yes|0x1|1:30|~") {
        let mut federation = checked("demo", &["a"]);
        federation.federates[0].env.insert("X".to_owned(), value.clone());
        let compose = plain(&federation).unwrap();
        prop_assert_eq!(&plain(&federation).unwrap(), &compose);
        let read: serde_json::Value = serde_saphyr::from_str(&compose.text).unwrap();
        let text = read["services"]["a"]["environment"]["X"].as_str().unwrap();
        prop_assert_eq!(text.replace("$$", "\u{0}").contains('$'), false);
        prop_assert_eq!(text.replace("$$", "$"), value);
        let plan = read["services"]["a"]["environment"]["ICTUS_PLAN"].as_str().unwrap();
        let plan: Plan = serde_json::from_str(&plan.replace("$$", "$")).unwrap();
        prop_assert_eq!(plan, federation.plan);
    }
}

#[test]
fn compose_builds_what_the_manifest_has_built() {
    let mut checked = checked("demo", &["a"]);
    checked.federates[0].kind = FederateKind::Foreign { args: Vec::new() };
    checked.federates[0].needs.build = Some(ImageBuild {
        context: "/home/ann/camera".into(),
        dockerfile: "Dockerfile".to_owned(),
    });
    let compose = plain(&checked).unwrap();
    // Nobody else makes it.
    assert_eq!(compose.images.len(), 1, "the RTI's alone");
    for words in [
        "context: /home/ann/camera",
        "dockerfile: Dockerfile",
        &format!("{REPOSITORY}:demo.federate.a"),
    ] {
        assert!(compose.text.contains(words), "{words}: {}", compose.text);
    }
}
