//! `cargo +nightly fuzz run colmap_cameras_txt` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("colmap_cameras_txt", bytes));
