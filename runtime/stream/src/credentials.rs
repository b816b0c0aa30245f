//! What a member needs to make connections of its own and to take those of others.

use crate::tls::{Tls, TlsError};
use crate::{Member, Papers, Stream};
use rustls::client::{Resumption, WebPkiServerVerifier};
use rustls::crypto::{CryptoProvider, ring};
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use rustls::server::WebPkiClientVerifier;
use rustls::version::TLS13;
use rustls::{
    ClientConfig, ClientConnection, Connection, RootCertStore, ServerConfig, ServerConnection,
};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use thiserror::Error;

/// A member's certificate and key, ready for use.
#[derive(Clone, Debug)]
pub struct Credentials {
    member: Member,
    run: Arc<str>,
    client: Arc<ClientConfig>,
    server: Arc<ServerConfig>,
}

/// Why a member has no credentials. All are fatal: who made the files must make others.
#[derive(Debug, Error)]
pub enum CredentialsError {
    /// A file cannot be read.
    #[error("cannot read {}: {source}", .path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// A text holds no certificate, or no key.
    #[error("there is no {what} in PEM form: {why}")]
    NotPem {
        /// Which.
        what: &'static str,
        /// Where it ends to be one.
        why: String,
    },
    /// Certificate and key do not fit, or are of no use.
    #[error("certificate and key cannot be used: {0}")]
    Unusable(String),
    /// The certificate is no member's.
    #[error("the certificate names no member of a federation")]
    Nobody,
    /// The certificate is another member's.
    #[error("the certificate is {found}'s, and this is {wanted}")]
    Another {
        /// Whose it is.
        found: Member,
        /// Who has it.
        wanted: Member,
    },
}

impl Credentials {
    /// Those in a directory with [`Papers::FILES`], which must be of `member`.
    ///
    /// # Errors
    ///
    /// When a file is missing, is not what it should be, or belongs to another member.
    pub fn load(directory: &Path, member: Member) -> Result<Self, CredentialsError> {
        let papers = Papers::read(directory)
            .map_err(|(path, source)| CredentialsError::Read { path, source })?;
        let credentials = Self::of(&papers)?;
        let found = credentials.member;
        if found == member {
            Ok(credentials)
        } else {
            let wanted = member;
            Err(CredentialsError::Another { found, wanted })
        }
    }

    /// Those of some member.
    ///
    /// # Errors
    ///
    /// When they are not what they should be.
    pub fn of(papers: &Papers) -> Result<Self, CredentialsError> {
        let authority = certificate("authority", &papers.authority)?;
        let certificate = certificate("certificate", &papers.certificate)?;
        let key = PrivateKeyDer::from_pem_slice(papers.key.as_bytes())
            .map_err(|error| not_pem("key", &error))?;
        let (member, run) = owner(&certificate).ok_or(CredentialsError::Nobody)?;
        let mut roots = RootCertStore::empty();
        roots.add(authority).map_err(unusable)?;
        let roots = Arc::new(roots);
        let provider = Arc::new(ring::default_provider());
        let pair = (certificate, key);
        Ok(Self {
            member,
            run: run.into(),
            client: Arc::new(client(&provider, &roots, &pair)?),
            server: Arc::new(server(&provider, roots, pair)?),
        })
    }

    /// Whose they are.
    #[must_use]
    pub const fn member(&self) -> Member {
        self.member
    }

    /// A connection that was made to `to`, who must show its certificate.
    ///
    /// # Errors
    ///
    /// When TLS cannot begin, which no peer can bring about.
    pub fn connect<T>(&self, tcp: T, to: Member) -> io::Result<Stream<T>> {
        let name = ServerName::try_from(to.name(&self.run)).map_err(io::Error::other)?;
        let connection = ClientConnection::new(Arc::clone(&self.client), name);
        let connection = Connection::Client(connection.map_err(io::Error::other)?);
        Ok(Stream::secure(
            tcp,
            Tls::new(connection, Some(to), &self.run),
        ))
    }

    /// A connection that was accepted from somebody, who must show the certificate of a federate.
    ///
    /// # Errors
    ///
    /// When TLS cannot begin, which no peer can bring about.
    pub fn accept<T>(&self, tcp: T) -> io::Result<Stream<T>> {
        let connection = ServerConnection::new(Arc::clone(&self.server));
        let connection = Connection::Server(connection.map_err(io::Error::other)?);
        Ok(Stream::secure(tcp, Tls::new(connection, None, &self.run)))
    }
}

type Pair = (CertificateDer<'static>, PrivateKeyDer<'static>);

fn client(
    provider: &Arc<CryptoProvider>,
    roots: &Arc<RootCertStore>,
    (certificate, key): &Pair,
) -> Result<ClientConfig, CredentialsError> {
    let verifier =
        WebPkiServerVerifier::builder_with_provider(Arc::clone(roots), Arc::clone(provider));
    let verifier = verifier
        .build()
        .map_err(|error| CredentialsError::Unusable(error.to_string()))?;
    let mut config = ClientConfig::builder_with_provider(Arc::clone(provider))
        .with_protocol_versions(&[&TLS13])
        .map_err(unusable)?
        .with_webpki_verifier(verifier)
        .with_client_auth_cert(vec![certificate.clone()], key.clone_key())
        .map_err(unusable)?;
    // A connection lasts as long as the federation.
    config.resumption = Resumption::disabled();
    Ok(config)
}

fn server(
    provider: &Arc<CryptoProvider>,
    roots: Arc<RootCertStore>,
    (certificate, key): Pair,
) -> Result<ServerConfig, CredentialsError> {
    let verifier = WebPkiClientVerifier::builder_with_provider(roots, Arc::clone(provider));
    let verifier = verifier
        .build()
        .map_err(|error| CredentialsError::Unusable(error.to_string()))?;
    let mut config = ServerConfig::builder_with_provider(Arc::clone(provider))
        .with_protocol_versions(&[&TLS13])
        .map_err(unusable)?
        .with_client_cert_verifier(verifier)
        .with_single_cert(vec![certificate], key)
        .map_err(unusable)?;
    config.send_tls13_tickets = 0;
    Ok(config)
}

/// The member and the run that a certificate is made out to.
pub(crate) fn owner(certificate: &CertificateDer<'_>) -> Option<(Member, String)> {
    let certificate = webpki::EndEntityCert::try_from(certificate).ok()?;
    let mut names = certificate.valid_dns_names();
    names.find_map(|name| Member::of_name(name).map(|(member, run)| (member, run.to_owned())))
}

fn certificate(what: &'static str, pem: &str) -> Result<CertificateDer<'static>, CredentialsError> {
    CertificateDer::from_pem_slice(pem.as_bytes()).map_err(|error| not_pem(what, &error))
}

fn not_pem(what: &'static str, error: &rustls::pki_types::pem::Error) -> CredentialsError {
    let why = error.to_string();
    CredentialsError::NotPem { what, why }
}

fn unusable(error: rustls::Error) -> CredentialsError {
    CredentialsError::Unusable(TlsError::Other(error).to_string())
}
