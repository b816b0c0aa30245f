//! The attribute layer over the Ictus program builder.
