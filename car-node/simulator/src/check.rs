//! The report on a track: its measures, and the faults that make it unfit for racing.

use maps::{Cell, OccupancyGrid};
use serde::Serialize;

use crate::{Track, VehicleParams};

/// Least distance from the raceline to a wall \[m\]: half a car and 6 cm.
const CLEARANCE: f64 = 0.20;

/// A track's measures and faults.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TrackReport {
    /// Its name.
    pub name: String,
    /// Length of a lap on the raceline \[m\].
    pub length_m: f64,
    /// Time for a lap at the raceline's speeds \[s\].
    pub lap_time_s: f64,
    /// Least and greatest speed on the raceline \[m/s\].
    pub speed_mps: [f64; 2],
    /// Least radius of the raceline \[m\].
    pub least_radius_m: f64,
    /// Greatest lateral acceleration on the raceline \[m/s^2\].
    pub lateral_mps2: f64,
    /// Least distance from the raceline to a wall \[m\].
    pub clearance_m: f64,
    /// Least width between the walls, across the raceline \[m\].
    pub width_m: f64,
    /// Size of the map \[m\].
    pub map_m: [f64; 2],
    /// Edge of a map cell \[m\].
    pub resolution_m: f64,
    /// Free area of the map \[m^2\].
    pub free_m2: f64,
    /// Error of the map's walls, seen from the raceline \[m\]: mean (positive where the map's walls are further away) and
    /// standard deviation.
    pub map_error_m: [f64; 2],
    /// Faults that make it unfit for racing; empty if there are none.
    pub faults: Vec<String>,
}

impl TrackReport {
    /// Examines a track from all points of its raceline.
    pub fn of(track: &Track) -> Self {
        let line = &track.raceline;
        let points = line.points();
        let mut faults = Vec::new();
        let mut first_fault = |condition: bool, s: f64, fault: &str| {
            if condition && !faults.iter().any(|f: &String| f.ends_with(fault)) {
                faults.push(format!("at s = {s:.2} m {fault}"));
            }
        };
        let mut clearance = f64::INFINITY;
        let mut width = f64::INFINITY;
        let mut map_errors = Vec::new();
        let sharpest = VehicleParams::default();
        let sharpest = sharpest.max_steering.tan() / sharpest.wheelbase();
        for p in points {
            let mut across = 0.0;
            for i in 0..24 {
                let angle = p.heading + f64::from(i) * std::f64::consts::TAU / 24.0;
                let direction = [angle.cos(), angle.sin()];
                let range = track.walls.cast([p.x, p.y], direction, 30.0).map(|hit| hit.range);
                clearance = clearance.min(range.unwrap_or(f64::INFINITY));
                if i == 6 || i == 18 {
                    across += range.unwrap_or(30.0);
                    first_fault(range.is_none(), p.s, "there is no wall beside the raceline");
                    if let (Some(range), Some(drawn)) = (range, drawn(&track.grid, [p.x, p.y], direction)) {
                        // At the edge of a post the two may see different walls.
                        let error = drawn - range;
                        map_errors.extend((error.abs() < 0.3).then_some(error));
                    }
                }
            }
            width = width.min(across);
            first_fault(
                track.grid.at([p.x, p.y]) != Cell::Free,
                p.s,
                "the raceline leaves the map's free cells",
            );
            first_fault(
                p.curvature.abs() > sharpest,
                p.s,
                "the raceline is too sharp for the steering",
            );
            first_fault(p.speed <= 0.0, p.s, "the raceline's speed is zero");
        }
        if clearance < CLEARANCE {
            faults.push(format!(
                "the raceline comes within {clearance:.2} m of a wall; a car needs {CLEARANCE} m"
            ));
        }
        let over = |value: fn(&maps::RacelinePoint) -> f64| {
            points
                .iter()
                .map(value)
                .fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], v| {
                    [low.min(v), high.max(v)]
                })
        };
        let grid = &track.grid;
        let free = grid.cells.iter().filter(|&&cell| cell == Cell::Free).count();
        Self {
            name: track.name.clone(),
            length_m: line.length(),
            lap_time_s: track.lap_time(),
            speed_mps: over(|p| p.speed),
            least_radius_m: 1.0 / over(|p| p.curvature.abs())[1].max(1e-9),
            lateral_mps2: over(|p| p.speed * p.speed * p.curvature.abs())[1],
            clearance_m: clearance,
            width_m: width,
            map_m: [grid.width, grid.height].map(|cells| cells as f64 * grid.resolution),
            resolution_m: grid.resolution,
            free_m2: free as f64 * grid.resolution * grid.resolution,
            map_error_m: mean_sigma(&map_errors),
            faults,
        }
    }
}

impl Track {
    /// Time for a lap at the raceline's own speeds \[s\].
    pub fn lap_time(&self) -> f64 {
        let points = self.raceline.points();
        (0..points.len())
            .map(|i| {
                let (here, next) = (points[i], points[(i + 1) % points.len()]);
                let gap = self.raceline.wrap(next.s - here.s);
                2.0 * gap / (here.speed + next.speed).max(1e-3)
            })
            .sum()
    }
}

/// Distance to the wall in the map: where the ray enters the first cell that is not free \[m\].
fn drawn(grid: &OccupancyGrid, from: [f64; 2], direction: [f64; 2]) -> Option<f64> {
    let step = grid.resolution / 20.0;
    (0..6000)
        .map(|i| f64::from(i) * step)
        .find(|t| grid.at([from[0] + t * direction[0], from[1] + t * direction[1]]) != Cell::Free)
}

fn mean_sigma(values: &[f64]) -> [f64; 2] {
    let count = values.len().max(1) as f64;
    let mean = values.iter().sum::<f64>() / count;
    let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / count;
    [mean, variance.sqrt()]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Wall, Walls};

    #[test]
    fn bundled_tracks_have_no_faults() {
        for name in crate::BUNDLED {
            let report = TrackReport::of(&Track::bundled(name).expect("it ships"));
            assert!(report.faults.is_empty(), "{name}: {:?}", report.faults);
            // A map is off by about half a cell.
            assert!(
                report.map_error_m[0].abs() < 0.05 && report.map_error_m[1] < 0.05,
                "{report:?}"
            );
        }
    }

    #[test]
    fn an_obstacle_near_the_raceline_is_found() {
        let mut track = Track::bundled("club").expect("it ships");
        let p = track.raceline.at(10.0);
        let mut walls = track.walls.polylines().to_vec();
        walls.push(Wall {
            surface: crate::Surface::Plain,
            points: vec![[p.x - 0.1, p.y - 0.1], [p.x + 0.1, p.y + 0.1]],
        });
        track.walls = Walls::new(walls);
        let report = TrackReport::of(&track);
        assert!(
            report.faults.iter().any(|f| f.contains("of a wall")),
            "{:?}",
            report.faults
        );
    }
}
