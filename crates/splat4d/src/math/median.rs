//! Medians.

use std::cmp::Ordering;

/// The middle of some values, the upper one of an even number; half of the values may be anything. `None` of none. Their
/// order changes.
pub fn median(values: &mut [f64]) -> Option<f64> {
    median_by(values, f64::total_cmp)
}

/// The same in another order.
pub fn median_by<T: Copy>(values: &mut [T], compare: impl FnMut(&T, &T) -> Ordering) -> Option<T> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, compare).1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_middle_is_the_upper_one_of_two() {
        assert_eq!(median(&mut [3.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(&mut [4.0, 1.0, f64::NAN, 2.0]), Some(4.0));
        assert_eq!(median(&mut []), None);
        assert_eq!(median_by(&mut [9u8, 1, 5, 7], |a, b| b.cmp(a)), Some(5));
    }
}
