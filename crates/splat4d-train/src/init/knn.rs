//! Temporary.
use rayon::prelude::*;
fn d(a: [f32; 3], b: [f32; 3]) -> f32 {
    (a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2) + (a[2] - b[2]).powi(2)
}
/// [N, k]
pub fn knn(points: &[[f32; 3]], k: usize) -> Vec<u32> {
    points
        .par_iter()
        .enumerate()
        .flat_map_iter(|(i, p)| {
            let mut o: Vec<(f32, u32)> =
                points.iter().enumerate().filter(|(j, _)| *j != i).map(|(j, q)| (d(*p, *q), j as u32)).collect();
            let kk = k.min(o.len());
            if kk > 0 && kk < o.len() {
                o.select_nth_unstable_by(kk - 1, |a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            }
            o.truncate(kk);
            o.into_iter().map(|x| x.1).collect::<Vec<_>>()
        })
        .collect()
}
/// mean of 3
pub fn mean_square_distance(points: &[[f32; 3]]) -> Vec<f32> {
    if points.len() < 4 {
        return vec![0.01; points.len()];
    }
    let k = knn(points, 3);
    points
        .iter()
        .enumerate()
        .map(|(i, p)| (0..3).map(|j| d(*p, points[k[3 * i + j] as usize])).sum::<f32>() / 3.0)
        .collect()
}
