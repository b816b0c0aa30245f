//! A lease whose holder is gone ends by itself: who finds one waits for that, and refuses one that is renewed.

use std::collections::BTreeMap;
use std::time::Duration;

use ictus_deploy::placement::Way;
use ictusd::api::part::LeaseView;

use crate::error::CliError;
use crate::hosts::connect_all;
use crate::interrupts::Interrupts;
use crate::session::Session;
use crate::ui::Ui;

/// Between two looks.
const LOOK_EVERY: Duration = Duration::from_secs(1);

/// What was seen of leases so far, by host.
#[derive(Debug, Default)]
struct Watch(BTreeMap<String, LeaseView>);

/// What the next look means.
#[derive(Debug, PartialEq, Eq)]
enum Look {
    /// Nobody holds it any more.
    Free,
    /// Nobody has renewed it; it ends in so many milliseconds.
    Running(u64),
    /// Its holder lives, or somebody else has it by now.
    Held,
}

impl Watch {
    fn look(&mut self, now: BTreeMap<String, LeaseView>) -> Look {
        let renewed = now.iter().any(|(host, lease)| {
            self.0
                .get(host)
                .is_some_and(|before| before.fence != lease.fence || before.left_ms < lease.left_ms)
        });
        let appeared = !self.0.is_empty() && now.keys().any(|host| !self.0.contains_key(host));
        let longest = now.values().map(|lease| lease.left_ms).max();
        self.0 = now;
        match longest {
            None => Look::Free,
            Some(_) if renewed || appeared => Look::Held,
            Some(left) => Look::Running(left),
        }
    }
}

/// Waits until nobody holds a federation's lease any more; gives `refusal` back when its holder lives.
pub(crate) async fn outlive(
    ui: &mut Ui,
    session: &Session,
    (name, ways): (&str, &BTreeMap<String, Way>),
    interrupts: &mut Interrupts,
    refusal: CliError,
) -> Result<(), CliError> {
    let connected = connect_all(session, ways).await;
    let mut watch = Watch::default();
    let mut told = false;
    loop {
        let mut leases = BTreeMap::new();
        for (host, client) in &connected {
            let Ok(client) = client else {
                return Err(refusal);
            };
            let held = client.leases().await?.into_iter();
            let held = held.filter(|lease| lease.federation == name);
            leases.extend(held.map(|lease| (host.clone(), lease)));
        }
        match watch.look(leases) {
            Look::Free => return Ok(()),
            Look::Held => return Err(refusal),
            Look::Running(left_ms) if !told => {
                told = true;
                let seconds = left_ms.div_ceil(1000);
                ui.message(&format!(
                    "{refusal}\nwaiting for it, {seconds} s at most, unless its holder renews it"
                ));
            }
            Look::Running(_) => {}
        }
        tokio::select! {
            () = tokio::time::sleep(LOOK_EVERY) => {}
            () = interrupts.recv() => return Err(refusal),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lease(fence: u64, left_ms: u64) -> BTreeMap<String, LeaseView> {
        let lease = LeaseView {
            federation: "f".to_owned(),
            who: "ann".to_owned(),
            fence,
            left_ms,
        };
        BTreeMap::from([("h1".to_owned(), lease)])
    }

    #[test]
    fn a_lease_that_nobody_renews_is_waited_for_and_any_other_is_not() {
        let mut gone = Watch::default();
        assert_eq!(gone.look(lease(7, 20_000)), Look::Running(20_000));
        assert_eq!(gone.look(lease(7, 19_000)), Look::Running(19_000));
        assert_eq!(gone.look(BTreeMap::new()), Look::Free);
        for next in [lease(7, 30_000), lease(8, 10)] {
            let mut lives = Watch::default();
            assert_eq!(lives.look(lease(7, 20_000)), Look::Running(20_000));
            assert_eq!(lives.look(next), Look::Held);
        }
        let mut another = Watch::default();
        assert_eq!(another.look(lease(7, 20_000)), Look::Running(20_000));
        let mut two = lease(7, 19_000);
        two.insert("h2".to_owned(), two["h1"].clone());
        assert_eq!(another.look(two), Look::Held);
    }
}
