//! `cargo +nightly fuzz run cameras_json` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("cameras_json", bytes));
