//! `cargo +nightly fuzz run video_avi` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("video_avi", bytes));
