//! The form of a manifest against its schema: every unknown key, missing key and wrong value at once. What
//! is wrong is reported and cut out, so that the rest can be checked for meaning.

use std::collections::BTreeMap;
use std::net::SocketAddr;

use serde_json::Value as Json;

use crate::document::{Key, Node, Part, Value};
use crate::manifest::{COORDINATOR, is_name};
use crate::problem::{Place, Report};
use crate::{places, quantity, spans, suggest};

/// Reports every departure of `root` from `schema`; returns what is left without them.
pub(crate) fn prune(schema: &Json, root: &Node, report: &mut Report) -> Node {
    let mut walker = Walker {
        schema,
        report,
        path: Vec::new(),
    };
    let empty = Node {
        value: Value::Map(Vec::new()),
        site: root.site,
    };
    walker.node(schema, root).unwrap_or(empty)
}

struct Walker<'a> {
    schema: &'a Json,
    report: &'a mut Report,
    path: Vec<String>,
}

impl<'a> Walker<'a> {
    /// The node without its mistakes; absent when it is one.
    fn node(&mut self, schema: &'a Json, node: &Node) -> Option<Node> {
        let schema = self.resolve(schema);
        if let Some(words) = words(schema) {
            return self.word(&words, node);
        }
        if let Some(alternatives) = alternatives(schema) {
            return self.alternative(alternatives, node);
        }
        if node.value == Value::Null && allows(schema, "null") {
            return Some(node.clone());
        }
        match &node.value {
            Value::Map(entries) if allows(schema, "object") => {
                Some(self.mapping(schema, node, entries))
            }
            Value::List(items) if allows(schema, "array") => Some(self.list(schema, node, items)),
            Value::Integer(value) if allows(schema, "integer") => self.range(schema, node, *value),
            Value::Float(_) | Value::Integer(_) if allows(schema, "number") => {
                self.number(schema, node)
            }
            Value::Bool(_) if allows(schema, "boolean") => Some(node.clone()),
            Value::Text(text) if allows(schema, "string") => self.text(schema, node, text),
            Value::Null
            | Value::Bool(_)
            | Value::Integer(_)
            | Value::Float(_)
            | Value::Text(_)
            | Value::List(_)
            | Value::Map(_) => {
                self.wrong_kind(schema, node);
                None
            }
        }
    }

    fn mapping(&mut self, schema: &'a Json, node: &Node, entries: &[(Key, Node)]) -> Node {
        let mut kept: Vec<(Key, Node)> = Vec::new();
        let mut lines: BTreeMap<&str, u32> = BTreeMap::new();
        for (key, below) in entries {
            self.path.push(key.name.clone());
            if let Some(line) = lines.get(key.name.as_str()) {
                let name = &key.name;
                let message = format!("duplicate key `{name}`: it stands already in line {line}");
                let place = Place::exact(&self.path, key.site);
                self.report.add(
                    "F002",
                    place,
                    message,
                    "give it another name, or remove one",
                );
            } else {
                lines.insert(&key.name, key.site.line);
                if let Some(left) = self.entry(schema, key, below) {
                    kept.push((key.clone(), left));
                }
            }
            self.path.pop();
        }
        self.required(schema, entries);
        Node {
            value: Value::Map(kept),
            site: node.site,
        }
    }

    /// The value of one entry of a mapping, when its key is known and it can be read.
    fn entry(&mut self, schema: &'a Json, key: &Key, below: &Node) -> Option<Node> {
        let properties = schema.get("properties").and_then(Json::as_object);
        if let Some(property) = properties.and_then(|all| all.get(&key.name)) {
            return self.node(property, below);
        }
        match schema.get("additionalProperties") {
            Some(Json::Bool(false)) => {
                let known = properties
                    .into_iter()
                    .flat_map(|all| all.keys())
                    .map(String::as_str);
                let fix = match self.report.is_full() {
                    true => String::new(),
                    false => places::fix(self.schema, &key.name, &known.collect::<Vec<_>>()),
                };
                let message = format!("unknown key `{}`", key.name);
                self.report
                    .add("F003", Place::new(&self.path, Part::Key), message, fix);
                None
            }
            _ if !self.name(schema, &key.name) => None,
            Some(schema) => {
                let object = allows(self.resolve(schema), "object");
                let wrong = object.then(|| Node {
                    value: Value::Map(Vec::new()),
                    site: below.site,
                });
                self.node(schema, below).or(wrong)
            }
            None => Some(below.clone()),
        }
    }

