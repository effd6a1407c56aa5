//! `cargo +nightly fuzz run flow_npy` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("flow_npy", bytes));
