use super::*;
use crate::format::mutate::mutants;
use crate::format::samples::{gaussians, worst};
use crate::scene::GEOMETRY;
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use std::io::Read;

fn head(file: &[u8]) -> Header {
    container::open(file, &mut Warnings::default()).unwrap().header
}

/// The body of one Gaussian of degree 1 as specified; `rotation` as stored by the version.
fn body(rotation: &[u8]) -> Vec<u8> {
    let mut b = Vec::new();
    // x = 1.5, y = -0.25, z = 2048 − 1/4096, in steps of 1/4096.
    for steps in [6144i32, -1024, 8_388_607] {
        b.extend_from_slice(&steps.to_le_bytes()[..3]);
    }
    b.push(204); // opacity 0.8
    b.extend([0, 255, 153]); // (c/255 − ½)/0.15: −3.33, 3.33, 0.667
    b.extend([0, 160, 255]); // −10, 0, 5.9375
    b.extend(rotation);
    b.extend([128, 0, 255, 136, 120, 128, 128, 128, 64]);
    b
}

fn header(version: u32, degree: u8) -> Vec<u8> {
    let mut h = b"NGSP".to_vec();
    h.extend(version.to_le_bytes());
    h.extend(1u32.to_le_bytes());
    h.extend([degree, 12, 0]);
    h
}

/// gzip without compression (RFC 1952 and a stored block of RFC 1951), made by hand.
fn gzipped(plain: &[u8]) -> Vec<u8> {
    let mut out = vec![0x1F, 0x8B, 8, 0, 0, 0, 0, 0, 0, 255, 1];
    let n = plain.len() as u16;
    out.extend(n.to_le_bytes());
    out.extend((!n).to_le_bytes());
    out.extend(plain);
    let mut crc = !0u32;
    for &byte in plain {
        crc ^= u32::from(byte);
        (0..8).for_each(|_| crc = crc >> 1 ^ (0xEDB8_8320 & (crc & 1).wrapping_neg()));
    }
    out.extend((!crc).to_le_bytes());
    out.extend((plain.len() as u32).to_le_bytes());
    out
}

/// A zstd frame of one raw block (RFC 8878): magic, single segment with one byte of length, block header.
fn zstd_raw(plain: &[u8]) -> Vec<u8> {
    let mut out = vec![0x28, 0xB5, 0x2F, 0xFD, 0x20, plain.len() as u8];
    out.extend_from_slice(&((plain.len() as u32) << 3 | 1).to_le_bytes()[..3]);
    out.extend(plain);
    out
}

fn check(params: &Params) {
    let g = &params[GEOMETRY];
    assert_eq!(g.read::<3>(0, 0), [1.5, -0.25, 2048.0 - 1.0 / 4096.0]);
    assert_eq!(g.read::<3>(0, LOG_SCALE), [-10.0, 0.0, 5.9375]);
    let opacity = 1.0 / (1.0 + (-g.get(0, OPACITY)).exp());
    assert!((opacity - 0.8).abs() < 1e-6);
    let sh: [f32; 12] = params[SH].read(0, 0);
    let expected = [-3.333_333, 3.333_333, 0.666_667, 0.0, -1.0, 0.992_187_5, 0.0625, -0.0625, 0.0, 0.0, 0.0, -0.5];
    assert!(sh.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-5), "{sh:?}");
}

/// x = −0.6, y = 0, z = 0: w = 0.8.
const OLD_ROTATION: [u8; 3] = [51, 128, 128];
/// Largest is z (2); x = −√½·255/511, y = 0, w = √½·511/511.
const NEW_ROTATION: u32 = 2 << 30 | (1 << 9 | 255) << 20 | 511;

#[test]
fn positions_that_24_bits_cannot_hold_are_reported_with_their_error() {
    let mut p = gaussians(50, 1);
    let mut out = Vec::new();
    assert!(!write(&p, 3, Y_DOWN, &mut out).unwrap().lines().iter().any(|w| w.contains("24 bits")));
    (0..50).for_each(|row| p[GEOMETRY].add(row, 0, [431_234.0, 312_345.0, 310.0]));
    let said = write(&p, 3, Y_DOWN, &mut out).unwrap();
    assert!(said.lines().iter().any(|w| w.contains("24 bits") && w.contains("of the size of the median")), "{said:?}");
}

