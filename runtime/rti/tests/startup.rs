//! What holds as soon as the RTI says that it listens. Alone in its process, for the signal.

#![allow(clippy::unwrap_used, missing_docs, reason = "a test")]

use std::ffi::OsString;
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::os::fd::{AsRawFd, OwnedFd};
use std::process::ExitCode;

use ictus_coord::report::exit;
use ictus_rti::{Options, Server, Status};
use signal_hook::consts::SIGTERM;
use signal_hook::low_level::raise;

#[test]
fn a_signal_right_after_the_word_is_handled() {
    let (reader, writer) = std::io::pipe().unwrap();
    let arguments = format!("-n 1 -p 0 --status-fd {}", writer.as_raw_fd());
    let arguments: Vec<OsString> = arguments.split(' ').map(OsString::from).collect();
    let running = std::thread::spawn(move || {
        let code = ictus_rti::run(arguments);
        drop(writer);
        code
    });
    let mut line = String::new();
    BufReader::new(reader).read_line(&mut line).unwrap();
    assert!(line.contains("listening"), "{line}");
    raise(SIGTERM).unwrap();
    assert_eq!(running.join().unwrap(), ExitCode::from(exit::FAILED));
}

#[test]
fn nothing_is_said_before_signals_are_taken() {
    let (mut reader, writer) = std::io::pipe().unwrap();
    let status = Status::to_file(Some(File::from(OwnedFd::from(writer))));
    drop(Server::bind(&Options::new("test", 1), status).unwrap());
    let mut said = String::new();
    reader.read_to_string(&mut said).unwrap();
    assert_eq!(said, "");
}
