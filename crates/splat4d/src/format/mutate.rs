//! A deterministic corpus of damaged files for the readers' tests.

use crate::math::Rng;

/// `count` damaged versions of `sample`: flipped bits, changed bytes, cuts, splices, repeats, and digits grown in
/// position, so that text headers are as well.
pub(super) fn mutants(sample: &[u8], count: u64, purpose: &str) -> impl Iterator<Item = Vec<u8>> {
    (0..count).map(move |i| {
        let rng = Rng::new(11, purpose, i);
        let mut bytes = sample.to_vec();
        for round in 0..1 + rng.below(0, 4) as u64 {
            let r = rng.fork(round + 1);
            if bytes.is_empty() {
                break;
            }
            // Half of the damage is in the first bytes, where headers are.
            let range = if r.below(0, 2) == 0 { bytes.len().min(256) } else { bytes.len() };
            let at = r.below(1, range);
            match r.below(2, 7) {
                0 => bytes[at] ^= 1 << r.below(3, 8),
                1 => bytes[at] = r.bits(3) as u8,
                2 => bytes.truncate(at),
                3 => {
                    let end = (at + r.below(3, 64)).min(bytes.len());
                    bytes.drain(at..end);
                }
                4 => {
                    let from = r.below(3, bytes.len());
                    let piece = bytes[from..(from + r.below(4, 64)).min(bytes.len())].to_vec();
                    bytes.splice(at..at, piece);
                }
                5 => bytes[at] = b"0123456789-.\n {}[]\",:'e"[r.below(3, 23)],
                _ => {
                    if let Some(digit) = bytes[at..].iter().position(u8::is_ascii_digit) {
                        let digits = b"98765432109876543210";
                        let at = at + digit;
                        bytes.splice(at..at, digits[..1 + r.below(3, 20)].iter().copied());
                    }
                }
            }
        }
        bytes
    })
}