    fn required(&mut self, schema: &Json, entries: &[(Key, Node)]) {
        let names = schema
            .get("required")
            .and_then(Json::as_array)
            .into_iter()
            .flatten();
        for name in names.filter_map(Json::as_str) {
            if !entries.iter().any(|(key, _)| key.name == name) {
                let message = format!("missing key `{name}`");
                let place = Place::new(&self.path, Part::Key);
                self.report.add("F004", place, message, missing_fix(name));
            }
        }
    }

    fn name(&mut self, schema: &Json, name: &str) -> bool {
        if schema.get("propertyNames").is_none() {
            return true;
        }
        let taken = self.path.len() == 2 && self.path[0] == "federates" && name == COORDINATOR;
        let (message, fix) = if taken {
            let message = format!("`{name}` stands for the coordinator");
            (message, "give the federate another name")
        } else if !is_name(name) {
            let message = format!("`{name}` cannot be a name");
            let fix = "a name is a letter, then letters, digits, `_` or `-`; at most 64";
            (message, fix)
        } else {
            return true;
        };
        self.report
            .add("F008", Place::new(&self.path, Part::Key), message, fix);
        false
    }

    fn list(&mut self, schema: &'a Json, node: &Node, items: &[Node]) -> Node {
        let mut kept = Vec::new();
        for (position, item) in items.iter().enumerate() {
            self.path.push(position.to_string());
            let left = schema
                .get("items")
                .map_or(Some(item.clone()), |below| self.node(below, item));
            self.path.pop();
            // Positions name places, so a wrong item leaves a gap.
            kept.push(left.unwrap_or(Node {
                value: gap(schema),
                site: item.site,
            }));
        }
        Node {
            value: Value::List(kept),
            site: node.site,
        }
    }

    fn range(&mut self, schema: &Json, node: &Node, value: i64) -> Option<Node> {
        let bound = |name: &str| schema.get(name).and_then(Json::as_i64);
        let (least, most) = (bound("minimum"), bound("maximum"));
        if least.is_none_or(|least| value >= least) && most.is_none_or(|most| value <= most) {
            return Some(node.clone());
        }
        let message = match (least, most) {
            (Some(least), Some(most)) => format!("{value} is not between {least} and {most}"),
            (Some(least), None) => format!("{value} is less than {least}"),
            (None, Some(most)) => format!("{value} is more than {most}"),
            (None, None) => format!("{value} is out of range"),
        };
        self.report
            .add("F005", Place::new(&self.path, Part::Value), message, "");
        None
    }

    /// A number within the bounds of its schema.
    fn number(&mut self, schema: &Json, node: &Node) -> Option<Node> {
        let text = match &node.value {
            Value::Integer(value) => value.to_string(),
            Value::Float(value) => value.to_string(),
            Value::Null | Value::Bool(_) | Value::Text(_) | Value::List(_) | Value::Map(_) => {
                return Some(node.clone());
            }
        };
        let bound = |name: &str| schema.get(name).and_then(Json::as_f64);
        let (Some(least), Some(most)) = (bound("minimum"), bound("maximum")) else {
            return Some(node.clone());
        };
        if text
            .parse()
            .is_ok_and(|value: f64| (least..=most).contains(&value))
        {
            return Some(node.clone());
        }
        let message = format!("{text} is not between {least} and {most}");
        self.report
            .add("F005", Place::new(&self.path, Part::Value), message, "");
        None
    }

