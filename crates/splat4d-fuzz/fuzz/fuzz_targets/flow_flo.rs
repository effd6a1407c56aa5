//! `cargo +nightly fuzz run flow_flo` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("flow_flo", bytes));
