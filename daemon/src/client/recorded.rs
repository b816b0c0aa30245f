//! The client's calls for what runs have left; see [`crate::api::recorded`].

use std::io::Write;
use std::time::Duration;

use http_body_util::BodyExt;
use hyper::Method;
use hyper::body::Bytes;
use tokio::time::timeout;

use super::{Client, ClientError, path};
use crate::api::recorded::{FileKind, Generation, GenerationView, Recorded};

/// How long a file's next bytes may take.
const PIECE_MAX: Duration = Duration::from_secs(30);

impl Client {
    /// Every federation of which anything is left, sorted.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn names(&self) -> Result<Vec<String>, ClientError> {
        self.answer(Method::GET, "/v1/names", Bytes::new()).await
    }

    /// What the last run of a federation has written so far.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn recorded(&self, name: &str) -> Result<Recorded, ClientError> {
        self.answer(Method::GET, &path(name, "/recorded", &[]), Bytes::new())
            .await
    }

    /// Copies a federate's file from a position on, piece by piece; gives the bytes that came.
    ///
    /// # Errors
    /// See [`ClientError`]; bytes that cannot be written are [`ClientError::Unwritable`].
    pub async fn copy_recorded(
        &self,
        name: &str,
        (kind, federate, from): (FileKind, &str, u64),
        into: &mut impl Write,
    ) -> Result<u64, ClientError> {
        let call = format!("/recorded/{}/{}", kind.name(), super::escape(federate));
        let from = from.to_string();
        let path = path(name, &call, &[("from", &from)]);
        let (response, _connection) = self.send(Method::GET, &path, Bytes::new()).await?;
        let (mut body, mut copied) = (response.into_body(), 0);
        loop {
            let frame = timeout(PIECE_MAX, body.frame()).await;
            let frame = frame.map_err(|_| ClientError::Silent { pid: None })?;
            let Some(frame) = frame else {
                return Ok(copied);
            };
            let Ok(data) = frame.map_err(ClientError::Broken)?.into_data() else {
                continue;
            };
            into.write_all(&data).map_err(ClientError::Unwritable)?;
            copied += u64::try_from(data.len()).unwrap_or(u64::MAX);
        }
    }

    /// The runs of a federation that were committed there, the newest first.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn history(&self, name: &str) -> Result<Vec<GenerationView>, ClientError> {
        self.answer(Method::GET, &path(name, "/history", &[]), Bytes::new())
            .await
    }

    /// One of them, by the run's id.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn generation(&self, name: &str, run: &str) -> Result<Generation, ClientError> {
        let call = format!("/history/{}", super::escape(run));
        self.answer(Method::GET, &path(name, &call, &[]), Bytes::new())
            .await
    }
}
