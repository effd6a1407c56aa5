//! Lists of file names by split: in a transforms file (Nerfstudio), and next to a COLMAP model as text (Nerfstudio's
//! `train_list.txt`, `test_list.txt` and `validation_list.txt`, 3DGS's `sparse/0/test.txt`).

use super::Split;
use super::account::Severity;
use super::account::{Account, Aspect, first_names};
use super::json::{self, Node};
use super::lookup::{key, without_ending};
use crate::text;
use splat4d::{Error, Result};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Names to train on, to hold out, and to validate on.
#[derive(Default)]
pub(super) struct Lists {
    train: Vec<String>,
    test: Vec<String>,
    validation: Vec<String>,
}

impl Lists {
    /// Those of a transforms file.
    pub(super) fn of_transforms(top: &Node<'_>) -> Result<Self> {
        let list = |key: &str| -> Result<Vec<String>> {
            let nodes = top.opt(key)?.map(|n| n.list()).transpose()?.unwrap_or_default();
            nodes.iter().map(|n| n.text().map(str::to_owned)).collect()
        };
        Ok(Self { train: list("train_filenames")?, test: list("test_filenames")?, validation: list("val_filenames")? })
    }

    /// Those next to a COLMAP model.
    pub(super) fn next_to_model(root: &Path, model: &Path) -> Result<Self> {
        let list = |path: &Path| -> Result<Vec<String>> {
            if !path.is_file() {
                return Ok(Vec::new());
            }
            let bytes = json::read_bytes(path)?;
            let text = text::decode(&bytes).map_err(|e| e.at(path.display()))?;
            Ok(text
                .lines()
                .map(str::trim)
                .filter(|l| !l.is_empty() && !l.starts_with('#'))
                .map(str::to_owned)
                .collect())
        };
        let of = |name: &str| list(&root.join(name));
        // Other data sets keep numbers or scenes in files of these names.
        let images = |name: &str| -> Result<Vec<String>> {
            let found = of(name)?;
            Ok(if found.iter().all(|line| without_ending(line) != line) { found } else { Vec::new() })
        };
        let mut out =
            Self { train: of("train_list.txt")?, test: of("test_list.txt")?, validation: of("validation_list.txt")? };
        if out.test.is_empty() {
            out.test = list(&model.join("test.txt"))?;
        }
        if [&out.train, &out.test, &out.validation].iter().all(|l| l.is_empty()) {
            out = Self { train: images("train.txt")?, test: images("test.txt")?, validation: images("val.txt")? };
        }
        Ok(out)
    }

    /// Split of images with these names; `None`: one is left out. Images that no list names train where only test
    /// images are listed, are held out where only training images are, and are left out where both are. A listed name
    /// that fits no image is a warning. Errors: no name of the training images does.
    pub(super) fn settle(&self, names: &[&str], account: &mut Account) -> Result<Vec<Option<Split>>> {
        let Self { train, test, validation } = self;
        if [train, test, validation].iter().all(|l| l.is_empty()) {
            return Ok(vec![Some(Split::Train); names.len()]);
        }
        let keys: Vec<String> = names.iter().map(|n| key(n)).collect();
        let known: BTreeSet<&String> = keys.iter().collect();
        let mut split_of: BTreeMap<String, Split> = BTreeMap::new();
        let (mut lost, mut several) = (Vec::new(), BTreeSet::new());
        // Only a validation list: it is the only set to evaluate.
        let of_validation = if test.is_empty() { Split::Held } else { Split::Validation };
        for (names, split) in [(train, Split::Train), (validation, of_validation), (test, Split::Held)] {
            let mut found = 0;
            for name in names {
                match fitting(name, &known) {
                    Some(key) => {
                        let before = split_of.insert(key.clone(), split);
                        if before.is_some_and(|b| b != split) {
                            several.insert(key);
                        }
                        found += 1;
                    }
                    None => lost.push(name),
                }
            }
            if found == 0 && !names.is_empty() && split == Split::Train {
                let what = format!("none of the {} names in the list of training images fits an image", names.len());
                return Err(Error::input(format!("{what}: {}", first_names(names)))
                    .remedy("Write them as the images are named, or leave the list out."));
            }
        }
        if !lost.is_empty() {
            let what = format!("{} names of the split lists fit no frame: {}.", lost.len(), first_names(&lost));
            account.add(Aspect::NotFound, Severity::Warning, what);
        }
        if !several.is_empty() {
            let what =
                format!("{} of {} images are in several split lists, and not trained on.", several.len(), names.len());
            account.add(Aspect::Assumed, Severity::Note, what);
        }
        let measured = !test.is_empty() || !validation.is_empty();
        let others = keys.iter().filter(|k| !split_of.contains_key(*k)).count();
        if !train.is_empty() && others > 0 {
            let what = match measured {
                true => "are in no split list and left out",
                false => "are in no list of training images and held out",
            };
            account.add(Aspect::Assumed, Severity::Note, format!("{others} of {} images {what}.", names.len()));
        }
        let other = match (train.is_empty(), measured) {
            (true, _) => Some(Split::Train),
            (false, true) => None,
            (false, false) => Some(Split::Held),
        };
        Ok(keys.iter().map(|k| split_of.get(k).copied().or(other)).collect())
    }
}

/// The key of the image that a listed name represents, perhaps after leading folders (absolute paths of another
/// machine).
fn fitting(name: &str, known: &BTreeSet<&String>) -> Option<String> {
    let whole = key(name);
    let ends = whole.match_indices('/').map(|(i, _)| &whole[i + 1..]);
    std::iter::once(whole.as_str()).chain(ends).map(str::to_owned).find(|end| known.contains(end))
}