#[test]
fn version_2_by_hand() {
    let plain = [header(2, 1), vec![0], body(&OLD_ROTATION)].concat();
    for file in [gzipped(&plain), plain] {
        let (params, up, warnings) = read(&file).unwrap();
        check(&params);
        let q = params[GEOMETRY].read::<4>(0, QUAT);
        assert!((q[0] - 0.8).abs() < 1e-3 && (q[1] + 0.6).abs() < 1e-6 && q[2].abs() < 0.005, "{q:?}");
        let header = head(&file);
        assert_eq!((header.version, header.degree, header.fraction_bits), (2, 1, 12));
        // No extension names the axes: they are those of .ply.
        assert_eq!(up, Y_DOWN);
        assert!(warnings.lines().len() == 1 && warnings.lines()[0].contains("assumed"), "{warnings:?}");
    }
}

#[test]
fn version_3_by_hand() {
    let file = gzipped(&[header(3, 1), vec![0], body(&NEW_ROTATION.to_le_bytes())].concat());
    let (params, ..) = read(&file).unwrap();
    check(&params);
    check_new_rotation(&params);
    assert_eq!(head(&file).version, 3);
}

fn check_new_rotation(params: &Params) {
    let x = 0.5f32.sqrt() * 255.0 / 511.0;
    let q = params[GEOMETRY].read::<4>(0, QUAT);
    let expected = [0.5f32.sqrt(), -x, 0.0, (0.5 - x * x).sqrt()];
    assert!(q.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{q:?}");
}

/// Version 4, with two extensions before the table of contents.
fn version_4() -> Vec<u8> {
    let body = body(&NEW_ROTATION.to_le_bytes());
    let mut at = 0;
    let streams = [9, 1, 3, 3, 4, 9].map(|n| {
        at += n;
        body[at - n..at].to_vec()
    });
    let mut extensions = Vec::new();
    // The second one states right, up, back.
    for (kind, payload) in [(0xADBE_0002u32, vec![0; 12]), (0xADBE_0003, vec![4, 0, 0, 0])] {
        extensions.extend(kind.to_le_bytes());
        extensions.extend((payload.len() as u32).to_le_bytes());
        extensions.extend(payload);
    }
    let mut file = header(4, 1);
    file[14] = ANTIALIASED | EXTENDED;
    file.push(6);
    file.extend((32 + extensions.len() as u32).to_le_bytes());
    file.resize(32, 0);
    file.extend(extensions);
    let frames = streams.each_ref().map(|s| zstd_raw(s));
    for (frame, stream) in frames.iter().zip(&streams) {
        file.extend((frame.len() as u64).to_le_bytes());
        file.extend((stream.len() as u64).to_le_bytes());
    }
    frames.iter().for_each(|f| file.extend(f));
    file
}

#[test]
fn version_4_by_hand() {
    let (params, up, warnings) = read(&version_4()).unwrap();
    check(&params);
    check_new_rotation(&params);
    assert_eq!(head(&version_4()).version, 4);
    let said = warnings.lines().join("\n");
    assert!(said.contains("0xADBE0002") && said.contains("anti-aliasing") && !said.contains("assumed"), "{said}");
    assert_eq!(up, [0.0, 1.0, 0.0]);
}

#[test]
fn every_version_and_degree_round_trips_within_its_steps() {
    for version in VERSIONS {
        for coefficients in [1, 4, 9, 16] {
            let p = gaussians(700, coefficients);
            let mut file = Vec::new();
            write(&p, version, Y_DOWN, &mut file).unwrap();
            let (header, (back, ..)) = (head(&file), read(&file).unwrap());
            assert_eq!((header.version, back[SH].width()), (version, 3 * coefficients));
            let w = worst(&p, &back);
            // Half a step each; rotations of version 2 lose most where w is small.
            let turn = if version == 2 { 0.2 } else { 0.006 };
            let step = 0.5 / f32::from(1u16 << header.fraction_bits.min(15));
            assert!(w.mean <= step + 1e-6 && w.log_scale <= 0.5 / 16.0 + 1e-5, "version {version}: {w:?}");
            assert!(w.turn < turn && w.opacity < 0.0021 && w.sh <= 0.5 / 8.0 + 0.004, "version {version}: {w:?}");
            assert!(w.dc_inside < 0.5 / 255.0 / 0.15 + 1e-5, "version {version}: {w:?}");
        }
    }
}

#[test]
fn gzip_streams_end_like_any_other() {
    let mut file = Vec::new();
    write(&gaussians(100, 4), 3, Y_DOWN, &mut file).unwrap();
    let mut plain = Vec::new();
    flate2::read::GzDecoder::new(&file[..]).read_to_end(&mut plain).unwrap();
    let streams = 16 + 100 * (20 + 9);
    assert_eq!(plain[..8], *b"NGSP\x03\0\0\0");
    // The header's flag, and behind the streams the extension that states right, down, front.
    assert_eq!((plain[14], &plain[streams..]), (EXTENDED, &[3, 0, 0xBE, 0xAD, 4, 0, 0, 0, 6, 0, 0, 0][..]));
}

#[test]
fn files_store_the_up_direction_except_in_version_2() {
    let written = |version, up| {
        let mut file = Vec::new();
        let said = write(&gaussians(5, 4), version, up, &mut file).unwrap().lines().join("\n");
        (said, file)
    };
    for version in [3, 4] {
        for up in [Y_DOWN, [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]] {
            let (said, file) = written(version, up);
            let (_, found, read) = read(&file).unwrap();
            assert_eq!(found, up, "version {version}");
            assert!(!said.contains("axes") && !read.lines().join("").contains("axes"), "version {version}: {said}");
        }
        assert!(written(version, [0.6, 0.8, 0.0]).0.contains("does not name its axes"), "version {version}");
    }
    // Its readers refuse bytes behind the streams.
    let (said, file) = written(2, Y_DOWN);
    let mut plain = Vec::new();
    flate2::read::GzDecoder::new(&file[..]).read_to_end(&mut plain).unwrap();
    assert_eq!((plain.len(), plain[14]), (16 + 5 * (19 + 9), 0));
    assert!(!said.contains("axes") && written(2, [0.0, 1.0, 0.0]).0.contains("does not name its axes"));
}

#[test]
fn clipped_values_are_counted() {
    let mut p = gaussians(4, 4);
    p[GEOMETRY].set(0, 0, 1e9);
    p[GEOMETRY].set(1, LOG_SCALE, -11.0);
    p[SH].set(2, 0, 4.0);
    p[SH].set(3, 5, -1.5);
    let mut file = Vec::new();
    let said = write(&p, 3, Y_DOWN, &mut file).unwrap().lines().join("\n");
    for part in ["were outside of the range", "a scale outside", "base colour", "spherical harmonics above"] {
        assert!(said.contains(&format!("1 of 4 Gaussians {}", sentence(&said, part))), "{part}: {said}");
    }
    assert!(write(&Params::new(0, 1, &[]), 3, Y_DOWN, &mut Vec::new()).is_err());
}

/// The words of the line that holds `part`, behind "Gaussians ".
fn sentence<'a>(said: &'a str, part: &str) -> &'a str {
    said.lines().find(|l| l.contains(part)).and_then(|l| l.split_once("Gaussians ")).map_or("nothing", |x| x.1)
}

