//! Learns moving Gaussian scenes from posed captures.

pub mod eval;
pub mod init;
pub mod loss;
