//! The client's calls for a host's part; see [`crate::api::part`].

use std::collections::{BTreeMap, BTreeSet};
use std::convert::Infallible;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::task::{Context, Poll};
use std::time::Duration;

use flate2::Compression;
use flate2::write::GzEncoder;
use hyper::Method;
use hyper::body::{Body, Bytes, Frame};
use tokio::sync::mpsc;

use super::{Client, ClientError, Stream, encode, path, whole};
use crate::api::part::sent_name;
use crate::api::part::{
    CommitRequest, Foreign, HostFacts, ImageFacts, Lease, LeaseRequest, LeaseView, PrepareRequest,
    Prepared,
};
use crate::api::secret::{SecretValues, SecretsChanged};
use crate::api::{Happening, Removed};
use crate::images::Saved;

/// How long a host may take to prepare a part, or to write down a blob after its last byte.
const PREPARE_MAX: Duration = Duration::from_secs(120);
/// Bytes of a blob that are compressed at a time.
const PIECE_BYTES: usize = 64 << 10;
/// Pieces that wait for the network.
const PIECES_MAX: usize = 8;

impl Client {
    /// What the host is and can do.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn host(&self) -> Result<HostFacts, ClientError> {
        self.answer(Method::GET, "/v1/host", Bytes::new()).await
    }

    /// Containers that say that they are of a federation and are in no record there.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn foreign(&self, federation: &str) -> Result<Vec<Foreign>, ClientError> {
        let path = format!("/v1/foreign?{}", encode(&[("federation", federation)]));
        self.answer(Method::GET, &path, Bytes::new()).await
    }

    /// Takes the lease of a federation.
    ///
    /// # Errors
    /// See [`ClientError`]; held by somebody else: [`crate::api::ErrorCode::Held`].
    pub async fn lease(&self, name: &str, request: &LeaseRequest) -> Result<Lease, ClientError> {
        self.answer(Method::POST, &lease_path(name, &[]), json(request)?)
            .await
    }

    /// Lets a lease last.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn renew(&self, name: &str, fence: u64) -> Result<Lease, ClientError> {
        let fence = fence.to_string();
        let path = lease_path(name, &[("fence", &fence)]);
        self.answer(Method::PUT, &path, Bytes::new()).await
    }

    /// Gives a lease back.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn release(&self, name: &str, fence: u64) -> Result<(), ClientError> {
        let fence = fence.to_string();
        let path = lease_path(name, &[("fence", &fence)]);
        let released: Option<LeaseView> = self.answer(Method::DELETE, &path, Bytes::new()).await?;
        drop(released);
        Ok(())
    }

    /// Takes a lease from whoever holds it; tells from whom.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn break_lease(
        &self,
        name: &str,
        by: &str,
    ) -> Result<Option<LeaseView>, ClientError> {
        let path = lease_path(name, &[("break", by)]);
        self.answer(Method::DELETE, &path, Bytes::new()).await
    }

    /// Leases that are held.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn leases(&self) -> Result<Vec<LeaseView>, ClientError> {
        self.answer(Method::GET, "/v1/leases", Bytes::new()).await
    }

    /// Which of these blobs are not there.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn missing_blobs(&self, digests: &[String]) -> Result<Vec<String>, ClientError> {
        self.answer(Method::POST, "/v1/blobs", json(&digests)?)
            .await
    }

    /// Sends a file, compressed; gives the bytes that went over the wire. `sent` is told as they go.
    ///
    /// # Errors
    /// See [`ClientError`]; the daemon refuses bytes of another digest.
    pub async fn send_blob(
        &self,
        (name, fence): (&str, u64),
        digest: &str,
        file: &Path,
        sent: Arc<AtomicU64>,
    ) -> Result<u64, ClientError> {
        let mut opened = File::open(file).map_err(|error| self.unreachable(error))?;
        let fence = fence.to_string();
        let query = encode(&[("fence", fence.as_str()), ("federation", name)]);
        let path = format!("/v1/blobs/{digest}?{query}");
        // A file that cannot be read ends early, and its digest is then another one.
        let content = move |out: &mut dyn Write| io::copy(&mut opened, out).map(drop);
        self.transfer(&path, content, sent).await
    }

    /// Those of these images that are there, by name or id, and those that were sent for the federation.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn images(
        &self,
        federation: &str,
        wanted: &[String],
    ) -> Result<BTreeMap<String, ImageFacts>, ClientError> {
        let path = format!("/v1/images?{}", encode(&[("federation", federation)]));
        self.answer(Method::POST, &path, json(&wanted)?).await
    }

    /// Which layers of an image, the lowest first, are not there.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn missing_layers(&self, layers: &[String]) -> Result<Vec<String>, ClientError> {
        self.answer(Method::POST, "/v1/images/layers", json(&layers)?)
            .await
    }

    /// Sends an image but for the layers that are there, compressed; gives the bytes that went over the wire. `sent` is told
    /// as they go.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn send_image(
        &self,
        (name, fence): (&str, u64),
        id: &str,
        (image, layers): (Arc<Saved>, BTreeSet<String>),
        sent: Arc<AtomicU64>,
    ) -> Result<u64, ClientError> {
        let fence = fence.to_string();
        let query = encode(&[("fence", fence.as_str()), ("federation", name)]);
        let path = format!("/v1/images/{}?{query}", super::escape(id));
        let called = sent_name(name, id).unwrap_or_default();
        let content = move |out: &mut dyn Write| image.write_to(&called, &layers, out);
        self.transfer(&path, content, sent).await
    }

    /// Sends what is written, compressed.
    async fn transfer(
        &self,
        path: &str,
        content: impl FnOnce(&mut dyn Write) -> io::Result<()> + Send + 'static,
        sent: Arc<AtomicU64>,
    ) -> Result<u64, ClientError> {
        let (pieces, body) = mpsc::channel(PIECES_MAX);
        tokio::task::spawn_blocking(move || compress(content, pieces));
        let body = Pieces {
            pieces: body,
            sent: Arc::clone(&sent),
        };
        let (response, _connection) = self.exchange((Method::PUT, path), body, None).await?;
        whole(response).await?;
        Ok(sent.load(Ordering::Relaxed))
    }

    /// Has the host write down its part; nothing of it runs yet.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn prepare(
        &self,
        (name, fence): (&str, u64),
        request: &PrepareRequest,
    ) -> Result<Prepared, ClientError> {
        let fence = fence.to_string();
        let path = path(name, "", &[("fence", &fence)]);
        let body = http_body_util::Full::new(json(request)?);
        let limit = Some(PREPARE_MAX);
        let (response, _connection) = self.exchange((Method::PUT, &path), body, limit).await?;
        let bytes = whole(response).await?;
        serde_json::from_slice(&bytes).map_err(ClientError::NotUnderstood)
    }

    /// Which of these values are others than the run's; the host learns nothing that it does not hold or is not given.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn changed_secrets(
        &self,
        name: &str,
        values: &SecretValues,
    ) -> Result<SecretsChanged, ClientError> {
        let path = path(name, "/secrets", &[]);
        self.answer(Method::POST, &path, json(values)?).await
    }

    /// Begins what was prepared. Dropping the stream before `healthy` undoes the part.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn commit(
        &self,
        name: &str,
        request: &CommitRequest,
    ) -> Result<Stream<Happening>, ClientError> {
        self.stream(Method::POST, &path(name, "/commit", &[]), json(request)?)
            .await
    }

    /// Stops a part in order; the stream ends with its end.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn stop_part(
        &self,
        (name, fence): (&str, u64),
        kill: bool,
    ) -> Result<Stream<Happening>, ClientError> {
        let (kill, fence) = (kill.to_string(), fence.to_string());
        let path = path(name, "/stop", &[("kill", &kill), ("fence", &fence)]);
        self.stream(Method::POST, &path, Bytes::new()).await
    }

    /// Stops a part if it runs and removes what it left.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn remove_part(
        &self,
        (name, fence): (&str, u64),
        purge: bool,
    ) -> Result<Removed, ClientError> {
        let (purge, fence) = (purge.to_string(), fence.to_string());
        let path = path(name, "", &[("purge", &purge), ("fence", &fence)]);
        self.answer(Method::DELETE, &path, Bytes::new()).await
    }

    /// The same for a part that was not begun: the generations before it stay.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn undo_part(&self, (name, fence): (&str, u64)) -> Result<Removed, ClientError> {
        let fence = fence.to_string();
        let query = [
            ("purge", "true"),
            ("keep_history", "true"),
            ("fence", &fence),
        ];
        self.answer(Method::DELETE, &path(name, "", &query), Bytes::new())
            .await
    }
}

