use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};

use ictus_metrics::Page;
use ictusd::api::{ErrorCode, Event, StartRequest};
use serde_json::Value;

use crate::world::{BOUND, Process, Started, World, federation, next, outcome};

/// A federate `a`, and `b` that says what it measured of `a`; metrics over TCP on any port.
fn request() -> StartRequest {
    let mut request = federation(&[("a", ""), ("b", "measured")]);
    request.settings.metrics_listen = Some(SocketAddr::from(([127, 0, 0, 1], 0)));
    request
}

/// Starts it and waits until `b` has said all.
async fn start(world: &World) -> Started {
    let mut stream = world.client.start("pair", &request()).await.unwrap();
    let mut processes = std::collections::BTreeMap::new();
    let (mut healthy, mut late) = (false, None);
    while !healthy || late.is_none() {
        match next(&mut stream).await.event {
            Event::Started { member, pid, .. } => {
                processes.insert(member, Process::of(pid));
            }
            Event::Healthy => healthy = true,
            Event::StpViolation {
                federate,
                upstream,
                count,
                ..
            } => late = Some((federate, upstream, count)),
            Event::Ended { outcome } => panic!("not healthy: {outcome:?}"),
            _ => {}
        }
    }
    assert_eq!(late, Some(("b".to_owned(), "a".to_owned(), 1)));
    Started { processes, stream }
}

async fn page(world: &World) -> Page {
    Page::parse(&world.client.metrics().await.unwrap()).unwrap()
}

#[track_caller]
fn assert_measured(page: &Page) {
    let b = [("federation", "pair"), ("federate", "b")];
    for (name, value) in [
        ("ictus_messages_received_total", 1.0),
        ("ictus_messages_sent_total", 1.0),
        ("ictus_stp_violations_total", 1.0),
        ("ictus_stp_slack_seconds_sum", 0.003),
        ("ictus_stp_violation_lateness_seconds_sum", 0.002),
        ("ictus_tags_completed_total", 1.0),
        ("ictus_clock_error_bound_seconds", 0.000_005),
    ] {
        assert_eq!(page.value(name, &b), Some(value), "{name}");
    }
}

fn up(page: &Page, federate: &str) -> Option<f64> {
    page.value(
        "ictus_federate_up",
        &[("federation", "pair"), ("federate", federate)],
    )
}

/// Sends a request over TCP and reads the whole answer.
fn ask(address: SocketAddr, request: &str) -> String {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(BOUND)).unwrap();
    write!(stream, "{request}\r\nhost: x\r\n\r\n").unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    answer
}

async fn address(world: &World) -> SocketAddr {
    let view = world.client.federation("pair").await.unwrap();
    view.metrics.unwrap()
}

#[tokio::test]
async fn metrics_and_measures_are_served_until_the_federation_is_taken_down() {
    let world = World::new().await;
    let mut pair = start(&world).await;
    let served = page(&world).await;
    assert_measured(&served);
    assert_eq!((up(&served, "a"), up(&served, "b")), (Some(1.0), Some(1.0)));
    let measures = world.client.measures("pair").await.unwrap();
    let names: Vec<_> = measures
        .federates
        .iter()
        .map(|it| it.federate.as_str())
        .collect();
    assert_eq!(names, ["a", "b"]);
    assert_eq!(measures.federates[1].upstreams["a"].stp_violations, 1);

    let address = address(&world).await;
    let scraped = ask(address, "GET /metrics HTTP/1.1");
    let (head, body) = scraped.split_once("\r\n\r\n").unwrap();
    assert!(head.starts_with("HTTP/1.1 200 "), "{head}");
    assert!(
        head.contains("content-type: text/plain; version=0.0.4"),
        "{head}"
    );
    assert_measured(&Page::parse(body).unwrap());
    assert!(ask(address, "GET /healthz HTTP/1.1").ends_with("\r\n\r\nok\n"));
    for (request, status) in [
        ("POST /metrics HTTP/1.1", "405"),
        ("GET /v1/federations HTTP/1.1", "404"),
        ("POST /v1/federations/pair/stop HTTP/1.1", "404"),
        ("nonsense", "400"),
    ] {
        let answer = ask(address, request);
        assert!(
            answer.starts_with(&format!("HTTP/1.1 {status} ")),
            "{request}: {answer}"
        );
    }

    world.client.stop("pair", false).await.unwrap();
    outcome(&mut pair.stream).await;
    let served = page(&world).await;
    assert_measured(&served);
    assert_eq!((up(&served, "a"), up(&served, "b")), (Some(0.0), Some(0.0)));
    assert_eq!(world.client.measures("pair").await.unwrap(), measures);

    world.client.remove("pair", false).await.unwrap();
    assert_eq!(up(&page(&world).await, "a"), None);
    let error = world.client.measures("pair").await.unwrap_err();
    assert_eq!(error.refusal().unwrap().code, ErrorCode::Unknown);
    assert!(
        TcpStream::connect(address).is_err(),
        "nobody wants it any more"
    );
}

