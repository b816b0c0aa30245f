//! What `--monitoring` adds: a collector of what federates say, Prometheus and Grafana.

use super::file::{Depends, Healthcheck, Line, Mount, NamedVolume, Service, Table, Variable};
use super::image::ImageSource;
use super::{COLLECTOR, ComposeError, PLAN_VARIABLE, Writer};

/// What Prometheus is told. The collector lays it into the shared volume, because nothing can be laid beside the file.
pub const PROMETHEUS_CONFIG: &str = "\
global:
  scrape_interval: 1s
  scrape_timeout: 1s
scrape_configs:
  - job_name: ictus
    static_configs:
      - targets: [\"collector:9464\"]
";
/// What Grafana is told.
pub const GRAFANA_DATASOURCE: &str = "\
apiVersion: 1
datasources:
  - name: Ictus
    type: prometheus
    access: proxy
    url: http://prometheus:9090
    isDefault: true
";

/// Where the collector listens in its container.
pub const COLLECTOR_PORT: u16 = 9464;
/// Where federates find the collector, below [`SHARED`].
pub const SOCKET: &str = "/ictus/status/collector.sock";
/// Its name there.
pub const SOCKET_NAME: &str = "collector.sock";
/// Where the shared volume is mounted.
pub const SHARED: &str = "/ictus/status";
/// The shared volume.
const STATUS: &str = "status";
/// What Prometheus has measured.
const MEASURED: &str = "prometheus";

/// The shared volume in a container.
pub(super) fn shared(read_only: bool) -> Mount {
    Mount::volume(STATUS, SHARED).read_only(read_only)
}

/// Adds the services and their volumes.
pub(super) fn add(
    writer: &mut Writer<'_>,
    services: &mut Vec<(String, Service)>,
    volumes: &mut Vec<(String, NamedVolume)>,
) -> Result<(), ComposeError> {
    let mut more = vec![(COLLECTOR, collector(writer))];
    volumes.push((STATUS.to_owned(), NamedVolume::shared_memory()));
    if writer.options.monitoring {
        more.extend([("prometheus", prometheus()), ("grafana", grafana())]);
        volumes.push((MEASURED.to_owned(), NamedVolume::kept()));
    }
    for (name, service) in more {
        if services.iter().any(|(taken, _)| taken == name) {
            return Err(ComposeError::NameTaken(name.to_owned()));
        }
        services.push((name.to_owned(), service));
    }
    Ok(())
}

fn collector(writer: &mut Writer<'_>) -> Service {
    let listen = format!("0.0.0.0:{COLLECTOR_PORT}");
    let command = [
        "collect",
        "--plan-env",
        PLAN_VARIABLE,
        "--directory",
        SHARED,
        "--listen",
        &listen,
    ];
    let published = writer.checked.settings.metrics_listen;
    let published = published.map(|address| format!("{address}:{COLLECTOR_PORT}"));
    let plan = Variable::Plan(writer.plan.clone());
    Service {
        image: writer.image("ictus", ImageSource::Ictus),
        command: Line::of(command),
        environment: [(PLAN_VARIABLE.to_owned(), plan)].into(),
        healthcheck: Some(Healthcheck::of_port(COLLECTOR_PORT)),
        ports: published.into_iter().collect(),
        volumes: vec![shared(false)],
        ..writer.service()
    }
}

fn prometheus() -> Service {
    let config = format!("--config.file={SHARED}/prometheus.yml");
    Service {
        image: "prom/prometheus:v2.53.4".to_owned(),
        command: Line::of([&config, "--storage.tsdb.path=/prometheus"]),
        depends_on: Table(vec![(COLLECTOR.to_owned(), Depends::HEALTHY)]),
        ports: vec!["127.0.0.1:9090:9090".to_owned()],
        volumes: vec![shared(true), Mount::volume(MEASURED, "/prometheus")],
        restart: "no",
        ..others()
    }
}

fn grafana() -> Service {
    let provisioning = Variable::Text(format!("{SHARED}/grafana"));
    Service {
        image: "grafana/grafana:11.6.0".to_owned(),
        environment: [("GF_PATHS_PROVISIONING".to_owned(), provisioning)].into(),
        depends_on: Table(vec![(COLLECTOR.to_owned(), Depends::HEALTHY)]),
        ports: vec!["127.0.0.1:3000:3000".to_owned()],
        volumes: vec![shared(true)],
        ..others()
    }
}

/// A service of somebody else's image.
fn others() -> Service {
    Service {
        restart: "no",
        logging: super::file::Logging::files(10 << 20, 3),
        ..Service::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_said_twice_is_the_same() {
        assert_eq!(SOCKET, format!("{SHARED}/{SOCKET_NAME}"));
        let target = format!("[\"{COLLECTOR}:{COLLECTOR_PORT}\"]");
        assert!(PROMETHEUS_CONFIG.contains(&target), "{PROMETHEUS_CONFIG}");
    }
}
