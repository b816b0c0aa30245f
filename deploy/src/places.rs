//! Where a key that does not belong here belongs.

use serde_json::Value as Json;

use crate::suggest;

/// How deep keys are looked for; the schema nests five levels.
const DEPTH: usize = 8;

/// Names of Lingua Franca and what they are called here.
const FOREIGN: [(&str, &str); 5] = [
    ("maxwait", "stp_offset"),
    ("STP_offset", "stp_offset"),
    ("STA", "stp_offset"),
    ("absentAfter", "absent_after"),
    ("STAA", "absent_after"),
];

/// The fix for an unknown key where `known` ones may stand: its name here, its places elsewhere, else what it may be
/// a typing error of.
pub(crate) fn fix(schema: &Json, key: &str, known: &[&str]) -> String {
    let foreign = FOREIGN.iter().find(|(name, _)| *name == key);
    let name = foreign.map_or(key, |(_, ours)| ours);
    if known.contains(&name) {
        return format!("Lingua Franca's `{key}` is `{name}` here");
    }
    let mut all = Vec::new();
    places(schema, schema, (name, String::new(), 0), &mut all);
    let places = match all.as_slice() {
        [] => return suggest::fix(key, known.iter().copied()),
        [only] => format!("`{only}`"),
        [others @ .., last] => format!("`{}` or `{last}`", others.join("`, `")),
    };
    match foreign {
        Some(_) => format!("Lingua Franca's `{key}` is `{name}`, which stands at {places}"),
        None => format!("it stands at {places}"),
    }
}

/// Adds the paths at which a schema has a key.
fn places(
    root: &Json,
    at: &Json,
    (key, path, depth): (&str, String, usize),
    all: &mut Vec<String>,
) {
    if depth > DEPTH {
        return;
    }
    let pointer = at.get("$ref").and_then(Json::as_str);
    let target = pointer.and_then(|pointer| root.pointer(pointer.strip_prefix('#')?));
    let at = target.unwrap_or(at);
    let below = |step: &str| match path.is_empty() {
        true => step.to_owned(),
        false => format!("{path}.{step}"),
    };
    let properties = at.get("properties").and_then(Json::as_object);
    for (name, property) in properties.into_iter().flatten() {
        let path = below(name);
        if name == key && !all.contains(&path) {
            all.push(path.clone());
        }
        places(root, property, (key, path, depth + 1), all);
    }
    if let Some(named) = at.get("additionalProperties").filter(|it| it.is_object()) {
        let step = match path.ends_with("links") {
            true => "SENDER -> RECEIVER",
            false => "NAME",
        };
        places(root, named, (key, below(step), depth + 1), all);
    }
    if let Some(items) = at.get("items") {
        places(root, items, (key, format!("{path}[]"), depth + 1), all);
    }
    let alternatives = ["anyOf", "oneOf", "allOf"].into_iter();
    let alternatives = alternatives.filter_map(|any| at.get(any)?.as_array());
    for one in alternatives.flatten() {
        places(root, one, (key, path.clone(), depth + 1), all);
    }
}
