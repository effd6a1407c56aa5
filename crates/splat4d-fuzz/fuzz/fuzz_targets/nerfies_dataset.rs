//! `cargo +nightly fuzz run nerfies_dataset` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("nerfies_dataset", bytes));
