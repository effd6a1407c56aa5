//! `cargo +nightly fuzz run import_note` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("import_note", bytes));