fn json(value: &impl serde::Serialize) -> Result<Bytes, ClientError> {
    let bytes = serde_json::to_vec(value).map_err(ClientError::NotUnderstood)?;
    Ok(bytes.into())
}

fn lease_path(name: &str, query: &[(&str, &str)]) -> String {
    format!("/v1/leases/{}?{}", super::escape(name), encode(query))
}

/// Compresses what is written, piece by piece, until nobody takes them. What fails ends early, and is
/// then not what was promised.
fn compress(
    content: impl FnOnce(&mut dyn Write) -> io::Result<()>,
    pieces: mpsc::Sender<Bytes>,
) -> io::Result<()> {
    let mut encoder = GzEncoder::new(Sending(pieces), Compression::fast());
    let mut buffered = BufWriter::with_capacity(PIECE_BYTES, &mut encoder);
    content(&mut buffered)?;
    buffered.flush()?;
    drop(buffered);
    encoder.finish().map(drop)
}

/// Bytes on their way to the network.
struct Sending(mpsc::Sender<Bytes>);

impl Write for Sending {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let piece = Bytes::copy_from_slice(bytes);
        let sent = self.0.blocking_send(piece);
        sent.map_err(|_| io::Error::from(io::ErrorKind::BrokenPipe))?;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// A request's body of pieces.
struct Pieces {
    pieces: mpsc::Receiver<Bytes>,
    sent: Arc<AtomicU64>,
}

impl Body for Pieces {
    type Data = Bytes;
    type Error = Infallible;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Infallible>>> {
        let piece = self.pieces.poll_recv(context);
        piece.map(|piece| {
            let piece = piece?;
            let count = u64::try_from(piece.len()).unwrap_or(u64::MAX);
            self.sent.fetch_add(count, Ordering::Relaxed);
            Some(Ok(Frame::data(piece)))
        })
    }
}
