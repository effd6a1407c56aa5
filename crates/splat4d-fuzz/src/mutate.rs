//! Damaged files: the same ones for the same seed.

use splat4d::math::Rng;

/// Most changes of one input.
const CHANGES: usize = 4;
/// Half of the damage is in the first bytes, where headers are.
const HEAD: usize = 256;
/// Longest piece that is cut out or put in.
const PIECE: usize = 64;
/// Numbers at which code breaks, as their bytes.
const NUMBERS: [&[u8]; 12] = [
    &[0; 8],
    &[0xFF; 8],
    &[0xFF; 4],
    &[0xFF, 0xFF, 0xFF, 0x7F],
    &[0, 0, 0, 0x80],
    &[0, 0, 0, 0x10],
    &[0, 0, 0x80, 0x7F],             // infinity, f32
    &[0, 0, 0xC0, 0x7F],             // NaN, f32
    &[0xFF, 0xFF, 0x7F, 0x7F],       // the largest f32
    &[0, 0, 0, 0, 0, 0, 0xF0, 0x7F], // infinity, f64
    &[0, 0, 0, 0, 0, 0, 0xF8, 0x7F], // NaN, f64
    &[0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xEF, 0x7F],
];
/// Words at which texts break.
const WORDS: [&[u8]; 16] = [
    b"nan",
    b"inf",
    b"-1",
    b"0",
    b"1e400",
    b"1e-400",
    b"9999999999999999999",
    b"null",
    b"[[[[[[[[",
    b"{\"a\":",
    b"]}",
    b"\"\"",
    b"\xFF\xFE",
    b"\xEF\xBB\xBF",
    b"../../",
    b"%99999d",
];

/// Input number `i` of a reader: one of its seeds, changed in one to four places.
pub fn mutant(seeds: &[Vec<u8>], seed: u64, reader: &str, i: u64) -> Vec<u8> {
    let rng = Rng::new(seed, reader, i);
    let mut bytes = seeds[rng.below(0, seeds.len())].clone();
    for round in 0..1 + rng.below(1, CHANGES) as u64 {
        change(&mut bytes, seeds, rng.fork(round + 1));
    }
    bytes
}

fn change(bytes: &mut Vec<u8>, seeds: &[Vec<u8>], r: Rng) {
    if bytes.is_empty() {
        return;
    }
    let range = if r.below(0, 2) == 0 { bytes.len().min(HEAD) } else { bytes.len() };
    let at = r.below(1, range);
    let piece = |from: &[u8]| {
        let start = r.below(4, from.len());
        from[start..(start + 1 + r.below(5, PIECE)).min(from.len())].to_vec()
    };
    match r.below(2, 10) {
        0 => bytes[at] ^= 1 << r.below(3, 8),
        1 => bytes[at] = r.below(3, 256) as u8,
        2 => bytes.truncate(at),
        3 => drop(bytes.drain(at..(at + 1 + r.below(3, PIECE)).min(bytes.len()))),
        4 => {
            let own = piece(bytes);
            bytes.splice(at..at, own);
        }
        5 => bytes[at] = b"0123456789-.\n {}[]\",:'e#"[r.below(3, 24)],
        6 => {
            if let Some(digit) = bytes[at..].iter().position(u8::is_ascii_digit) {
                let digits = b"98765432109876543210";
                bytes.splice(at + digit..at + digit, digits[..1 + r.below(3, 20)].iter().copied());
            }
        }
        7 => {
            let number = NUMBERS[r.below(3, NUMBERS.len())];
            let end = (at + number.len()).min(bytes.len());
            bytes[at..end].copy_from_slice(&number[..end - at]);
        }
        8 => {
            let word = WORDS[r.below(3, WORDS.len())];
            let end = (at + r.below(4, 1 + word.len())).min(bytes.len());
            bytes.splice(at..end, word.iter().copied());
        }
        _ => {
            let other = piece(&seeds[r.below(6, seeds.len())]);
            let end = (at + other.len()).min(bytes.len());
            bytes.splice(at..end, other);
        }
    }
}
