//! Streams of several hosts as one.

use ictusd::client::{ClientError, Stream};
use serde::de::DeserializeOwned;
use tokio::sync::mpsc;

/// Values that wait for who reads them.
const WAITING_MAX: usize = 256;

/// What several streams say, in the order in which it comes; each value with its host.
#[derive(Debug)]
pub(crate) struct Merged<T> {
    values: mpsc::Receiver<(String, Result<T, ClientError>)>,
    /// Kept so that streams that are added later have a way.
    way: mpsc::Sender<(String, Result<T, ClientError>)>,
    /// Streams that have not ended.
    open: usize,
    /// Says that one has ended.
    ended: (mpsc::Sender<()>, mpsc::Receiver<()>),
}

impl<T: DeserializeOwned + Send + 'static> Merged<T> {
    pub(crate) fn new() -> Self {
        let (way, values) = mpsc::channel(WAITING_MAX);
        Self {
            values,
            way,
            open: 0,
            ended: mpsc::channel(WAITING_MAX),
        }
    }

    /// Adds a stream, which is dropped with this.
    pub(crate) fn add(&mut self, host: String, mut stream: Stream<T>) {
        self.open += 1;
        let (way, ended) = (self.way.clone(), self.ended.0.clone());
        tokio::spawn(async move {
            loop {
                let next = tokio::select! {
                    next = stream.next() => next,
                    () = way.closed() => return,
                };
                let (value, last) = match next {
                    Ok(Some(value)) => (Ok(value), false),
                    Ok(None) => break,
                    Err(error) => (Err(error), true),
                };
                if way.send((host.clone(), value)).await.is_err() || last {
                    break;
                }
            }
            ended.send(()).await.ok();
        });
    }

    /// Whether any stream has not ended.
    pub(crate) fn has_open(&self) -> bool {
        self.open > 0
    }

    /// The next value of any of them; absent when all have ended.
    pub(crate) async fn next(&mut self) -> Option<(String, Result<T, ClientError>)> {
        loop {
            if self.open == 0 {
                return self.values.try_recv().ok();
            }
            tokio::select! {
                biased;
                Some(value) = self.values.recv() => return Some(value),
                Some(()) = self.ended.1.recv() => self.open -= 1,
            }
        }
    }
}
