//! Finds the files that a capture names: one lookup for every layout.
//!
//! Captures travel between programs and systems. Names then differ from the files by slashes, letter case, ending,
//! Unicode normal form (macOS decomposes umlauts) and leading folders (absolute paths of another machine). The exact
//! name has priority; else the one file that fits is taken, and one remark counts such names. Several files that fit
//! are an error.

mod twins;

use super::account::Severity;
use super::account::{Account, Aspect, first_names};
use super::{CaptureOptions, rig};
use splat4d::{Error, Result};
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::rc::Rc;
use unicode_normalization::UnicodeNormalization;

pub(super) use twins::Twins;

/// Parts of names of folders in which other programs keep masks, with either polarity.
const MASK_WORDS: [&str; 3] = ["mask", "matte", "segment"];

/// Folders that usually contain images, below that of the capture.
const IMAGE_FOLDERS: [&str; 3] = ["images", "input", "image"];
/// How names of folders begin that hold other things than images, though their files may be called like these.
const NO_IMAGES: [&str; 5] = ["depth", "normal", "seg", "flow", "."];
/// Names of images compared when a folder is searched for: enough to distinguish folders.
const SAMPLE: usize = 32;
/// Endings of images, readable ones first; a name with one of the others may be an image converted since.
const KNOWN_ENDINGS: &[&str] = &[
    "png", "jpg", "jpeg", "webp", "tif", "tiff", "bmp", "heic", "heif", "avif", "jxl", "jp2", "gif", "dng", "arw",
    "cr2", "cr3", "nef", "ppm", "pgm", "exr", "tga",
];

/// Difference of a name from the file found for it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Way {
    Slashes,
    Folders,
    Ending,
    Case,
    Unicode,
    Codes,
}

impl Way {
    fn in_words(self) -> &'static str {
        match self {
            Self::Slashes => "backslashes",
            Self::Folders => "leading folders",
            Self::Ending => "the ending",
            Self::Case => "letter case",
            Self::Unicode => "Unicode form",
            Self::Codes => "percent codes, spaces or file://",
        }
    }
}

/// Names of one folder, by what they have in common with other spellings.
#[derive(Default)]
struct Listing {
    names: BTreeMap<String, Vec<String>>,
    /// Images by their names without endings.
    stems: BTreeMap<String, Vec<String>>,
}

/// Finds files below a capture's folder.
pub(super) struct Lookup {
    root: PathBuf,
    /// The folder of images that the user chose.
    chosen: Option<PathBuf>,
    listings: RefCell<BTreeMap<PathBuf, Rc<Listing>>>,
    /// Files that were not found by their exact name, and the name that led there.
    loose: RefCell<BTreeMap<PathBuf, String>>,
    ways: RefCell<BTreeMap<Way, usize>>,
    /// Files that were read for names without an ending, and the others that fit as well.
    bare: RefCell<BTreeMap<PathBuf, Vec<String>>>,
}

/// A name's canonical form: composed (NFC) and in lower case.
pub(super) fn fold(name: &str) -> String {
    if name.is_ascii() { name.to_ascii_lowercase() } else { name.nfc().collect::<String>().to_lowercase() }
}

/// A file's name without the ending of an image.
pub(super) fn without_ending(name: &str) -> &str {
    match name.rsplit_once('.') {
        Some((stem, ending)) if KNOWN_ENDINGS.iter().any(|e| ending.eq_ignore_ascii_case(e)) => stem,
        _ => name,
    }
}

/// A name without `file://` and spaces at its ends, and with its percent codes (`%20`) decoded.
fn decoded(name: &str) -> String {
    let trimmed = name.trim();
    let plain = trimmed.strip_prefix("file://").unwrap_or(trimmed);
    let (mut bytes, mut rest) = (Vec::with_capacity(plain.len()), plain.as_bytes());
    while let Some((&first, after)) = rest.split_first() {
        let code = after.get(..2).and_then(|c| u8::from_str_radix(std::str::from_utf8(c).ok()?, 16).ok());
        let code = code.filter(|_| first == b'%');
        bytes.push(code.unwrap_or(first));
        rest = if code.is_some() { &after[2..] } else { after };
    }
    String::from_utf8(bytes).unwrap_or_else(|_| plain.to_owned())
}

/// A path's parts, whichever slashes it has; and whether it is absolute.
fn parts(name: &str) -> (Vec<&str>, bool) {
    let drive = name.as_bytes().get(1) == Some(&b':');
    let plain = if drive { &name[2..] } else { name };
    let parts = plain.split(['/', '\\']).filter(|p| !p.is_empty() && *p != ".").collect();
    (parts, drive || plain.starts_with(['/', '\\']))
}

