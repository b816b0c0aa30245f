//! The code that `#[reactor]` expands to.

use super::{Action, Kind, Member, given};
use proc_macro2::{Span, TokenStream, TokenTree};
use quote::{ToTokens, format_ident, quote, quote_spanned};
use syn::spanned::Spanned;
use syn::{Expr, GenericParam, Generics, Ident, ItemStruct, Type, parse_quote};

pub(super) fn all(input: &ItemStruct, members: &[Member]) -> TokenStream {
    let class = Class::new(input, members);
    let state = class.state();
    let parameters = class.parameters();
    let given = class.given();
    let parts = class.parts();
    let reactor = class.reactor();
    quote! {
        #state

        #[allow(
            dead_code,
            missing_docs,
            missing_debug_implementations,
            unnameable_types,
            unreachable_pub,
            unused_variables,
            clippy::clone_on_copy,
            clippy::needless_update,
            clippy::new_without_default,
            clippy::type_complexity,
            clippy::use_self
        )]
        const _: () = {
            #parameters
            #given
            #parts
            #reactor
        };
    }
}

struct Class<'a> {
    input: &'a ItemStruct,
    members: &'a [Member],
    /// `GivenName<T, G0, G1>`: one more parameter for each required one.
    given_generics: Generics,
    parameters: Ident,
    given: Ident,
    parts: Ident,
}

/// A parameter of the class.
struct Parameter<'a> {
    name: &'a Ident,
    ty: &'a Type,
    default: Option<&'a Expr>,
    /// The type parameter that says whether it is given, when it must be.
    marker: Option<Ident>,
}

