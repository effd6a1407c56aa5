//! `cargo +nightly fuzz run sound_mp4` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("sound_mp4", bytes));
