//! Tries whether the hosts of a federation can connect to each other as its members will.

use std::collections::BTreeMap;
use std::net::SocketAddrV4;

use futures_util::future::join_all;
use ictus_deploy::placement::HostSpec;
use ictus_deploy::rollout::{Protocol, ReachWay, Shut, reach_ways};
use ictusd::api::reach::{ListenRequest, ProbeRequest};
use ictusd::identity;

use super::Rollout;
use crate::error::CliError;

/// How long a host listens, in milliseconds: until all others have tried.
const LISTEN_MS: u32 = 10_000;
/// How long an answer may take, in milliseconds: SYN is sent again after 1 s.
const PROBE_MS: u32 = 2_500;
/// The same for a host that says the word to itself.
const END_MS: u32 = 500;

impl Rollout<'_> {
    /// The ways between hosts that are shut, each with the rule that opens it. Hosts that cannot be asked are left out:
    /// what is wrong with them is said elsewhere.
    pub(crate) async fn shut_ways(&self) -> Result<Vec<String>, CliError> {
        let ways = reach_ways(&self.checked.plan, self.placement);
        let word = identity::random_id().map_err(CliError::failed)?;
        let targets: BTreeMap<&str, &HostSpec> = ways
            .iter()
            .map(|way| (way.to.name.as_str(), way.to))
            .collect();
        let listening = targets.values().map(|host| self.listen(host, &word));
        let (mut ports, mut wrong) = (BTreeMap::new(), Vec::new());
        for (host, port) in join_all(listening).await {
            match port {
                Some(Ok(port)) => {
                    ports.insert(host, port);
                }
                Some(Err(error)) => wrong.push(format!("host `{host}`: {error}")),
                None => {}
            }
        }
        let tried = ways.iter().map(|way| self.try_way(way, &ports, &word));
        wrong.extend(join_all(tried).await.into_iter().flatten());
        // So that the ports are free again.
        let listened = ports
            .iter()
            .map(|(host, port)| self.end(host, *port, &word));
        join_all(listened).await;
        Ok(wrong)
    }

    /// A host listens no more when it has said the word to itself; if that fails, it ends a little later.
    async fn end(&self, host: &str, port: u16, word: &str) {
        let spec = self.placement.hosts.iter().find(|it| it.name == host);
        let (Some(client), Some(spec)) = (self.clients.get(host), spec) else {
            return;
        };
        let address = self.address(spec.address);
        let request = ProbeRequest {
            from: address,
            to: SocketAddrV4::new(address, port),
            word: word.to_owned(),
            limit_ms: END_MS,
        };
        client.try_to_reach(&request).await.ok();
    }

    async fn listen<'h>(
        &self,
        host: &'h HostSpec,
        word: &str,
    ) -> (&'h str, Option<Result<u16, CliError>>) {
        let name = host.name.as_str();
        let Some(client) = self.clients.get(name) else {
            return (name, None);
        };
        let request = ListenRequest {
            address: self.address(host.address),
            ports: host.ports,
            word: word.to_owned(),
            for_ms: LISTEN_MS,
        };
        let answer = client.listen_for_a_while(&request).await;
        let port = answer.map(|it| it.port).map_err(CliError::from);
        (name, Some(port))
    }

    /// What is wrong with one way, in words.
    async fn try_way(
        &self,
        way: &ReachWay<'_>,
        ports: &BTreeMap<&str, u16>,
        word: &str,
    ) -> Vec<String> {
        let client = self.clients.get(&way.from.name);
        let (Some(client), Some(&port)) = (client, ports.get(way.to.name.as_str())) else {
            return Vec::new();
        };
        let (from, to) = (self.address(way.from.address), self.address(way.to.address));
        let request = ProbeRequest {
            from,
            to: SocketAddrV4::new(to, port),
            word: word.to_owned(),
            limit_ms: PROBE_MS,
        };
        let reached = match client.try_to_reach(&request).await {
            Ok(reached) => reached,
            Err(error) => return vec![format!("host `{}`: {error}", way.from.name)],
        };
        let wanted = [
            (Protocol::Tcp, way.needs.tcp, reached.tcp),
            (Protocol::Udp, way.needs.udp, reached.udp),
        ];
        let shut = wanted.into_iter().filter(|(_, needed, _)| *needed);
        shut.filter_map(|(protocol, _, outcome)| {
            let shut = Shut {
                from: (way.from.name.clone(), from),
                to: (way.to.name.clone(), to),
                protocol,
                port,
                ports: way.to.ports,
                why: outcome.err()?,
            };
            Some(shut.to_string())
        })
        .collect()
    }
}
