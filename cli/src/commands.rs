//! One file per command.

pub(crate) mod bench;
pub(crate) mod check;
pub(crate) mod collect;
pub(crate) mod compose;
pub(crate) mod daemon;
pub(crate) mod dial_stdio;
pub(crate) mod down;
pub(crate) mod events;
pub(crate) mod explain;
pub(crate) mod health;
pub(crate) mod history;
pub(crate) mod host;
pub(crate) mod init;
pub(crate) mod lock;
pub(crate) mod logs;
pub(crate) mod metrics;
pub(crate) mod plan;
pub(crate) mod ps;
pub(crate) mod schema;
pub(crate) mod stop;
pub(crate) mod supervise;
pub(crate) mod swap;
pub(crate) mod timing;
pub(crate) mod up;
pub(crate) mod verify;
