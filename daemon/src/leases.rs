//! Who may change a federation of this host, one at a time: leases with numbers that only grow.
//!
//! Time is an argument: `since` on a monotonic clock, `wall_ns` only as the floor of numbers, so that they grow even
//! when nothing was kept. What a daemon kept is held anew for its whole time: nobody could renew it meanwhile.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::api::part::{Lease, LeaseRequest, LeaseView};

/// The longest a lease may be without renewal.
const TTL_MAX: Duration = Duration::from_secs(600);

/// All leases of a host.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Leases {
    held: BTreeMap<String, Held>,
    last: u64,
}

/// A lease and when it ends.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Held {
    kept: Kept,
    until: Duration,
}

/// What is kept of a lease.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Kept {
    who: String,
    fence: u64,
    ttl_ms: u64,
}

/// What is on disk.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(crate) struct Stored {
    /// The last number given.
    last: u64,
    held: BTreeMap<String, Kept>,
}

/// Why a call that needs a lease is refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum LeaseError {
    /// Somebody else holds it.
    #[error(
        "federation `{federation}` is being changed by {who}; it is free in {left_s} s unless that goes on"
    )]
    Held {
        federation: String,
        who: String,
        left_s: u64,
    },
    /// The number is not the one of the holder: it has ended, was broken, or was given anew.
    #[error(
        "the lease of federation `{federation}` was lost: its number {fence} is not the last one"
    )]
    Lost { federation: String, fence: u64 },
}

impl Leases {
    /// What an earlier daemon kept.
    pub(crate) fn restored(stored: Stored, since: Duration) -> Self {
        let held = stored.held.into_iter().map(|(federation, kept)| {
            let until = since + Duration::from_millis(kept.ttl_ms);
            (federation, Held { kept, until })
        });
        Self {
            held: held.collect(),
            last: stored.last,
        }
    }

    /// What a later daemon needs; absent when that is nothing.
    pub(crate) fn stored(&self) -> Option<Stored> {
        let held = self.held.iter();
        let held: BTreeMap<_, _> = held
            .map(|(federation, held)| (federation.clone(), held.kept.clone()))
            .collect();
        (!held.is_empty()).then_some(Stored {
            last: self.last,
            held,
        })
    }

    /// Gives a lease, unless it is held.
    pub(crate) fn take(
        &mut self,
        (since, wall_ns): (Duration, i64),
        federation: &str,
        request: &LeaseRequest,
    ) -> Result<Lease, LeaseError> {
        self.expire(since);
        self.check(since, federation, None)?;
        let ttl = Duration::from_millis(request.ttl_ms).min(TTL_MAX);
        let floor = u64::try_from(wall_ns).unwrap_or(0);
        self.last = self.last.saturating_add(1).max(floor);
        let kept = Kept {
            who: request.who.clone(),
            fence: self.last,
            ttl_ms: u64::try_from(ttl.as_millis()).unwrap_or(u64::MAX),
        };
        let until = since + ttl;
        self.held
            .insert(federation.to_owned(), Held { kept, until });
        Ok(Lease { fence: self.last })
    }

    /// Lets it last for its whole time again.
    pub(crate) fn renew(
        &mut self,
        since: Duration,
        federation: &str,
        fence: u64,
    ) -> Result<Lease, LeaseError> {
        self.check(since, federation, Some(fence))?;
        if let Some(held) = self.held.get_mut(federation) {
            held.until = since + Duration::from_millis(held.kept.ttl_ms);
        }
        Ok(Lease { fence })
    }

    /// Gives it back.
    pub(crate) fn release(
        &mut self,
        since: Duration,
        federation: &str,
        fence: u64,
    ) -> Result<(), LeaseError> {
        self.check(since, federation, Some(fence))?;
        self.held.remove(federation);
        Ok(())
    }

    /// Takes it from whoever holds it; tells from whom.
    pub(crate) fn break_off(&mut self, since: Duration, federation: &str) -> Option<LeaseView> {
        self.expire(since);
        let views = self.views(since);
        self.held.remove(federation)?;
        views.into_iter().find(|view| view.federation == federation)
    }

    /// Whether a call with this number, or without one, may change the federation.
    pub(crate) fn check(
        &self,
        since: Duration,
        federation: &str,
        fence: Option<u64>,
    ) -> Result<(), LeaseError> {
        let held = self.held.get(federation).filter(|held| since < held.until);
        match (held, fence) {
            (None, None) => Ok(()),
            (Some(held), Some(fence)) if held.kept.fence == fence => Ok(()),
            (_, Some(fence)) => Err(LeaseError::Lost {
                federation: federation.to_owned(),
                fence,
            }),
            (Some(held), None) => Err(LeaseError::Held {
                federation: federation.to_owned(),
                who: held.kept.who.clone(),
                left_s: held.until.saturating_sub(since).as_secs() + 1,
            }),
        }
    }