    fn text(&mut self, schema: &Json, node: &Node, text: &str) -> Option<Node> {
        let (code, message, fix) = match schema.get("format").and_then(Json::as_str) {
            Some(format @ ("ictus-duration" | "ictus-signed-duration" | "ictus-offset")) => {
                let key = self.path.last().map_or("", String::as_str);
                match spans::check(key, text, format) {
                    Ok(()) => return Some(node.clone()),
                    Err((message, fix)) => ("F006", message, fix),
                }
            }
            Some("ictus-address") if text.trim().parse::<SocketAddr>().is_err() => {
                let fix = "write it as `127.0.0.1:9464`";
                (
                    "F005",
                    format!("`{text}` is not an address with a port"),
                    fix.to_owned(),
                )
            }
            Some("ictus-size") => match quantity::size(text) {
                Ok(_) => return Some(node.clone()),
                Err(error) => ("F006", error.to_string(), "write it as `10 MiB`".to_owned()),
            },
            Some("ictus-name") if !is_name(text) => {
                let fix = "a name is a letter, then letters, digits, `_` or `-`; at most 64";
                ("F008", format!("`{text}` cannot be a name"), fix.to_owned())
            }
            _ => return Some(node.clone()),
        };
        self.report
            .add(code, Place::new(&self.path, Part::Value), message, fix);
        None
    }

    fn word(&mut self, words: &[&str], node: &Node) -> Option<Node> {
        if let Value::Text(text) = &node.value {
            if words.contains(&text.as_str()) {
                return Some(node.clone());
            }
            let message = format!("unknown value `{text}`");
            let fix = match words {
                ["count"] => "write `count`, or `{ stop_after: N }`".to_owned(),
                [only] => format!("write `{only}`"),
                several => suggest::fix(text, several.iter().copied()),
            };
            self.report
                .add("F005", Place::new(&self.path, Part::Value), message, fix);
            return None;
        }
        let message = format!("expected `{}`, found {}", words.join("` or `"), node.kind());
        let fix = match &node.value {
            Value::Float(number) if words.contains(&number.to_string().as_str()) => {
                format!("quote it: `\"{number}\"`")
            }
            Value::Null
            | Value::Bool(_)
            | Value::Integer(_)
            | Value::Float(_)
            | Value::Text(_)
            | Value::List(_)
            | Value::Map(_) => String::new(),
        };
        self.report
            .add("F005", Place::new(&self.path, Part::Value), message, fix);
        None
    }

    /// The alternative that fits; when none does, the problems of the one of the node's own kind.
    fn alternative(&mut self, alternatives: &'a [Json], node: &Node) -> Option<Node> {
        let resolved: Vec<&'a Json> = alternatives.iter().map(|one| self.resolve(one)).collect();
        if node.value == Value::Null && resolved.iter().any(|one| allows(one, "null")) {
            return Some(node.clone());
        }
        let same_kind = |one: &&&Json| json_kinds(node).iter().any(|kind| allows(one, kind));
        match resolved.iter().find(same_kind) {
            Some(one) => self.node(one, node),
            None if node.value == Value::Null && self.report.is_broken(&self.path) => None,
            None => {
                let kinds: Vec<String> = resolved.iter().copied().filter_map(describe).collect();
                let message = format!("expected {}, found {}", kinds.join(" or "), node.kind());
                self.report
                    .add("F005", Place::new(&self.path, Part::Value), message, "");
                None
            }
        }
    }

    fn wrong_kind(&mut self, schema: &Json, node: &Node) {
        if node.value == Value::Null && self.report.is_broken(&self.path) {
            return;
        }
        let format = schema.get("format").and_then(Json::as_str);
        let number = match &node.value {
            Value::Integer(value) => Some(value.to_string()),
            Value::Float(value) => Some(value.to_string()),
            Value::Null | Value::Bool(_) | Value::Text(_) | Value::List(_) | Value::Map(_) => None,
        };
        let place = Place::new(&self.path, Part::Value);
        let (code, message, fix) = match (format, number) {
            (
                Some(format @ ("ictus-duration" | "ictus-signed-duration" | "ictus-offset")),
                Some(number),
            ) => {
                let key = self.path.last().map_or("", String::as_str);
                let no_unit = || (format!("`{number}` has no unit"), spans::fix(&number));
                let (message, fix) = spans::check(key, &number, format)
                    .err()
                    .unwrap_or_else(no_unit);
                ("F006", message, fix)
            }
            (Some("ictus-size"), Some(number)) => (
                "F006",
                format!("`{number}` has no unit"),
                format!("write `{number} MiB`"),
            ),
            (_, number) => {
                let expected = describe(schema).unwrap_or("another kind of value".to_owned());
                let message = format!("expected {expected}, found {}", node.kind());
                let quote = number.filter(|_| allows(schema, "string"));
                (
                    "F005",
                    message,
                    quote.map_or(String::new(), |n| format!("quote it: `\"{n}\"`")),
                )
            }
        };
        self.report.add(code, place, message, fix);
    }

