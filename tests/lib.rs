//! What the end-to-end tests share: finding binaries, running them with a bound, reading what they say.
