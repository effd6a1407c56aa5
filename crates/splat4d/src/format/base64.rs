//! Base64 (RFC 4648, section 4) of data URIs.

const ALPHABET: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
const PAD: u8 = b'=';

/// By character: its six bits; [`u8::MAX`]: none.
const VALUES: [u8; 256] = {
    let (mut values, mut i) = ([u8::MAX; 256], 0);
    while i < ALPHABET.len() {
        values[ALPHABET[i] as usize] = i as u8;
        i += 1;
    }
    values
};

/// Appends bytes as text, padded.
pub(super) fn encode(bytes: &[u8], out: &mut String) {
    for group in bytes.chunks(3) {
        let three = [group[0], *group.get(1).unwrap_or(&0), *group.get(2).unwrap_or(&0)];
        let bits = u32::from_be_bytes([0, three[0], three[1], three[2]]);
        for i in 0..4 {
            let letter = ALPHABET[(bits >> (18 - 6 * i) & 63) as usize];
            out.push(char::from(if i <= group.len() { letter } else { PAD }));
        }
    }
}

/// The bytes of a text; padding may be missing, spaces between are passed over. `None`: other characters, or a length that
/// no bytes have.
pub(super) fn decode(text: &[u8]) -> Option<Vec<u8>> {
    let mut out = Vec::with_capacity(text.len() / 4 * 3 + 3);
    let (mut bits, mut count, mut ended) = (0u32, 0, false);
    for &c in text.iter().filter(|c| !c.is_ascii_whitespace()) {
        ended |= c == PAD;
        if ended {
            if c != PAD {
                return None;
            }
            continue;
        }
        let value = VALUES[usize::from(c)];
        if value == u8::MAX {
            return None;
        }
        (bits, count) = (bits << 6 | u32::from(value), count + 1);
        if count == 4 {
            out.extend(&bits.to_be_bytes()[1..]);
            (bits, count) = (0, 0);
        }
    }
    match count {
        0 => {}
        2 => out.push((bits >> 4) as u8),
        3 => out.extend([(bits >> 10) as u8, (bits >> 2) as u8]),
        _ => return None,
    }
    Some(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_of_rfc_4648_section_10() {
        let known = ["", "Zg==", "Zm8=", "Zm9v", "Zm9vYg==", "Zm9vYmE=", "Zm9vYmFy"];
        for (length, text) in known.into_iter().enumerate() {
            let (plain, mut own) = (&b"foobar"[..length], String::new());
            encode(plain, &mut own);
            assert_eq!(own, text);
            assert_eq!(decode(text.as_bytes()).as_deref(), Some(plain));
            assert_eq!(decode(text.trim_end_matches('=').as_bytes()).as_deref(), Some(plain));
        }
        let all: Vec<u8> = (0..=255).collect();
        let mut text = String::new();
        encode(&all, &mut text);
        assert_eq!(decode(text.as_bytes()), Some(all));
        assert_eq!(decode(b"Zm\n9v"), Some(b"foo".to_vec()));
        for bad in ["Z", "Zm9v*", "Zg==Zg==", "Zm9vY"] {
            assert_eq!(decode(bad.as_bytes()), None, "{bad}");
        }
    }
}
