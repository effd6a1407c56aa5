//! `cargo +nightly fuzz run dynamic3d` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("dynamic3d", bytes));