#[test]
fn inconsistent_headers_are_errors_with_a_reason() {
    let plain = |version, degree| [header(version, degree), vec![0], body(&OLD_ROTATION)].concat();
    let error = |file: &[u8]| read(file).unwrap_err().to_string();
    assert!(error(&gzipped(&plain(9, 1))).contains("version 9"));
    assert!(error(&gzipped(&plain(1, 1))).contains("version 1"));
    assert!(error(&gzipped(&plain(2, 5))).contains("degree 5"));
    assert!(error(&gzipped(&plain(2, 2))).contains("43 bytes"), "{}", error(&gzipped(&plain(2, 2))));
    assert!(error(b"PK\x03\x04").contains("not an .spz file"));
    let mut many = plain(2, 1);
    many[8..12].copy_from_slice(&u32::MAX.to_le_bytes());
    assert!(error(&gzipped(&many)).contains("4294967295"));
    let mut v5 = version_4();
    v5[4] = 5;
    assert!(error(&v5).contains("version 5"));
    let mut longer = version_4();
    longer[15] = 7;
    assert!(error(&longer).contains("7 streams"));
    let whole = version_4();
    for cut in 0..whole.len() {
        assert!(read(&whole[..cut]).is_err(), "cut to {cut} bytes");
    }
}

#[test]
fn damaged_files_never_panic() {
    for version in VERSIONS {
        let mut file = Vec::new();
        write(&gaussians(60, 9), version, Y_DOWN, &mut file).unwrap();
        for mutant in mutants(&file, 300, "spz") {
            let _ = read(&mutant);
        }
    }
    // Damage inside the gzip stream seldom gets through its checksum; this is the same body without.
    let plain = [header(3, 1), vec![0], body(&NEW_ROTATION.to_le_bytes())].concat();
    for mutant in mutants(&plain, 500, "spz plain").chain(mutants(&version_4(), 500, "spz 4")) {
        let _ = read(&mutant);
    }
}
