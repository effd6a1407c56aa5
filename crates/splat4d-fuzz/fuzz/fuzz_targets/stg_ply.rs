//! `cargo +nightly fuzz run stg_ply` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("stg_ply", bytes));
