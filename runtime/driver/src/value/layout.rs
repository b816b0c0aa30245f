//! Layouts: a text that two types share exactly when values of one can be read as the other.

use super::digest::Digest;
use std::fmt::Write;

/// Collects the description of a type.
#[derive(Debug, Default)]
pub struct Layout {
    text: String,
    /// Types being described, so that a recursive type ends.
    open: Vec<String>,
}

impl Layout {
    /// Adds the name of a type that has no parts.
    pub fn primitive(&mut self, name: &str) {
        self.text.push_str(name);
        self.text.push(';');
    }

    /// Adds a declared type and what `parts` adds to it; a type inside itself is only named.
    pub fn declared(&mut self, name: &str, parts: impl FnOnce(&mut Self)) {
        self.text.push_str(name);
        if self.open.iter().any(|open| open == name) {
            self.text.push(';');
            return;
        }
        self.open.push(name.to_owned());
        self.text.push('{');
        parts(self);
        self.text.push('}');
        self.open.pop();
    }

    /// Adds a type made of others by the language (`Vec`, a tuple); what `parts` adds tells two of them apart.
    pub fn composed(&mut self, name: &str, parts: impl FnOnce(&mut Self)) {
        self.text.push_str(name);
        self.text.push('<');
        parts(self);
        self.text.push('>');
    }

    /// Adds a field of the declared type; its type follows.
    pub fn field(&mut self, name: &str) {
        let _ = write!(self.text, "{name}:");
    }

    /// Adds a variant of the declared enum; its fields follow.
    pub fn variant(&mut self, name: &str) {
        let _ = write!(self.text, "|{name} ");
    }

    /// The whole description as 16 hexadecimal digits.
    #[must_use]
    pub fn fingerprint(&self) -> String {
        let mut digest = Digest::new();
        digest.bytes(self.text.as_bytes());
        digest.word(self.text.len() as u64);
        format!("{:016x}", digest.mixed())
    }
}
