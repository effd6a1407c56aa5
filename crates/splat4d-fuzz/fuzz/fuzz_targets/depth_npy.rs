//! `cargo +nightly fuzz run depth_npy` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("depth_npy", bytes));
