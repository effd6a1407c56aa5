//! `cargo +nightly fuzz run mask_png` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("mask_png", bytes));