#[tokio::test]
async fn counters_survive_the_daemon() {
    let mut world = World::new().await;
    let _pair = start(&world).await;
    let measures = world.client.measures("pair").await.unwrap();
    world.replace_daemon().await;
    assert_measured(&page(&world).await);
    assert_eq!(world.client.measures("pair").await.unwrap(), measures);
    let scraped = ask(address(&world).await, "GET /metrics HTTP/1.1");
    assert_measured(&Page::parse(scraped.split_once("\r\n\r\n").unwrap().1).unwrap());
}

#[tokio::test]
async fn what_was_measured_before_an_end_without_a_daemon_is_known() {
    let mut world = World::new().await;
    let pair = start(&world).await;
    let measures = world.client.measures("pair").await.unwrap();
    let supervisor = &world.record("pair")["members"]["b"]["supervisor"]["pid"];
    let supervisor = Process::of(u32::try_from(supervisor.as_u64().unwrap()).unwrap());
    world.kill_daemon();
    pair.processes["b"].kill();
    for process in pair.processes.values() {
        process.assert_ends();
    }
    // Its supervisor has written the record before it ends.
    supervisor.assert_ends();
    let record = std::fs::read(world.directory("pair").join("exit/b.json")).unwrap();
    let record: Value = serde_json::from_slice(&record).unwrap();
    assert!(!record["reports"].as_array().unwrap().is_empty());
    world.replace_daemon_after_end().await;
    let mut stop = world.client.stop("pair", false).await.unwrap();
    outcome(&mut stop).await;
    assert_eq!(world.client.measures("pair").await.unwrap(), measures);
    let killed = [("federate", "b"), ("reason", "killed")];
    let page = page(&world).await;
    assert_eq!(page.value("ictus_federate_exits_total", &killed), Some(1.0));
}

#[tokio::test]
async fn an_address_in_use_refuses_the_start_and_one_address_serves_several_federations() {
    let world = World::new().await;
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap();
    let mut request = federation(&[("a", "")]);
    request.settings.metrics_listen = Some(address);
    let error = world.client.start("one", &request).await.unwrap_err();
    let said = error.to_string();
    assert!(
        said.starts_with(&format!("cannot serve metrics at {address}: ")),
        "{said}"
    );
    assert!(world.client.federations().await.unwrap().is_empty());
    drop(taken);

    let _one = world.start_healthy("one", &request).await;
    let _two = world.start_healthy("two", &request).await;
    world.client.remove("one", true).await.unwrap();
    let answer = ask(address, "GET /metrics HTTP/1.1");
    assert!(answer.contains("federation=\"two\"") && !answer.contains("federation=\"one\""));
    world.client.remove("two", true).await.unwrap();
    assert!(TcpStream::connect(address).is_err());
}

#[tokio::test]
async fn silent_connections_do_not_keep_others_out_for_ever() {
    let world = World::new().await;
    let _pair = start(&world).await;
    let address = address(&world).await;
    let silent: Vec<_> = (0..20)
        .map(|_| TcpStream::connect(address).unwrap())
        .collect();
    assert!(ask(address, "GET /healthz HTTP/1.1").ends_with("ok\n"));
    drop(silent);
}
