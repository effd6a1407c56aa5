//! Learns moving Gaussian scenes from posed captures.

pub mod capture;
