//! Attribute arguments: `name = expression` and bare names, separated by commas.

use proc_macro2::Span;
use syn::parse::{Parse, ParseStream};
use syn::{Attribute, Error, Expr, Ident, Meta, Result, Token};

/// The arguments of one attribute.
pub(crate) struct Options {
    entries: Vec<Entry>,
}

struct Entry {
    name: Ident,
    value: Option<Expr>,
}

impl Options {
    /// Reads `#[attribute]` or `#[attribute(..)]`; only the `known` names may occur.
    pub(crate) fn of(attribute: &Attribute, known: &[&str]) -> Result<Self> {
        let options = match &attribute.meta {
            Meta::Path(_) => Self {
                entries: Vec::new(),
            },
            Meta::List(list) => list.parse_args()?,
            Meta::NameValue(pair) => {
                let message = "write the arguments in parentheses";
                return Err(Error::new_spanned(pair, message));
            }
        };
        options.only(known)?;
        Ok(options)
    }

    fn only(&self, known: &[&str]) -> Result<()> {
        for entry in &self.entries {
            if !known.iter().any(|name| entry.name == name) {
                let message = match known {
                    [] => "no arguments are expected here".to_owned(),
                    known => format!("expected {}", known.join(" or ")),
                };
                return Err(Error::new(entry.name.span(), message));
            }
        }
        Ok(())
    }

    /// The expression given for a name.
    pub(crate) fn take(&mut self, name: &str) -> Result<Option<Expr>> {
        let Some(at) = self.entries.iter().position(|entry| entry.name == name) else {
            return Ok(None);
        };
        let entry = self.entries.swap_remove(at);
        let message = format!("give it a value: `{name} = ..`");
        match entry.value {
            Some(value) => Ok(Some(value)),
            None => Err(Error::new(entry.name.span(), message)),
        }
    }

    /// Where a bare name stands.
    pub(crate) fn flag(&self, name: &str) -> Option<Span> {
        let mut entries = self.entries.iter();
        let entry = entries.find(|entry| entry.name == name)?;
        Some(entry.name.span())
    }
}

impl Parse for Options {
    fn parse(input: ParseStream<'_>) -> Result<Self> {
        let mut entries = Vec::new();
        while !input.is_empty() {
            let name = input.parse()?;
            let equals: Option<Token![=]> = input.parse()?;
            let value = equals.map(|_| input.parse()).transpose()?;
            entries.push(Entry { name, value });
            if !input.is_empty() {
                input.parse::<Token![,]>()?;
            }
        }
        Ok(Self { entries })
    }
}

/// Removes the attribute of this name and returns it.
pub(crate) fn take_attribute(attributes: &mut Vec<Attribute>, name: &str) -> Option<Attribute> {
    let at = attributes.iter().position(|a| a.path().is_ident(name))?;
    Some(attributes.remove(at))
}
