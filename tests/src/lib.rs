//! End to end, interoperability, tidy. Imports everything, imported by nothing.
