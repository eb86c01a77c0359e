//! Exact ray casting on the grid.

use crate::{Cell, OccupancyGrid, Pose};

impl OccupancyGrid {
    /// Range that a laser at `map_from_laser` measures along its x axis \[m\], to the face of the first occupied cell. Visits
    /// every cell on the way (Amanatides and Woo, Eurographics 1987). Unknown cells do not stop the ray. `max_range` if no
    /// wall is nearer; 0 if the laser is not in free space.
    pub fn cast(&self, map_from_laser: Pose, max_range: f64) -> f64 {
        let laser = self.origin.inverse() * map_from_laser;
        let start = [laser.x / self.resolution, laser.y / self.resolution];
        let direction = [laser.heading.cos(), laser.heading.sin()];
        let mut cell = start.map(|v| v.floor() as i64);
        if self.cell(cell[0], cell[1]) != Cell::Free {
            return 0.0;
        }
        // Along each axis: the step, the path from one crossing to the next, and the path to the next crossing.
        let step = direction.map(|d| if d < 0.0 { -1 } else { 1 });
        let between = direction.map(|d| if d == 0.0 { f64::INFINITY } else { 1.0 / d.abs() });
        let mut next = [0, 1].map(|axis| {
            let edge = cell[axis] as f64 + if step[axis] > 0 { 1.0 } else { 0.0 };
            if direction[axis] == 0.0 {
                f64::INFINITY
            } else {
                (edge - start[axis]) / direction[axis]
            }
        });
        let limit = max_range / self.resolution;
        loop {
            let axis = usize::from(next[1] < next[0]);
            let path = next[axis];
            if path >= limit {
                return max_range;
            }
            cell[axis] += step[axis];
            next[axis] += between[axis];
            if self.cell(cell[0], cell[1]) == Cell::Occupied {
                return path * self.resolution;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A room of 10 x 6 m with cells of 0.1 m, turned by 0.3 rad, walls one cell thick.
    fn room() -> OccupancyGrid {
        OccupancyGrid::from_fn(100, 60, 0.1, Pose::new(3.0, -2.0, 0.3), |column, row| {
            match (column, row) {
                (0 | 99, _) | (_, 0 | 59) => Cell::Occupied,
                _ => Cell::Free,
            }
        })
    }

    #[test]
    fn ranges_end_on_faces() {
        let room = room();
        let laser = room.origin * Pose::new(5.0, 3.0, 0.0);
        assert!((room.cast(laser, 30.0) - 4.9).abs() < 1e-9);
        assert!((room.cast(laser, 2.0) - 2.0).abs() < 1e-12);
        let in_the_wall = room.origin * Pose::new(0.05, 3.0, 0.0);
        assert!(room.cast(in_the_wall, 30.0).abs() < 1e-12);
    }

    #[test]
    fn the_unknown_stops_no_ray() {
        let mut room = room();
        // An unmapped doorway, with a wall behind it that was seen through the gap.
        for i in 0..60 {
            room.cells[i * 100 + 70] = Cell::Unknown;
        }
        let laser = room.origin * Pose::new(5.0, 3.0, 0.0);
        assert!((room.cast(laser, 30.0) - 4.9).abs() < 1e-9);
    }

    proptest! {
        #[test]
        fn a_rectangle_is_measured_exactly(x in 0.2..9.8, y in 0.2..5.8, heading in -3.1f64..3.1) {
            let room = room();
            let along = |position: f64, direction: f64, low: f64, high: f64| {
                if direction > 0.0 { (high - position) / direction } else { (low - position) / direction }
            };
            let expected =
                along(x, heading.cos(), 0.1, 9.9).min(along(y, heading.sin(), 0.1, 5.9));
            let measured = room.cast(room.origin * Pose::new(x, y, heading), 30.0);
            prop_assert!((measured - expected).abs() < 1e-9, "{measured} {expected}");
        }
    }
}
