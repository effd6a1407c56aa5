//! Lists of file names by split in a transforms file (Nerfstudio): `train_filenames`, `test_filenames`, `val_filenames`.

use super::super::account::{Account, Aspect, first_names};
use super::super::json::Node;
use super::super::lookup::key;
use super::super::preflight::Severity;
use super::Split;
use super::frame::Entry;
use splat4d::Result;
use std::collections::{BTreeMap, BTreeSet};

/// Gives entries their splits. Images that no list names train where only test images are listed, are held out where only
/// training images are, and are left out where both are. A listed name that fits no frame is a warning.
pub(super) fn apply(top: &Node<'_>, entries: &mut Vec<Entry>, account: &mut Account) -> Result<()> {
    let mut split_of: BTreeMap<String, Split> = BTreeMap::new();
    let mut lost = Vec::new();
    let known: BTreeSet<String> = entries.iter().map(|e| key(&e.name)).collect();
    let mut lists = Vec::new();
    for name in ["test_filenames", "val_filenames", "train_filenames"] {
        let list = top.opt(name)?.map(|n| n.list()).transpose()?.unwrap_or_default();
        lists.push(list.iter().map(|n| n.text()).collect::<Result<Vec<_>>>()?);
    }
    let [test, validation, train] = [&lists[0], &lists[1], &lists[2]];
    // Only a validation list: that is what there is to measure on.
    let of_validation = if test.is_empty() { Split::Held } else { Split::Validation };
    for (names, split) in [(train, Split::Train), (validation, of_validation), (test, Split::Held)] {
        for name in names {
            let key = key(name);
            if !known.contains(&key) {
                lost.push(*name);
            }
            split_of.insert(key, split);
        }
    }
    if !lost.is_empty() {
        let what = format!("{} names of the split lists fit no frame: {}.", lost.len(), first_names(&lost));
        account.add(Aspect::NotFound, Severity::Warning, what);
    }
    let measured = !test.is_empty() || !validation.is_empty();
    let listed = |e: &Entry| split_of.get(&key(&e.name)).copied();
    let others = entries.iter().filter(|e| listed(e).is_none()).count();
    if !train.is_empty() && others > 0 {
        let what = match measured {
            true => "are in no split list and left out",
            false => "are not in train_filenames and held out",
        };
        account.add(Aspect::Assumed, Severity::Note, format!("{others} of {} images {what}.", entries.len()));
    }
    if !train.is_empty() && measured {
        entries.retain(|e| listed(e).is_some());
    }
    let other = if train.is_empty() { Split::Train } else { Split::Held };
    entries.iter_mut().for_each(|e| e.split = split_of.get(&key(&e.name)).copied().unwrap_or(other));
    Ok(())
}
