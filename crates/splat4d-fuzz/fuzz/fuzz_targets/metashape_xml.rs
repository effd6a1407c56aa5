//! `cargo +nightly fuzz run metashape_xml` in crates/splat4d-fuzz.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| splat4d_fuzz::read("metashape_xml", bytes));
