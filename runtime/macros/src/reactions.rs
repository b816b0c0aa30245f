//! `#[reactions]`: signatures become declarations.

use crate::options::{Options, take_attribute};
use proc_macro2::TokenStream;
use quote::{ToTokens, format_ident, quote, quote_spanned};
use syn::spanned::Spanned;
use syn::{
    Attribute, Error, Expr, FnArg, Ident, ImplItem, ImplItemFn, ItemImpl, Meta, Pat, PatType,
    Result, ReturnType, Type, parse2,
};

pub(crate) fn expand(attributes: TokenStream, item: TokenStream) -> Result<TokenStream> {
    if !attributes.is_empty() {
        return Err(Error::new_spanned(
            attributes,
            "no arguments are expected here",
        ));
    }
    let mut block: ItemImpl = parse2(item)?;
    if let Some((path, _)) = &block.trait_ {
        return Err(Error::new_spanned(
            path,
            "write `#[reactions] impl Name { .. }`, without a trait",
        ));
    }
    let mut steps: Vec<TokenStream> = Vec::new();
    let mut errors: Option<Error> = None;
    for item in &mut block.items {
        let ImplItem::Fn(method) = item else {
            continue;
        };
        match step(method) {
            Ok(tokens) => steps.extend(tokens),
            Err(error) => match &mut errors {
                None => errors = Some(error),
                Some(errors) => errors.combine(error),
            },
        }
    }
    // With a mistake, the block and an empty implementation stand in, so that no other error hides it.
    if let Some(errors) = errors {
        let errors = errors.into_compile_error();
        steps = vec![quote!(#errors)];
    }
    let (impl_generics, _, where_clause) = block.generics.split_for_impl();
    let this = &block.self_ty;
    Ok(quote! {
        #block

        #[automatically_derived]
        #[allow(unused_variables)]
        impl #impl_generics ::ictus::build::Reactions for #this #where_clause {
            fn react(
                &self,
                parts: &<Self as ::ictus::build::Reactor>::Parts,
                scope: &mut ::ictus::build::ReactionScope<'_, Self>,
            ) {
                #(#steps)*
            }
        }
    })
}

/// What one method adds to `react`; nothing for a helper.
fn step(method: &mut ImplItemFn) -> Result<Option<TokenStream>> {
    let reaction = take_attribute(&mut method.attrs, "reaction");
    let connections = take_attribute(&mut method.attrs, "connections");
    let watchdog = take_attribute(&mut method.attrs, "watchdog");
    match (reaction, connections, watchdog) {
        (None, None, None) => Ok(None),
        (Some(attribute), None, None) => self::reaction(method, &attribute).map(Some),
        (None, Some(attribute), None) => self::connections(method, &attribute).map(Some),
        (None, None, Some(attribute)) => self::watchdog(method, &attribute).map(Some),
        (_, Some(attribute), _) | (Some(_), None, Some(attribute)) => Err(Error::new_spanned(
            attribute,
            "a method is a reaction, a watchdog's handler, or makes connections: one of them",
        )),
    }
}

/// An argument of a reaction.
enum Argument {
    Context { ty: Box<Type> },
    Item(Box<ItemArgument>),
}

struct ItemArgument {
    /// How the reaction uses it: a function of `ictus::build`.
    role: &'static str,
    /// The part, as an expression over `parts` and `scope`.
    part: TokenStream,
    mutable: bool,
    ty: Type,
    /// The last segment of the type's path.
    kind: String,
}

/// What runs instead of a reaction.
struct Handlers {
    deadline: Option<Expr>,
    late: Option<Expr>,
    stp: Option<Expr>,
}

fn reaction(method: &mut ImplItemFn, attribute: &Attribute) -> Result<TokenStream> {
    let mut options = Options::of(attribute, &["deadline", "late", "stp"])?;
    let handlers = Handlers {
        deadline: options.take("deadline")?,
        late: options.take("late")?,
        stp: options.take("stp")?,
    };
    let arguments = arguments(method, "a reaction")?;
    let triggered = arguments.iter().any(|argument| match argument {
        Argument::Context { .. } => false,
        Argument::Item(item) => item.role.starts_with("trigger"),
    });
    if !triggered {
        let message = "nothing triggers this reaction: take an input, a timer or an action by `&`, or an action by `#[trigger] name: &mut`";
        return Err(Error::new(method.sig.ident.span(), message));
    }
    match (&handlers.deadline, &handlers.late) {
        (Some(_), Some(_)) | (None, None) => {}
        (Some(deadline), None) => {
            let message =
                "say what runs instead when the deadline is missed: `late = Self::handler`";
            return Err(Error::new_spanned(deadline, message));
        }
        (None, Some(late)) => {
            let message = "a handler needs a deadline: `deadline = 5.ms()`";
            return Err(Error::new_spanned(late, message));
        }
    }
    let allow: Attribute = syn::parse_quote!(#[allow(clippy::too_many_arguments)]);
    method.attrs.push(allow);
    Ok(registration(&method.sig.ident, &arguments, &handlers))
}

fn registration(name: &Ident, arguments: &[Argument], handlers: &Handlers) -> TokenStream {
    let Items {
        accesses,
        pattern,
        passed,
    } = items(arguments);
    let instead = |case: &str, handler: &Option<Expr>| {
        let handler = handler.as_ref()?;
        let case = Ident::new(case, handler.span());
        Some(quote_spanned! {handler.span()=>
            if case == ::ictus::build::Case::#case {
                return (#handler)(state #(, #passed)*);
            }
        })
    };
    let late = instead("Deadline", &handlers.late);
    let stp = instead("Stp", &handlers.stp);
    let deadline = match &handlers.deadline {
        Some(deadline) => quote!(::core::option::Option::Some(#deadline)),
        None => quote!(::core::option::Option::None),
    };
    let (text, has_stp) = (name.to_string(), handlers.stp.is_some());
    quote! {
        scope.reaction(
            #text,
            ::ictus::build::Handlers { deadline: #deadline, stp: #has_stp },
            #accesses,
            |state, ctx, items, case| {
                let #pattern = items;
                #late
                #stp
                Self::#name(state #(, #passed)*)
            },
        );
    }
}

/// A watchdog's handler.
fn watchdog(method: &mut ImplItemFn, attribute: &Attribute) -> Result<TokenStream> {
    let Meta::List(list) = &attribute.meta else {
        let message = "name the watchdog: `#[watchdog(guard)]`";
        return Err(Error::new_spanned(attribute, message));
    };
    let watchdog: Ident = list.parse_args()?;
    let arguments = arguments(method, "a watchdog's handler")?;
    for argument in &arguments {
        if let Argument::Item(item) = argument
            && !(item.kind == "PhysicalAction" && item.role == "effect")
        {
            let message = "a watchdog's handler runs at no tag: it takes `&mut Ctx` and actions as `&mut PhysicalAction<..>`";
            return Err(Error::new_spanned(&item.ty, message));
        }
    }
    let Items {
        accesses,
        pattern,
        passed,
    } = items(&arguments);
    let name = &method.sig.ident;
    let text = name.to_string();
    let part = quote_spanned!(watchdog.span()=> parts.#watchdog);
    Ok(quote! {
        scope.watchdog(&#part, #text, #accesses, |state, ctx, items| {
            let #pattern = items;
            Self::#name(state #(, #passed)*)
        });
    })
}

/// The items of a signature: as a value of `Args`, as a pattern for it, and as arguments of a call.
struct Items {
    accesses: TokenStream,
    pattern: TokenStream,
    passed: Vec<TokenStream>,
}

fn items(arguments: &[Argument]) -> Items {
    let mut accesses = quote!(());
    let mut pattern = quote!(());
    for (i, argument) in arguments.iter().enumerate().rev() {
        if let Argument::Item(item) = argument {
            let (role, part) = (Ident::new(item.role, item.ty.span()), &item.part);
            let binding = format_ident!("item_{i}");
            let span = item.ty.span();
            accesses = quote_spanned!(span=> (::ictus::build::#role(&#part), #accesses));
            pattern = quote!((#binding, #pattern));
        }
    }
    let passed = arguments.iter().enumerate();
    Items {
        accesses,
        pattern,
        passed: passed
            .map(|(i, argument)| self::passed(i, argument))
            .collect(),
    }
}

fn passed(i: usize, argument: &Argument) -> TokenStream {
    match argument {
        Argument::Context { ty } => quote_spanned!(ty.span()=> ctx),
        Argument::Item(item) => {
            let span = item.ty.span();
            let binding = format_ident!("item_{i}", span = span);
            if item.mutable {
                quote_spanned!(span=> #binding.item_mut())
            } else {
                quote_spanned!(span=> #binding.item())
            }
        }
    }
}

fn arguments(method: &mut ImplItemFn, what: &str) -> Result<Vec<Argument>> {
    let signature = &mut method.sig;
    if let ReturnType::Type(_, ty) = &signature.output {
        return Err(Error::new_spanned(
            ty,
            format!("{what} returns nothing: set an output or schedule an action instead"),
        ));
    }
    if let Some(token) = &signature.asyncness {
        return Err(Error::new_spanned(
            token,
            format!("{what} runs to its end: it cannot be async"),
        ));
    }
    let name = signature.ident.clone();
    let mut inputs = signature.inputs.iter_mut();
    match inputs.next() {
        Some(FnArg::Receiver(_)) => {}
        Some(FnArg::Typed(_)) | None => {
            let message =
                format!("{what} takes `&mut self` first: its reactor's parameters and state");
            return Err(Error::new(name.span(), message));
        }
    }
    inputs
        .map(|input| match input {
            FnArg::Typed(typed) => argument(typed),
            FnArg::Receiver(receiver) => Err(Error::new_spanned(receiver, "`self` stands first")),
        })
        .collect()
}

fn argument(typed: &mut PatType) -> Result<Argument> {
    let uses = take_attribute(&mut typed.attrs, "uses");
    let trigger = take_attribute(&mut typed.attrs, "trigger");
    let of = take_attribute(&mut typed.attrs, "of");
    let Type::Reference(reference) = &*typed.ty else {
        let message = "take parts by `&` (to read) or `&mut` (to set or schedule)";
        return Err(Error::new_spanned(&typed.ty, message));
    };
    let mutable = reference.mutability.is_some();
    let kind = type_name(&reference.elem);
    if kind == "Ctx" {
        let ty = typed.ty.clone();
        return Ok(Argument::Context { ty });
    }
    check_kind(&kind, mutable, &typed.ty)?;
    let role = match (mutable, &uses, &trigger) {
        (false, None, _) => "trigger",
        (false, Some(_), None) => "uses",
        (true, None, None) => "effect",
        (true, None, Some(_)) => "trigger_and_effect",
        (true, Some(attribute), _) | (false, Some(attribute), Some(_)) => {
            let message = "`#[uses]` is for what is read by `&` and does not trigger";
            return Err(Error::new_spanned(attribute, message));
        }
    };
    Ok(Argument::Item(Box::new(ItemArgument {
        role,
        part: part(typed, &kind, of.as_ref(), mutable)?,
        mutable,
        ty: (*typed.ty).clone(),
        kind,
    })))
}

fn check_kind(kind: &str, mutable: bool, at: &Type) -> Result<()> {
    let message = match (kind, mutable) {
        ("Input", true) => "an input is read: take it as `&Input<..>`",
        ("Output", false) => "an output is set: take it as `&mut Output<..>`",
        ("Timer", true) => "a timer is read: take it as `&Timer`",
        ("Startup" | "Shutdown", true) => "take it by `&`",
        ("Watchdog", false) => "a watchdog is started and stopped: take it as `&mut Watchdog`",
        _ => return Ok(()),
    };
    Err(Error::new_spanned(at, message))
}

/// The part that an argument names, as an expression.
fn part(typed: &PatType, kind: &str, of: Option<&Attribute>, mutable: bool) -> Result<TokenStream> {
    let span = typed.pat.span();
    match (kind, of) {
        ("Startup", None) => Ok(quote!(scope.startup())),
        ("Shutdown", None) => Ok(quote!(scope.shutdown())),
        (_, None) => {
            let name = part_name(&typed.pat)?;
            Ok(quote_spanned!(span=> parts.#name))
        }
        (_, Some(attribute)) => {
            let Meta::List(list) = &attribute.meta else {
                return Err(Error::new_spanned(
                    attribute,
                    "name the child's port: `#[of(child.out)]`",
                ));
            };
            let port: Expr = list.parse_args()?;
            let view = Ident::new(if mutable { "as_output" } else { "as_input" }, port.span());
            Ok(quote_spanned!(port.span()=> parts.#port.#view()))
        }
    }
}

/// The name of the part: the argument's, less a leading underscore.
fn part_name(pat: &Pat) -> Result<Ident> {
    let Pat::Ident(ident) = pat else {
        return Err(Error::new_spanned(
            pat,
            "give the argument the name of a port, timer or action; `_name` when it is not used",
        ));
    };
    let text = ident.ident.to_string();
    Ok(match text.strip_prefix('_') {
        Some(name) if !name.is_empty() => Ident::new(name, ident.ident.span()),
        _ => ident.ident.clone(),
    })
}

/// The last segment of a type's path.
fn type_name(ty: &Type) -> String {
    match ty {
        Type::Path(path) => match path.path.segments.last() {
            Some(segment) => segment.ident.to_string(),
            None => String::new(),
        },
        _ => ty.to_token_stream().to_string(),
    }
}

fn connections(method: &ImplItemFn, attribute: &Attribute) -> Result<TokenStream> {
    Options::of(attribute, &[])?;
    let mut passed = Vec::new();
    let mut wired = false;
    for input in &method.sig.inputs {
        match input {
            FnArg::Receiver(receiver) if receiver.mutability.is_none() => passed.push(quote!(self)),
            FnArg::Receiver(receiver) => {
                let message =
                    "connections are made once, before any reaction: take `&self` or nothing";
                return Err(Error::new_spanned(receiver, message));
            }
            FnArg::Typed(typed) => {
                let Type::Reference(reference) = &*typed.ty else {
                    return Err(Error::new_spanned(&typed.ty, "take parts by `&`"));
                };
                let span = typed.ty.span();
                if type_name(&reference.elem) == "Wiring" {
                    wired = true;
                    passed.push(quote_spanned!(span=> wiring));
                } else {
                    let name = part_name(&typed.pat)?;
                    let part = quote_spanned!(typed.pat.span()=> parts.#name);
                    passed.push(quote_spanned!(span=> &#part));
                }
            }
        }
    }
    let name = &method.sig.ident;
    if !wired {
        let message = "take `&mut Wiring`, which makes the connections";
        return Err(Error::new(name.span(), message));
    }
    Ok(quote!(scope.connections(|wiring| Self::#name(#(#passed),*));))
}
