//! `cargo +nightly fuzz run scan_obj` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("scan_obj", bytes));
