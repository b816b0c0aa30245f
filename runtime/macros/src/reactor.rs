//! `#[reactor]`: one struct becomes parameters, state and parts.

mod generate;
mod given;

use crate::options::{Options, take_attribute};
use proc_macro2::TokenStream;
use syn::spanned::Spanned;
use syn::{
    Attribute, Error, Expr, Field, Fields, GenericArgument, Ident, ItemStruct, Meta, PathArguments,
    Result, Type, parse2,
};

pub(crate) fn expand(attributes: TokenStream, item: TokenStream) -> Result<TokenStream> {
    if !attributes.is_empty() {
        return Err(Error::new_spanned(
            attributes,
            "no arguments are expected here",
        ));
    }
    let input: ItemStruct = parse2(item)?;
    let fields = match &input.fields {
        Fields::Named(fields) => fields.named.iter().cloned().collect(),
        Fields::Unit => Vec::new(),
        Fields::Unnamed(fields) => {
            let message = "a reactor's fields have names";
            return Err(Error::new_spanned(fields, message));
        }
    };
    let mut members = Vec::new();
    let mut errors: Option<Error> = None;
    for field in fields {
        match Member::new(field) {
            Ok(member) => members.push(member),
            Err(error) => match &mut errors {
                None => errors = Some(error),
                Some(errors) => errors.combine(error),
            },
        }
    }
    match errors {
        Some(errors) => Err(errors),
        None => Ok(generate::all(&input, &members)),
    }
}

/// A field of the declaration.
struct Member {
    /// Attributes that are not ours: documentation, lints.
    attributes: Vec<Attribute>,
    name: Ident,
    ty: Type,
    vis: syn::Visibility,
    kind: Kind,
}

enum Kind {
    Parameter {
        default: Option<Expr>,
    },
    State {
        init: Option<Expr>,
    },
    BankIndex,
    Input,
    Output,
    MultiInput {
        width: Expr,
    },
    MultiOutput {
        width: Expr,
    },
    Timer {
        offset: Option<Expr>,
        period: Option<Expr>,
    },
    Logical(Action),
    Physical(Action),
    Watchdog {
        timeout: Expr,
    },
    Child {
        class: Type,
        given: Option<Expr>,
    },
    Bank {
        class: Type,
        given: Option<Expr>,
        width: Expr,
    },
}

/// The options of an action.
#[derive(Default)]
struct Action {
    min_delay: Option<Expr>,
    min_spacing: Option<Expr>,
    /// A variant of `SpacingPolicy`.
    policy: Option<Ident>,
}

impl Kind {
    /// Whether it stays in the user's struct.
    fn stays(&self) -> bool {
        matches!(
            self,
            Self::Parameter { .. } | Self::State { .. } | Self::BankIndex
        )
    }
}

impl Member {
    fn new(field: Field) -> Result<Self> {
        let Field {
            mut attrs,
            vis,
            ident,
            ty,
            ..
        } = field;
        let Some(name) = ident else {
            return Err(Error::new_spanned(ty, "a reactor's fields have names"));
        };
        let own = OwnAttributes::take(&mut attrs);
        Ok(Self {
            attributes: attrs,
            kind: own.kind(&ty)?,
            name,
            ty,
            vis,
        })
    }
}

/// The attributes of one field that `#[reactor]` understands.
struct OwnAttributes {
    param: Option<Attribute>,
    state: Option<Attribute>,
    timer: Option<Attribute>,
    action: Option<Attribute>,
    watchdog: Option<Attribute>,
    child: Option<Attribute>,
    width: Option<Attribute>,
    bank_index: Option<Attribute>,
}

impl OwnAttributes {
    fn take(attributes: &mut Vec<Attribute>) -> Self {
        let mut take = |name| take_attribute(attributes, name);
        Self {
            param: take("param"),
            state: take("state"),
            timer: take("timer"),
            action: take("action"),
            watchdog: take("watchdog"),
            child: take("child"),
            width: take("width"),
            bank_index: take("bank_index"),
        }
    }

    fn kind(mut self, ty: &Type) -> Result<Kind> {
        if let Some(attribute) = self.param.take() {
            let default = Options::of(&attribute, &["default"])?.take("default")?;
            self.nothing_left("a parameter")?;
            return Ok(Kind::Parameter { default });
        }
        if let Some(attribute) = self.state.take() {
            let init = Options::of(&attribute, &["init"])?.take("init")?;
            self.nothing_left("state")?;
            return Ok(Kind::State { init });
        }
        if let Some(attribute) = self.bank_index.take() {
            Options::of(&attribute, &[])?;
            self.nothing_left("the bank index")?;
            return Ok(Kind::BankIndex);
        }
        let (class, inner) = class_of(ty);
        let kind = match class.as_str() {
            "Input" => Kind::Input,
            "Output" => Kind::Output,
            "Timer" => self.timer(ty)?,
            "LogicalAction" => Kind::Logical(self.action(false)?),
            "PhysicalAction" => Kind::Physical(self.action(true)?),
            "Watchdog" => self.watchdog(ty)?,
            "Multi" => self.multi(ty, inner.as_ref())?,
            "Child" => Kind::Child {
                class: inner
                    .ok_or_else(|| Error::new_spanned(ty, "say of which class: `Child<Stage>`"))?,
                given: self.given()?,
            },
            "Bank" => Kind::Bank {
                class: inner
                    .ok_or_else(|| Error::new_spanned(ty, "say of which class: `Bank<Stage>`"))?,
                given: self.given()?,
                width: self.width(ty)?,
            },
            _ => Kind::State { init: None },
        };
        self.nothing_left(&format!("`{class}`"))?;
        Ok(kind)
    }

