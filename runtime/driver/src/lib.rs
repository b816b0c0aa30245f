//! Deterministic reactors, alone or federated: what a federate program depends on.
