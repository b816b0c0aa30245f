//! Why an engine did not do what it was asked: each with what to do about it.

use std::path::PathBuf;

use bollard::errors::Error;

/// Status codes of the engine's API.
const NOT_FOUND: u16 = 404;
const CONFLICT: u16 = 409;

/// Why an engine cannot be used, or did not do what it was asked.
#[derive(Debug, thiserror::Error)]
pub(crate) enum EngineError {
    /// `DOCKER_HOST` names an engine that is not this host's own.
    #[error(
        "DOCKER_HOST is {host}, but a daemon uses its own host's engine: unset it, or set it to unix:///PATH"
    )]
    NotLocal {
        /// The variable's value.
        host: String,
    },
    /// There is no socket.
    #[error(
        "no Docker engine: {socket} is not there: install it (`sudo apt-get install docker.io`) or start it \
         (`sudo systemctl start docker`); `ictus host add HOST --install-docker` does it from elsewhere",
        socket = socket.display()
    )]
    Absent {
        /// Where it should be.
        socket: PathBuf,
    },
    /// There is a socket and nobody behind it.
    #[error(
        "the Docker engine at {socket} does not run: start it (`sudo systemctl start docker`)",
        socket = socket.display()
    )]
    Stopped {
        /// Its socket.
        socket: PathBuf,
    },
    /// The daemon's user may not use the engine.
    #[error(
        "this user (uid {uid}) may not use the Docker engine at {socket}: `sudo usermod -aG docker USER`, log in again \
         and start ictusd again; `ictus host add HOST --install-docker` does it from elsewhere",
        socket = socket.display()
    )]
    Denied {
        /// Its socket.
        socket: PathBuf,
        /// The user.
        uid: u32,
    },
    /// The engine is older than anything Ictus is tried with.
    #[error(
        "the Docker engine is too old (version {version}, API {api}): Docker 20.10 (API 1.41) or newer is needed; upgrade it \
         (`sudo apt-get install --only-upgrade docker.io`, or docker-ce from docs.docker.com/engine/install)"
    )]
    TooOld {
        /// The engine's version.
        version: String,
        /// Its API version.
        api: String,
    },
    /// The engine did not answer in time.
    #[error(
        "cannot {doing}: the Docker engine does not answer: look at its log (`journalctl -u docker`)"
    )]
    Silent {
        /// What it was asked.
        doing: String,
    },
    /// The connection broke.
    #[error(
        "cannot {doing}: the Docker engine is gone ({why}): start it (`sudo systemctl start docker`)"
    )]
    Gone {
        /// What it was asked.
        doing: String,
        /// What the connection says.
        why: String,
    },
    /// An image or a container is not there.
    #[error("cannot {doing}: {why}")]
    NotFound {
        /// What it was asked.
        doing: String,
        /// What the engine says.
        why: String,
    },
    /// The image of a container is not there.
    #[error(
        "cannot {doing}: image {image} is not on this host: load it (`docker load`), pull it (`docker pull {image}`), or \
         correct `image:` in the manifest"
    )]
    ImageMissing {
        /// What it was asked.
        doing: String,
        /// The image.
        image: String,
    },
    /// An image is not there, and cannot be pulled either.
    #[error(
        "cannot {doing}: image {image} is not on this host, was not found where it is deployed from, and cannot be pulled \
         ({why}): make it there (`docker build`, `docker pull {image}`), or correct `image:` in the manifest"
    )]
    ImageNowhere {
        /// What it was asked.
        doing: String,
        /// The image.
        image: String,
        /// Why it cannot be pulled.
        why: String,
    },
    /// An image cannot be built.
    #[error("{what}{words}")]
    Build {
        /// What went wrong.
        what: String,
        /// The last lines of the build, each on a line of its own.
        words: String,
    },
    /// The image is for another processor.
    #[error(
        "cannot {doing}: image {image} is built for {found}, but this host is {host}: use an image for {host}"
    )]
    ImageArchitecture {
        /// What it was asked.
        doing: String,
        /// The image.
        image: String,
        /// What the image is for.
        found: String,
        /// What this host is.
        host: String,
    },
    /// A container that is not ours has the name.
    #[error(
        "cannot {doing}: a container of this name is there that is not of this run, and it is left alone: look at it \
         (`docker inspect {name}`) and remove it if it is not needed (`docker rm {name}`)"
    )]
    NameTaken {
        /// What it was asked.
        doing: String,
        /// The name.
        name: String,
    },
    /// The engine's disk is full.
    #[error(
        "cannot {doing}: no space left on the engine's disk ({why}): free some (`docker system df`)"
    )]
    NoSpace {
        /// What it was asked.
        doing: String,
        /// What the engine says.
        why: String,
    },
    /// The image's archive could not be made.
    #[error("cannot {doing}: {source}")]
    Image {
        /// What it was asked.
        doing: String,
        /// Why there is no archive.
        source: Box<ictus_deploy::image::ImageError>,
    },
    /// The engine refused for a reason of its own.
    #[error("cannot {doing}: {why}{fix}")]
    Refused {
        /// What it was asked.
        doing: String,
        /// What the engine says.
        why: String,
        /// What may be done, when it is known.
        fix: &'static str,
    },
}

