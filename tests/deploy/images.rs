//! Federates in images of their own: sent without a registry, built, pulled, refused.

#![expect(
    clippy::unwrap_used,
    clippy::panic,
    reason = "a test stops at the first surprise"
)]

use std::fs::{self, File};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use ictus_deploy::image::{Archive, ImageConfig};
use ictus_tests::rig::{Host, Rig};
use ictus_tests::{root, said};
use serde_json::Value;

use super::Scenario;
use super::operator::{Operator, target};
use super::rows::{foreign_program, program_of};

/// In this order.
pub(crate) const SCENARIOS: &[Scenario] = &[
    (
        "an_image_is_sent_without_a_registry_and_only_what_is_missing",
        an_image_is_sent_without_a_registry_and_only_what_is_missing,
    ),
    (
        "an_image_is_built_where_it_is_deployed_from",
        an_image_is_built_where_it_is_deployed_from,
    ),
    (
        "an_image_that_is_nowhere_or_for_another_processor_is_said",
        an_image_that_is_nowhere_or_for_another_processor_is_said,
    ),
];

/// Images of this machine's engine that are made here; all go with the value.
struct Workshop {
    label: String,
    folder: PathBuf,
}

impl Workshop {
    /// A folder of which an image is built that runs one federate of ours as if it were a foreign one: it gets what a Lingua
    /// Franca federate gets, and reads its plan from the image.
    fn new(operator: &Operator<'_>) -> Self {
        let folder = operator.home.path().join("viewer");
        fs::create_dir(&folder).unwrap();
        let text = manifest(
            None,
            &program_line(operator),
            "class: Faulty, parameters: { at: 0 }",
        );
        let planned = operator.run(&[
            "plan",
            &operator.manifest("alone.yaml", &text),
            "-o",
            "json",
        ]);
        let planned: Value = serde_json::from_slice(&planned.stdout)
            .unwrap_or_else(|_| panic!("{}", said(&planned)));
        fs::write(folder.join("plan.json"), planned["plan"].to_string()).unwrap();
        fs::copy(program_of(operator), folder.join("canary")).unwrap();
        let workshop = Self {
            label: format!("ictus.test={}", root().display()),
            folder,
        };
        workshop.change("one");
        workshop
    }

    /// Another upper layer.
    fn change(&self, what: &str) {
        fs::write(self.folder.join("note"), what).unwrap();
        let text = format!(
            "FROM scratch\nLABEL {}\nCOPY canary plan.json /\nCOPY note /note\n\
             ENTRYPOINT [\"/canary\", \"--plan\", \"/plan.json\", \"--federate\", \"viewer\"]\n",
            self.label
        );
        fs::write(self.folder.join("Dockerfile"), text).unwrap();
    }

    fn build(&self, name: &str) {
        docker(&[
            "build",
            "--quiet",
            "--tag",
            name,
            self.folder.to_str().unwrap(),
        ]);
    }
}

impl Drop for Workshop {
    fn drop(&mut self) {
        let label = format!("label={}", self.label);
        let listed = Command::new("docker")
            .args(["images", "--quiet", "--all", "--filter", &label])
            .output();
        let listed = listed.map(|it| String::from_utf8_lossy(&it.stdout).into_owned());
        for image in listed.unwrap_or_default().lines() {
            drop(
                Command::new("docker")
                    .args(["rmi", "--force", image])
                    .output(),
            );
        }
    }
}

/// `docker ARGS` on this machine.
fn docker(args: &[&str]) -> String {
    let output = Command::new("timeout")
        .args(["100", "docker"])
        .args(args)
        .env("DOCKER_BUILDKIT", "0")
        .output()
        .unwrap();
    assert!(
        output.status.success(),
        "docker {args:?}: {}",
        said(&output)
    );
    String::from_utf8(output.stdout).unwrap()
}

fn program_line(operator: &Operator<'_>) -> String {
    format!("binary: {}", program_of(operator).display())
}

/// A federate of ours and one that is given, on a host or on this machine.
fn manifest(host: Option<&Host>, program: &str, viewer: &str) -> String {
    let hosts = host.map_or_else(String::new, |host| {
        let at = target(host);
        format!(
            "hosts:\n  {}: {{ ssh: \"{at}\", engine: docker }}\nsecurity: trusted-network\n",
            host.name
        )
    });
    format!(
        "ictus: v1\nfederation: gallery\nlet: {{ at: 0 }}\n{hosts}programs:\n  canary: {{ {program} }}\n\
         federates:\n  ticker: {{ class: Faulty, parameters: {{ at: $at }} }}\n  viewer: {{ {viewer} }}\n"
    )
}

/// The names of a host's images that were sent.
fn sent(host: &Host) -> Vec<String> {
    let names = host.docker(&["images", "--format", "{{.Repository}}:{{.Tag}}"]);
    let sent = names.lines().filter(|name| name.starts_with("ictus-sent:"));
    sent.map(str::to_owned).collect()
}

