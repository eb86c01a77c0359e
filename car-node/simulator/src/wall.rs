//! A wall: a polyline with a surface, as the laser sees it.

use serde::{Deserialize, Serialize};

/// A wall's surface, as the laser sees it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Surface {
    /// Cardboard, air ducts, paint: most of the light is reflected.
    Plain,
    /// Black tubes: at a distance and at an angle, beams have no return.
    Black,
}

impl Surface {
    /// Diffuse reflectance at the laser's 905 nm, in \[0, 1\].
    pub fn reflectance(self) -> f64 {
        match self {
            Self::Plain => 0.7,
            Self::Black => 0.02,
        }
    }
}

/// A polyline of wall.
#[derive(Debug, Clone, PartialEq)]
pub struct Wall {
    /// Its surface.
    pub surface: Surface,
    /// Vertices in `map` \[m\]; repeat the first one to close it.
    pub points: Vec<[f64; 2]>,
}

/// Where a ray meets a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Distance along the ray \[m\].
    pub range: f64,
    /// Cosine of the angle between the ray and the surface's normal, in \[0, 1\].
    pub incidence: f64,
    /// The surface hit.
    pub surface: Surface,
}
