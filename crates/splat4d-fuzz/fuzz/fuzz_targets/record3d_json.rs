//! `cargo +nightly fuzz run record3d_json` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("record3d_json", bytes));
