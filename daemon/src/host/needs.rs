//! What federates need from this host besides their programs: whether they get it, and their secrets.

use std::fs::{self, Permissions};
use std::os::unix::fs::{PermissionsExt, chown};
use std::path::Path;

use ictus_deploy::{Engine, FederateRun, Needs};
use ictus_stream::Papers;

use super::{Host, error, error_of, recorded, store_error, with_sources};
use crate::accounts::{self, Account};
use crate::agent::RTI;
use crate::api::secret::{SecretValues, SecretsChanged};
use crate::api::{ApiError, ErrorCode, StartRequest};
use crate::facts;
use crate::paths::Paths;
use crate::secrets::{self, KeptSecrets, SecretsError};
use crate::store::Directory;

impl Host {
    /// Refuses what this host cannot give; better said than left out.
    pub(super) fn check_needs(&self, request: &StartRequest) -> Result<(), ApiError> {
        let needy: Vec<_> = here(request)
            .filter(|run| run.needs != Needs::default())
            .collect();
        if needy.is_empty() {
            return Ok(());
        }
        let gives = facts::gives(self.paths());
        for run in needy {
            let refused = |what: &str, fix: &str| {
                let name = &run.name;
                let message = format!("this host cannot give federate `{name}` {what}; {fix}");
                error(ErrorCode::BadRequest, message)
            };
            if let Some(lack) = gives.lacks(engine(request), &run.needs).first() {
                return Err(refused(&lack.what, &lack.fix));
            }
            let Some(user) = run.needs.user.as_deref().filter(|_| !contained(request)) else {
                continue;
            };
            let account = account(self.paths(), request, run)?;
            // Root may have other names.
            let root = account.as_ref().is_none_or(|account| account.uid == 0);
            if root && gives.refuses_root {
                let lack = gives.no_root(user);
                return Err(refused(&lack.what, &lack.fix));
            }
            let Some(account) = account else {
                continue;
            };
            let parent = self.paths().state.parent();
            if let Some(closed) = parent.and_then(|path| accounts::closed_to(path, &account)) {
                let what = format!("user `{user}`, who may not enter {}", closed.display());
                let fix = "set ICTUS_STATE_DIR of its daemon to a directory that everybody may enter, as /var/lib/ictus";
                return Err(refused(&what, fix));
            }
        }
        Ok(())
    }

    /// Writes the secrets of a run that is about to be prepared or started.
    pub(super) fn hand_over(
        &self,
        name: &str,
        request: &StartRequest,
        values: &SecretValues,
    ) -> Result<Option<KeptSecrets>, ApiError> {
        let federates = here(request).map(|run| Ok((run, account(self.paths(), request, run)?)));
        let federates: Vec<_> = federates.collect::<Result<_, ApiError>>()?;
        let kept = secrets::hand_over(self.paths(), name, &federates, values);
        kept.map_err(|error| secrets_error(&error))
    }

    /// Removes the secrets of a run of which nothing runs any more.
    pub(super) fn remove_secrets(&self, name: &str) -> Result<(), ApiError> {
        let record = recorded(name, &self.directory(name)).ok().flatten();
        let kept = record.and_then(|record| record.secrets);
        let removed = secrets::remove(self.paths(), name, kept.as_ref());
        removed.map_err(|error| secrets_error(&error))
    }

    /// Those of these secrets whose value is another one than the run's.
    pub(crate) fn changed_secrets(
        &self,
        name: &str,
        values: &SecretValues,
    ) -> Result<SecretsChanged, ApiError> {
        let record = recorded(name, &self.directory(name)).map_err(|error| store_error(&error))?;
        let kept = record.and_then(|record| record.secrets);
        Ok(secrets::changed(self.paths(), name, kept.as_ref(), values))
    }