    fn timer(&mut self, ty: &Type) -> Result<Kind> {
        let message =
            "say when it fires: `#[timer(period = 100.ms())]`, `#[timer(offset = 1.secs())]`";
        let attribute = self.timer.take();
        let attribute = attribute.ok_or_else(|| Error::new_spanned(ty, message))?;
        let mut options = Options::of(&attribute, &["offset", "period"])?;
        Ok(Kind::Timer {
            offset: options.take("offset")?,
            period: options.take("period")?,
        })
    }

    fn action(&mut self, physical: bool) -> Result<Action> {
        let Some(attribute) = self.action.take() else {
            return Ok(Action::default());
        };
        let known: &[_] = if physical {
            &["physical", "min_delay", "min_spacing", "policy"]
        } else {
            &["min_delay", "min_spacing", "policy"]
        };
        let mut options = Options::of(&attribute, known)?;
        let action = Action {
            min_delay: options.take("min_delay")?,
            min_spacing: options.take("min_spacing")?,
            policy: options.take("policy")?.as_ref().map(policy).transpose()?,
        };
        match &action {
            Action {
                policy: Some(policy),
                min_spacing: None,
                ..
            } => {
                let message = "a policy is for events that come too soon: `min_spacing = 1.ms()`";
                Err(Error::new(policy.span(), message))
            }
            _ => Ok(action),
        }
    }

    fn watchdog(&mut self, ty: &Type) -> Result<Kind> {
        let message = "say when it expires: `#[watchdog(timeout = 100.ms())]`";
        let attribute = self.watchdog.take();
        let attribute = attribute.ok_or_else(|| Error::new_spanned(ty, message))?;
        let timeout = Options::of(&attribute, &["timeout"])?.take("timeout")?;
        let timeout = timeout.ok_or_else(|| Error::new_spanned(attribute, message))?;
        Ok(Kind::Watchdog { timeout })
    }

    fn multi(&mut self, ty: &Type, inner: Option<&Type>) -> Result<Kind> {
        let width = self.width(ty)?;
        match inner.map(|inner| class_of(inner).0).as_deref() {
            Some("Input") => Ok(Kind::MultiInput { width }),
            Some("Output") => Ok(Kind::MultiOutput { width }),
            _ => Err(Error::new_spanned(
                ty,
                "a multiport is `Multi<Input<..>>` or `Multi<Output<..>>`",
            )),
        }
    }

    fn width(&mut self, ty: &Type) -> Result<Expr> {
        match self.width.take().map(|attribute| attribute.meta) {
            Some(Meta::NameValue(pair)) => Ok(pair.value),
            Some(Meta::List(list)) => list.parse_args(),
            Some(Meta::Path(path)) => Err(Error::new_spanned(path, "write `#[width = n]`")),
            None => Err(Error::new_spanned(ty, "say how many: `#[width = n]`")),
        }
    }

    fn given(&mut self) -> Result<Option<Expr>> {
        match self.child.take().map(|attribute| attribute.meta) {
            Some(Meta::List(list)) => list.parse_args().map(Some),
            Some(Meta::Path(_)) | None => Ok(None),
            Some(Meta::NameValue(pair)) => {
                let message = "write `#[child(Class { parameter: value })]`";
                Err(Error::new_spanned(pair, message))
            }
        }
    }

    /// Refuses attributes that do not belong to the kind.
    fn nothing_left(self, what: &str) -> Result<()> {
        let left = [
            self.param,
            self.state,
            self.timer,
            self.action,
            self.watchdog,
            self.child,
            self.width,
            self.bank_index,
        ];
        match left.into_iter().flatten().next() {
            None => Ok(()),
            Some(attribute) => Err(Error::new_spanned(
                attribute,
                format!("this attribute does not go with {what}"),
            )),
        }
    }
}

/// The variant that `policy = drop` names.
fn policy(given: &Expr) -> Result<Ident> {
    let name = match given {
        Expr::Path(path) => path.path.get_ident(),
        _ => None,
    };
    let variants = [("defer", "Defer"), ("drop", "Drop"), ("replace", "Replace")];
    let variant = variants
        .iter()
        .find(|(text, _)| name.is_some_and(|name| name == text));
    let message = "what becomes of an event that comes too soon: `defer`, `drop` or `replace`";
    variant
        .map(|(_, variant)| Ident::new(variant, given.span()))
        .ok_or_else(|| Error::new_spanned(given, message))
}

/// The last segment of a type's path and its first type argument.
fn class_of(ty: &Type) -> (String, Option<Type>) {
    let Type::Path(path) = ty else {
        return (String::new(), None);
    };
    let Some(segment) = path.path.segments.last() else {
        return (String::new(), None);
    };
    let inner = match &segment.arguments {
        PathArguments::AngleBracketed(arguments) => {
            arguments.args.iter().find_map(|argument| match argument {
                GenericArgument::Type(ty) => Some(ty.clone()),
                _ => None,
            })
        }
        PathArguments::None | PathArguments::Parenthesized(_) => None,
    };
    (segment.ident.to_string(), inner)
}
