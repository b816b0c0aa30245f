//! Containers with our label that are not ours: told, never touched.

use std::collections::BTreeSet;

use crate::api::part::Foreign;
use crate::docker::{Engine, label};

use super::{Host, recorded};

impl Host {
    /// Those that say that they are of a federation and are in no record of this host, sorted by name; none when the engine
    /// does not tell.
    pub(crate) async fn foreign(&self, federation: &str) -> Vec<Foreign> {
        let Ok(engine) = Engine::connect().await else {
            return Vec::new();
        };
        let listed = engine.list(&[(label::FEDERATION, federation)]).await;
        let record = recorded(federation, &self.directory(federation));
        let members = record.ok().flatten().map(|record| record.members);
        let instances: BTreeSet<String> = members
            .into_iter()
            .flat_map(|members| members.into_values().map(|it| it.instance))
            .collect();
        let listed = listed.unwrap_or_default().into_iter();
        listed
            .filter(|found| {
                let instance = found.labels.get(label::INSTANCE);
                instance.is_none_or(|instance| !instances.contains(instance))
            })
            .map(|found| Foreign {
                container: found.name,
                federation: federation.to_owned(),
            })
            .collect()
    }
}
