//! The reference's choice of beams: about evenly spaced along the outline of a corridor.

/// Indices of the chosen beams of a scan, in order. `angle_min` and `increment` \[rad\] are the scan's, `length_over_width`
/// the corridor's, `wanted` how many.
///
/// From the middle beam to one side, each beam before the one at which the way along the outline since the last
/// exceeds an equal share of the whole, then the last beam; and the same, mirrored. Rounding along the way makes the number
/// differ from `wanted` a little.
pub(super) fn boxed(
    count: usize,
    angle_min: f64,
    increment: f64,
    length_over_width: f64,
    wanted: usize,
) -> Vec<usize> {
    let on_outline = |i: usize| {
        let (sin, cos) = (angle_min + increment * i as f64).sin_cos();
        let reach = (length_over_width / cos.abs()).min(1.0 / sin.abs());
        [reach * cos, reach * sin]
    };
    let points: Vec<[f64; 2]> = (0..count).map(on_outline).collect();
    let steps: Vec<f64> = points
        .windows(2)
        .map(|pair| f64::hypot(pair[1][0] - pair[0][0], pair[1][1] - pair[0][1]))
        .collect();
    let share = steps.iter().sum::<f64>() / (wanted.max(2) - 1) as f64;
    let middle = count / 2;
    let mut half = Vec::new();
    let mut way = 0.0;
    for (i, step) in steps.iter().enumerate().skip(middle + 1) {
        if half.len() > wanted / 2 {
            break;
        }
        way += step;
        if way >= share {
            way = 0.0;
            half.push(i - 1);
        }
    }
    if half.len() <= wanted / 2 && count > middle + 1 {
        half.push(count - 1);
    }
    half.retain(|&i| i > middle);
    let mirrored = half.iter().rev().filter_map(|&i| (2 * middle).checked_sub(i));
    let mut chosen: Vec<usize> = mirrored.chain([middle]).chain(half.iter().copied()).collect();
    chosen.dedup();
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    #[test]
    fn a_hokuyo_gives_as_many_as_wanted_symmetric_and_to_both_ends() {
        let increment = 1.5 * PI / 1080.0;
        let chosen = boxed(1081, -0.75 * PI, increment, 3.5, 21);
        assert!((19..=23).contains(&chosen.len()), "{chosen:?}");
        assert_eq!((chosen.first(), chosen.last()), (Some(&0), Some(&1080)));
        for (left, right) in chosen.iter().zip(chosen.iter().rev()) {
            assert_eq!(left + right, 1080);
        }
        // More look ahead than at even angles.
        let ahead = chosen.iter().filter(|&&i| i.abs_diff(540) < 140).count();
        assert!(ahead >= 7, "{chosen:?}");
    }

    #[test]
    fn scans_of_few_beams_give_what_they_have() {
        for count in 1..30 {
            let chosen = boxed(count, -1.0, 0.1, 3.5, 21);
            assert!(
                !chosen.is_empty() && chosen.iter().all(|&i| i < count),
                "{count}: {chosen:?}"
            );
            assert!(
                chosen.windows(2).all(|pair| pair[0] < pair[1]),
                "{count}: {chosen:?}"
            );
        }
    }
}
