//! Cartographer's states, `.pbstream`: a map as submaps, and the trajectory that it was made on.
//!
//! A magic number, then messages, each with its length of 8 bytes in front and compressed with gzip. The first says which
//! version the format has; then come the pose graph, the options, the submaps, and scans and other sensor data, which are
//! skipped (`cartographer/io/proto_stream.cc`, `mapping/proto/serialization.proto`).

mod messages;
mod painter;
mod writer;

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

use flate2::read::MultiGzDecoder;
use prost::Message;

use crate::{MapError, OccupancyGrid, Pose};
use messages::{Grid2d, PoseGraph, Rigid3d, SerializationHeader, SerializedData, Submap2d};
pub use writer::write_pbstream;

/// The first eight bytes, least significant first.
const MAGIC: u64 = 0x7b1d_1f7b_5bf5_01db;
/// Versions of the format that are known. In version 2 only three-dimensional submaps changed.
const VERSIONS: std::ops::RangeInclusive<u32> = 1..=2;
/// Largest message, compressed or not \[bytes\]: a submap of 400 m x 400 m at 5 cm has fewer.
const LARGEST_MESSAGE: u64 = 1 << 27;
/// Known cells of all submaps together, at most: each takes a byte.
const MOST_CELLS: usize = 1 << 29;
/// Submaps and nodes, at most.
const MOST_SUBMAPS: usize = 100_000;
const MOST_NODES: usize = 10_000_000;
/// Seconds from the year 1 to 1970.
const EPOCH: i64 = 719_162 * 24 * 3600;
/// A submap's number in its trajectory, and the trajectory's.
type SubmapId = (i32, i32);

/// A node of the trajectory: a scan's time and optimized pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrajectoryNode {
    /// When the scan ended \[ns since 1970\].
    pub stamp: i64,
    /// The tracking frame in `map`: `base_link` or the IMU's frame, as the team has configured it.
    pub pose: Pose,
}

/// A grid of the scans of a part of the drive.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Submap {
    /// Where the corner with the greatest x and y of the first known cell stands in `map`. From there, columns lead
    /// towards -y and rows towards -x.
    corner: Pose,
    resolution: f64,
    width: usize,
    height: usize,
    /// Log odds in steps from 1 (free) to 255 (occupied), 0 where nothing is known, row by row.
    log_odds: Vec<u8>,
}

/// A state of Cartographer.
#[derive(Debug, Clone, PartialEq)]
pub struct PbStream {
    file: String,
    submaps: BTreeMap<SubmapId, Submap>,
    nodes: Vec<TrajectoryNode>,
}

/// True for the name of a state.
pub fn is_pbstream(path: &Path) -> bool {
    path.extension()
        .is_some_and(|extension| extension.eq_ignore_ascii_case("pbstream"))
}

