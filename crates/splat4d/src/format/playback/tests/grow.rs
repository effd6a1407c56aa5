//! Files that grow: the present part plays at any time, and a finished file is like any other, in whatever order it was
//! added.

use super::*;
use std::io::{Cursor, ErrorKind as Io, Read, Seek, SeekFrom, Write};

/// Half a second of a clip, and the static background.
fn part(seed: u64, from: f64) -> Vec<u8> {
    let mut draft = made_up(900, 1, seed);
    draft.nodes = vec![Node { from, to: from + 0.5, primitives: draft.nodes.swap_remove(0).primitives }];
    bytes_of(&draft, &WriteConfig { kmeans_rounds: 1, ..WriteConfig::default() }).0
}

fn meta(last: f64, parts: &[&str]) -> Meta {
    let parts = parts.iter().map(|p| (*p).to_owned()).collect();
    Meta { clip: [0.0, last], parts, ..made_up(4, 1, 1).meta }
}

fn added<F: Read + Write + Seek>(file: &mut Growing<F>, part: &[u8], meta: Meta) -> crate::Result<()> {
    file.append(part, meta, &mut |_| Ok(()))
}

/// What a file shows, by the position of its first Gaussian.
fn shown(bytes: &[u8], t: f64) -> Vec<[f64; 3]> {
    let scene = read(bytes).unwrap();
    let layers = scene.layers.iter().filter(|l| l.span[0] <= t && t < l.span[1]);
    layers.map(|l| l.means().next().unwrap()).collect()
}

#[test]
fn a_growing_file_plays_and_readers_of_an_older_header_are_not_disturbed() {
    let mut growing = Growing::begin(Cursor::new(Vec::new()), meta(0.0, &[])).unwrap();
    let bytes = |g: &mut Growing<Cursor<Vec<u8>>>| g.file().get_ref().clone();
    assert_eq!(read(&bytes(&mut growing)).unwrap().len(), 0);
    added(&mut growing, &part(1, 0.0), meta(0.5, &["0"])).unwrap();
    let first = bytes(&mut growing);
    added(&mut growing, &part(2, 0.5), meta(1.0, &["0", "1"])).unwrap();
    let second = bytes(&mut growing);
    assert_eq!([&first, &second].map(|b| shown(b, 0.7).len()), [0, 1]);
    assert_eq!((shown(&first, 0.2).len(), shown(&first, 0.2)), (1, shown(&second, 0.2)));
    assert_eq!(second[64..first.len()], first[64..], "nothing but the header is written again");
    // The first header, and all later content.
    let stale = [&first[..64], &second[64..]].concat();
    assert_eq!(read(&stale).unwrap().clip, [0.0, 0.5]);
    // Its start alone gives the index's position.
    let place = Index::place(&second[..64]).unwrap();
    let index = Index::of(&second[..64], &second[place.start as usize..place.end as usize]).unwrap();
    assert_eq!((index.meta.parts.clone(), index.meta.gaussians), (vec!["0".into(), "1".into()], 1800 - 2 * 450));
    assert!(Index::grows(&second) && index == Index::parse(&second, None).unwrap());
    // Who continues with the file finds what is in it.
    let again = Growing::open(Cursor::new(second)).unwrap();
    assert_eq!(again.index(), &index);
    assert!(Growing::open(Cursor::new(part(1, 0.0))).is_err(), "a finished file grows no more");
}

#[test]
fn the_finished_file_does_not_depend_on_the_order_of_chunks() {
    let parts = [part(1, 0.0), part(2, 0.5), part(3, 0.0)];
    let file = |order: [usize; 3]| {
        let mut growing = Growing::begin(Cursor::new(Vec::new()), meta(1.0, &[])).unwrap();
        for i in order {
            added(&mut growing, &parts[i], meta(1.0, &["x"])).unwrap();
        }
        let mut out = Vec::new();
        let length = finish(growing.file(), meta(1.0, &["x"]), (Some(b"poster"), None), &mut out).unwrap();
        assert_eq!(length, out.len() as u64);
        out
    };
    let one = file([0, 1, 2]);
    assert!(one == file([2, 1, 0]) && one == file([1, 0, 2]));
    let index = Index::parse(&one, None).unwrap();
    assert_eq!((index.version, index.meta.parts.len()), ([1, 0], 0));
    let kinds: Vec<String> = index.sections.iter().map(|e| e.kind.name()).collect();
    assert_eq!(kinds, ["POST", "PAGE", "PAGE", "PALT", "PALT", "PALT", "PAGE"]);
    for (part, t) in [(&parts[0], 0.2), (&parts[1], 0.7), (&parts[2], 0.2)] {
        let theirs = shown(part, t)[0];
        assert!(shown(&one, t).contains(&theirs), "{theirs:?} at {t}");
    }
    let mut cut = one.clone();
    cut.truncate(one.len() - 5);
    assert!(finish(&mut Cursor::new(cut), meta(1.0, &[]), (None, None), &mut Vec::new()).is_err());
}

/// A disk with this many bytes.
struct Small(Cursor<Vec<u8>>, usize);

impl Read for Small {
    fn read(&mut self, out: &mut [u8]) -> std::io::Result<usize> {
        self.0.read(out)
    }
}

impl Seek for Small {
    fn seek(&mut self, to: SeekFrom) -> std::io::Result<u64> {
        self.0.seek(to)
    }
}

impl Write for Small {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let room = self.1.saturating_sub(self.0.position() as usize);
        if room == 0 { Err(Io::StorageFull.into()) } else { self.0.write(&bytes[..bytes.len().min(room)]) }
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

#[test]
fn on_a_full_disk_the_file_is_unchanged_and_grows_later() {
    let [one, two] = [part(1, 0.0), part(2, 0.5)];
    let room = one.len() + two.len() / 2;
    let mut growing = Growing::begin(Small(Cursor::new(Vec::new()), room), meta(0.0, &[])).unwrap();
    added(&mut growing, &one, meta(0.5, &["0"])).unwrap();
    assert!(added(&mut growing, &two, meta(1.0, &["0", "1"])).is_err());
    let bytes = growing.file().0.get_ref().clone();
    assert_eq!((read(&bytes).unwrap().clip, growing.index().meta.parts.len()), ([0.0, 0.5], 1));
    growing.file().1 = usize::MAX;
    added(&mut growing, &two, meta(1.0, &["0", "1"])).unwrap();
    assert_eq!(read(growing.file().0.get_ref()).unwrap().clip, [0.0, 1.0]);
}