    /// How long a lease still lasts, and for how long it was given; absent when nobody holds one.
    pub(crate) fn left(&self, since: Duration, federation: &str) -> Option<(Duration, Duration)> {
        let held = self.held.get(federation)?;
        let left = held
            .until
            .checked_sub(since)
            .filter(|left| !left.is_zero())?;
        Some((left, Duration::from_millis(held.kept.ttl_ms)))
    }

    /// Those that are held.
    pub(crate) fn views(&self, since: Duration) -> Vec<LeaseView> {
        let held = self.held.iter().filter(|(_, held)| since < held.until);
        held.map(|(federation, held)| LeaseView {
            federation: federation.clone(),
            who: held.kept.who.clone(),
            fence: held.kept.fence,
            left_ms: u64::try_from(held.until.saturating_sub(since).as_millis())
                .unwrap_or(u64::MAX),
        })
        .collect()
    }

    fn expire(&mut self, since: Duration) {
        self.held.retain(|_, held| since < held.until);
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn request(who: &str) -> LeaseRequest {
        LeaseRequest {
            who: who.to_owned(),
            ttl_ms: 10_000,
        }
    }

    fn at(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    #[test]
    fn a_lease_is_one_holders_until_it_ends() {
        let mut leases = Leases::default();
        let ann = leases.take((at(0), 5), "f", &request("ann")).unwrap();
        assert_eq!(ann.fence, 5);
        let held = leases.take((at(9), 6), "f", &request("bob")).unwrap_err();
        assert_eq!(
            held.to_string(),
            "federation `f` is being changed by ann; it is free in 2 s unless that goes on"
        );
        assert!(leases.take((at(9), 6), "g", &request("bob")).is_ok());
        leases.renew(at(9), "f", ann.fence).unwrap();
        assert!(leases.check(at(15), "f", None).is_err());
        let bob = leases.take((at(19), 7), "f", &request("bob")).unwrap();
        assert!(bob.fence > ann.fence);
        // Who slept is fenced off.
        for refused in [
            leases.renew(at(20), "f", ann.fence).unwrap_err(),
            leases.release(at(20), "f", ann.fence).unwrap_err(),
            leases.check(at(20), "f", Some(ann.fence)).unwrap_err(),
        ] {
            assert!(matches!(refused, LeaseError::Lost { .. }), "{refused}");
        }
        leases.release(at(20), "f", bob.fence).unwrap();
        assert_eq!(leases.check(at(20), "f", None), Ok(()));
    }

    #[test]
    fn a_broken_lease_tells_whose_it_was() {
        let mut leases = Leases::default();
        let ann = leases.take((at(0), 0), "f", &request("ann")).unwrap();
        assert_eq!(leases.break_off(at(1), "f").unwrap().who, "ann");
        assert_eq!(leases.break_off(at(1), "f"), None);
        assert!(leases.check(at(1), "f", Some(ann.fence)).is_err());
    }

    proptest! {
        /// Over any history, restarts included: numbers only grow, and at most one number is good at a time.
        #[test]
        fn numbers_only_grow(steps in prop::collection::vec((0_u8..5, 0_u64..8_000, 0_i64..100), 1..40)) {
            let (mut leases, mut now, mut given) = (Leases::default(), Duration::ZERO, Vec::new());
            for (what, later_ms, wall_ns) in steps {
                now += Duration::from_millis(later_ms);
                match what {
                    0 | 1 => if let Ok(lease) = leases.take((now, wall_ns), "f", &request("x")) {
                        prop_assert!(given.iter().all(|older| *older < lease.fence));
                        given.push(lease.fence);
                    },
                    2 => if let Some(fence) = given.last() {
                        leases.renew(now, "f", *fence).ok();
                    },
                    3 => if let Some(fence) = given.last() {
                        leases.release(now, "f", *fence).ok();
                    },
                    _ => {
                        // A lease that is held is kept; when none is, the wall clock keeps numbers growing.
                        if let Some(stored) = leases.stored() {
                            let text = serde_json::to_string(&stored).unwrap();
                            leases = Leases::restored(serde_json::from_str(&text).unwrap(), now);
                        }
                    }
                }
                let good = given.iter().filter(|fence| leases.check(now, "f", Some(**fence)).is_ok());
                prop_assert!(good.count() <= 1);
            }
        }
    }
}
