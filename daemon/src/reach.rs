//! One side that listens for a while, one that says a word to it: whether two hosts can connect.

use std::io;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpSocket, TcpStream, UdpSocket};
use tokio::task::JoinSet;
use tokio::time::{Instant, timeout, timeout_at};

use crate::api::reach::{
    LISTEN_MS_MAX, ListenRequest, Listening, PROBE_MS_MAX, ProbeRequest, Reached,
};

/// The longest word, in bytes.
const WORD_MAX: usize = 64;
/// How long who has connected may take to say the word.
const SAID_WITHIN: Duration = Duration::from_secs(2);
/// A datagram may be lost: it is sent again so often.
const UDP_EVERY: Duration = Duration::from_millis(250);
/// Ports that are tried when any will do: TCP and UDP must both be free.
const TRIES: u16 = 16;

/// Why a host cannot listen, or be asked to.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ReachError {
    /// No port will do.
    #[error("cannot listen on {address}: {why}")]
    Listen {
        /// The address.
        address: Ipv4Addr,
        /// What the last port said.
        why: io::Error,
    },
    /// The word is no word.
    #[error("the word has 1 to {WORD_MAX} bytes")]
    Word,
}

/// Listens, and goes on for as long as is asked, or until this host has said the word to itself.
pub(crate) async fn listen(request: ListenRequest) -> Result<Listening, ReachError> {
    check_word(&request.word)?;
    let (tcp, udp, port) = open(&request).await?;
    let lasting = Duration::from_millis(request.for_ms.min(LISTEN_MS_MAX).into());
    let until = Instant::now() + lasting;
    let word = request.word;
    tokio::spawn(async move {
        let both = async {
            tokio::select! {
                () = hear(&tcp, &word) => {}
                () = echo(&udp, word.as_bytes()) => {}
            }
        };
        let _over = timeout_at(until, both).await;
    });
    Ok(Listening { port })
}

async fn open(request: &ListenRequest) -> Result<(TcpListener, UdpSocket, u16), ReachError> {
    let ports = request.ports.map_or_else(
        || vec![0; TRIES.into()],
        |range| (range.first..=range.last).collect(),
    );
    let address = request.address;
    let mut last = io::Error::other("no port may be used");
    for port in ports {
        match open_one(address, port).await {
            Ok(opened) => return Ok(opened),
            Err(why) => last = why,
        }
    }
    let why = last;
    Err(ReachError::Listen { address, why })
}

async fn open_one(address: Ipv4Addr, port: u16) -> io::Result<(TcpListener, UdpSocket, u16)> {
    let tcp = TcpListener::bind((address, port)).await?;
    let port = tcp.local_addr()?.port();
    Ok((tcp, UdpSocket::bind((address, port)).await?, port))
}

/// Gives the word back to everybody who connects and says it; ends when that was this host.
async fn hear(listener: &TcpListener, word: &str) {
    let mut callers = JoinSet::new();
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            Some(itself) = callers.join_next() => match itself {
                Ok(true) => return,
                Ok(false) | Err(_) => continue,
            },
        };
        let Ok((mut stream, from)) = accepted else {
            return;
        };
        let itself = stream.local_addr().is_ok_and(|here| here.ip() == from.ip());
        let word = word.to_owned();
        callers.spawn(async move {
            let answer = async {
                let mut said = vec![0; word.len()];
                stream.read_exact(&mut said).await?;
                let right = said == word.as_bytes();
                if right {
                    stream.write_all(&said).await?;
                }
                io::Result::Ok(right)
            };
            // Who says nothing is told nothing.
            let said = timeout(SAID_WITHIN, answer).await;
            itself && matches!(said, Ok(Ok(true)))
        });
    }
}

async fn echo(socket: &UdpSocket, word: &[u8]) {
    let mut said = [0; WORD_MAX + 1];
    loop {
        // An error is of one datagram: an answer that could not be delivered.
        if let Ok((count, from)) = socket.recv_from(&mut said).await
            && said[..count] == *word
        {
            let _sent = socket.send_to(word, from).await;
        }
    }
}

/// Says the word over TCP and UDP at once.
pub(crate) async fn probe(request: &ProbeRequest) -> Result<Reached, ReachError> {
    check_word(&request.word)?;
    let limit = Duration::from_millis(request.limit_ms.min(PROBE_MS_MAX).into());
    let (from, to, word) = (request.from, request.to, request.word.as_bytes());
    let (tcp, udp) = tokio::join!(
        timeout(limit, over_tcp(from, to, word)),
        timeout(limit, over_udp(from, to, word)),
    );
    let words = |outcome: Result<io::Result<()>, _>| match outcome {
        Ok(Ok(())) => Ok(()),
        Ok(Err(error)) => Err(error.to_string()),
        Err(_) => Err(format!("no answer within {} s", limit.as_secs_f64())),
    };
    Ok(Reached {
        tcp: words(tcp),
        udp: words(udp),
    })
}

