//! Who signs the certificates of one run: made for it, and forgotten with it.

use crate::{Member, Papers};
use rcgen::{
    BasicConstraints, CertificateParams, DistinguishedName, DnType, ExtendedKeyUsagePurpose, IsCa,
    Issuer, KeyPair, KeyUsagePurpose, date_time_ymd,
};
use thiserror::Error;

/// An authority. Its key is nowhere but here.
#[derive(Debug)]
pub struct Authority {
    run: String,
    certificate: String,
    issuer: Issuer<'static, KeyPair>,
}

/// Why no certificate can be made.
#[derive(Debug, Error)]
pub enum AuthorityError {
    /// The run's id cannot stand in a name.
    #[error("a run's id is 1 to 63 letters and digits, not {0:?}")]
    Run(String),
    /// The system gives no randomness, or signing fails.
    #[error("cannot make certificates: {0}")]
    Signing(#[from] rcgen::Error),
}

impl Authority {
    /// An authority for the run with this random id: 1 to 63 lower-case letters and digits.
    ///
    /// # Errors
    ///
    /// When the id has another form, or the system gives no randomness.
    pub fn new(run: &str) -> Result<Self, AuthorityError> {
        let allowed = |byte: u8| byte.is_ascii_digit() || byte.is_ascii_lowercase();
        if !(1..=63).contains(&run.len()) || !run.bytes().all(allowed) {
            return Err(AuthorityError::Run(run.to_owned()));
        }
        let mut params = params(&[], &format!("ictus {run}"))?;
        params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
        params.key_usages.push(KeyUsagePurpose::KeyCertSign);
        let key = KeyPair::generate()?;
        let certificate = params.self_signed(&key)?.pem();
        Ok(Self {
            run: run.to_owned(),
            certificate,
            issuer: Issuer::new(params, key),
        })
    }

    /// Signs a new key for a member.
    ///
    /// # Errors
    ///
    /// When the system gives no randomness.
    pub fn certify(&self, member: Member) -> Result<Papers, AuthorityError> {
        let name = member.name(&self.run);
        let mut params = params(&[name], &member.to_string())?;
        params.key_usages.push(KeyUsagePurpose::DigitalSignature);
        // A federate accepts and connects.
        params.extended_key_usages = vec![
            ExtendedKeyUsagePurpose::ServerAuth,
            ExtendedKeyUsagePurpose::ClientAuth,
        ];
        let key = KeyPair::generate()?;
        let certificate = params.signed_by(&key, &self.issuer)?;
        Ok(Papers {
            authority: self.certificate.clone(),
            certificate: certificate.pem(),
            key: key.serialize_pem(),
        })
    }
}

/// What is common to both. Valid whatever a host's clock shows: the run's name is the limit.
fn params(names: &[String], common: &str) -> Result<CertificateParams, AuthorityError> {
    let mut params = CertificateParams::new(names)?;
    params.not_before = date_time_ymd(1970, 1, 1);
    params.not_after = date_time_ymd(9999, 12, 31);
    params.distinguished_name = DistinguishedName::new();
    params.distinguished_name.push(DnType::CommonName, common);
    Ok(params)
}