impl PbStream {
    /// Reads a file.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, MapError> {
        let path = path.as_ref();
        let file = path.display().to_string();
        let opened = File::open(path).map_err(|source| MapError::Read {
            file: file.clone(),
            source,
        })?;
        Self::read(&file, BufReader::new(opened))
    }

    /// Reads a stream of bytes; `file` names it in errors.
    pub fn read(file: &str, from: impl Read) -> Result<Self, MapError> {
        let mut state = Self {
            file: file.to_owned(),
            submaps: BTreeMap::new(),
            nodes: Vec::new(),
        };
        state
            .read_messages(from)
            .map_err(|fault| MapError::format(file, fault))?;
        Ok(state)
    }

    fn read_messages(&mut self, from: impl Read) -> Result<(), String> {
        let mut stream = Messages { from, number: 0 };
        stream.magic()?;
        let header = stream.next()?.ok_or("the file has no message")?;
        let header = SerializationHeader::decode(&header[..]).map_err(|e| format!("message 1: {e}"))?;
        let version = header.format_version;
        if !VERSIONS.contains(&version) {
            return Err(format!(
                "format version {version} is not known, 1 and 2 are; Cartographer's pbstream migrate converts older files"
            ));
        }
        let mut global: Option<BTreeMap<SubmapId, Pose>> = None;
        let mut cells = 0;
        while let Some(message) = stream.next()? {
            let number = stream.number;
            let data = SerializedData::decode(&message[..]).map_err(|e| format!("message {number}: {e}"))?;
            let at = |fault: String| format!("message {number}: {fault}");
            if let Some(graph) = data.pose_graph {
                global = Some(self.take_graph(graph).map_err(at)?);
            }
            let Some(submap) = data.submap else { continue };
            let id = submap.submap_id.unwrap_or_default();
            let id = (id.trajectory_id, id.submap_index);
            let name = format!("submap {} of trajectory {}", id.1, id.0);
            let at = |fault: String| format!("message {number}: {name}: {fault}");
            let poses = global
                .as_ref()
                .ok_or_else(|| at("the pose graph should come before it".into()))?;
            let pose = *poses
                .get(&id)
                .ok_or_else(|| at("the pose graph has no pose of it".into()))?;
            let submap = submap
                .submap_2d
                .ok_or_else(|| at("only two-dimensional submaps can be read".into()))?;
            let submap = Submap::new(pose, submap).map_err(at)?;
            cells += submap.log_odds.len();
            if cells > MOST_CELLS || self.submaps.len() >= MOST_SUBMAPS {
                return Err(format!(
                    "message {number}: the submaps are larger than any track: {cells} cells"
                ));
            }
            self.submaps.insert(id, submap);
        }
        if global.is_none() {
            return Err("there is no pose graph in it".into());
        }
        self.nodes.sort_by_key(|node| node.stamp);
        self.nodes.dedup_by_key(|node| node.stamp);
        Ok(())
    }

    /// Takes the nodes, and returns the submaps' optimized poses.
    fn take_graph(&mut self, graph: PoseGraph) -> Result<BTreeMap<SubmapId, Pose>, String> {
        let mut poses = BTreeMap::new();
        for trajectory in graph.trajectory {
            let id = trajectory.trajectory_id;
            if self.nodes.len() + trajectory.node.len() > MOST_NODES {
                return Err(format!(
                    "trajectory {id} has too many nodes: {}",
                    trajectory.node.len()
                ));
            }
            for (index, node) in trajectory.node.into_iter().enumerate() {
                let name = || format!("node {index} of trajectory {id}");
                let stamp = node
                    .timestamp
                    .checked_sub(EPOCH * 10_000_000)
                    .and_then(|ticks| ticks.checked_mul(100))
                    .ok_or_else(|| format!("{}: the time {} is out of range", name(), node.timestamp))?;
                let pose = pose(node.pose).ok_or_else(|| format!("{}: its pose is not finite", name()))?;
                self.nodes.push(TrajectoryNode { stamp, pose });
            }
            for submap in trajectory.submap {
                let index = submap.submap_index;
                let pose = pose(submap.pose)
                    .ok_or_else(|| format!("submap {index} of trajectory {id}: its pose is not finite"))?;
                poses.insert((id, index), pose);
            }
        }
        Ok(poses)
    }

    /// The nodes of all trajectories, by time.
    pub fn nodes(&self) -> &[TrajectoryNode] {
        &self.nodes
    }

    /// The map: the submaps painted over each other at their optimized poses, in the order of their numbers, as
    /// `cartographer_pbstream_to_ros_map` paints them. The cells have the size of the submaps' finest.
    pub fn paint(&self) -> Result<OccupancyGrid, MapError> {
        painter::paint(&self.submaps).map_err(|fault| MapError::format(&self.file, fault))
    }
}

/// The messages of a stream, uncompressed.
struct Messages<R> {
    from: R,
    /// Number of the message that was read last.
    number: usize,
}

impl<R: Read> Messages<R> {
    fn magic(&mut self) -> Result<(), String> {
        let mut bytes = [0; 8];
        let read = self.from.read_exact(&mut bytes).is_ok();
        if read && u64::from_le_bytes(bytes) == MAGIC {
            return Ok(());
        }
        Err("this is no state of Cartographer: it does not begin with the magic number of a .pbstream".into())
    }

