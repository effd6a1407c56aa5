//! `cargo +nightly fuzz run colmap_images_txt` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("colmap_images_txt", bytes));