async fn over_tcp(from: Ipv4Addr, to: SocketAddrV4, word: &[u8]) -> io::Result<()> {
    let socket = TcpSocket::new_v4()?;
    socket.bind(SocketAddrV4::new(from, 0).into())?;
    let mut stream: TcpStream = socket.connect(to.into()).await?;
    stream.write_all(word).await?;
    let mut answer = vec![0; word.len()];
    stream.read_exact(&mut answer).await?;
    same(&answer, word)
}

async fn over_udp(from: Ipv4Addr, to: SocketAddrV4, word: &[u8]) -> io::Result<()> {
    let socket = UdpSocket::bind(SocketAddrV4::new(from, 0)).await?;
    socket.connect(to).await?;
    let mut answer = [0; WORD_MAX + 1];
    loop {
        socket.send(word).await?;
        if let Ok(received) = timeout(UDP_EVERY, socket.recv(&mut answer)).await {
            return same(&answer[..received?], word);
        }
    }
}

fn same(answer: &[u8], word: &[u8]) -> io::Result<()> {
    if answer == word {
        Ok(())
    } else {
        Err(io::Error::other("something else answers there"))
    }
}

fn check_word(word: &str) -> Result<(), ReachError> {
    if word.is_empty() || word.len() > WORD_MAX {
        return Err(ReachError::Word);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    const HERE: Ipv4Addr = Ipv4Addr::LOCALHOST;
    const ELSEWHERE: Ipv4Addr = Ipv4Addr::new(127, 0, 0, 2);

    async fn ask(port: u16, word: &str, limit_ms: u32) -> Reached {
        let request = ProbeRequest {
            from: ELSEWHERE,
            to: SocketAddrV4::new(HERE, port),
            word: word.to_owned(),
            limit_ms,
        };
        probe(&request).await.unwrap()
    }

    fn request(word: &str, for_ms: u32) -> ListenRequest {
        ListenRequest {
            address: HERE,
            ports: None,
            word: word.to_owned(),
            for_ms,
        }
    }

    #[tokio::test]
    async fn who_says_the_word_is_answered_and_nobody_else() {
        let there = listen(request("open", 20_000)).await.unwrap();
        let both = Reached {
            tcp: Ok(()),
            udp: Ok(()),
        };
        for _ in 0..3 {
            assert_eq!(ask(there.port, "open", 10_000).await, both);
        }
        let wrong = ask(there.port, "shut", 300).await;
        assert!(wrong.udp.unwrap_err().starts_with("no answer within"));
        wrong.tcp.unwrap_err();
    }

    #[tokio::test]
    async fn a_host_that_says_the_word_to_itself_listens_no_more() {
        let port = listen(request("open", 20_000)).await.unwrap().port;
        let to_itself = ProbeRequest {
            from: HERE,
            to: SocketAddrV4::new(HERE, port),
            word: "open".to_owned(),
            limit_ms: 10_000,
        };
        probe(&to_itself).await.unwrap().tcp.unwrap();
        // Its sockets go with its task, which is on this thread.
        while TcpListener::bind((HERE, port)).await.is_err() {
            tokio::task::yield_now().await;
        }
    }

    #[tokio::test]
    async fn where_nobody_listens_is_refused() {
        let port = {
            let socket = TcpListener::bind((HERE, 0)).await.unwrap();
            socket.local_addr().unwrap().port()
        };
        let said = ask(port, "open", 10_000).await.tcp.unwrap_err();
        assert!(said.contains("refused"), "{said}");
    }

    #[tokio::test]
    async fn a_host_listens_in_its_range_and_at_its_own_address_only() {
        let taken = listen(request("open", 20_000)).await.unwrap().port;
        let mut wanted = request("open", 20_000);
        wanted.ports = Some(ictus_deploy::placement::PortRange {
            first: taken,
            last: taken,
        });
        listen(wanted.clone()).await.unwrap_err();
        wanted.address = Ipv4Addr::new(192, 0, 2, 1);
        let error = listen(wanted).await.unwrap_err().to_string();
        assert!(error.contains("192.0.2.1"), "{error}");
        listen(request("", 1)).await.unwrap_err();
    }
}