    /// The next message; None at the end.
    fn next(&mut self) -> Result<Option<Vec<u8>>, String> {
        let mut length = Vec::with_capacity(8);
        let number = self.number + 1;
        let fault = |error: std::io::Error| format!("message {number}: {error}");
        self.from
            .by_ref()
            .take(8)
            .read_to_end(&mut length)
            .map_err(fault)?;
        if length.is_empty() {
            return Ok(None);
        }
        let cut = || format!("message {number}: the file ends within it");
        let length = u64::from_le_bytes(length[..].try_into().map_err(|_| cut())?);
        if length > LARGEST_MESSAGE {
            return Err(format!(
                "message {number}: a length of {length} bytes is too large"
            ));
        }
        // Grows with what is there, not with what the length promises.
        let mut compressed = Vec::new();
        self.from
            .by_ref()
            .take(length)
            .read_to_end(&mut compressed)
            .map_err(fault)?;
        if compressed.len() as u64 != length {
            return Err(cut());
        }
        let mut message = Vec::new();
        MultiGzDecoder::new(&compressed[..])
            .take(LARGEST_MESSAGE + 1)
            .read_to_end(&mut message)
            .map_err(|error| format!("message {number}: it cannot be uncompressed: {error}"))?;
        if message.len() as u64 > LARGEST_MESSAGE {
            return Err(format!(
                "message {number}: it is larger than {LARGEST_MESSAGE} bytes"
            ));
        }
        self.number = number;
        Ok(Some(message))
    }
}

/// The pose in the plane; None if it is not finite.
fn pose(rigid: Option<Rigid3d>) -> Option<Pose> {
    let rigid = rigid.unwrap_or_default();
    let at = rigid.translation.unwrap_or_default();
    let heading = match rigid.rotation {
        None => 0.0,
        Some(q) => (2.0 * (q.w * q.z + q.x * q.y)).atan2(1.0 - 2.0 * (q.y * q.y + q.z * q.z)),
    };
    let finite = [at.x, at.y, heading]
        .iter()
        .all(|v| v.is_finite() && v.abs() < 1e6);
    finite.then(|| Pose::new(at.x, at.y, heading))
}

impl Submap {
    fn new(map_from_submap: Pose, submap: Submap2d) -> Result<Self, String> {
        let grid = submap.grid.ok_or("it has no grid")?;
        if grid.probability_grid_2d.is_none() {
            return Err("its grid is no probability grid; TSDF grids cannot be read".into());
        }
        let local = pose(submap.local_pose).ok_or("its local pose is not finite")?;
        let limits = grid.limits.clone().unwrap_or_default();
        let resolution = limits.resolution;
        if !(resolution.is_finite() && (0.001..=10.0).contains(&resolution)) {
            return Err(format!(
                "resolution: {resolution} should be a length from 0.001 to 10 m"
            ));
        }
        let max = limits.max.unwrap_or_default();
        if ![max.x, max.y].iter().all(|v| v.is_finite() && v.abs() < 1e6) {
            return Err(format!("limits: ({}, {}) is no place", max.x, max.y));
        }
        let size = limits.cell_limits.unwrap_or_default();
        let [columns, rows] = [size.num_x_cells, size.num_y_cells]
            .map(|cells| usize::try_from(cells).ok().filter(|&cells| cells > 0));
        let (Some(columns), Some(rows)) = (columns, rows) else {
            return Err(format!(
                "a size of {} x {} cells",
                size.num_x_cells, size.num_y_cells
            ));
        };
        if columns.checked_mul(rows) != Some(grid.cells.len()) {
            let found = grid.cells.len();
            return Err(format!(
                "it has {found} cells, and should have {columns} x {rows}"
            ));
        }
        let [left, top, width, height] = known(&grid, columns, rows)?;
        let log_odds = LogOdds::new(&grid)?;
        let row = |row: usize| &grid.cells[row * columns + left..][..width];
        let log_odds = (top..top + height)
            .flat_map(row)
            .map(|&cell| log_odds.of(cell))
            .collect::<Result<_, _>>()?;
        let corner = Pose::new(
            max.x - resolution * top as f64,
            max.y - resolution * left as f64,
            0.0,
        );
        Ok(Self {
            corner: map_from_submap * local.inverse() * corner,
            resolution,
            width,
            height,
            log_odds,
        })
    }
}

