//! Voxel filters: fewer end points, evenly spread.

use std::collections::HashSet;

/// Keeps the first point of each voxel of edge `size` \[m\].
pub(crate) fn voxel_filter(points: &[[f32; 2]], size: f64) -> Vec<[f32; 2]> {
    let per_metre = 1.0 / size;
    let mut taken = HashSet::with_capacity(points.len());
    let voxel = |point: &[f32; 2]| point.map(|v| (f64::from(v) * per_metre).floor() as i64);
    points
        .iter()
        .filter(|point| taken.insert(voxel(point)))
        .copied()
        .collect()
}

/// A voxel filter with the largest voxels, of edge up to `max_length` \[m\], that keep at least `min_num_points` of the points
/// within `max_range` \[m\].
pub(crate) fn adaptive_voxel_filter(
    points: &[[f32; 2]],
    max_length: f64,
    min_num_points: usize,
    max_range: f64,
) -> Vec<[f32; 2]> {
    let near: Vec<[f32; 2]> = points
        .iter()
        .filter(|[x, y]| f64::from(x.hypot(*y)) <= max_range)
        .copied()
        .collect();
    if near.len() <= min_num_points {
        return near;
    }
    let widest = voxel_filter(&near, max_length);
    if widest.len() >= min_num_points {
        return widest;
    }
    // Halve the edge until enough are left, then search between the last two.
    let mut high = max_length;
    while high > 1e-2 * max_length {
        let mut low = high / 2.0;
        let mut filtered = voxel_filter(&near, low);
        if filtered.len() >= min_num_points {
            while (high - low) / low > 1e-1 {
                let middle = f64::midpoint(low, high);
                let candidate = voxel_filter(&near, middle);
                if candidate.len() >= min_num_points {
                    low = middle;
                    filtered = candidate;
                } else {
                    high = middle;
                }
            }
            return filtered;
        }
        high /= 2.0;
    }
    near
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line() -> Vec<[f32; 2]> {
        (0..1000).map(|i| [0.01 * i as f32 + 0.005, 0.0]).collect()
    }

    #[test]
    fn one_point_of_each_voxel_is_kept() {
        assert_eq!(voxel_filter(&line(), 0.1).len(), 100);
        assert!((voxel_filter(&line(), 0.1)[1][0] - 0.105).abs() < 1e-6);
        assert_eq!(voxel_filter(&[], 0.1), Vec::<[f32; 2]>::new());
    }

    #[test]
    fn the_adaptive_filter_keeps_enough_and_not_many_more() {
        let kept = adaptive_voxel_filter(&line(), 0.5, 200, 50.0);
        assert!((200..240).contains(&kept.len()), "{}", kept.len());
        // Few enough: all.
        assert_eq!(adaptive_voxel_filter(&line()[..150], 0.5, 200, 50.0).len(), 150);
        // Enough with the widest voxels.
        assert_eq!(adaptive_voxel_filter(&line(), 0.5, 10, 50.0).len(), 20);
        let near = adaptive_voxel_filter(&line(), 0.5, 200, 1.0);
        assert!(near.iter().all(|point| point[0] <= 1.0));
    }
}
