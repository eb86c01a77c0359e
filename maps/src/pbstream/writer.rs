//! Writes states, for tests that need one: no state is at hand that may be part of the project.

use std::io::Write;

use flate2::Compression;
use flate2::write::GzEncoder;
use prost::Message;

use super::messages::{
    CellBox, CellLimits, Empty, Grid2d, MapLimits, PoseGraph, Quaternion, Rigid3d, SerializationHeader,
    SerializedData, Submap, Submap2d, SubmapId, Trajectory, TrajectoryNode as Node, TrajectorySubmap, Vector,
};
use super::{EPOCH, MAGIC, TOP, TrajectoryNode};
use crate::{Cell, OccupancyGrid, Pose};

/// Unknown cells around the known ones of a submap.
const BORDER: usize = 3;

/// A state of Cartographer with one trajectory. At each of `poses` stands a submap that shows the whole map, in a local frame
/// of its own.
pub fn write_pbstream(map: &OccupancyGrid, poses: &[Pose], nodes: &[TrajectoryNode]) -> Vec<u8> {
    let mut bytes = MAGIC.to_le_bytes().to_vec();
    push(&mut bytes, &SerializationHeader { format_version: 2 });
    let trajectory = Trajectory {
        trajectory_id: 0,
        node: nodes
            .iter()
            .map(|node| Node {
                timestamp: node.stamp / 100 + EPOCH * 10_000_000,
                pose: Some(rigid(node.pose)),
            })
            .collect(),
        submap: (0..)
            .zip(poses)
            .map(|(submap_index, pose)| TrajectorySubmap {
                submap_index,
                pose: Some(rigid(*pose)),
            })
            .collect(),
    };
    let graph = PoseGraph {
        trajectory: vec![trajectory],
    };
    push(
        &mut bytes,
        &SerializedData {
            pose_graph: Some(graph),
            submap: None,
        },
    );
    for (index, &pose) in (0..).zip(poses) {
        let submap_id = SubmapId {
            trajectory_id: 0,
            submap_index: index,
        };
        let local = Pose::new(0.4 * f64::from(index), -0.3, 0.0);
        let submap = Submap {
            submap_id: Some(submap_id),
            submap_2d: Some(Submap2d {
                local_pose: Some(rigid(local)),
                grid: Some(grid(map, pose * local.inverse())),
            }),
        };
        push(
            &mut bytes,
            &SerializedData {
                pose_graph: None,
                submap: Some(submap),
            },
        );
    }
    bytes
}

/// Adds a message to a stream.
pub(super) fn push(bytes: &mut Vec<u8>, message: &impl Message) {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::fast());
    let compressed = encoder
        .write_all(&message.encode_to_vec())
        .and_then(|()| encoder.finish());
    let compressed = compressed.expect("writing to memory does not fail");
    bytes.extend_from_slice(&(compressed.len() as u64).to_le_bytes());
    bytes.extend_from_slice(&compressed);
}

fn rigid(pose: Pose) -> Rigid3d {
    let (sin, cos) = (0.5 * pose.heading).sin_cos();
    Rigid3d {
        translation: Some(Vector { x: pose.x, y: pose.y }),
        rotation: Some(Quaternion {
            x: 0.0,
            y: 0.0,
            z: sin,
            w: cos,
        }),
    }
}

/// The map in a frame at `map_from_local`.
fn grid(map: &OccupancyGrid, map_from_local: Pose) -> Grid2d {
    let local_from_grid = map_from_local.inverse() * map.origin;
    let [width, height] = [map.width, map.height].map(|cells| cells as f64 * map.resolution);
    let corners =
        [[0.0, 0.0], [width, 0.0], [0.0, height], [width, height]].map(|c| local_from_grid.transform(c));
    let bound =
        |k: usize, fold: fn(f64, f64) -> f64, start: f64| corners.iter().map(|c| c[k]).fold(start, fold);
    let border = BORDER as f64 * map.resolution;
    let max = [0, 1].map(|k| bound(k, f64::max, f64::NEG_INFINITY) + border);
    let min = [0, 1].map(|k| bound(k, f64::min, f64::INFINITY));
    // Columns lead towards -y, rows towards -x.
    let [rows, columns] = [0, 1].map(|k| ((max[k] - min[k]) / map.resolution).round() as usize + BORDER);
    let value = |index: usize| {
        let (column, row) = (index % columns, index / columns);
        let at = [
            max[0] - (row as f64 + 0.5) * map.resolution,
            max[1] - (column as f64 + 0.5) * map.resolution,
        ];
        match map.at(map_from_local.transform(at)) {
            Cell::Occupied => 1,
            Cell::Free => TOP,
            Cell::Unknown => 0,
        }
    };
    Grid2d {
        limits: Some(MapLimits {
            resolution: map.resolution,
            max: Some(Vector { x: max[0], y: max[1] }),
            cell_limits: Some(CellLimits {
                num_x_cells: columns as i32,
                num_y_cells: rows as i32,
            }),
        }),
        cells: (0..columns * rows).map(value).collect(),
        known_cells_box: Some(CellBox {
            max_x: (columns - 1) as i32,
            max_y: (rows - 1) as i32,
            min_x: 1,
            min_y: 2,
        }),
        probability_grid_2d: Some(Empty {}),
        min_correspondence_cost: 0.1,
        max_correspondence_cost: 0.9,
    }
}