/// The part in which cells are known: first column and row, width, height.
fn known(grid: &Grid2d, columns: usize, rows: usize) -> Result<[usize; 4], String> {
    let Some(known) = &grid.known_cells_box else {
        return Ok([0; 4]);
    };
    let span = |least: i32, most: i32, cells: usize| {
        let (least, most) = (usize::try_from(least).ok()?, usize::try_from(most).ok()?);
        (least <= most && most < cells).then(|| (least, most - least + 1))
    };
    let x = span(known.min_x, known.max_x, columns);
    let y = span(known.min_y, known.max_y, rows);
    let (Some((left, width)), Some((top, height))) = (x, y) else {
        return Err(format!(
            "its known cells from ({}, {}) to ({}, {}) are outside of {columns} x {rows}",
            known.min_x, known.min_y, known.max_x, known.max_y
        ));
    };
    Ok([left, top, width, height])
}

/// From a cell's value to its log odds.
struct LogOdds {
    least_cost: f64,
    most_cost: f64,
}

/// A cell's greatest value.
const TOP: i32 = 32_767;
/// Bounds of a probability, and of a correspondence cost where the file names none.
const LEAST: f64 = 0.1;
const MOST: f64 = 0.9;

impl LogOdds {
    fn new(grid: &Grid2d) -> Result<Self, String> {
        let costs = [grid.min_correspondence_cost, grid.max_correspondence_cost].map(f64::from);
        match costs {
            [0.0, 0.0] => Ok(Self {
                least_cost: LEAST,
                most_cost: MOST,
            }),
            [least_cost, most_cost] if 0.0 < least_cost && least_cost < most_cost && most_cost < 1.0 => {
                Ok(Self {
                    least_cost,
                    most_cost,
                })
            }
            [least, most] => Err(format!("correspondence costs from {least} to {most}")),
        }
    }

