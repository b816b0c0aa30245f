//! A TCP connection between members of a federation: in the clear, or under TLS with certificates of one run.
//!
//! Every run has an authority of its own, which signs one certificate for each member and is then forgotten. Both ends show
//! theirs: who connects knows whom it wants to reach, and who accepts learns who has come. The bytes inside are the same.

#[cfg(feature = "authority")]
mod authority;
mod credentials;
mod member;
mod papers;
mod stream;
#[cfg(test)]
mod tests;
mod tls;

#[cfg(feature = "authority")]
pub use authority::{Authority, AuthorityError};
pub use credentials::{Credentials, CredentialsError};
pub use member::Member;
pub use papers::Papers;
pub use stream::Stream;
pub use tls::TlsError;
