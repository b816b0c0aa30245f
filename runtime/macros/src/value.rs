//! `#[derive(Value)]`.

use crate::options::Options;
use proc_macro2::{Span, TokenStream};
use quote::{ToTokens, format_ident, quote, quote_spanned};
use syn::spanned::Spanned;
use syn::{Data, DeriveInput, Error, Fields, Generics, Ident, Result, Type, parse_quote, parse2};

pub(crate) fn expand(item: TokenStream) -> Result<TokenStream> {
    let input: DeriveInput = parse2(item)?;
    let mut serializers = Serializers::default();
    for attribute in input.attrs.iter().filter(|a| a.path().is_ident("value")) {
        let options = Options::of(attribute, &["native", "postcard"])?;
        serializers.native = serializers.native.or(options.flag("native"));
        serializers.postcard |= options.flag("postcard").is_some();
    }
    let shape = Shape::of(&input)?;
    let value = value_impl(&input, &shape, &serializers);
    let native = match serializers.native {
        None => TokenStream::new(),
        Some(span) => native_impl(&input, &shape, span)?,
    };
    Ok(quote! { #value #native })
}

#[derive(Default)]
struct Serializers {
    native: Option<Span>,
    postcard: bool,
}

/// The fields of a struct, or of each variant of an enum.
enum Shape {
    Struct(Vec<Field>),
    Enum(Vec<(Ident, Vec<Field>)>),
}

struct Field {
    /// The name or the position.
    member: syn::Member,
    binding: Ident,
    ty: Type,
}

impl Field {
    fn all(fields: &Fields) -> Vec<Self> {
        let pairs = fields.members().zip(fields).enumerate();
        pairs
            .map(|(i, (member, field))| Self {
                member,
                binding: format_ident!("field_{i}"),
                ty: field.ty.clone(),
            })
            .collect()
    }

    fn name(&self) -> String {
        self.member.to_token_stream().to_string()
    }
}

impl Shape {
    fn of(input: &DeriveInput) -> Result<Self> {
        match &input.data {
            Data::Struct(data) => Ok(Self::Struct(Field::all(&data.fields))),
            Data::Enum(data) => Ok(Self::Enum(
                data.variants
                    .iter()
                    .map(|v| (v.ident.clone(), Field::all(&v.fields)))
                    .collect(),
            )),
            Data::Union(data) => {
                let message = "a union cannot be a value: its bytes have no one meaning";
                Err(Error::new(data.union_token.span, message))
            }
        }
    }
}

fn bounded(generics: &Generics, bound: &TokenStream) -> Generics {
    let mut generics = generics.clone();
    for parameter in generics.type_params_mut() {
        let bound: syn::TypeParam = parse_quote!(T: #bound);
        parameter.bounds.extend(bound.bounds);
    }
    generics
}

fn value_impl(input: &DeriveInput, shape: &Shape, serializers: &Serializers) -> TokenStream {
    let name = &input.ident;
    let mut bound = quote!(::ictus::Value);
    if serializers.native.is_some() {
        bound = quote!(#bound + ::ictus::value::Native);
    }
    if serializers.postcard {
        bound = quote!(#bound + ::ictus::value::Portable);
    }
    let generics = bounded(&input.generics, &bound);
    let (impl_generics, type_generics, where_clause) = generics.split_for_impl();
    let type_name = type_name(name, &input.generics);
    let (layout, digest) = match shape {
        Shape::Struct(fields) => (struct_layout(fields), struct_digest(fields)),
        Shape::Enum(variants) => (enum_layout(variants), enum_digest(variants)),
    };
    let native = serializers.native.map(|_| {
        quote! {
            fn native() -> ::core::option::Option<::ictus::value::Codec<Self>> {
                ::core::option::Option::Some(::ictus::value::Codec::of_native())
            }
        }
    });
    let postcard = serializers.postcard.then(|| {
        quote! {
            fn postcard() -> ::core::option::Option<::ictus::value::Codec<Self>> {
                ::core::option::Option::Some(::ictus::value::Codec::of_serde())
            }
        }
    });
    let name_text = name.to_string();
    quote! {
        #[automatically_derived]
        impl #impl_generics ::ictus::Value for #name #type_generics #where_clause {
            fn type_name() -> ::std::string::String {
                #type_name
            }

            fn layout(layout: &mut ::ictus::value::Layout) {
                layout.declared(#name_text, |layout| { #layout });
            }

            #[inline]
            fn digest(&self, digest: &mut ::ictus::value::Digest) {
                #digest
            }

            #native
            #postcard
        }
    }
}

fn type_name(name: &Ident, generics: &Generics) -> TokenStream {
    let name = name.to_string();
    let parameters: Vec<_> = generics.type_params().map(|p| &p.ident).collect();
    if parameters.is_empty() {
        quote!(::std::string::String::from(#name))
    } else {
        quote! {{
            let parameters: &[::std::string::String] =
                &[#(<#parameters as ::ictus::Value>::type_name()),*];
            ::std::format!("{}<{}>", #name, parameters.join(", "))
        }}
    }
}

fn field_layouts(fields: &[Field]) -> TokenStream {
    let parts = fields.iter().map(|field| {
        let (name, ty) = (field.name(), &field.ty);
        // The type's tokens carry the user's span: a field that is no value is shown where it stands.
        quote_spanned! {ty.span()=>
            layout.field(#name);
            <#ty as ::ictus::Value>::layout(layout);
        }
    });
    quote!(#(#parts)*)
}

fn struct_layout(fields: &[Field]) -> TokenStream {
    let fields = field_layouts(fields);
    quote!(let _ = &layout; #fields)
}

fn enum_layout(variants: &[(Ident, Vec<Field>)]) -> TokenStream {
    let variants = variants.iter().map(|(name, fields)| {
        let (name, fields) = (name.to_string(), field_layouts(fields));
        quote!(layout.variant(#name); #fields)
    });
    quote!(let _ = &layout; #(#variants)*)
}

fn struct_digest(fields: &[Field]) -> TokenStream {
    let fields = fields.iter().map(|field| {
        let (member, ty) = (&field.member, &field.ty);
        quote!(<#ty as ::ictus::Value>::digest(&self.#member, digest);)
    });
    quote!(let _ = &digest; #(#fields)*)
}

fn enum_digest(variants: &[(Ident, Vec<Field>)]) -> TokenStream {
    if variants.is_empty() {
        return quote!(let _ = digest; match *self {});
    }
    let arms = variants.iter().enumerate().map(|(index, (name, fields))| {
        let index = index as u64;
        let members = fields.iter().map(|f| &f.member);
        let bindings = fields.iter().map(|f| &f.binding);
        let digests = fields.iter().map(|field| {
            let (binding, ty) = (&field.binding, &field.ty);
            quote!(<#ty as ::ictus::Value>::digest(#binding, digest);)
        });
        quote! {
            Self::#name { #(#members: #bindings),* } => {
                digest.word(#index);
                #(#digests)*
            }
        }
    });
    quote!(match self { #(#arms)* })
}

fn native_impl(input: &DeriveInput, shape: &Shape, at: Span) -> Result<TokenStream> {
    let Shape::Struct(fields) = shape else {
        let message = "an enum is not plain old data; offer `#[value(postcard)]` instead";
        return Err(Error::new(at, message));
    };
    let name = &input.ident;
    let generics = bounded(&input.generics, &quote!(::ictus::value::Native));
    let (impl_generics, type_generics, where_clause) = generics.split_for_impl();
    let sizes = fields.iter().map(|field| {
        let ty = &field.ty;
        quote_spanned!(ty.span()=> + <#ty as ::ictus::value::Native>::SIZE)
    });
    let puts = fields.iter().map(|field| {
        let (member, ty) = (&field.member, &field.ty);
        quote!(let rest = ::ictus::build::put_front::<#ty>(&self.#member, rest);)
    });
    let takes = fields.iter().map(|field| {
        let (member, ty) = (&field.member, &field.ty);
        quote!(#member: ::ictus::build::take_front::<#ty>(&mut rest)?)
    });
    Ok(quote! {
        #[automatically_derived]
        impl #impl_generics ::ictus::value::Native for #name #type_generics #where_clause {
            const SIZE: usize = 0 #(#sizes)*;

            #[inline]
            fn put(&self, out: &mut [u8]) {
                let rest = out;
                #(#puts)*
                let _ = rest;
            }

            #[inline]
            fn take(input: &[u8]) -> ::core::result::Result<Self, ::ictus::value::CodecError> {
                let mut rest = input;
                let _ = &mut rest;
                ::core::result::Result::Ok(Self { #(#takes),* })
            }
        }
    })
}
