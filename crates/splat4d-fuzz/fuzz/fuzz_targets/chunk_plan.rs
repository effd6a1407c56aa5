//! `cargo +nightly fuzz run chunk_plan` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("chunk_plan", bytes));
