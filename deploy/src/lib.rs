//! Manifest to validated federation to plan to executors.
