//! The messages of a Cartographer state, as far as map and trajectory need them. Field numbers are those of
//! `cartographer/mapping/proto`; what is left out is skipped by the decoder.

use prost::Message;

/// The stream's first message.
#[derive(Clone, PartialEq, Message)]
pub(super) struct SerializationHeader {
    #[prost(uint32, tag = "1")]
    pub(super) format_version: u32,
}

/// Each of the other messages has one of these fields, or one that is not read (options, scans, odometry, IMU).
#[derive(Clone, PartialEq, Message)]
pub(super) struct SerializedData {
    #[prost(message, optional, tag = "1")]
    pub(super) pose_graph: Option<PoseGraph>,
    #[prost(message, optional, tag = "3")]
    pub(super) submap: Option<Submap>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct PoseGraph {
    #[prost(message, repeated, tag = "4")]
    pub(super) trajectory: Vec<Trajectory>,
}

#[derive(Clone, PartialEq, Message)]
#[expect(clippy::struct_field_names, reason = "Cartographer's name")]
pub(super) struct Trajectory {
    #[prost(message, repeated, tag = "1")]
    pub(super) node: Vec<TrajectoryNode>,
    #[prost(message, repeated, tag = "2")]
    pub(super) submap: Vec<TrajectorySubmap>,
    #[prost(int32, tag = "3")]
    pub(super) trajectory_id: i32,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct TrajectoryNode {
    /// Units of 100 ns since the year 1.
    #[prost(int64, tag = "1")]
    pub(super) timestamp: i64,
    #[prost(message, optional, tag = "5")]
    pub(super) pose: Option<Rigid3d>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct TrajectorySubmap {
    #[prost(message, optional, tag = "1")]
    pub(super) pose: Option<Rigid3d>,
    #[prost(int32, tag = "2")]
    pub(super) submap_index: i32,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct SubmapId {
    #[prost(int32, tag = "1")]
    pub(super) trajectory_id: i32,
    #[prost(int32, tag = "2")]
    pub(super) submap_index: i32,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct Submap {
    #[prost(message, optional, tag = "1")]
    pub(super) submap_id: Option<SubmapId>,
    #[prost(message, optional, tag = "2")]
    pub(super) submap_2d: Option<Submap2d>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct Submap2d {
    #[prost(message, optional, tag = "1")]
    pub(super) local_pose: Option<Rigid3d>,
    #[prost(message, optional, tag = "4")]
    pub(super) grid: Option<Grid2d>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct Grid2d {
    #[prost(message, optional, tag = "1")]
    pub(super) limits: Option<MapLimits>,
    /// 0 where nothing is known, else from 1 for the least correspondence cost to 32767 for the greatest.
    #[prost(int32, repeated, tag = "2")]
    pub(super) cells: Vec<i32>,
    #[prost(message, optional, tag = "3")]
    pub(super) known_cells_box: Option<CellBox>,
    #[prost(message, optional, tag = "4")]
    pub(super) probability_grid_2d: Option<Empty>,
    #[prost(float, tag = "6")]
    pub(super) min_correspondence_cost: f32,
    #[prost(float, tag = "7")]
    pub(super) max_correspondence_cost: f32,
}

/// A message of which only the presence matters.
#[derive(Clone, PartialEq, Message)]
pub(super) struct Empty {}

#[derive(Clone, PartialEq, Message)]
pub(super) struct CellBox {
    #[prost(int32, tag = "1")]
    pub(super) max_x: i32,
    #[prost(int32, tag = "2")]
    pub(super) max_y: i32,
    #[prost(int32, tag = "3")]
    pub(super) min_x: i32,
    #[prost(int32, tag = "4")]
    pub(super) min_y: i32,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct MapLimits {
    #[prost(double, tag = "1")]
    pub(super) resolution: f64,
    #[prost(message, optional, tag = "2")]
    pub(super) max: Option<Vector>,
    #[prost(message, optional, tag = "3")]
    pub(super) cell_limits: Option<CellLimits>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct CellLimits {
    #[prost(int32, tag = "1")]
    pub(super) num_x_cells: i32,
    #[prost(int32, tag = "2")]
    pub(super) num_y_cells: i32,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct Rigid3d {
    #[prost(message, optional, tag = "1")]
    pub(super) translation: Option<Vector>,
    #[prost(message, optional, tag = "2")]
    pub(super) rotation: Option<Quaternion>,
}

/// `Vector2d` and `Vector3d`; of the latter z is skipped.
#[derive(Clone, PartialEq, Message)]
pub(super) struct Vector {
    #[prost(double, tag = "1")]
    pub(super) x: f64,
    #[prost(double, tag = "2")]
    pub(super) y: f64,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct Quaternion {
    #[prost(double, tag = "1")]
    pub(super) x: f64,
    #[prost(double, tag = "2")]
    pub(super) y: f64,
    #[prost(double, tag = "3")]
    pub(super) z: f64,
    #[prost(double, tag = "4")]
    pub(super) w: f64,
}
