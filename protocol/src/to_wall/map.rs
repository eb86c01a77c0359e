//! The map that a car localizes on.

use serde::{Deserialize, Serialize};

use crate::{Invalid, Message, Pose2, Schema};

/// An occupancy grid with a raceline.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MapReply {
    /// The map's name.
    pub name: String,
    /// Cells along x.
    pub width: u32,
    /// Cells along y.
    pub height: u32,
    /// Edge of a cell \[m\].
    pub resolution: f64,
    /// The lower left corner of the grid in `map`.
    pub origin: Pose2,
    /// The cells from the lower left corner, row by row upwards, as runs of equal ones.
    pub runs: Vec<(Cell, u32)>,
    /// The raceline; None where the car has no raceline.
    pub raceline: Option<MapRaceline>,
}

/// A closed raceline.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MapRaceline {
    /// Length of a lap \[m\].
    pub length: f64,
    /// Points `[x, y]` in order of travel \[m\].
    pub points: Vec<[f32; 2]>,
}

/// The state of a cell.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "u8", into = "u8")]
#[repr(u8)]
pub enum Cell {
    /// Free space.
    Free = 0,
    /// A wall or an obstacle.
    Occupied = 1,
    /// Not mapped.
    Unknown = 2,
}

impl From<Cell> for u8 {
    fn from(cell: Cell) -> Self {
        cell as Self
    }
}

impl TryFrom<u8> for Cell {
    type Error = String;

    fn try_from(cell: u8) -> Result<Self, String> {
        Ok(match cell {
            0 => Self::Free,
            1 => Self::Occupied,
            2 => Self::Unknown,
            _ => return Err(format!("unknown cell {cell}")),
        })
    }
}

impl MapReply {
    /// Most cells of a map.
    pub const MAX_CELLS: u64 = 64_000_000;

    /// Packs cells into [`MapReply::runs`].
    pub fn pack(cells: impl IntoIterator<Item = Cell>) -> Vec<(Cell, u32)> {
        let mut runs: Vec<(Cell, u32)> = Vec::new();
        for cell in cells {
            match runs.last_mut() {
                Some((last, length)) if *last == cell && *length < u32::MAX => *length += 1,
                _ => runs.push((cell, 1)),
            }
        }
        runs
    }

    /// The cells, `width * height` of them.
    pub fn cells(&self) -> impl Iterator<Item = Cell> + '_ {
        self.runs
            .iter()
            .flat_map(|&(cell, length)| std::iter::repeat_n(cell, length as usize))
    }

    /// The cells as in ROS (`nav_msgs/OccupancyGrid`): 0 free, 100 occupied, 255 unknown.
    pub fn occupancy(&self) -> Vec<u8> {
        self.cells()
            .map(|cell| match cell {
                Cell::Free => 0,
                Cell::Occupied => 100,
                Cell::Unknown => 255,
            })
            .collect()
    }
}

impl Message for MapReply {
    const SCHEMA: Schema = Schema::MapReply;
    const MAX_LEN: usize = 16 * 1024 * 1024;

    fn validate(&self) -> Result<(), Invalid> {
        let cells = u64::from(self.width) * u64::from(self.height);
        if cells > Self::MAX_CELLS {
            let (width, height) = (self.width, self.height);
            let fault = format!("{width} x {height} cells exceed {}", Self::MAX_CELLS);
            return Err(Invalid::new("width", fault));
        }
        let packed: u64 = self.runs.iter().map(|&(_, length)| u64::from(length)).sum();
        if packed != cells {
            return Err(Invalid::new(
                "runs",
                format!("{packed} cells for a map of {cells}"),
            ));
        }
        if self.resolution <= 0.0 {
            let fault = format!("{} m is no size of a cell", self.resolution);
            return Err(Invalid::new("resolution", fault));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn unpacking_undoes_packing(cells in proptest::collection::vec(0u8..3, 0..200)) {
            let cells: Vec<_> = cells.into_iter().map(|c| Cell::try_from(c).expect("0 to 2")).collect();
            let map = MapReply {
                name: "m".into(),
                width: cells.len() as u32,
                height: 1,
                resolution: 0.05,
                origin: Pose2::default(),
                runs: MapReply::pack(cells.iter().copied()),
                raceline: None,
            };
            prop_assert_eq!(map.validate(), Ok(()));
            prop_assert_eq!(map.cells().collect::<Vec<_>>(), cells);
        }
    }
}
