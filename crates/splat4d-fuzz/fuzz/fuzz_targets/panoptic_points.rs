//! `cargo +nightly fuzz run panoptic_points` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("panoptic_points", bytes));
