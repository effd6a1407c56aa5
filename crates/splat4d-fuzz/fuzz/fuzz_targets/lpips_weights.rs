//! `cargo +nightly fuzz run lpips_weights` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("lpips_weights", bytes));
