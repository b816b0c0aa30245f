//! The client's calls that try whether hosts can connect; see [`crate::api::reach`].

use hyper::Method;
use hyper::body::Bytes;
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::{Client, ClientError};
use crate::api::reach::{ListenRequest, Listening, ProbeRequest, Reached};

impl Client {
    /// Has the host listen for a while.
    ///
    /// # Errors
    /// See [`ClientError`]; the host refuses when no port will do.
    pub async fn listen_for_a_while(
        &self,
        request: &ListenRequest,
    ) -> Result<Listening, ClientError> {
        self.reach("/v1/reach/listen", request).await
    }

    /// Has the host try to reach another one that listens.
    ///
    /// # Errors
    /// See [`ClientError`]; a way that is shut is an answer.
    pub async fn try_to_reach(&self, request: &ProbeRequest) -> Result<Reached, ClientError> {
        self.reach("/v1/reach/probe", request).await
    }

    async fn reach<T: DeserializeOwned>(
        &self,
        path: &str,
        request: &impl Serialize,
    ) -> Result<T, ClientError> {
        let body = serde_json::to_vec(request).map_err(ClientError::NotUnderstood)?;
        self.answer(Method::POST, path, Bytes::from(body)).await
    }
}
