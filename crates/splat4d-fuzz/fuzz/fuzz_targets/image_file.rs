//! `cargo +nightly fuzz run image_file` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("image_file", bytes));
