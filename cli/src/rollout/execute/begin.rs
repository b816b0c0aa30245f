//! What else can be carried out: taking down, stopping, and bringing a generation back.

use ictus_deploy::rollout::{Apply, Plan};
use ictusd::identity;

use super::{Executor, Work};
use crate::error::CliError;
use crate::hosts::Clients;
use crate::rollout::{Again, certificates};

impl Executor {
    /// Carries out what takes a federation down.
    pub(crate) fn down(clients: Clients, plan: Plan) -> Result<Self, CliError> {
        Self::ending("down", clients, plan)
    }

    /// Carries out what stops a federation, or kills it.
    pub(crate) fn stop(clients: Clients, plan: Plan, kill: bool) -> Result<Self, CliError> {
        let executor = Self::ending("stop", clients, plan)?;
        Ok(Self { kill, ..executor })
    }

    /// Carries out what brings a generation back.
    pub(crate) fn again(again: Again) -> Result<Self, CliError> {
        let run = identity::random_id().map_err(CliError::failed)?;
        let Again {
            plan,
            clients,
            mut requests,
            rti,
            federates,
        } = again;
        for request in requests.values_mut() {
            request.id.clone_from(&run);
        }
        certificates::hand_out(&run, requests.values_mut())?;
        let work = Work {
            requests,
            rti,
            ..Work::default()
        };
        let apply = Apply::new(plan, run);
        Ok(Self::new("rollback", apply, clients, (work, federates)))
    }

    fn ending(verb: &str, clients: Clients, plan: Plan) -> Result<Self, CliError> {
        let run = identity::random_id().map_err(CliError::failed)?;
        let apply = Apply::new(plan, run);
        Ok(Self::new(verb, apply, clients, (Work::default(), 0)))
    }
}
