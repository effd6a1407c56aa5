//! `cargo +nightly fuzz run geometry_json` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("geometry_json", bytes));