impl<'a> Class<'a> {
    fn new(input: &'a ItemStruct, members: &'a [Member]) -> Self {
        let mut class = Self {
            input,
            members,
            given_generics: input.generics.clone(),
            parameters: format_ident!("{}Parameters", input.ident),
            given: format_ident!("{}Given", input.ident),
            parts: format_ident!("{}Parts", input.ident),
        };
        for marker in class.all_parameters().into_iter().filter_map(|p| p.marker) {
            class.given_generics.params.push(parse_quote!(#marker));
        }
        class
    }

    fn all_parameters(&self) -> Vec<Parameter<'a>> {
        let mut required = 0;
        let parameters = self.members.iter().filter_map(|member| match &member.kind {
            Kind::Parameter { default } => Some((member, default)),
            _ => None,
        });
        parameters
            .map(|(member, default)| Parameter {
                name: &member.name,
                ty: &member.ty,
                default: default.as_ref(),
                marker: default.is_none().then(|| {
                    required += 1;
                    format_ident!("Given{required}")
                }),
            })
            .collect()
    }

    /// `PhantomData<fn() -> (T, ..)>`, for types that may not name all type parameters.
    fn phantom(&self) -> TokenStream {
        let types = self.input.generics.type_params().map(|p| &p.ident);
        quote!(::core::marker::PhantomData<fn() -> (#(#types,)*)>)
    }

    /// The user's struct with what stays in it.
    fn state(&self) -> TokenStream {
        let ItemStruct {
            attrs,
            vis,
            ident,
            generics,
            ..
        } = self.input;
        let where_clause = &generics.where_clause;
        let fields = self
            .members
            .iter()
            .filter(|m| m.kind.stays())
            .map(|member| {
                let Member {
                    attributes,
                    name,
                    ty,
                    vis,
                    kind,
                } = member;
                // A parameter may serve timers, widths and children only.
                let allow =
                    (!matches!(kind, Kind::State { .. })).then(|| quote!(#[allow(dead_code)]));
                quote!(#(#attributes)* #allow #vis #name: #ty)
            });
        let phantom = generics.type_params().next().map(|_| {
            let phantom = self.phantom();
            quote!(#[doc(hidden)] __types: #phantom,)
        });
        quote! {
            #(#attrs)*
            #vis struct #ident #generics #where_clause {
                #(#fields,)*
                #phantom
            }
        }
    }

    fn parameters(&self) -> TokenStream {
        let name = &self.parameters;
        let generics = &self.input.generics;
        let where_clause = &generics.where_clause;
        let fields = self.all_parameters();
        let fields = fields.iter().map(|p| {
            let (name, ty) = (p.name, p.ty);
            quote!(#name: #ty)
        });
        let phantom = self.phantom();
        quote! {
            pub struct #name #generics #where_clause { #(#fields,)* __types: #phantom }
        }
    }

    /// The builder of the parameters: a required one that is not given is a type error.
    fn given(&self) -> TokenStream {
        let name = &self.given;
        let parameters = self.all_parameters();
        let (impl_generics, type_generics, where_clause) = self.given_generics.split_for_impl();
        let fields = parameters.iter().map(|p| {
            let (name, ty) = (p.name, p.ty);
            match &p.marker {
                Some(marker) => quote!(#name: #marker),
                None => quote!(#name: ::core::option::Option<#ty>),
            }
        });
        let setters = parameters.iter().map(|p| self.setter(p, &parameters));
        let phantom = self.phantom();
        let generics = &self.given_generics;
        let (none, whole) = (self.given_none(), self.given_whole());
        quote! {
            pub struct #name #generics #where_clause { #(#fields,)* __types: #phantom }

            impl #impl_generics #name #type_generics #where_clause { #(#setters)* }

            #none
            #whole
        }
    }

    fn setter(&self, parameter: &Parameter<'_>, all: &[Parameter<'_>]) -> TokenStream {
        let (name, ty) = (parameter.name, parameter.ty);
        let Some(marker) = &parameter.marker else {
            return quote! {
                pub fn #name(mut self, value: #ty) -> Self {
                    self.#name = ::core::option::Option::Some(value);
                    self
                }
            };
        };
        let given = &self.given;
        let arguments = self.given_arguments(|other| {
            if other == marker {
                ty.to_token_stream()
            } else {
                other.to_token_stream()
            }
        });
        let fields = all.iter().map(|other| {
            let field = other.name;
            if field == name {
                quote!(#field: value)
            } else {
                quote!(#field: self.#field)
            }
        });
        quote! {
            pub fn #name(self, value: #ty) -> #given #arguments {
                #given { #(#fields,)* __types: self.__types }
            }
        }
    }

    /// The generic arguments of the builder, with each marker replaced.
    fn given_arguments(&self, marker: impl Fn(&Ident) -> TokenStream) -> TokenStream {
        let own = self.input.generics.params.iter().map(|p| match p {
            GenericParam::Type(p) => p.ident.to_token_stream(),
            GenericParam::Const(p) => p.ident.to_token_stream(),
            GenericParam::Lifetime(p) => p.lifetime.to_token_stream(),
        });
        let parameters = self.all_parameters();
        let markers = parameters
            .iter()
            .filter_map(|p| p.marker.as_ref())
            .map(marker);
        quote!(<#(#own,)* #(#markers,)*>)
    }

    /// Nothing given yet.
    fn given_none(&self) -> TokenStream {
        let (impl_generics, _, where_clause) = self.input.generics.split_for_impl();
        let given = &self.given;
        let missing = self.given_arguments(|_| quote!(::ictus::build::Missing));
        let fields = self.all_parameters().into_iter().map(|p| {
            let name = p.name;
            match p.marker {
                Some(_) => quote!(#name: ::ictus::build::Missing),
                None => quote!(#name: ::core::option::Option::None),
            }
        });
        quote! {
            impl #impl_generics ::core::default::Default for #given #missing #where_clause {
                fn default() -> Self {
                    Self { #(#fields,)* __types: ::core::marker::PhantomData }
                }
            }
        }
    }

    /// Everything required is given: defaults fill the rest, in order, so that one may name those before it.
    fn given_whole(&self) -> TokenStream {
        let (impl_generics, type_generics, where_clause) = self.input.generics.split_for_impl();
        let (parameters, given) = (&self.parameters, &self.given);
        let all = self.all_parameters();
        let types = |marker: &Ident| {
            let of = all.iter().find(|p| p.marker.as_ref() == Some(marker));
            of.map_or_else(TokenStream::new, |p| p.ty.to_token_stream())
        };
        let whole = self.given_arguments(types);
        let names: Vec<_> = all.iter().map(|p| p.name).collect();
        let values = all.iter().map(|p| {
            let (name, ty) = (p.name, p.ty);
            match p.default {
                None => quote!(let #name: #ty = __given.#name;),
                Some(default) => {
                    let default = self.over_parameters(default);
                    quote! {
                        let #name: #ty = match __given.#name {
                            ::core::option::Option::Some(value) => value,
                            ::core::option::Option::None => #default,
                        };
                    }
                }
            }
        });
        quote! {
            impl #impl_generics ::ictus::build::Complete<#parameters #type_generics>
                for #given #whole #where_clause
            {
                fn complete(self) -> #parameters #type_generics {
                    let __given = self;
                    #(#values)*
                    #parameters { #(#names,)* __types: ::core::marker::PhantomData }
                }
            }
        }
    }

    /// Ports, timers, actions and children.
    fn parts(&self) -> TokenStream {
        let name = &self.parts;
        let generics = &self.input.generics;
        let where_clause = &generics.where_clause;
        let fields = self
            .members
            .iter()
            .filter(|m| !m.kind.stays())
            .map(|member| {
                let Member { name, ty, vis, .. } = member;
                match member.kind {
                    Kind::Input
                    | Kind::Output
                    | Kind::MultiInput { .. }
                    | Kind::MultiOutput { .. } => quote!(pub #name: #ty),
                    _ => quote!(#vis #name: #ty),
                }
            });
        let phantom = self.phantom();
        quote! {
            pub struct #name #generics #where_clause { #(#fields,)* __types: #phantom }
        }
    }

    fn reactor(&self) -> TokenStream {
        let class = &self.input.ident;
        let text = class.to_string();
        let (impl_generics, type_generics, where_clause) = self.input.generics.split_for_impl();
        let (parameters, given, parts) = (&self.parameters, &self.given, &self.parts);
        let missing = self.given_arguments(|_| quote!(::ictus::build::Missing));
        let described = self.all_parameters().into_iter().map(|p| {
            let (name, ty) = (p.name.to_string(), type_text(p.ty));
            let required = p.default.is_none();
            quote!(::ictus::build::parameter(#name, #ty, #required))
        });
        let (read, declare) = (self.read(), self.declare());
        quote! {
            impl #impl_generics ::ictus::build::Reactor for #class #type_generics #where_clause {
                const NAME: &'static str = #text;
                type Parameters = #parameters #type_generics;
                type Given = #given #missing;
                type Parts = #parts #type_generics;

                fn parameters() -> ::std::vec::Vec<::ictus::build::ParameterDescription> {
                    ::std::vec![#(#described),*]
                }

                #read
                #declare
            }
        }
    }

    fn read(&self) -> TokenStream {
        let all = self.all_parameters();
        let names: Vec<_> = all.iter().map(|p| p.name).collect();
        let values = all.iter().map(|p| {
            let (name, ty) = (p.name, p.ty);
            let (text, type_text) = (name.to_string(), type_text(ty));
            match p.default {
                None => quote!(let #name: #ty = __source.require(#text, #type_text)?;),
                Some(default) => {
                    let default = self.over_parameters(default);
                    quote! {
                        let #name: #ty = match __source.take(#text, #type_text)? {
                            ::core::option::Option::Some(value) => value,
                            ::core::option::Option::None => #default,
                        };
                    }
                }
            }
        });
        quote! {
            fn read(
                __source: &mut ::ictus::build::ParameterSource,
            ) -> ::core::result::Result<Self::Parameters, ::ictus::build::ParameterError> {
                #(#values)*
                ::core::result::Result::Ok(Self::Parameters {
                    #(#names,)*
                    __types: ::core::marker::PhantomData,
                })
            }
        }
    }

    fn declare(&self) -> TokenStream {
        let parameters: Vec<_> = self.all_parameters().iter().map(|p| p.name).collect();
        let index = self
            .members
            .iter()
            .filter(|m| matches!(m.kind, Kind::BankIndex));
        let index = index.map(|m| {
            let (name, ty) = (&m.name, &m.ty);
            quote!(let #name: #ty = __scope.bank_index();)
        });
        let values = self.members.iter().map(|m| self.member_value(m));
        let stay: Vec<_> = self
            .members
            .iter()
            .filter(|m| m.kind.stays())
            .map(|m| &m.name)
            .collect();
        let go = self
            .members
            .iter()
            .filter(|m| !m.kind.stays())
            .map(|m| &m.name);
        let types = self.input.generics.type_params().next();
        let types = types.map(|_| quote!(__types: ::core::marker::PhantomData,));
        let parts = &self.parts;
        quote! {
            fn declare(
                __parameters: Self::Parameters,
                __scope: &mut ::ictus::build::Scope<'_>,
            ) -> (Self, Self::Parts) {
                let Self::Parameters { #(#parameters,)* .. } = __parameters;
                #(#index)*
                #(#values)*
                let __parts = #parts { #(#go,)* __types: ::core::marker::PhantomData };
                (Self { #(#stay,)* #types }, __parts)
            }
        }
    }

    /// Declares one member as a local variable of its name.
    fn member_value(&self, member: &Member) -> TokenStream {
        let Member { name, ty, kind, .. } = member;
        let text = name.to_string();
        let over = |expr: &Expr| self.over_parameters(expr);
        let duration = |expr: &Option<Expr>| match expr {
            Some(expr) => over(expr),
            None => quote!(::ictus::Duration::ZERO),
        };
        let value = match kind {
            Kind::Parameter { .. } | Kind::BankIndex => return TokenStream::new(),
            Kind::State { init: Some(init) } => over(init),
            Kind::State { init: None } => {
                let span = ty
                    .to_token_stream()
                    .into_iter()
                    .next()
                    .map_or_else(Span::call_site, |t| t.span());
                quote_spanned!(span=> <#ty as ::core::default::Default>::default())
            }
            Kind::Input => quote!(__scope.input(#text)),
            Kind::Output => quote!(__scope.output(#text)),
            Kind::MultiInput { width } => {
                let width = over(width);
                quote!(__scope.multi_input(#text, #width))
            }
            Kind::MultiOutput { width } => {
                let width = over(width);
                quote!(__scope.multi_output(#text, #width))
            }
            Kind::Timer { offset, period } => {
                let (offset, period) = (duration(offset), duration(period));
                quote!(__scope.timer(#offset, #period))
            }
            Kind::Logical(action) => {
                let (min_delay, spacing) = (duration(&action.min_delay), self.spacing(action));
                quote!(__scope.logical_action(#text, #min_delay, #spacing))
            }
            Kind::Physical(action) => {
                let (min_delay, spacing) = (duration(&action.min_delay), self.spacing(action));
                quote!(__scope.physical_action(#text, #min_delay, #spacing))
            }
            Kind::Watchdog { timeout } => {
                let timeout = over(timeout);
                quote!(__scope.watchdog(#text, #timeout))
            }
            Kind::Child { class, given } => {
                let given = self.with_parameters(&given::parameters(class, given.as_ref()));
                quote_spanned!(class.span()=> __scope.child(#text, #given))
            }
            Kind::Bank {
                class,
                given,
                width,
            } => {
                let given = match given {
                    // Called once for each member: it owns copies of the parameters, and each call gets its own.
                    Some(Expr::Closure(closure)) => {
                        let body = given::parameters(class, Some(&closure.body));
                        let (body, inputs) = (self.with_parameters(&body), &closure.inputs);
                        quote_spanned!(closure.span()=> move |#inputs| #body)
                    }
                    other => {
                        let given = given::parameters(class, other.as_ref());
                        quote!(|_| #given)
                    }
                };
                let (given, width) = (self.with_parameters(&given), over(width));
                quote_spanned!(class.span()=> __scope.bank(#text, #width, #given))
            }
        };
        quote!(let #name: #ty = #value;)
    }

    fn spacing(&self, action: &Action) -> TokenStream {
        let Some(min) = &action.min_spacing else {
            return quote!(::ictus::build::Spacing::NONE);
        };
        let min = self.over_parameters(min);
        let policy = match &action.policy {
            Some(policy) => quote!(::ictus::build::SpacingPolicy::#policy),
            None => quote!(::ictus::build::SpacingPolicy::Defer),
        };
        quote!(::ictus::build::Spacing { min: #min, policy: #policy })
    }

    fn over_parameters(&self, expr: &Expr) -> TokenStream {
        self.with_parameters(&expr.to_token_stream())
    }

    /// The expression with copies of the parameters that it names: it may consume them.
    fn with_parameters(&self, expr: &TokenStream) -> TokenStream {
        let named = self.members.iter().filter(|member| {
            matches!(member.kind, Kind::Parameter { .. } | Kind::BankIndex)
                && mentions(expr.clone(), &member.name)
        });
        let copies: Vec<_> = named
            .map(|member| {
                let name = &member.name;
                quote!(let #name = ::core::clone::Clone::clone(&#name);)
            })
            .collect();
        if copies.is_empty() {
            expr.clone()
        } else {
            quote!({ #(#copies)* #expr })
        }
    }
}

/// Whether an identifier occurs in the tokens, also as `{name}` in a format string.
fn mentions(tokens: TokenStream, name: &Ident) -> bool {
    tokens.into_iter().any(|token| match token {
        TokenTree::Ident(ident) => ident == *name,
        TokenTree::Group(group) => mentions(group.stream(), name),
        TokenTree::Literal(literal) => literal.to_string().contains(&format!("{{{name}")),
        TokenTree::Punct(_) => false,
    })
}

/// A type as one would write it.
fn type_text(ty: &Type) -> String {
    let text = ty.to_token_stream().to_string();
    let text = text
        .replace(" :: ", "::")
        .replace(" < ", "<")
        .replace(" >", ">");
    text.replace(" ,", ",")
        .replace(" ;", ";")
        .replace("& ", "&")
}
