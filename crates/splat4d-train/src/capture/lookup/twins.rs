//! Images of one folder whose names differ in their endings alone (`0001.jpg` next to `0001.png`): one of them is read.

use super::{fold, without_ending};
use crate::capture::account::{Account, Aspect, Severity};
use crate::capture::{picture, rig};
use splat4d::{Error, Result};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The pairs of a capture: the image that is read, and the one that is not.
#[derive(Default)]
pub(in crate::capture) struct Twins(Vec<(PathBuf, PathBuf)>);

impl Twins {
    /// One image of each name, in their order. Errors: images of one name differ in size, so that which is meant
    /// decides.
    pub(in crate::capture) fn single(&mut self, images: Vec<PathBuf>) -> Result<Vec<PathBuf>> {
        let mut places: BTreeMap<(PathBuf, String), usize> = BTreeMap::new();
        let mut out: Vec<PathBuf> = Vec::with_capacity(images.len());
        for image in images {
            let name = image.file_name().unwrap_or_default().to_string_lossy();
            let key = (image.parent().unwrap_or(Path::new("")).to_path_buf(), fold(without_ending(&name)));
            let Some(&at) = places.get(&key) else {
                places.insert(key, out.len());
                out.push(image);
                continue;
            };
            let (read, other) = if rank(&image) < rank(&out[at]) {
                (image.clone(), std::mem::replace(&mut out[at], image))
            } else {
                (out[at].clone(), image)
            };
            self.add(read, other)?;
        }
        Ok(out)
    }

    /// Keeps `read` and leaves `other` out. Errors: they differ in size.
    pub(in crate::capture) fn add(&mut self, read: PathBuf, other: PathBuf) -> Result<()> {
        // Images that cannot be read are reported where they are read.
        let size = |path: &Path| picture::header(path).ok().map(|header| header.stored);
        if let (Some(a), Some(b)) = (size(&read), size(&other))
            && a != b
        {
            let name = other.file_name().unwrap_or_default().to_string_lossy();
            let what = format!("{name} has the same name and another size ({}x{}, here {}x{})", b.0, b.1, a.0, a.1);
            return Err(Error::input(what)
                .at(read.display())
                .remedy("Remove the one that is not meant, or move it to another folder."));
        }
        self.named(read, other);
        Ok(())
    }

    /// The same where the capture names `read`, with its ending.
    pub(in crate::capture) fn named(&mut self, read: PathBuf, other: PathBuf) {
        self.0.push((read, other));
    }

    /// Reports in one remark which images are not read.
    pub(in crate::capture) fn report(&self, root: &Path, account: &mut Account) {
        if let Some(what) = self.in_words(root) {
            account.add(Aspect::NotRead, Severity::Warning, what);
        }
    }

    /// The remark; `None` where all images are read.
    pub(in crate::capture) fn in_words(&self, root: &Path) -> Option<String> {
        let (read, other) = self.0.first()?;
        let short = |path: &PathBuf| path.strip_prefix(root).unwrap_or(path).display().to_string();
        Some(format!(
            "{} images have the name of another with a different ending, for instance {}: {} is read in its place. Remove the images \
             that are not meant.",
            self.0.len(),
            short(other),
            short(read)
        ))
    }
}

/// The place of an image's ending in the usual order.
fn rank(image: &Path) -> usize {
    let ending = image.extension().unwrap_or_default();
    rig::IMAGE_ENDINGS.iter().position(|e| ending.eq_ignore_ascii_case(e)).unwrap_or(usize::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_image_of_each_name_is_read_and_other_sizes_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let image = |name: &str, side: u32| {
            let path = dir.path().join(name);
            image::RgbImage::new(side, 4).save(&path).unwrap();
            path
        };
        let all = vec![image("0.jpg", 6), image("0.png", 6), image("1.jpg", 6), image("2.PNG", 6), image("2.webp", 6)];
        let mut twins = Twins::default();
        let kept = twins.single(all.clone()).unwrap();
        assert_eq!(kept, [all[1].clone(), all[2].clone(), all[3].clone()]);
        let mut account = Account::default();
        twins.report(dir.path(), &mut account);
        let said = &account.remarks[0];
        assert!(said.severity == Severity::Warning && said.what.starts_with("2 images"), "{said:?}");
        assert!(said.what.contains("0.jpg: 0.png is read"), "{said:?}");
        image("2.webp", 3);
        let refused = twins.single(all).unwrap_err().to_string();
        assert!(refused.contains("2.webp") && refused.contains("another size (3x4, here 6x4)"), "{refused}");
        assert_eq!(Twins::default().single(kept.clone()).unwrap(), kept);
    }
}