    fn of(&self, cell: i32) -> Result<u8, String> {
        match cell {
            0 => Ok(0),
            1..=TOP => {
                let share = f64::from(cell - 1) / f64::from(TOP - 1);
                let cost = self.least_cost + share * (self.most_cost - self.least_cost);
                let logit = |p: f64| (p / (1.0 - p)).ln();
                let probability = (1.0 - cost).clamp(LEAST, MOST);
                let share = (logit(probability) - logit(LEAST)) / (logit(MOST) - logit(LEAST));
                Ok(1 + (share * 254.0).round() as u8)
            }
            _ => Err(format!(
                "a cell has the value {cell}, more than {TOP} or negative"
            )),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Cell;

    /// A room with a wall across it, in a corner of which nothing is known.
    fn map() -> OccupancyGrid {
        OccupancyGrid::from_fn(60, 40, 0.05, Pose::new(-1.0, 2.0, 0.0), |column, row| {
            match (column, row) {
                (50.., 30..) => Cell::Unknown,
                (0 | 1, _) | (_, 0 | 1 | 38 | 39) | (20 | 21, 10..) => Cell::Occupied,
                _ => Cell::Free,
            }
        })
    }

    fn nodes() -> Vec<TrajectoryNode> {
        let node = |k: i64| TrajectoryNode {
            stamp: 1_700_000_000_000_000_000 + k * 100_000_000,
            pose: Pose::new(0.1 * k as f64, 2.5, -3.0),
        };
        (0..5).map(node).collect()
    }

    fn read(bytes: &[u8]) -> Result<PbStream, String> {
        PbStream::read("drive.pbstream", bytes).map_err(|error| error.to_string())
    }

    /// Share of the map's cells that are the same in the painted one.
    fn agreement(poses: &[Pose]) -> f64 {
        let map = map();
        let state = read(&write_pbstream(&map, poses, &[])).expect("sound");
        let painted = state.paint().expect("a map");
        assert!((painted.resolution - 0.05).abs() < 1e-12);
        let same = |index: usize| {
            let at = [index % map.width, index / map.width].map(|v| v as f64 + 0.5);
            painted.at(map.to_map(at)) == map.cells[index]
        };
        (0..map.cells.len()).filter(|&index| same(index)).count() as f64 / map.cells.len() as f64
    }

    #[test]
    fn submaps_are_painted_at_their_optimized_poses() {
        let one = agreement(&[Pose::IDENTITY]);
        assert!(one > 0.999, "{one}");
        // Cells of a turned submap lie between those of the map.
        let turned = agreement(&[Pose::new(3.0, -1.0, 2.0)]);
        assert!(turned > 0.9, "{turned}");
        let several = agreement(&[
            Pose::IDENTITY,
            Pose::new(1.0, 1.0, 0.4),
            Pose::new(-2.0, 0.0, -1.0),
        ]);
        assert!(several > 0.93, "{several}");
    }

    #[test]
    fn a_submap_at_another_place_is_another_map() {
        let map = map();
        let bytes = write_pbstream(&map, &[Pose::IDENTITY], &[]);
        let mut state = read(&bytes).expect("sound");
        let submap = state.submaps.get_mut(&(0, 0)).expect("there");
        submap.corner = Pose::new(10.0, 5.0, 0.5) * submap.corner;
        let painted = state.paint().expect("a map");
        let wall = Pose::new(10.0, 5.0, 0.5).transform(map.to_map([1.0, 20.0]));
        assert_eq!(painted.at(wall), Cell::Occupied);
    }

    #[test]
    fn nodes_keep_their_times_and_poses() {
        let state = read(&write_pbstream(&map(), &[Pose::IDENTITY], &nodes())).expect("sound");
        assert_eq!(state.nodes().len(), 5);
        for (found, expected) in state.nodes().iter().zip(nodes()) {
            assert_eq!(found.stamp, expected.stamp);
            assert!(found.pose.distance(expected.pose) < 1e-12);
            assert!((found.pose.heading - expected.pose.heading).abs() < 1e-12);
        }
    }

    #[test]
    fn a_damaged_file_is_an_error_that_says_where() {
        let whole = write_pbstream(&map(), &[Pose::IDENTITY], &nodes());
        let fault = |bytes: &[u8]| read(bytes).expect_err("damaged");
        assert!(fault(b"image: map.png").contains("magic number"));
        assert!(fault(&whole[..8]).contains("the file has no message"));
        assert!(fault(&whole[..whole.len() - 1]).contains("message 3: the file ends within it"));
        let mut long = whole.clone();
        long[8..16].copy_from_slice(&u64::MAX.to_le_bytes());
        assert!(fault(&long).contains("message 1: a length of"));
        let mut flipped = whole.clone();
        let last = flipped.len() - 20;
        flipped[last] ^= 0x10;
        assert!(fault(&flipped).contains("message 3: it cannot be uncompressed"));
        // The oldest format begins with the pose graph.
        let mut old = MAGIC.to_le_bytes().to_vec();
        let trajectory = vec![messages::Trajectory::default()];
        writer::push(&mut old, &PoseGraph { trajectory });
        assert!(
            fault(&old).contains("format version 0 is not known"),
            "{}",
            fault(&old)
        );
    }

    #[test]
    fn a_small_file_that_promises_much_takes_no_memory() {
        use std::io::Write;
        let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::best());
        let zeros = vec![0; 1 << 20];
        for _ in 0..=(LARGEST_MESSAGE >> 20) {
            encoder.write_all(&zeros).expect("written");
        }
        let bomb = encoder.finish().expect("written");
        let mut bytes = MAGIC.to_le_bytes().to_vec();
        bytes.extend_from_slice(&(bomb.len() as u64).to_le_bytes());
        bytes.extend_from_slice(&bomb);
        assert!(read(&bytes).expect_err("too large").contains("larger than"));
    }
}
