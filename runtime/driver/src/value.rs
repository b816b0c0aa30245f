//! Values: what ports and actions carry.
//!
//! Three things are asked of a type, all settled at compile time: a **digest** that depends on the value alone, for
//! traces; an **identity** (name and layout), so that two programs can be connected safely; and **serializers** by
//! name, for crossing process borders. `#[derive(Value)]` answers all three.

mod builtin;
mod codec;
mod digest;
mod layout;
mod native;

pub use codec::{Codec, CodecError, Portable};
pub use digest::Digest;
pub use layout::Layout;
pub use native::{Native, put_front, take_front};

use ictus_coord::describe::TypeIdentity;

/// What a port or an action can carry.
///
/// Laws: equal values have equal digests; decoding what was encoded gives a value with the same digest, for every
/// serializer of the type.
#[diagnostic::on_unimplemented(
    message = "`{Self}` cannot be carried by ports and actions",
    label = "not a value",
    note = "add `#[derive(Clone, ictus::Value)]` to the type"
)]
pub trait Value: Clone + Send + 'static {
    /// The declared name, without module path.
    fn type_name() -> String;

    /// Describes field names, types and order.
    fn layout(layout: &mut Layout);

    /// Mixes the value into a digest; a type that has none calls [`Digest::refuse`], and traces show `?`.
    fn digest(&self, digest: &mut Digest);

    /// Mixes several values into a digest, as calling [`Value::digest`] in order, or faster.
    fn digest_all(items: &[Self], digest: &mut Digest) {
        for item in items {
            item.digest(digest);
        }
    }

    /// The fixed-layout little-endian form, when the type is plain old data.
    #[must_use]
    fn native() -> Option<Codec<Self>> {
        None
    }

    /// The postcard form, when the type offers it.
    #[must_use]
    fn postcard() -> Option<Codec<Self>> {
        None
    }

    /// Every serializer of the type by name, best first.
    #[must_use]
    fn serializers() -> Vec<(&'static str, Codec<Self>)> {
        let native = Self::native().map(|codec| ("native", codec));
        let postcard = Self::postcard().map(|codec| ("postcard", codec));
        native.into_iter().chain(postcard).collect()
    }
}

/// The identity of a type: ports may be connected only when theirs are equal.
#[must_use]
pub fn identity<T: Value>() -> TypeIdentity {
    let mut layout = Layout::default();
    T::layout(&mut layout);
    TypeIdentity {
        name: T::type_name(),
        fingerprint: layout.fingerprint(),
    }
}

/// The digest of one value; `None` when its type has none.
#[must_use]
pub fn digest_of<T: Value>(value: &T) -> Option<u64> {
    let mut digest = Digest::new();
    value.digest(&mut digest);
    digest.finish()
}