/// A path as lists of names are compared: composed, lower case, forward slashes, without folders of all images and
/// without ending.
pub(super) fn key(name: &str) -> String {
    let (mut parts, _) = parts(name);
    let file = parts.pop().unwrap_or_default();
    let folders = parts.iter().map(|p| fold(p)).filter(|p| !is_image_folder(p));
    folders.chain([fold(without_ending(file))]).collect::<Vec<_>>().join("/")
}

impl Lookup {
    /// A lookup below `root`. Errors: the folder of images that was requested is not there.
    pub(super) fn new(root: &Path, options: &CaptureOptions) -> Result<Self> {
        let chosen = options.images.as_ref().map(|name| root.join(name));
        if let Some(folder) = chosen.as_ref().filter(|f| !f.is_dir()) {
            let there: Vec<String> = rig::file_names(root).into_iter().filter(|n| root.join(n).is_dir()).collect();
            return Err(Error::input("the folder of images that --images names is not there")
                .at(folder.display())
                .remedy(format!("Folders here are: {}.", there.join(", "))));
        }
        Ok(Self {
            root: root.to_path_buf(),
            chosen,
            listings: RefCell::default(),
            loose: RefCell::default(),
            ways: RefCell::default(),
            bare: RefCell::default(),
        })
    }

    /// Files of names relative to the capture's folder.
    pub(super) fn bases(&self) -> Vec<PathBuf> {
        let mut bases = self.folders();
        // The capture's own folder has priority: names may hold that of the images.
        bases.sort_by_key(|folder| *folder != self.root);
        bases
    }

    /// Folders that may hold the images: the usual ones, the capture's own, and reduced copies last.
    pub(super) fn folders(&self) -> Vec<PathBuf> {
        if let Some(folder) = &self.chosen {
            return vec![folder.clone()];
        }
        let usual = IMAGE_FOLDERS.iter().map(|name| self.root.join(name));
        let all = usual.chain([self.root.clone()]).chain(reduced_folders(&self.root));
        all.filter(|folder| folder.is_dir()).collect()
    }

    /// The folder that holds most of `names`, which are relative to it; the first of equals.
    pub(super) fn folder_of(&self, names: &[&str]) -> PathBuf {
        let sample: Vec<&&str> = names.iter().step_by(names.len().div_ceil(SAMPLE).max(1)).collect();
        let mut best: Option<(usize, PathBuf)> = None;
        let usual = self.folders();
        // Folders of other names only where none of the usual ones has an image.
        let others = || self.other_folders().into_iter().map(|folder| (folder, true));
        for (folder, other) in usual.into_iter().map(|folder| (folder, false)).chain(others()) {
            if other && best.is_some() {
                break;
            }
            let exact = sample.iter().filter(|name| folder.join(name).is_file()).count();
            let loose =
                || sample.iter().filter(|name| matches!(self.walk(&folder, &parts(name).0), Ok(Some(_)))).count();
            let count = if exact == sample.len() { exact } else { loose() };
            if count > best.as_ref().map_or(0, |(most, _)| *most) {
                best = Some((count, folder));
            }
        }
        if best.is_none() && self.chosen.is_none() {
            // A folder of its own inside these (`images/images`), if it has all of them.
            let mut outer = self.folders();
            outer.extend(self.other_folders());
            let inner = outer.iter().filter(|f| **f != self.root).flat_map(|f| folders_in(f));
            let has_all =
                |folder: &PathBuf| sample.iter().all(|name| matches!(self.walk(folder, &parts(name).0), Ok(Some(_))));
            if let Some(folder) = inner.into_iter().find(has_all) {
                return folder;
            }
        }
        let usual = || self.chosen.clone().unwrap_or_else(|| self.root.join(IMAGE_FOLDERS[0]));
        best.map_or_else(usual, |(_, folder)| folder)
    }

    /// Folders of the capture's that are none of the usual ones.
    fn other_folders(&self) -> Vec<PathBuf> {
        if self.chosen.is_some() {
            return Vec::new();
        }
        let is_usual = |folder: &PathBuf| is_image_folder(&folder.file_name().unwrap_or_default().to_string_lossy());
        folders_in(&self.root).into_iter().filter(|folder| !is_usual(folder)).collect()
    }