impl EngineError {
    /// Sorts what the engine's client says.
    pub(super) fn of(doing: String, error: Error) -> Self {
        if let Error::DockerResponseServerError {
            status_code,
            message,
        } = error
        {
            return match status_code {
                NOT_FOUND => Self::NotFound {
                    doing,
                    why: message,
                },
                _ => Self::said(doing, message),
            };
        }
        if let Error::DockerStreamError { error } = error {
            return Self::said(doing, error);
        }
        if matches!(error, Error::RequestTimeoutError) {
            return Self::Silent { doing };
        }
        Self::Gone {
            doing,
            why: chain(&error),
        }
    }

    /// Sorts what the engine says in words; it has no codes for most causes.
    fn said(doing: String, why: String) -> Self {
        if why.contains("no space left on device") {
            return Self::NoSpace { doing, why };
        }
        Self::Refused {
            fix: fix(&why),
            doing,
            why,
        }
    }
}

/// What the engine's words mean for who reads them.
fn fix(why: &str) -> &'static str {
    const FIXES: [(&str, &str); 7] = [
        (
            "error setting rlimit",
            ": the engine itself may not raise this limit; start it as root, or leave `realtime:` out",
        ),
        (
            "error gathering device information",
            ": correct `devices:` in the manifest, or connect the device",
        ),
        (
            "bind source path does not exist",
            ": make the directory on the host, or correct `volumes:` in the manifest",
        ),
        (
            "unable to find user",
            ": `user:` names somebody whom the image does not know; use numbers (UID:GID)",
        ),
        (
            "Requested CPUs are not available",
            ": correct `cpus:` in the manifest",
        ),
        ("Minimum memory limit", ": raise `memory:` in the manifest"),
        (
            "exec format error",
            ": the program is built for another processor",
        ),
    ];
    FIXES
        .into_iter()
        .find(|(words, _)| why.contains(words))
        .map_or("", |(_, fix)| fix)
}

/// Whether the engine says that this clashes with something that is there.
pub(super) fn is_conflict(error: &Error) -> bool {
    matches!(
        error,
        Error::DockerResponseServerError {
            status_code: CONFLICT,
            ..
        }
    )
}

/// Whether the engine says that there is no such thing.
pub(super) fn is_not_found(error: &Error) -> bool {
    matches!(
        error,
        Error::DockerResponseServerError {
            status_code: NOT_FOUND,
            ..
        }
    )
}

/// An error with its sources: clients hide the cause behind one.
fn chain(error: &dyn std::error::Error) -> String {
    let mut words = error.to_string();
    let mut source = error.source();
    while let Some(error) = source {
        words = format!("{words}: {error}");
        source = error.source();
    }
    words
}

#[cfg(test)]
mod tests {
    use super::*;

    fn server(status_code: u16, message: &str) -> String {
        let message = message.to_owned();
        EngineError::of(
            "start container `c`".to_owned(),
            Error::DockerResponseServerError {
                status_code,
                message,
            },
        )
        .to_string()
    }

    #[test]
    fn what_the_engine_says_names_what_was_tried_and_the_fix() {
        let rlimit = server(
            500,
            "runc create failed: error setting rlimit type 7: operation not permitted",
        );
        assert!(
            rlimit.starts_with("cannot start container `c`: runc"),
            "{rlimit}"
        );
        assert!(rlimit.contains("leave `realtime:` out"), "{rlimit}");
        let full = server(500, "write /var/lib/docker/x: no space left on device");
        assert!(full.contains("docker system df"), "{full}");
        let source = server(
            400,
            "invalid mount config: bind source path does not exist: /data",
        );
        assert!(source.contains("/data: make the directory"), "{source}");
        assert_eq!(
            server(404, "No such container: c"),
            "cannot start container `c`: No such container: c"
        );
    }

    #[test]
    fn a_broken_connection_and_silence_are_told_apart() {
        let broken = Error::IOError {
            err: std::io::ErrorKind::ConnectionRefused.into(),
        };
        let broken = EngineError::of("list containers".to_owned(), broken).to_string();
        assert!(
            broken.contains("the Docker engine is gone (") && broken.contains("systemctl"),
            "{broken}"
        );
        let silent =
            EngineError::of("list containers".to_owned(), Error::RequestTimeoutError).to_string();
        assert!(silent.contains("does not answer"), "{silent}");
    }
}
