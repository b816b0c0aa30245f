//! The RTI as a server: sockets around ictus-coord.
