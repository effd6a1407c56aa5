//! Each fault drawn once, and a clean take.
