//! `cargo +nightly fuzz run edit_request` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("edit_request", bytes));
