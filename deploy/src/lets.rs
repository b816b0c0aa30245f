//! `let` values: `$name` anywhere in the manifest is replaced before anything is read.

use std::collections::BTreeMap;

use crate::document::{Node, Value};
use crate::problem::{Place, Report};
use crate::suggest;

/// Replaces every `$name` by the value of `let.name` or by its override; `$$` at the start is a dollar sign.
/// Replaced values keep the place of their use.
pub(crate) fn substitute(
    root: &Node,
    overrides: &BTreeMap<String, String>,
    report: &mut Report,
) -> Node {
    let mut values: BTreeMap<String, Value> = BTreeMap::new();
    if let Some(Value::Map(entries)) = root.get("let").map(|node| &node.value) {
        for (key, node) in entries {
            // Only scalars are allowed: the schema refuses the others.
            if !matches!(node.value, Value::List(_) | Value::Map(_)) {
                values.insert(key.name.clone(), node.value.clone());
            }
        }
    }
    for (name, text) in overrides {
        let known = values.contains_key(name);
        match Node::parse(text) {
            Ok(node) if known => {
                values.insert(name.clone(), node.value);
            }
            Ok(_) => {
                let fix = suggest::fix(name, values.keys().map(String::as_str));
                let message = format!("`--set {name}`: `let` has no such name");
                report.add("F007", Place::key(&["let"]), message, fix);
            }
            Err(error) => {
                let message = format!("`--set {name}`: {}", error.message);
                report.add("F007", Place::key(&["let", name]), message, "");
            }
        }
    }
    let mut substitution = Substitution {
        values,
        used: Vec::new(),
        path: Vec::new(),
    };
    let result = substitution.node(root, report);
    for name in substitution.values.keys() {
        if !substitution.used.contains(name) {
            let message = format!("nothing uses `${name}`");
            report.warn("W002", Place::key(&["let", name]), message, "");
        }
    }
    result
}

struct Substitution {
    values: BTreeMap<String, Value>,
    used: Vec<String>,
    path: Vec<String>,
}

impl Substitution {
    fn node(&mut self, node: &Node, report: &mut Report) -> Node {
        let value = match &node.value {
            Value::Text(text) => self.text(text, report),
            Value::List(items) => {
                let mut result = Vec::with_capacity(items.len());
                for (position, item) in items.iter().enumerate() {
                    self.path.push(position.to_string());
                    result.push(self.node(item, report));
                    self.path.pop();
                }
                Value::List(result)
            }
            Value::Map(entries) => {
                let mut result = Vec::with_capacity(entries.len());
                for (key, below) in entries {
                    self.path.push(key.name.clone());
                    result.push((key.clone(), self.node(below, report)));
                    self.path.pop();
                }
                Value::Map(result)
            }
            Value::Null | Value::Bool(_) | Value::Integer(_) | Value::Float(_) => {
                node.value.clone()
            }
        };
        Node {
            value,
            site: node.site,
        }
    }

    fn text(&mut self, text: &str, report: &mut Report) -> Value {
        let Some(name) = text.strip_prefix('$') else {
            return Value::Text(text.to_owned());
        };
        if name.starts_with('$') {
            return Value::Text(name.to_owned());
        }
        let inside_let = self.path.first().is_some_and(|first| first == "let");
        match self.values.get(name) {
            Some(value) if !inside_let => {
                self.used.push(name.to_owned());
                value.clone()
            }
            Some(_) => {
                let message = "a value of `let` cannot refer to another";
                report.add(
                    "F007",
                    Place::value(&self.path),
                    message,
                    "write the value itself",
                );
                Value::Null
            }
            None => {
                let fix = match suggest::fix(name, self.values.keys().map(String::as_str)) {
                    known if known.is_empty() => format!("add `let: {{ {name}: ... }}`"),
                    known => known,
                };
                let message = format!("unknown name `${name}`: `let` does not have it");
                report.add("F007", Place::value(&self.path), message, fix);
                Value::Null
            }
        }
    }
}