    /// Follows `$ref`.
    fn resolve(&self, schema: &'a Json) -> &'a Json {
        let pointer = schema
            .get("$ref")
            .and_then(Json::as_str)
            .and_then(|r| r.strip_prefix('#'));
        pointer
            .and_then(|pointer| self.schema.pointer(pointer))
            .unwrap_or(schema)
    }
}

/// What stands for a wrong item of a list, so that those after it keep their positions.
fn gap(schema: &Json) -> Value {
    let kind = schema.pointer("/items/type").and_then(Json::as_str);
    match kind {
        Some("string") => Value::Text(String::new()),
        Some("integer") => Value::Integer(0),
        Some(_) | None => Value::Map(Vec::new()),
    }
}

fn missing_fix(name: &str) -> &'static str {
    match name {
        "ictus" => "start the manifest with `ictus: v1`",
        "federation" => "name the federation: `federation: NAME`",
        _ => "",
    }
}

/// Whether a schema allows a JSON type; a schema that says nothing of types allows all.
fn allows(schema: &Json, kind: &str) -> bool {
    match schema.get("type") {
        Some(Json::String(one)) => one == kind,
        Some(Json::Array(many)) => many.iter().any(|one| one == kind),
        _ if words(schema).is_some() => kind == "string",
        _ => alternatives(schema).is_none_or(|many| many.iter().any(|one| allows(one, kind))),
    }
}

/// The JSON types that fit a node, nearest first.
fn json_kinds(node: &Node) -> &'static [&'static str] {
    match &node.value {
        Value::Null => &["null"],
        Value::Bool(_) => &["boolean"],
        Value::Integer(_) => &["integer", "number"],
        Value::Float(_) => &["number"],
        Value::Text(_) => &["string"],
        Value::List(_) => &["array"],
        Value::Map(_) => &["object"],
    }
}

/// The words of an enumeration.
fn words(schema: &Json) -> Option<Vec<&str>> {
    if let Some(word) = schema.get("const").and_then(Json::as_str) {
        return Some(vec![word]);
    }
    if let Some(many) = schema.get("enum").and_then(Json::as_array) {
        return Some(many.iter().filter_map(Json::as_str).collect());
    }
    let alternatives = alternatives(schema)?;
    alternatives
        .iter()
        .map(|one| one.get("const").and_then(Json::as_str))
        .collect()
}

fn alternatives(schema: &Json) -> Option<&[Json]> {
    let any = schema.get("anyOf").or_else(|| schema.get("oneOf"))?;
    any.as_array().map(Vec::as_slice)
}

/// What a schema wants, as a person says it.
fn describe(schema: &Json) -> Option<String> {
    let format = match schema.get("format").and_then(Json::as_str) {
        Some("ictus-duration" | "ictus-signed-duration") => Some("a duration such as `10 ms`"),
        Some("ictus-offset") => Some("a duration such as `10 ms`, or `auto`"),
        Some("ictus-address") => Some("an address such as `127.0.0.1:9464`"),
        Some("ictus-size") => Some("a size such as `10 MiB`"),
        Some("ictus-name") => Some("a name"),
        _ => None,
    };
    if let Some(format) = format {
        return Some(format.to_owned());
    }
    if let Some(words) = words(schema) {
        return Some(format!("`{}`", words.join("` or `")));
    }
    if let Some(alternatives) = alternatives(schema) {
        let all: Vec<String> = alternatives.iter().filter_map(describe).collect();
        return Some(all.join(" or "));
    }
    let kind = match schema.get("type") {
        Some(Json::String(one)) => one.as_str(),
        Some(Json::Array(many)) => many
            .iter()
            .filter_map(Json::as_str)
            .find(|k| *k != "null")?,
        _ => return None,
    };
    let kind = match kind {
        "object" => "a mapping",
        "array" => "a list",
        "string" => "a text",
        "integer" => "an integer",
        "number" => "a number",
        "boolean" => "`true` or `false`",
        _ => return None,
    };
    Some(kind.to_owned())
}
