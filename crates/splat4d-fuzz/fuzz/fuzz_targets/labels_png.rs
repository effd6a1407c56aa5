//! `cargo +nightly fuzz run labels_png` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("labels_png", bytes));
