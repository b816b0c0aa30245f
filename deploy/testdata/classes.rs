//! The classes of `example.yaml` and a few more, as the fake program and unit tests describe them.

use ictus_coord::describe::{
    ClassDescription, InstanceRequest, ParameterDescription, PortDescription, ReactionDescription,
    TypeIdentity,
};

/// What an instance looks like; empty for an unknown class.
pub(crate) fn instance(request: &InstanceRequest) -> ClassDescription {
    let known = classes()
        .into_iter()
        .find(|class| class.class == request.class);
    let mut class = known.unwrap_or_default();
    if let Some(width) = request.parameters.get("width") {
        match width.as_u64().and_then(|width| u32::try_from(width).ok()) {
            Some(width) => {
                for port in class.inputs.iter_mut().chain(&mut class.outputs) {
                    port.width = port.width.map(|_| width);
                }
            }
            None => class.error = Some(format!("parameter `width`: {width} is not a u32")),
        }
    }
    class
}

/// Every class.
pub(crate) fn classes() -> Vec<ClassDescription> {
    vec![
        class("Radar", &[("period", true), ("seed", false)])
            .outputs(&["object Object", "points Points[2]"])
            .reactions(&["tick"]),
        class("Planner", &[])
            .inputs(&["object Object", "frame u32"])
            .outputs(&["command f64", "wish u32"])
            .zero_delay(&[("object", "command")])
            .reactions(&["tick", "on_object", "on_frame"]),
        class("Logger", &[])
            .inputs(&["command f64", "copy f64", "points Points[2]"])
            .reactions(&["on_command", "on_copy", "filter[0] sift"]),
        class("Bank", &[("width", false)])
            .inputs(&["input f64[4]"])
            .outputs(&["out f64[4]"])
            .zero_delay(&[("input", "out")]),
        class("Relay", &[])
            .inputs(&["input f64"])
            .outputs(&["out f64"])
            .zero_delay(&[("input", "out")]),
        class("Breaker", &[])
            .inputs(&["input f64"])
            .outputs(&["out f64"]),
        ClassDescription {
            physical: true,
            ..class("Button", &[]).outputs(&["pressed f64"])
        },
    ]
}

fn class(name: &str, parameters: &[(&str, bool)]) -> ClassDescription {
    let parameter = |(name, required): &(&str, bool)| ParameterDescription {
        name: (*name).to_owned(),
        type_name: "Duration".to_owned(),
        required: *required,
    };
    ClassDescription {
        class: name.to_owned(),
        parameters: parameters.iter().map(parameter).collect(),
        ..ClassDescription::default()
    }
}

/// Short forms: `name Type[width]` for ports, `path name` for reactions.
trait Describe {
    fn inputs(self, ports: &[&str]) -> Self;
    fn outputs(self, ports: &[&str]) -> Self;
    fn zero_delay(self, pairs: &[(&str, &str)]) -> Self;
    fn reactions(self, reactions: &[&str]) -> Self;
}

impl Describe for ClassDescription {
    fn inputs(mut self, ports: &[&str]) -> Self {
        self.inputs = ports.iter().map(|text| port(text)).collect();
        self
    }

    fn outputs(mut self, ports: &[&str]) -> Self {
        self.outputs = ports.iter().map(|text| port(text)).collect();
        self
    }

    fn zero_delay(mut self, pairs: &[(&str, &str)]) -> Self {
        self.zero_delay = pairs
            .iter()
            .map(|(from, to)| ((*from).to_owned(), (*to).to_owned()))
            .collect();
        self
    }

    fn reactions(mut self, reactions: &[&str]) -> Self {
        let reaction = |(index, text): (u32, &&str)| {
            let (path, name) = text.split_once(' ').unwrap_or(("", text));
            let index = if path.is_empty() { index } else { 0 };
            ReactionDescription {
                path: path.to_owned(),
                index,
                name: name.to_owned(),
            }
        };
        self.reactions = (0..).zip(reactions).map(reaction).collect();
        self
    }
}

fn port(text: &str) -> PortDescription {
    let (name, kind) = text.split_once(' ').unwrap_or((text, "f64"));
    let (kind, width) = match kind.split_once('[') {
        Some((kind, width)) => (kind, width.trim_end_matches(']').parse().ok()),
        None => (kind, None),
    };
    let native = kind != "Points";
    PortDescription {
        name: name.to_owned(),
        width,
        type_identity: TypeIdentity {
            name: kind.to_owned(),
            fingerprint: format!("{:016x}", kind.len()),
        },
        serializers: ["native", "postcard"][usize::from(!native)..]
            .iter()
            .map(|name| (*name).to_owned())
            .collect(),
    }
}
