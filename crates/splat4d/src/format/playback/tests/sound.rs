//! Sound of files: round trips, readers that do not know it, and MP4 files that are something else.

use super::*;

/// 0.3 s of a tone: `ffmpeg -f lavfi -i sine=frequency=440:duration=0.3:sample_rate=48000 -c:a aac -b:a 32k`.
const TONE: &[u8] = include_bytes!("../../../../tests/data/tone.m4a");

fn tone(start: f64) -> Sound {
    Sound::try_from((start, TONE.to_vec())).unwrap()
}

#[test]
fn sound_round_trips_and_is_removed_exactly() {
    let plain = bytes_of(&made_up(40, 1, 1), &WriteConfig::default()).0;
    assert_eq!(sound(&plain).unwrap(), None);
    let own = tone(0.25);
    assert!((own.span[1] - 0.55).abs() < 1e-9, "{:?}: the encoder's first 1024 samples are not heard", own.span);
    let with = with_sound(&plain, Some(&own)).unwrap();
    assert_eq!(sound(&with).unwrap(), Some(own));
    assert_eq!(with_sound(&with, None).unwrap(), plain);
    let replaced = with_sound(&with, Some(&tone(-3.0))).unwrap();
    assert_eq!(sound(&replaced).unwrap().map(|s| s.span[0]), Some(-3.0));
    assert_eq!(strict(&with).unwrap().len(), strict(&plain).unwrap().len());
    // Provenance and sound do not disturb each other, and images begin as early as before.
    let both = with_provenance(&with, Some(&Provenance::default())).unwrap();
    assert_eq!(
        (sound(&both).unwrap(), provenance(&both).unwrap()),
        (sound(&with).unwrap(), Some(Provenance::default()))
    );
    let index = Index::parse(&both, None).unwrap();
    let at = |kind: Kind| index.sections.iter().rposition(|e| e.kind == kind);
    assert!(at(Kind::Sound) > at(Kind::Page) && index.version == [1, 0]);
}

#[test]
fn readers_that_do_not_know_sound_play_the_scene() {
    let plain = bytes_of(&made_up(40, 1, 1), &WriteConfig::default()).0;
    let mut with = with_sound(&plain, Some(&tone(0.0))).unwrap();
    let scene = |bytes: &[u8]| read(bytes).unwrap().layers.iter().map(|l| l.params.clone()).collect::<Vec<_>>();
    assert!(scene(&with) == scene(&plain));
    // To an earlier reader it is a section of an unknown kind.
    let at = Index::parse(&with, None).unwrap().sections.iter().position(|e| e.kind == Kind::Sound).unwrap();
    with = hostile::with_entry(&with, at, 0, b"WAVE");
    assert!(scene(&with) == scene(&plain) && sound(&with).unwrap().is_none());
}

#[test]
fn finished_files_that_grew_have_sound() {
    let part = bytes_of(&made_up(40, 1, 1), &WriteConfig::default()).0;
    let meta = made_up(4, 1, 1).meta;
    let mut growing = Growing::begin(std::io::Cursor::new(Vec::new()), meta.clone()).unwrap();
    growing.append(&part, meta.clone(), &mut |_| Ok(())).unwrap();
    let mut out = Vec::new();
    finish(growing.file(), meta, (Some(b"poster"), Some(&tone(0.1))), &mut out).unwrap();
    assert_eq!((read(&out).unwrap().len(), sound(&out).unwrap()), (40, Some(tone(0.1))));
}

#[test]
fn damaged_sound_is_reported_and_the_scene_still_plays() {
    let with = with_sound(&bytes_of(&made_up(40, 1, 1), &WriteConfig::default()).0, Some(&tone(0.0))).unwrap();
    let mut broken = with.clone();
    *broken.last_mut().unwrap() ^= 1;
    assert!(sound(&broken).unwrap_err().to_string().contains("checksum of its sound"));
    assert_eq!(read(&broken).unwrap().len(), 40);
    let at = Index::parse(&with, None).unwrap().sections.len() - 1;
    for (byte, value, says) in [
        (48, 9.0f64.to_le_bytes(), "lasts 0.300 s instead of 9.000 s"),
        (48, (-1.0f64).to_le_bytes(), "cannot be played"),
        (40, f64::NAN.to_le_bytes(), "cannot be played"),
        (48, 1e9f64.to_le_bytes(), "cannot be played"),
    ] {
        let error = sound(&hostile::with_entry(&with, at, byte, &value)).unwrap_err().to_string();
        assert!(error.contains(says), "{error}");
    }
}

#[test]
fn other_containers_are_refused() {
    let find = |name: &[u8]| TONE.windows(4).position(|w| w == name).unwrap();
    let with = |name: &[u8], from: usize, bytes: &[u8]| {
        let (mut m, at) = (TONE.to_vec(), find(name) + from);
        m[at..at + bytes.len()].copy_from_slice(bytes);
        m
    };
    let cases: [(&str, Vec<u8>); 14] = [
        ("begin", b"RIFF....WAVEfmt ".to_vec()),
        ("fit into each other", TONE[..TONE.len() - 9].to_vec()),
        ("does not begin", Vec::new()),
        ("has a box `moof`", with(b"free", 0, b"moof")),
        ("has no box `moov`", with(b"moov", 0, b"free")),
        ("has no box `trak`", with(b"trak", 0, b"udta")),
        ("several boxes `trak`", with(b"udta", 0, b"trak")),
        ("not sound", with(b"soun", 0, b"vide")),
        ("another file", with(b"url ", 4, &[0; 4])),
        ("not AAC", with(b"mp4a", 0, b"fLaC")),
        ("no ticks", with(b"mdhd", 16, &[0; 4])),
        ("lasts", with(b"mdhd", 20, &[0; 4])),
        ("several edits", with(b"elst", 8, &[0, 0, 0, 9])),
        ("cut short", with(b"stco", 12, &[1, 0, 0, 0])),
    ];
    for (says, bytes) in cases {
        let error = Sound::try_from((0.0, bytes)).unwrap_err().to_string();
        assert!(error.contains(says), "{says}: {error}");
    }
    assert!(Sound::try_from((f64::NAN, TONE.to_vec())).is_err());
    // No change of a byte makes it panic.
    for at in 0..TONE.len().min(900) {
        for value in [0, 1, 0x7F, 0xFF] {
            let mut m = TONE.to_vec();
            m[at] = value;
            let _ = Sound::try_from((0.0, m));
        }
    }
}
