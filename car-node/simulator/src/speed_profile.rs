//! The speeds of a raceline, from limits on acceleration.

use maps::{Raceline, RacelinePoint};
use serde::{Deserialize, Serialize};

/// Limits of acceleration and speed, well below those of the car.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SpeedParams {
    /// Lateral acceleration \[m/s^2\].
    pub lateral: f64,
    /// Acceleration on the straight \[m/s^2\].
    pub drive: f64,
    /// Deceleration on the straight \[m/s^2\].
    pub brake: f64,
    /// Top speed \[m/s\].
    pub top: f64,
}

impl Default for SpeedParams {
    /// Within the grip of taped tyres (19 N at 3.5 kg are 5.4 m/s^2), so that both rows of the paper's table can use the
    /// same profile, as in the paper.
    fn default() -> Self {
        Self {
            lateral: 4.8,
            drive: 4.0,
            brake: 4.0,
            top: 7.6,
        }
    }
}

/// The line with the highest speeds within the limits, which form an ellipse of longitudinal and lateral acceleration:
/// first by curvature, then a pass backwards for braking and one forwards for driving (Subosits and Gerdes, 2015).
pub fn speed_profile(line: &Raceline, params: &SpeedParams) -> Raceline {
    fastest(line, params, |_| params.top)
}

/// The same for a line that was made for another car. Nowhere faster than the line's own speeds.
pub fn slowed_to(line: &Raceline, params: &SpeedParams) -> Raceline {
    fastest(line, params, |p| p.speed.min(params.top))
}

fn fastest(line: &Raceline, params: &SpeedParams, most: impl Fn(&RacelinePoint) -> f64) -> Raceline {
    let mut points: Vec<RacelinePoint> = line.points().to_vec();
    let n = points.len();
    let gaps: Vec<f64> = (0..n)
        .map(|i| {
            if i + 1 < n {
                points[i + 1].s - points[i].s
            } else {
                line.length() - points[i].s
            }
        })
        .collect();
    for p in &mut points {
        p.speed = (params.lateral / p.curvature.abs().max(1e-6)).sqrt().min(most(p));
    }
    let left = |p: &RacelinePoint| {
        let lateral = p.speed * p.speed * p.curvature / params.lateral;
        (1.0 - lateral * lateral).max(0.0).sqrt()
    };
    // Two laps, so that the start line is no special place.
    for i in (0..2 * n).rev() {
        let (here, next) = (i % n, (i + 1) % n);
        let gain = 2.0 * params.brake * left(&points[next]) * gaps[here];
        points[here].speed = points[here].speed.min((points[next].speed.powi(2) + gain).sqrt());
    }
    for i in 0..2 * n {
        let (here, next) = (i % n, (i + 1) % n);
        let gain = 2.0 * params.drive * left(&points[here]) * gaps[here];
        points[next].speed = points[next].speed.min((points[here].speed.powi(2) + gain).sqrt());
    }
    Raceline::new(points).expect("the same line with other speeds")
}

/// Time of a lap at the line's own speeds \[s\].
#[cfg(test)]
fn lap_time(line: &Raceline) -> f64 {
    let points = line.points();
    let n = points.len();
    (0..n)
        .map(|i| {
            let next = points[(i + 1) % n];
            let gap = if i + 1 < n {
                next.s - points[i].s
            } else {
                line.length() - points[i].s
            };
            2.0 * gap / (points[i].speed + next.speed)
        })
        .sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::{PI, TAU};

    /// Two straights of 20 m with half circles of 2 m radius.
    fn stadium() -> Raceline {
        let mut points = Vec::new();
        for i in 0..200 {
            points.push([f64::from(i) * 0.1, -2.0]);
        }
        for i in 0..63 {
            let (sin, cos) = (f64::from(i) / 63.0 * PI - PI / 2.0).sin_cos();
            points.push([20.0 + 2.0 * cos, 2.0 * sin]);
        }
        let turned: Vec<_> = points.iter().map(|[x, y]| [20.0 - x, -y]).collect();
        points.extend(turned);
        Raceline::through(&points, 1.0).expect("a valid line")
    }

    #[test]
    fn no_limit_is_passed() {
        let params = SpeedParams::default();
        let line = speed_profile(&stadium(), &params);
        for pair in line.points().windows(2) {
            let [a, b] = pair else { unreachable!() };
            let lateral = a.speed * a.speed * a.curvature / params.lateral;
            let along = (b.speed.powi(2) - a.speed.powi(2)) / (2.0 * (b.s - a.s));
            let share = along / if along > 0.0 { params.drive } else { params.brake };
            assert!(lateral.abs() < 1.0 + 1e-9 && share.abs() < 1.0 + 1e-9);
        }
    }

    #[test]
    fn a_line_for_a_better_car_is_slowed_and_one_for_a_slower_car_is_kept() {
        let params = SpeedParams::default();
        let own = speed_profile(&stadium(), &params);
        let better = SpeedParams {
            lateral: 12.0,
            drive: 9.0,
            brake: 11.0,
            top: 12.0,
        };
        let slowed = slowed_to(&speed_profile(&stadium(), &better), &params);
        for (a, b) in slowed.points().iter().zip(own.points()) {
            assert!((a.speed - b.speed).abs() < 1e-9, "{a:?} {b:?}");
        }
        let careful = SpeedParams {
            lateral: 2.0,
            drive: 2.0,
            brake: 2.0,
            top: 3.0,
        };
        let line = speed_profile(&stadium(), &careful);
        assert_eq!(slowed_to(&line, &params).points(), line.points());
    }

    #[test]
    fn a_stadium_takes_the_time_that_can_be_computed() {
        let params = SpeedParams::default();
        let line = speed_profile(&stadium(), &params);
        // Each straight: speed up and slow down symmetrically; each end: at the corner's speed.
        let corner = (params.lateral * 2.0).sqrt();
        let top = (corner.powi(2) + params.drive * 20.0).sqrt();
        let top_time = if top < params.top {
            2.0 * (top - corner) / params.drive
        } else {
            let ramp = (params.top.powi(2) - corner.powi(2)) / params.drive;
            2.0 * (params.top - corner) / params.drive + (20.0 - ramp) / params.top
        };
        let expected = 2.0 * top_time + TAU * 2.0 / corner;
        assert!((lap_time(&line) / expected - 1.0).abs() < 0.02);
    }
}
