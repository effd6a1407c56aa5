//! `cargo +nightly fuzz run results_json` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("results_json", bytes));
