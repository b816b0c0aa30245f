//! The certificates of one run: made here, handed out, and forgotten with who signed them.

use ictus_deploy::placement::Security;
use ictus_stream::{Authority, Member};
use ictusd::api::part::PrepareRequest;

use crate::error::CliError;

/// Gives each host those of its own members, where messages between hosts are to be protected.
pub(super) fn hand_out<'a>(
    run: &str,
    requests: impl Iterator<Item = &'a mut PrepareRequest>,
) -> Result<(), CliError> {
    let mut authority = None;
    for prepare in requests {
        let part = prepare.request.part.as_ref();
        let Some(part) = part.filter(|part| part.security == Security::Mtls) else {
            continue;
        };
        let authority = match &authority {
            Some(authority) => authority,
            None => authority.insert(Authority::new(run).map_err(CliError::failed)?),
        };
        let federates = part.federates.iter().filter_map(|id| {
            let run = prepare.request.federates.get(usize::from(*id))?;
            Some((run.name.clone(), Member::Federate(*id)))
        });
        let rti = part.rti.then(|| ("rti".to_owned(), Member::Rti));
        for (name, member) in federates.chain(rti) {
            let papers = authority.certify(member).map_err(CliError::failed)?;
            prepare.papers.insert(name, papers);
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use ictus_stream::Credentials;
    use serde_json::json;

    fn prepare(security: &str, federates: &[u16], rti: bool) -> PrepareRequest {
        let run = |id: u16| json!({ "id": id, "name": format!("f{id}"), "executable": "/f", "kind": "ours", "env": {}, "portable": true });
        let part = json!({
            "host": "h", "hosts": {}, "rti": rti, "federates": federates, "address": "10.0.0.1", "engine": "process",
            "ports": null, "programs": {}, "security": security,
        });
        let runs: Vec<_> = (0..3).map(run).collect();
        let request = json!({
            "manifest": "/m", "cwd": "/", "plan": ictus_coord::plan::Plan::default(), "federates": runs,
            "settings": ictus_deploy::Settings::default(), "timing": ictus_deploy::TimingSpec::default(),
            "trace": false, "part": part,
        });
        let prepare = json!({ "previous": null, "id": "run", "digest": "", "request": request });
        serde_json::from_value(prepare).unwrap()
    }

    #[test]
    fn each_host_gets_what_its_own_members_need() {
        let mut requests = [prepare("mtls", &[0], true), prepare("mtls", &[1, 2], false)];
        hand_out("run", requests.iter_mut()).unwrap();
        let members = requests.each_ref().map(|prepare| {
            let of = |(name, papers): (&String, _)| {
                (name.clone(), Credentials::of(papers).unwrap().member())
            };
            prepare.papers.iter().map(of).collect::<Vec<_>>()
        });
        let named = |name: &str, member| (name.to_owned(), member);
        assert_eq!(
            members[0],
            [named("f0", Member::Federate(0)), named("rti", Member::Rti)]
        );
        assert_eq!(
            members[1],
            [
                named("f1", Member::Federate(1)),
                named("f2", Member::Federate(2))
            ]
        );
        let authorities = requests.iter().flat_map(|prepare| prepare.papers.values());
        let first = requests[0].papers["rti"].authority.clone();
        assert!(
            authorities
                .into_iter()
                .all(|papers| papers.authority == first)
        );
        // The key is in what is sent, and in nothing that is shown.
        let key = requests[0].papers["rti"]
            .key
            .lines()
            .nth(1)
            .unwrap()
            .to_owned();
        assert!(serde_json::to_string(&requests[0]).unwrap().contains(&key));
        assert!(!format!("{:?}", requests[0]).contains(&key));
    }

    #[test]
    fn where_the_network_is_trusted_there_are_none() {
        let mut requests = [prepare("trusted-network", &[0], true)];
        hand_out("run", requests.iter_mut()).unwrap();
        assert!(requests[0].papers.is_empty());
    }
}