    /// The capture's folder.
    pub(super) fn root(&self) -> &Path {
        &self.root
    }

    /// A layout's own folder of images, unless the user chose another.
    pub(super) fn folder(&self, name: &str) -> PathBuf {
        self.chosen.clone().unwrap_or_else(|| self.root.join(name))
    }

    /// The image that `name` represents, below the first of `bases` that has it. `None`: it is missing. Errors: several
    /// files fit, or two names fit one file.
    pub(super) fn image(&self, bases: &[PathBuf], name: &str) -> Result<Option<PathBuf>> {
        let plain = name.strip_prefix("./").unwrap_or(name);
        let exact = bases.iter().map(|base| base.join(plain)).find(|p| p.is_file());
        if exact.is_some() {
            return Ok(exact);
        }
        if let Some(found) = self.spelled_otherwise(bases, name, name)? {
            return Ok(Some(found));
        }
        let plain = decoded(name);
        if plain == name {
            return Ok(None);
        }
        let exact = bases.iter().map(|base| base.join(&plain)).find(|p| p.is_file());
        let found = match exact {
            Some(found) => Some(found),
            None => self.spelled_otherwise(bases, &plain, name)?,
        };
        if let Some(found) = &found {
            self.loose.borrow_mut().entry(found.clone()).or_insert_with(|| name.to_owned());
            *self.ways.borrow_mut().entry(Way::Codes).or_default() += 1;
        }
        Ok(found)
    }

    /// The image that `plain` leads to in another spelling, or after leading folders that are not there; `name` as it
    /// is written. Errors: as [`Self::image`].
    fn spelled_otherwise(&self, bases: &[PathBuf], plain: &str, name: &str) -> Result<Option<PathBuf>> {
        let (parts, absolute) = parts(plain);
        let there = |first: &str| {
            let folder = fold(first);
            bases.iter().any(|base| self.listing(base).names.contains_key(&folder))
        };
        // A relative path may have folders of another machine too, but none that is here with other files.
        let elsewhere = parts.first().is_some_and(|first| !there(first));
        for skip in 0..parts.len() {
            // A folder right before the file may name a camera, whose image this is not.
            let with_folder = elsewhere && parts.len() - skip > 1;
            if !absolute && !with_folder && !parts[..skip].iter().all(|p| rig::is_plain(p)) {
                break;
            }
            for base in bases {
                let Some(found) = self.walk(base, &parts[skip..])? else { continue };
                let known = self.loose.borrow_mut().entry(found.clone()).or_insert_with(|| name.to_owned()).clone();
                if known != name {
                    return Err(Error::input(format!("\"{known:.200}\" and \"{name:.200}\" both fit one file"))
                        .at(found.display())
                        .remedy("Give each image a name of its own, or write the exact names."));
                }
                self.note(name, &parts[skip..], skip, base, &found);
                return Ok(Some(found));
            }
        }
        Ok(None)
    }

    /// The only image below the capture's folder with this name, whatever folder it is in. `None`: there is none, or
    /// there are several.
    pub(super) fn anywhere(&self, name: &str) -> Result<Option<PathBuf>> {
        let mut folders = self.folders();
        folders.extend(self.other_folders());
        folders.dedup();
        let inner: Vec<PathBuf> = folders.iter().filter(|f| **f != self.root).flat_map(|f| folders_in(f)).collect();
        folders.retain(|folder| !is_reduced(folder));
        let mut found: Option<PathBuf> = None;
        for folder in folders.iter().chain(&inner) {
            match (self.walk(folder, &parts(name).0)?, &found) {
                (Some(_), Some(_)) => return Ok(None),
                (Some(image), None) => found = Some(image),
                (None, _) => {}
            }
        }
        if let Some(found) = &found {
            self.loose.borrow_mut().entry(found.clone()).or_insert_with(|| name.to_owned());
            *self.ways.borrow_mut().entry(Way::Folders).or_default() += 1;
        }
        Ok(found)
    }

    /// [`Self::image`], or where it should be.
    pub(super) fn image_or_place(&self, bases: &[PathBuf], name: &str) -> Result<PathBuf> {
        let place = || bases.first().unwrap_or(&self.root).join(name.strip_prefix("./").unwrap_or(name));
        Ok(self.image(bases, name)?.unwrap_or_else(place))
    }

    /// Another file that the capture names (points, a mask, depth): found like an image; else where it should be.
    pub(super) fn file(&self, name: &str) -> Result<PathBuf> {
        self.image_or_place(std::slice::from_ref(&self.root), name)
    }

