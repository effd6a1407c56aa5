//! `cargo +nightly fuzz run per_view_json` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("per_view_json", bytes));
