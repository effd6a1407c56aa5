//! Learns moving Gaussian scenes from posed captures.
