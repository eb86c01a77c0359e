//! Racelines: where the car means to drive, and how fast.

/// One point of a raceline.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RacelinePoint {
    /// Arc length from the start line [m].
    pub s: f64,
    /// Position in `map` [m].
    pub x: f64,
    /// Position in `map` [m].
    pub y: f64,
    /// Direction of travel, 0 along x, in `[-pi, pi)` [rad].
    pub heading: f64,
    /// Curvature, left positive [1/m].
    pub curvature: f64,
    /// Speed to drive [m/s].
    pub speed: f64,
}

/// Where a point is relative to a raceline.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackPosition {
    /// Arc length of the nearest point of the line, in `[0, length)` [m].
    pub s: f64,
    /// Signed distance from the line, left positive [m].
    pub d: f64,
    /// The line's heading there [rad].
    pub heading: f64,
}

/// A closed raceline.
#[derive(Debug, Clone, PartialEq)]
pub struct Raceline {
    /// At least three points, `s` strictly increasing from 0.
    points: Vec<RacelinePoint>,
    /// Length of a lap, the closing segment included [m].
    length: f64,
}

impl Raceline {
    /// The points, in order of travel.
    pub fn points(&self) -> &[RacelinePoint] {
        &self.points
    }

    /// Length of a lap [m].
    pub fn length(&self) -> f64 {
        self.length
    }
}
