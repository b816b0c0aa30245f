//! The catalogue of every metric, and the page that Prometheus reads.
//!
//! [`catalogue`] says what exists; a [`Registry`] takes values and writes the classic text format 0.0.4; [`Page`] reads such a
//! page back, strictly. Nothing here measures: values come from federates' cumulative reports.

pub mod catalogue;
mod page;
mod registry;

pub use catalogue::{Kind, Metric, Unit};
pub use page::{Page, PageError, Sample};
pub use registry::{CONTENT_TYPE, Registry};