    fn listing(&self, folder: &Path) -> Rc<Listing> {
        if let Some(known) = self.listings.borrow().get(folder) {
            return known.clone();
        }
        let mut listing = Listing::default();
        for name in rig::file_names(folder) {
            if rig::is_image(&name) {
                listing.stems.entry(fold(without_ending(&name))).or_default().push(name.clone());
            }
            listing.names.entry(fold(&name)).or_default().push(name);
        }
        let listing = Rc::new(listing);
        self.listings.borrow_mut().insert(folder.to_path_buf(), listing.clone());
        listing
    }

    /// The file below `base` that `parts` lead to, whatever their spelling.
    fn walk(&self, base: &Path, parts: &[&str]) -> Result<Option<PathBuf>> {
        let Some((file, folders)) = parts.split_last() else { return Ok(None) };
        let mut folder = base.to_path_buf();
        for part in folders {
            if *part == ".." {
                folder.pop();
                continue;
            }
            let listing = self.listing(&folder);
            let Some(name) = one(listing.names.get(&fold(part)), part, &folder)? else { return Ok(None) };
            folder.push(name);
        }
        let listing = self.listing(&folder);
        if let Some(name) = one(listing.names.get(&fold(file)), file, &folder)? {
            let path = folder.join(name);
            if path.is_file() {
                return Ok(Some(path));
            }
        }
        let stem = fold(without_ending(file));
        let images = listing.stems.get(&stem);
        if without_ending(file) == *file {
            // No ending is stated: the usual order of endings decides.
            let ends = |name: &&String, ending: &str| fold(name).ends_with(&format!(".{ending}"));
            let found = rig::IMAGE_ENDINGS.iter().find_map(|e| images?.iter().find(|n| ends(n, e)));
            let Some(name) = found else { return Ok(None) };
            let others: Vec<String> = images.into_iter().flatten().filter(|n| *n != name).cloned().collect();
            let path = folder.join(name);
            if !others.is_empty() {
                let mut twins = Twins::default();
                others.iter().try_for_each(|other| twins.add(path.clone(), folder.join(other)))?;
                self.bare.borrow_mut().insert(path.clone(), others);
            }
            return Ok(Some(path));
        }
        Ok(one(images, file, &folder)?.map(|name| folder.join(name)))
    }

    /// Counts how a name differs from the file that was found.
    fn note(&self, name: &str, parts: &[&str], skip: usize, base: &Path, found: &Path) {
        let written = parts.join("/");
        let actual = found.strip_prefix(base).unwrap_or(found).to_string_lossy().replace('\\', "/");
        let bare = without_ending(&written) == written;
        let actual = if bare { without_ending(&actual).to_owned() } else { actual };
        let mut ways = self.ways.borrow_mut();
        let mut add = |way: Way, differs: bool| {
            if differs {
                *ways.entry(way).or_default() += 1;
            }
        };
        let (a, b) = (without_ending(&written), without_ending(&actual));
        let ending = |path: &str| path.rsplit_once('.').map_or_else(String::new, |(_, e)| e.to_ascii_lowercase());
        add(Way::Slashes, name.contains('\\'));
        add(Way::Folders, skip > 0);
        add(Way::Ending, !bare && fold(&written) != fold(&actual) && ending(&written) != ending(&actual));
        let cased = |s: &str| s.nfc().collect::<String>();
        add(Way::Case, cased(a) != cased(b) || !bare && fold(&written) == fold(&actual) && written != actual && a == b);
        add(Way::Unicode, a != b && fold(a) == fold(b) && a.to_lowercase() != b.to_lowercase());
    }

    /// Reports in one remark which names were not exact.
    pub(super) fn report(&self, account: &mut Account) {
        let bare = self.bare.borrow();
        if let Some((file, others)) = bare.iter().next() {
            let what = format!(
                "{} names have no ending and fit several images each, for instance {}: it is read, and {} is not. Remove the images \
                 that are not meant.",
                bare.len(),
                file.strip_prefix(&self.root).unwrap_or(file).display(),
                first_names(others)
            );
            account.add(Aspect::Assumed, Severity::Warning, what);
        }
        let (loose, ways) = (self.loose.borrow(), self.ways.borrow());
        let Some((file, name)) = loose.iter().next().filter(|_| !ways.is_empty()) else { return };
        let ways: Vec<String> = ways.iter().map(|(way, n)| format!("{} ({n})", way.in_words())).collect();
        let file = file.strip_prefix(&self.root).unwrap_or(file);
        let what = format!(
            "{} names differ from their files by {}, for instance {name:.200}: {} is read.",
            loose.len(),
            ways.join(", "),
            file.display()
        );
        account.add(Aspect::Assumed, Severity::Note, what);
    }
}

