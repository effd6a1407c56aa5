//! Labels: what a Gaussian is part of, as a logit for each of a scene's labels, in a table of the layer that follows
//! every edit of rows.
//!
//! A Gaussian's probabilities are the softmax of its logits; images blend probabilities, not logits (Siddiqui et al.
//! 2023,
//! "Panoptic Lifting", §3.2: what is blended stays a distribution, whatever single logits grow to).

use super::{Key, Params, Space, Table};
use crate::math::Real;
use crate::{Error, Result};

/// Name of the table.
pub(crate) const LABELS: &str = "labels";
/// Name of its column group, as files show it: `label_logits` [N, labels].
pub const LABEL_LOGITS: &str = "label_logits";
/// Most labels of a scene: what a byte can number, without the code of no label.
pub const MOST_LABELS: usize = 255;
/// Logit of the label of a Gaussian whose label is certain; the others are 0.
const SURE: f64 = 10.0;

/// Adds the table of `count` labels, filled from what was loaded, else with zeros: every label is as likely.
///
/// Errors: loaded logits of another number of labels. Panics: the layer has the table already.
pub fn claim<F: Real>(params: &mut Params<F>, count: usize) -> Result<Key> {
    let rows = params.len();
    params.entry(LABELS, Space::Gaussians, &[(LABEL_LOGITS, count)], rows, |_| {})
}

/// The table of a layer; `None`: its Gaussians have no labels.
pub fn key<F: Real>(params: &Params<F>) -> Option<Key> {
    params.find(LABELS)
}

/// Adds the table with a known label a Gaussian; `None`: it has none.
///
/// Panics: another number of labels than Gaussians, a label of `count` or more, the layer has the table already.
pub fn state<F: Real>(params: &mut Params<F>, count: usize, labels: &[Option<usize>]) -> Key {
    assert_eq!(labels.len(), params.len(), "a label a Gaussian");
    let key = claim(params, count).expect("nothing was loaded");
    for (row, label) in labels.iter().enumerate() {
        if let Some(label) = *label {
            assert!(label < count, "label {label} of {count}");
            params[key].set(row, label, F::of(SURE));
        }
    }
    key
}

/// Gives the labels of a layer other numbers: new label k is the old one `from[k]`, or one that no Gaussian has.
pub fn renumber<F: Real>(params: &mut Params<F>, from: &[Option<usize>]) {
    let Some(key) = key(params) else { return };
    if from.iter().enumerate().all(|(k, f)| *f == Some(k)) && from.len() == params[key].width() {
        return;
    }
    let mut table = Table::new(&[(LABEL_LOGITS, from.len())], params.len());
    for row in 0..params.len() {
        let logits = (0..params[key].width()).map(|k| params[key].get(row, k));
        let least = logits.fold(F::ZERO, F::min) - F::of(SURE);
        for (k, old) in from.iter().enumerate() {
            table.set(row, k, old.map_or(least, |old| params[key].get(row, old)));
        }
    }
    params.replace(key, table);
}

/// Probabilities of a row's labels into `out`: softmax.
pub(crate) fn probabilities<F: Real>(params: &Params<F>, key: Key, row: usize, out: &mut [F]) {
    let logits = &params[key];
    let largest = (0..out.len()).map(|k| logits.get(row, k)).fold(F::of(f64::NEG_INFINITY), F::max);
    let mut sum = F::ZERO;
    for (k, p) in out.iter_mut().enumerate() {
        *p = (logits.get(row, k) - largest).exp();
        sum += *p;
    }
    out.iter_mut().for_each(|p| *p /= sum);
}

/// The likeliest label of every row; `None` where no label is likelier than the others, or the layer has none.
pub fn of<F: Real>(params: &Params<F>) -> Vec<Option<usize>> {
    let Some(key) = key(params) else { return vec![None; params.len()] };
    let table = &params[key];
    let best = |row: usize| {
        let largest =
            (0..table.width()).max_by(|&a, &b| table.get(row, a).f64().total_cmp(&table.get(row, b).f64()))?;
        let ties = (0..table.width()).filter(|&k| table.get(row, k) == table.get(row, largest)).count();
        (ties == 1).then_some(largest)
    };
    (0..params.len()).map(best).collect()
}

/// The number of the label with this name. Errors: there is none; the message lists those there are.
pub fn named(names: &[String], name: &str) -> Result<usize> {
    names.iter().position(|n| n == name).ok_or_else(|| {
        let remedy = match names.len() {
            0 => "It has none: give the capture's cameras masks of labels, then: splat4d label RUN (docs/labels.md)."
                .into(),
            _ => format!("It has {}.", names.join(", ")),
        };
        Error::input(format!("the scene has no label `{name:.80}`")).remedy(remedy)
    })
}

/// Errors: no names, too many, an empty one, or a duplicate.
pub fn check(names: &[String]) -> Result<()> {
    if names.is_empty() || names.len() > MOST_LABELS {
        return Err(Error::input(format!("{} labels", names.len()))
            .remedy(format!("Name 1 to {MOST_LABELS} labels, that of mask value 0 first")));
    }
    let twice = |i: usize| names[..i].contains(&names[i]);
    match (0..names.len()).find(|&i| names[i].trim().is_empty() || twice(i)) {
        Some(i) => Err(Error::input(format!("label {i} is called `{:.80}`", names[i]))
            .remedy("Give every label a name of its own")),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_of_a_row_are_a_softmax() {
        let mut params = Params::<f64>::new(2, 1, &[]);
        let key = claim(&mut params, 4).unwrap();
        let logits = [0.3, -1.2, 2.0, 0.7];
        params[key].write(1, 0, logits);
        let mut p = [0.0; 4];
        probabilities(&params, key, 0, &mut p);
        assert_eq!(p, [0.25; 4]);
        probabilities(&params, key, 1, &mut p);
        let sum: f64 = logits.map(f64::exp).iter().sum();
        assert!(p.iter().zip(logits).all(|(p, x): (&f64, f64)| (p - x.exp() / sum).abs() < 1e-12), "{p:?}");
        assert_eq!(of(&params), [None, Some(2)], "where all are as likely there is none");
    }

    #[test]
    fn stated_labels_round_trip_and_names_are_checked() {
        let mut params = Params::<f32>::new(3, 1, &[]);
        state(&mut params, 2, &[Some(1), None, Some(0)]);
        assert_eq!(of(&params), [Some(1), None, Some(0)]);
        let names = ["floor".to_owned(), "hand".to_owned()];
        assert_eq!(named(&names, "hand").unwrap(), 1);
        assert!(named(&names, "foot").unwrap_err().to_string().contains("floor, hand"));
        renumber(&mut params, &[None, Some(1), Some(0)]);
        assert_eq!(of(&params), [Some(1), None, Some(2)]);
        assert!(check(&names).is_ok() && check(&[]).is_err());
        assert!(check(&["a".to_owned(), "a".to_owned()]).is_err() && check(&[" ".to_owned()]).is_err());
    }
}
