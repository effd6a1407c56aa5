//! `cargo +nightly fuzz run split_list` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("split_list", bytes));
