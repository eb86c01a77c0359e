//! The laser's end points, to draw over the map.

use serde::{Deserialize, Serialize};

use crate::{Invalid, Message, Schema};

/// Some of a scan's end points at the estimated pose.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ScanView {
    /// The filter update that it belongs to.
    pub update: u64,
    /// The point of `map` that the end points are relative to \[m\].
    pub centre: [f64; 2],
    /// At most [`ScanView::MAX_POINTS`], in the order of the beams.
    pub points: Vec<EndPoint>,
}

impl ScanView {
    /// Most points in one message.
    pub const MAX_POINTS: usize = 128;

    /// An end point in `map` \[m\].
    pub fn point(&self, point: EndPoint) -> [f64; 2] {
        [
            self.centre[0] + f64::from(point.x) * EndPoint::METRES,
            self.centre[1] + f64::from(point.y) * EndPoint::METRES,
        ]
    }
}

/// Where a beam ended, in 5 bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct EndPoint {
    /// Offset from the centre, in [`EndPoint::METRES`].
    pub x: i16,
    /// Offset from the centre, in [`EndPoint::METRES`].
    pub y: i16,
    /// How the reading compares with the map.
    pub kind: EndPointKind,
}

impl EndPoint {
    /// Step of a position \[m\].
    pub const METRES: f64 = 0.01;

    /// Rounds an end point in `map` \[m\]. Positions out of range become the outermost ones.
    pub fn quantise(point: [f64; 2], centre: [f64; 2], kind: EndPointKind) -> Self {
        Self {
            x: ((point[0] - centre[0]) / Self::METRES).round() as i16,
            y: ((point[1] - centre[1]) / Self::METRES).round() as i16,
            kind,
        }
    }
}

/// How a reading compares with the map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "u8", into = "u8")]
#[repr(u8)]
pub enum EndPointKind {
    /// It ends at a wall of the map.
    OnWall = 0,
    /// It ends off a wall, by less than `Short` and `Long` need.
    OffWall = 1,
    /// It is much shorter than in the map: something stands in view.
    Short = 2,
    /// It is much longer than in the map: the pose is wrong, or a wall is gone.
    Long = 3,
}

impl From<EndPointKind> for u8 {
    fn from(kind: EndPointKind) -> Self {
        kind as Self
    }
}

impl TryFrom<u8> for EndPointKind {
    type Error = String;

    fn try_from(kind: u8) -> Result<Self, String> {
        Ok(match kind {
            0 => Self::OnWall,
            1 => Self::OffWall,
            2 => Self::Short,
            3 => Self::Long,
            _ => return Err(format!("unknown kind of end point {kind}")),
        })
    }
}

impl Message for ScanView {
    const SCHEMA: Schema = Schema::ScanView;
    const MAX_LEN: usize = 2048;

    fn validate(&self) -> Result<(), Invalid> {
        Invalid::unless_at_most("points", self.points.len(), Self::MAX_POINTS)
    }
}
