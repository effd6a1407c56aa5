//! `cargo +nightly fuzz run predicted_npz` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("predicted_npz", bytes));