fn an_image_is_sent_without_a_registry_and_only_what_is_missing(rig: &Rig) {
    let hosts = &rig.hosts()[..1];
    let operator = Operator::new(rig);
    operator.add(hosts);
    let workshop = Workshop::new(&operator);
    // The engine is that of all work trees.
    let name = &format!("ictus-gallery-viewer:{}", operator.rig.name());
    workshop.build(name);
    let viewer = format!("image: \"{name}\", id: 1");
    let text = manifest(Some(&hosts[0]), &program_line(&operator), &viewer);
    let file = operator.manifest("gallery.yaml", &text);
    let first = operator.ok(&["up", &file]);
    assert!(first.contains("(2 of 2 layers)"), "{first}");
    let parts = operator.parts(&file);
    assert!(
        parts.iter().all(|part| part["state"] == "running"),
        "{parts:?}"
    );
    let running = hosts[0].docker(&["ps", "--format", "{{.Image}} {{.Names}}"]);
    assert!(
        running
            .lines()
            .any(|line| line.starts_with("ictus-sent:gallery-") && line.contains("viewer")),
        "{running}"
    );
    let again = operator.ok(&["up", &file]);
    assert!(again.contains("already running"), "{again}");
    // Another parameter of another federate: nothing is sent.
    let changed = operator.ok(&["up", &file, "--set", "at=1000000"]);
    assert!(changed.contains(" 0 B sent"), "{changed}");
    let before = sent(&hosts[0]);
    assert_eq!(before.len(), 1, "{before:?}");
    // Another upper layer under the same name: it alone is sent, and a generation before keeps its own.
    workshop.change("two");
    workshop.build(name);
    let layer = operator.ok(&["up", &file, "--set", "at=1000000"]);
    assert!(layer.contains("(1 of 2 layers)"), "{layer}");
    let bytes = layer.lines().find(|line| line.contains("(1 of 2 layers)"));
    assert!(
        bytes.is_some_and(|line| line.contains(" B (") || line.contains(".")),
        "{layer}"
    );
    assert!(
        bytes.is_some_and(|line| !line.contains(" MB (")),
        "one small layer: {layer}"
    );
    // The one before is kept for `ictus rollback`.
    let after = sent(&hosts[0]);
    assert_eq!(after.len(), 2, "{after:?}");
    assert!(after.contains(&before[0]), "{after:?}");
    operator.ok(&["down", &file, "--purge"]);
    assert_eq!(hosts[0].docker(&["images", "--quiet"]), "");
    operator.remove(hosts);
}

fn an_image_is_built_where_it_is_deployed_from(rig: &Rig) {
    let hosts = &rig.hosts()[..1];
    let operator = Operator::new(rig);
    operator.add(hosts);
    let workshop = Workshop::new(&operator);
    let text = manifest(
        Some(&hosts[0]),
        &program_line(&operator),
        "build: { context: viewer }, id: 1",
    );
    let file = operator.manifest("gallery.yaml", &text);
    let first = operator.ok(&["up", &file]);
    assert!(first.contains("(2 of 2 layers)"), "{first}");
    let again = operator.ok(&["up", &file]);
    assert!(again.contains("already running"), "{again}");
    operator.ok(&["down", &file, "--purge"]);
    // What is wrong with a build is said in its own words, before any host is touched.
    let text = format!("FROM scratch\nLABEL {}\nCOPY nothing /\n", workshop.label);
    fs::write(workshop.folder.join("Dockerfile"), text).unwrap();
    let said = operator.fails(&["up", &file], 1);
    for words in ["federate `viewer` cannot be built", "COPY", "nothing"] {
        assert!(said.contains(words), "{words} is missing in {said}");
    }
    fs::remove_file(workshop.folder.join("Dockerfile")).unwrap();
    let said = operator.fails(&["up", &file], 3);
    assert!(said.contains("there is no `Dockerfile` in"), "{said}");
    operator.remove(hosts);
}

fn an_image_that_is_nowhere_or_for_another_processor_is_said(rig: &Rig) {
    let hosts = &rig.hosts()[..1];
    let operator = Operator::new(rig);
    operator.add(hosts);
    let workshop = Workshop::new(&operator);
    let up = |viewer: &str| {
        let text = manifest(Some(&hosts[0]), &program_line(&operator), viewer);
        let file = operator.manifest("gallery.yaml", &text);
        operator.fails(&["up", &file], 1)
    };
    // Nobody answers there, so that nothing is asked of the world.
    let said = up("image: \"127.0.0.1:1/nowhere/none:1\", id: 1");
    for words in [
        "host `h1`",
        "127.0.0.1:1/nowhere/none:1 is not on this host",
        "cannot be pulled",
        "everything was undone",
    ] {
        assert!(said.contains(words), "{words} is missing in {said}");
    }
    let archive = archive_of_another(&workshop, &foreign_program(&operator));
    let loaded = docker(&["load", "--quiet", "--input", archive.to_str().unwrap()]);
    let name = loaded.trim().rsplit_once(' ').unwrap().1;
    let said = up(&format!("image: \"{name}\", id: 1"));
    for words in [
        "host `h1` is x86_64, but image ictus:",
        "of federate `viewer` is for aarch64",
    ] {
        assert!(said.contains(words), "{words} is missing in {said}");
    }
    assert_eq!(hosts[0].docker(&["images", "--quiet"]), "");
    operator.remove(hosts);
}

/// An image of a program for another processor, as a file.
fn archive_of_another(workshop: &Workshop, program: &Path) -> PathBuf {
    let (name, value) = workshop.label.split_once('=').unwrap();
    let labels = [(name.to_owned(), value.to_owned())].into();
    let archive = Archive::of(program, &ImageConfig { labels }).unwrap();
    let path = workshop.folder.join("foreign.tar");
    archive.write_to(File::create(&path).unwrap()).unwrap();
    fs::set_permissions(&path, fs::Permissions::from_mode(0o644)).unwrap();
    path
}