    /// Lets federates that are other users come to what they read and write.
    pub(super) fn admit_users(
        &self,
        directory: &Directory,
        request: &StartRequest,
    ) -> Result<(), ApiError> {
        let shared = self.paths().shared();
        let others = shared.is_some() || here(request).any(|run| run.needs.user.is_some());
        if !others || contained(request) || !rustix::process::geteuid().is_root() {
            return Ok(());
        }
        let paths = self.paths();
        let enter = |path: &Path| set_mode(path, 0o711);
        for path in [&paths.state, &paths.federations(), &paths.blobs()] {
            enter(path)?;
        }
        enter(directory.path())?;
        for path in [directory.trace(), directory.timing(), directory.work()] {
            set_mode(&path, 0o1777)?;
        }
        let part = request.part.as_ref();
        let programs = part.into_iter().flat_map(|part| part.programs.values());
        for program in programs {
            set_mode(&paths.blobs().join(program), 0o755)?;
        }
        let mut members = vec![(RTI, unnamed(paths))];
        for run in here(request) {
            members.push((&run.name, account(paths, request, run)?));
        }
        for (member, account) in members {
            let papers = directory.papers(member);
            let Some(account) = account.filter(|_| papers.exists()) else {
                continue;
            };
            enter(&directory.all_papers())?;
            let files = Papers::FILES.map(|file| papers.join(file));
            for path in files.iter().chain([&papers]) {
                chown(path, Some(account.uid), Some(account.gid)).map_err(|error| {
                    error_of(format!(
                        "cannot give {} to its user: {error}",
                        path.display()
                    ))
                })?;
            }
        }
        set_mode(&directory.plan(), 0o644)
    }
}

/// The federates that run on this host.
fn here(request: &StartRequest) -> impl Iterator<Item = &FederateRun> {
    let part = request.part.as_ref();
    let runs = request.federates.iter();
    runs.filter(move |run| part.is_none_or(|part| part.federates.contains(&run.id)))
}

fn engine(request: &StartRequest) -> Engine {
    let part = request.part.as_ref();
    part.map_or(Engine::Process, |part| part.engine)
}

fn contained(request: &StartRequest) -> bool {
    engine(request) == Engine::Docker
}

/// Who the RTI is, and every federate that the manifest gives no user, when that is not who the daemon is.
pub(crate) fn unnamed(paths: &Paths) -> Option<Account> {
    let own = rustix::process::geteuid().as_raw();
    let run_as = paths.shared().map(|shared| shared.run_as.clone());
    run_as.filter(|account| account.uid != own)
}

/// Who a federate is, when it is not who the daemon is.
pub(crate) fn account(
    paths: &Paths,
    request: &StartRequest,
    run: &FederateRun,
) -> Result<Option<Account>, ApiError> {
    let Some(user) = run.needs.user.as_deref() else {
        return Ok(unnamed(paths));
    };
    let own = rustix::process::geteuid().as_raw();
    if contained(request) {
        // Its names are the image's; those with secrets are numbers.
        let mut numbers = user.split(':').map(|text| text.parse::<u32>().ok());
        let (uid, gid) = (numbers.next().flatten(), numbers.next().flatten());
        let account = uid.filter(|uid| *uid != own).map(|uid| Account {
            uid,
            gid: gid.unwrap_or(0),
            groups: Vec::new(),
        });
        return Ok(account);
    }
    let found = accounts::find(user).map_err(|why| {
        let message = format!("federate `{}`: {why}", run.name);
        error(ErrorCode::BadRequest, message)
    })?;
    // A group that is asked for is not the daemon's.
    Ok(Some(found).filter(|found| found.uid != own || user.contains(':')))
}

fn set_mode(path: &Path, mode: u32) -> Result<(), ApiError> {
    if !path.exists() {
        return Ok(());
    }
    let changed = fs::set_permissions(path, Permissions::from_mode(mode));
    changed.map_err(|error| error_of(format!("cannot open {}: {error}", path.display())))
}

fn secrets_error(secrets: &SecretsError) -> ApiError {
    let code = match secrets {
        SecretsError::Missing { .. } | SecretsError::TooLong { .. } => ErrorCode::BadRequest,
        SecretsError::NoPlace(_) | SecretsError::NotOurs { .. } | SecretsError::Io { .. } => {
            ErrorCode::Failed
        }
    };
    error(code, with_sources(secrets))
}
