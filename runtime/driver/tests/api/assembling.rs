//! Mistakes in plans, each with its words; what a program says of itself.

use crate::harness::World;
use ictus::prelude::*;
use ictus::{Class, describe};
use ictus_coord::FederateExecutor;
use ictus_coord::describe::InstanceRequest;
use ictus_core::{InputId, OutputId};

#[reactor]
struct Node {
    #[param]
    gain: f64,
    #[param(default = 5.ms())]
    period: Duration,
    #[param(default = vec![1, 2])]
    list: Vec<u8>,
    a: Input<u32>,
    b: Input<u32>,
    #[width = 2]
    wide: Multi<Input<u32>>,
    text: Input<String>,
    x: Output<u32>,
    y: Output<u32>,
}

#[reactions]
impl Node {
    #[reaction]
    fn on_a(&mut self, a: &Input<u32>, x: &mut Output<u32>) {
        x.set(*a.get().unwrap());
    }

    #[reaction]
    fn on_b(&mut self, _b: &Input<u32>, y: &mut Output<u32>) {
        y.set(0);
    }
}

fn world(parameters: &str) -> World {
    World::new(&[Class::of::<Node>()])
        .federate("n", "Node", parameters)
        .federate("m", "Node", r#"{ "gain": 1.0 }"#)
}

fn error(world: &World) -> String {
    world.assemble().unwrap_err().to_string()
}

const GOOD: &str = r#"{ "gain": 1.0 }"#;

#[test]
fn parameter_mistakes_name_the_parameter_and_what_is_expected() {
    let table = [
        ("{}", "parameter `gain` (f64) is required"),
        (
            r#"{ "gain": "much" }"#,
            "parameter `gain` (f64): invalid type: string \"much\", expected f64",
        ),
        (
            r#"{ "gain": 1, "period": 5 }"#,
            "parameter `period` (Duration): invalid type: integer `5`, expected a duration with a unit, such as \"100 ms\"",
        ),
        (
            r#"{ "gain": 1, "period": "5" }"#,
            "parameter `period` (Duration): `5` is not a duration; write a number and a unit: ns, us, ms, s, min or h, such as `100 ms`",
        ),
        (
            r#"{ "gian": 1 }"#,
            "there is no parameter `gian`; there are `gain`, `period`, `list`",
        ),
        (
            r#"{ "gain": 1, "list": [1, 300] }"#,
            "parameter `list` (Vec<u8>): invalid value: integer `300`, expected u8",
        ),
    ];
    for (parameters, expected) in table {
        let expected = format!("federate n (class Node): {expected}");
        assert_eq!(error(&world(parameters)), expected);
    }
}

#[test]
fn connection_mistakes_name_the_ports() {
    let table = [
        (("n.z", "m.a"), "federate n (class Node) has no output `z`"),
        (("n.x", "m.x"), "federate m (class Node) has no input `x`"),
        (
            ("n.x", "m.wide[2]"),
            "federate m (class Node) has no input `wide[2]`",
        ),
        (
            ("n.x", "m.text"),
            "n.x (u32) and m.text (String) have different types",
        ),
    ];
    for ((from, to), expected) in table {
        assert_eq!(error(&world(GOOD).connect(from, to, None)), expected);
    }
    let twice = world(GOOD)
        .connect("n.x", "m.a", None)
        .connect("n.y", "m.a", None);
    assert_eq!(
        error(&twice),
        "m.a has more than one incoming connection: n.x and n.y"
    );
    let unknown = World::new(&[Class::of::<Node>()]).federate("n", "Nod", "{}");
    assert_eq!(
        error(&unknown),
        "federate n: this program has no class `Nod`; it has Node"
    );
}

#[test]
fn a_causality_loop_names_its_ports() {
    let looped = world(GOOD)
        .connect("n.x", "m.a", None)
        .connect("m.x", "n.a", None);
    assert_eq!(
        error(&looped),
        "causality loop: m.on_a -> m.x -> n.on_a -> n.x -> m.on_a; \
         give one of its connections an `after` delay"
    );
}

#[test]
fn connections_to_other_processes_become_inputs_and_outputs() {
    let world = world(GOOD)
        .connect("n.x", "m.a", None)
        .connect("n.y", "m.b", Some(1.ms()))
        .connect("m.x", "n.a", Some(0.ms()));
    let mut sender = world.assemble_some(&[0]).unwrap();
    let mut receiver = world.assemble_some(&[1]).unwrap();
    assert_eq!((sender.inputs, sender.outputs), (vec![2], vec![0, 1]));
    assert_eq!(
        (&receiver.inputs, &receiver.outputs),
        (&vec![0, 1], &vec![2])
    );
    let delayed: Vec<_> = receiver
        .program
        .network_inputs()
        .iter()
        .map(|i| i.delayed)
        .collect();
    assert_eq!(delayed, [false, true]);
    // Nothing was set: nothing is written.
    let mut bytes = Vec::new();
    sender.bodies.encode(OutputId::new(0), &mut bytes);
    assert!(bytes.is_empty());
    let decoded = receiver.bodies.decode(InputId::new(0), &[1, 0, 0, 0]);
    assert!(decoded.is_ok());
    let error = receiver
        .bodies
        .decode(InputId::new(0), &[1, 0, 0])
        .unwrap_err();
    assert_eq!(
        error.to_string(),
        "message of 3 bytes for m.a is not a u32: 4 bytes expected, 3 left"
    );
}

#[test]
fn a_program_describes_its_classes() {
    let request = InstanceRequest {
        name: "n".to_owned(),
        class: "Node".to_owned(),
        parameters: serde_json::from_str(GOOD).unwrap(),
    };
    let node = describe::instance(&[Class::of::<Node>()], request);
    assert_eq!(node.error, None);
    let names = |ports: &[ictus_coord::describe::PortDescription]| -> Vec<String> {
        ports.iter().map(|p| p.name.clone()).collect()
    };
    assert_eq!(names(&node.inputs), ["a", "b", "wide", "text"]);
    assert_eq!(names(&node.outputs), ["x", "y"]);
    let widths: Vec<_> = node.inputs.iter().map(|p| p.width).collect();
    assert_eq!(widths, [None, None, Some(2), None]);
    assert_eq!(node.inputs[0].serializers, ["native", "postcard"]);
    assert_eq!(node.inputs[3].serializers, ["postcard"]);
    // Reactions of one reactor run in order: y waits for the reaction to a.
    let pairs = [("a", "x"), ("a", "y"), ("b", "y")];
    let pairs = pairs.map(|(input, output)| (input.to_owned(), output.to_owned()));
    assert_eq!(node.zero_delay, pairs);
    let reactions: Vec<_> = node
        .reactions
        .iter()
        .map(|r| (r.index, r.name.as_str()))
        .collect();
    assert_eq!(reactions, [(0, "on_a"), (1, "on_b")]);

    let program = describe::program(&[Class::of::<Node>()]);
    let class = &program.classes[0];
    assert_eq!(
        class.error.as_deref(),
        Some("parameter `gain` (f64) is required")
    );
    let required: Vec<_> = class
        .parameters
        .iter()
        .map(|p| (p.name.as_str(), p.required))
        .collect();
    assert_eq!(
        required,
        [("gain", true), ("period", false), ("list", false)]
    );
}

#[reactor]
struct Uneven {
    #[width = 2]
    ins: Multi<Input<u32>>,
    #[width = 3]
    outs: Multi<Output<u32>>,
}

#[reactions]
impl Uneven {
    #[connections]
    fn wire(c: &mut Wiring, ins: &Multi<Input<u32>>, outs: &Multi<Output<u32>>) {
        c.connect(ins, outs);
    }
}

#[test]
fn a_connection_of_different_widths_is_refused() {
    let uneven = World::of(Class::of::<Uneven>());
    assert_eq!(error(&uneven), "main: a connection joins 2 channels to 3");
}

#[reactor]
struct Inner {
    #[param]
    label: String,
    #[param(default = 0)]
    index: usize,
    input: Input<u32>,
    out: Output<u32>,
}

#[reactions]
impl Inner {
    #[reaction]
    fn pass(&mut self, input: &Input<u32>, out: &mut Output<u32>) {
        assert_eq!(self.label, format!("of {}", self.index));
        out.set(*input.get().unwrap());
    }
}

/// A bank whose members get parameters of the container, and a connection the wrong way round.
#[reactor]
struct Backwards {
    #[param(default = "of".to_owned())]
    prefix: String,
    input: Input<u32>,
    #[child(|i| Inner { label: format!("{prefix} {i}"), index: i })]
    #[width = 2]
    bank: Bank<Inner>,
    out: Output<u32>,
}

#[reactions]
impl Backwards {
    #[connections]
    fn wire(c: &mut Wiring, input: &Input<u32>, bank: &Bank<Inner>, out: &Output<u32>) {
        c.connect(&bank[0].input, input);
        c.connect(&bank[1].out, out);
    }
}

#[test]
fn a_connection_against_the_grain_is_refused() {
    let world = World::of(Class::of::<Backwards>());
    let error = world.assemble().unwrap_err().to_string();
    assert!(
        error.starts_with("main: no connection can go from main.bank[0].input"),
        "{error}"
    );
}
