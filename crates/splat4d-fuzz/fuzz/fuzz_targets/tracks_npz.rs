//! `cargo +nightly fuzz run tracks_npz` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("tracks_npz", bytes));
