//! `cargo +nightly fuzz run output_files` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("output_files", bytes));