/// The only name of those that fit, or the exact one. Errors: several fit.
fn one<'a>(fitting: Option<&'a Vec<String>>, name: &str, folder: &Path) -> Result<Option<&'a String>> {
    let Some(fitting) = fitting else { return Ok(None) };
    if let Some(exact) = fitting.iter().find(|n| *n == name) {
        return Ok(Some(exact));
    }
    match &fitting[..] {
        [] => Ok(None),
        [only] => Ok(Some(only)),
        several => Err(Error::input(format!("\"{name:.200}\" is not there, and several fit: {}", several.join(", ")))
            .at(folder.display())
            .remedy("Rename the one that is meant, or remove the others.")),
    }
}

/// Whether a folder's name is like those of masks.
pub(super) fn may_hold_masks(folder: &str) -> bool {
    MASK_WORDS.iter().any(|word| fold(folder).contains(word))
}

/// Folders in a folder that may hold images.
fn folders_in(folder: &Path) -> Vec<PathBuf> {
    let for_images = |n: &String| !NO_IMAGES.iter().any(|o| fold(n).starts_with(o)) && !may_hold_masks(n);
    let names = rig::file_names(folder).into_iter().filter(for_images);
    names.map(|name| folder.join(name)).filter(|folder| folder.is_dir()).collect()
}

/// A file that is there in the place of a missing image, with the ending of a format that is not read.
pub(super) fn unreadable(image: &Path) -> Option<PathBuf> {
    let stem = fold(without_ending(&image.file_name()?.to_string_lossy()));
    let folder = image.parent()?;
    let named = rig::file_names(folder).into_iter().filter(|n| !rig::is_image(n) && !n.starts_with('.'));
    let mut images = named.filter(|n| without_ending(n) != n && fold(without_ending(n)) == stem);
    images.next().map(|name| folder.join(name))
}

/// Whether a name is that of a folder that usually contains images.
pub(super) fn is_image_folder(name: &str) -> bool {
    IMAGE_FOLDERS.contains(&name) || reduction(name).is_some()
}

/// Whether a folder holds reduced copies of images (`images_4`: Mip-NeRF 360, Nerfstudio, LLFF).
pub(super) fn is_reduced(folder: &Path) -> bool {
    reduction(&folder.file_name().unwrap_or_default().to_string_lossy()).is_some()
}

fn reduction(name: &str) -> Option<usize> {
    name.strip_prefix("images_")?.parse().ok()
}

