//! Scan alignment as defined by the paper's code.

use maps::Pose;
use synpf::{Scan, TrackMap};

/// An end point nearer than this to the boundary is aligned \[m\].
pub const PAPER_DISTANCE: f64 = 0.22;

/// Number of beams used.
const BEAMS: usize = 54;

/// Share of 54 beams whose end points lie within 0.22 m of the track's boundary (`race_stack`'s lap analyser). The beams are
/// dense straight ahead and sparse to the sides; those without a return count as misses. `race_stack` draws the beams from a
/// normal distribution whose three standard deviations are the edge of the field of view. We take the quantiles of that
/// distribution, so that the same scan always gives the same number.
///
/// `map_from_base_link` is the pose at the scan's stamp and `twist` the velocity then (forwards [m/s], yaw rate [rad/s]):
/// each beam is placed where it was measured, so that the sweep does not count as an error of the pose.
pub fn paper_alignment(
    map: &TrackMap,
    scan: &Scan,
    map_from_base_link: Pose,
    twist: [f64; 2],
    base_link_from_laser: Pose,
) -> f64 {
    let last = scan.ranges.len().saturating_sub(1);
    let middle = last as f64 / 2.0;
    let sigma = middle / 3.0;
    let hits = (0..BEAMS)
        .filter(|&i| {
            let share = (i as f64 + 0.5) / BEAMS as f64;
            let beam = (middle + sigma * quantile(share)).round().clamp(0.0, last as f64) as usize;
            let Some(&range) = scan.ranges.get(beam) else {
                return false;
            };
            let range = f64::from(range);
            if !(scan.range_min..scan.range_max).contains(&range) {
                return false;
            }
            let after = beam as f64 * scan.time_increment;
            let moved = Pose::exp([twist[0] * after, 0.0, twist[1] * after]);
            let angle = scan.angle_min + beam as f64 * scan.angle_increment;
            let end = (map_from_base_link * moved * base_link_from_laser)
                .transform([range * angle.cos(), range * angle.sin()]);
            map.distance(end).abs() <= PAPER_DISTANCE
        })
        .count();
    hits as f64 / BEAMS as f64
}

/// The standard normal distribution's quantile function, to 0.0005 (Abramowitz and Stegun, 26.2.23).
fn quantile(share: f64) -> f64 {
    let tail = share.min(1.0 - share).max(1e-12);
    let t = (-2.0 * tail.ln()).sqrt();
    let top = 2.515_517 + t * (0.802_853 + t * 0.010_328);
    let bottom = 1.0 + t * (1.432_788 + t * (0.189_269 + t * 0.001_308));
    (t - top / bottom).copysign(share - 0.5)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_of_the_normal_distribution() {
        assert!(quantile(0.5).abs() < 5e-4);
        assert!((quantile(0.841_345) - 1.0).abs() < 5e-4);
        assert!((quantile(0.001_35) + 3.0).abs() < 5e-4);
    }
}
