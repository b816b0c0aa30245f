//! Parameters as a container gives them to a child: `Stage { gain: 2 }` becomes `Stage`'s builder.

use proc_macro2::TokenStream;
use quote::{quote, quote_spanned};
use syn::spanned::Spanned;
use syn::{Block, Expr, ExprStruct, Member, Stmt, Type};

/// The expression for the parameters of a child of `class`.
pub(super) fn parameters(class: &Type, given: Option<&Expr>) -> TokenStream {
    let none =
        quote!(<<#class as ::ictus::build::Reactor>::Given as ::core::default::Default>::default());
    given.map_or(none, |given| rewritten(class, given))
}

/// Struct literals in the places where the expression's value comes from become builder calls.
fn rewritten(class: &Type, expr: &Expr) -> TokenStream {
    match expr {
        Expr::Struct(literal) => calls(class, literal),
        Expr::Closure(closure) => {
            let body = rewritten(class, &closure.body);
            let inputs = &closure.inputs;
            let capture = &closure.capture;
            quote_spanned!(closure.span()=> #capture |#inputs| #body)
        }
        Expr::Block(block) if block.label.is_none() => {
            let body = rewritten_block(class, &block.block);
            quote!({ #body })
        }
        Expr::Paren(inner) => rewritten(class, &inner.expr),
        other => quote!(#other),
    }
}

fn rewritten_block(class: &Type, block: &Block) -> TokenStream {
    match block.stmts.split_last() {
        Some((Stmt::Expr(last, None), before)) => {
            let last = rewritten(class, last);
            quote!(#(#before)* #last)
        }
        _ => {
            let stmts = &block.stmts;
            quote!(#(#stmts)*)
        }
    }
}

fn calls(class: &Type, literal: &ExprStruct) -> TokenStream {
    let calls = literal.fields.iter().map(|field| {
        let value = &field.expr;
        match &field.member {
            Member::Named(name) => quote_spanned!(name.span()=> .#name(#value)),
            Member::Unnamed(index) => quote_spanned!(index.span=> .#index(#value)),
        }
    });
    quote! {
        <<#class as ::ictus::build::Reactor>::Given as ::core::default::Default>::default() #(#calls)*
    }
}