/// Folders of reduced copies, the largest images first.
fn reduced_folders(root: &Path) -> Vec<PathBuf> {
    let mut found: Vec<(usize, PathBuf)> =
        rig::file_names(root).iter().filter_map(|n| Some((reduction(n)?, root.join(n)))).collect();
    found.sort();
    found.into_iter().map(|(_, folder)| folder).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn touch(root: &Path, name: &str) {
        let path = root.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, b"x").unwrap();
    }

    fn lookup(files: &[&str]) -> (tempfile::TempDir, Lookup) {
        let dir = tempfile::tempdir().unwrap();
        files.iter().for_each(|f| touch(dir.path(), f));
        let lookup = Lookup::new(dir.path(), &CaptureOptions::default()).unwrap();
        (dir, lookup)
    }

    /// File of `name`, relative to the folder, and the remark about it.
    fn find(files: &[&str], name: &str) -> (Option<String>, String) {
        let (dir, lookup) = lookup(files);
        let found = lookup.image(&lookup.bases(), name).unwrap();
        let mut account = Account::default();
        lookup.report(&mut account);
        let relative = found.map(|f| f.strip_prefix(dir.path()).unwrap().to_str().unwrap().to_owned());
        (relative, account.remarks.first().map_or_else(String::new, |r| r.what.clone()))
    }

    #[test]
    fn every_spelling_of_a_name_leads_to_its_file() {
        let cases = [
            ("images/cam0/0001.jpg", "images/cam0/0001.jpg", ""),
            ("images/cam0/0001.jpg", "cam0/0001.jpg", ""),
            ("images/cam0/0001.jpg", "./images/cam0/0001", ""),
            ("images/cam0/0001.jpg", "cam0\\0001.jpg", "backslashes (1)"),
            ("images/cam0/0001.JPG", "images/cam0/0001.jpg", "letter case (1)"),
            ("images/Cam0/A.jpg", "images/cam0/a.jpg", "letter case (1)"),
            ("images/cam0/0001.png", "cam0/0001.jpg", "the ending (1)"),
            ("images/cam0/0001.png", "cam0/0001.TIFF", "the ending (1)"),
            ("images/u\u{308}ber.jpg", "\u{fc}ber.jpg", "Unicode form (1)"),
            ("images/\u{fc}ber.jpg", "images/u\u{308}ber.jpg", "Unicode form (1)"),
            ("images/cam0/0001.jpg", "/home/me/scan/cam0/0001.jpg", "leading folders (1)"),
            ("images/cam0/0001.jpg", "C:\\scan\\images\\cam0\\0001.jpg", "backslashes (1), leading folders (1)"),
            ("cam0/0001.jpg", "images/cam0/0001.jpg", "leading folders (1)"),
        ];
        for (file, name, way) in cases {
            let (found, said) = find(&[file], name);
            assert_eq!(found.as_deref(), Some(file), "{name}");
            assert!(said.contains(way) && said.is_empty() == way.is_empty(), "{name}: {said}");
        }
        for gone in ["cam1/0001.jpg", "cam0/0002.jpg", "cam0/0001.jpg/x", ""] {
            assert_eq!(find(&["images/cam0/0001.jpg"], gone).0, None, "{gone}");
        }
        // A folder that names a camera states which image is meant.
        assert_eq!(find(&["images/0001.jpg"], "cam0/0001.jpg").0, None);
    }

    #[test]
    fn ambiguous_file_names_are_refused() {
        let (_dir, there) = lookup(&["images/a.PNG", "images/A.png", "images/b.webp", "images/b.png"]);
        let refuse = |name: &str| there.image(&there.bases(), name).unwrap_err().to_string();
        assert!(refuse("a.png").contains("A.png, a.PNG") && refuse("b.jpg").contains("b.png, b.webp"));
        assert!(there.image(&there.bases(), "b").unwrap().unwrap().ends_with("b.png"), "no ending is stated");
        let mut account = Account::default();
        there.report(&mut account);
        let said = &account.remarks[0];
        assert!(
            said.severity == Severity::Warning && said.what.contains("b.png: it is read, and b.webp is not"),
            "{said:?}"
        );
        let (_dir, there) = lookup(&["images/0001.jpg"]);
        assert!(there.image(&there.bases(), "/x/cam0/0001.jpg").unwrap().is_some());
        let two = there.image(&there.bases(), "/x/cam1/0001.jpg").unwrap_err().to_string();
        assert!(two.contains("cam0") && two.contains("cam1") && two.contains("both fit one file"), "{two}");
    }

    #[test]
    fn the_folder_with_most_images_is_theirs() {
        let (dir, there) = lookup(&["images/a.jpg", "images/b.jpg", "images_2/a.jpg", "images_2/b.jpg", "b.jpg"]);
        assert_eq!(there.folder_of(&["a.jpg", "b.jpg"]), dir.path().join("images"));
        let (dir, there) = lookup(&["images_4/a.png", "images_8/a.png", "x.txt"]);
        assert_eq!(there.folder_of(&["a.jpg"]), dir.path().join("images_4"));
        let (dir, there) = lookup(&["a.jpg"]);
        assert_eq!(there.folder_of(&["a.jpg"]), dir.path());
        let of = |name: &str| CaptureOptions { images: Some(name.into()), ..CaptureOptions::default() };
        let (dir, _) = lookup(&["images/a.jpg", "images_8/a.jpg"]);
        let there = Lookup::new(dir.path(), &of("images_8")).unwrap();
        let found = there.image(&there.bases(), "images/a.jpg").unwrap();
        assert_eq!(found, Some(dir.path().join("images_8/a.jpg")));
        let gone = Lookup::new(dir.path(), &of("images_3")).err().unwrap().to_string();
        assert!(gone.contains("images_3") && gone.contains("images_8"), "{gone}");
    }

    #[test]
    fn lists_of_names_are_compared_by_their_entries() {
        for name in
            ["./images/Cam0/0001.PNG", "IMAGES\\CAM0\\0001.JPG", "images\\cam0\\0001.png", "cam0/0001", "cam0/0001.jpg"]
        {
            assert_eq!(key(name), "cam0/0001", "{name}");
        }
    }
}
