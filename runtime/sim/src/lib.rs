//! Simulated network, clocks, hosts and faults with checkers; one seed drives all. Pure.
