//! Static transforms between the car's frames: where the laser is mounted.

use std::collections::{HashMap, HashSet};

use maps::Pose;
use nalgebra::{Isometry3, UnitQuaternion, Vector3};

use crate::ros2::messages::TransformStamped;

/// How the laser is mounted on the car.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mount {
    /// `base_link_from_laser`, on the ground plane.
    pub base_link_from_laser: Pose,
    /// The laser is mounted upside down: its beams turn the other way.
    pub upside_down: bool,
}

impl Mount {
    /// A laser that is mounted upright.
    pub fn upright(base_link_from_laser: Pose) -> Self {
        Self {
            base_link_from_laser,
            upside_down: false,
        }
    }

    /// The usual place on a 1:10 car: 0.27 m ahead of the rear axle. On the cars that we know it is 0.27 to 0.285 m.
    pub fn typical() -> Self {
        Self::upright(Pose::new(0.27, 0.0, 0.0))
    }
}

/// The car's own frame by REP 105.
pub(crate) const BASE_LINK: &str = "base_link";

/// True for a frame that is where `base_link` is, on the ground plane; namespaces do not matter.
pub(crate) fn is_base(frame: &str) -> bool {
    matches!(frame.rsplit('/').next(), Some(BASE_LINK | "base_footprint"))
}

/// Frames beyond this many are not taken.
const MOST_FRAMES: usize = 1000;

/// The frames of `/tf_static` and `/tf`, as a forest.
#[derive(Debug, Clone, Default)]
pub struct Frames {
    /// Child to parent, with `parent_from_child`.
    parents: HashMap<String, (String, Isometry3<f64>)>,
    /// Children whose transforms have changed.
    moving: HashSet<String>,
}

/// A transform that changes by less than this is constant \[m\], \[rad\].
const CONSTANT: f64 = 1e-4;

/// A frame without the leading slash that ROS 1 used, and some drivers still do.
fn bare(frame: &str) -> &str {
    frame.trim_start_matches('/')
}

impl Frames {
    /// Adds a transform; the latest one of a child counts. Returns false for one that is not valid, or one too many.
    pub fn insert(&mut self, transform: &TransformStamped) -> bool {
        let Some(parent_from_child) = transform.transform.spatial() else {
            return false;
        };
        let child = bare(&transform.child_frame_id);
        if self.parents.len() >= MOST_FRAMES && !self.parents.contains_key(child) {
            return false;
        }
        self.parents.insert(
            bare(&transform.child_frame_id).to_owned(),
            (bare(&transform.header.frame_id).to_owned(), parent_from_child),
        );
        true
    }

    /// Adds a transform that may change later. After the last one, [`Frames::drop_moving`] removes those that did.
    pub(crate) fn insert_if_constant(&mut self, transform: &TransformStamped) {
        let child = bare(&transform.child_frame_id);
        let Some((_, known)) = self.parents.get(child) else {
            self.insert(transform);
            return;
        };
        let same = transform.transform.spatial().is_some_and(|now| {
            let moved = known.inverse() * now;
            moved.translation.vector.norm() < CONSTANT && moved.rotation.angle() < CONSTANT
        });
        if !same {
            self.moving.insert(child.to_owned());
        }
    }

    /// Removes the frames that have moved.
    pub(crate) fn drop_moving(&mut self) {
        for child in self.moving.drain() {
            self.parents.remove(&child);
        }
    }

    /// The `base_link` of the car that `frame` is on, and its pose in that frame on the ground plane. None when there is none
    /// or the two are not connected.
    pub(crate) fn base_link_beside(&self, frame: &str) -> Option<(String, Pose)> {
        let frame = bare(frame);
        let namespace = frame.rsplit_once('/').map_or("", |(namespace, _)| namespace);
        let beside = [format!("{namespace}/{BASE_LINK}"), BASE_LINK.to_owned()];
        beside.into_iter().find_map(|base_link| {
            let mount = self.mount(frame, &base_link)?;
            let base_link = bare(&base_link).to_owned();
            Some((base_link, mount.base_link_from_laser))
        })
    }

    /// True when no transform is known.
    pub fn is_empty(&self) -> bool {
        self.parents.is_empty()
    }

    /// Adds all of another forest's frames.
    pub fn extend(&mut self, other: &Self) {
        for (child, parent) in &other.parents {
            if self.parents.len() < MOST_FRAMES || self.parents.contains_key(child) {
                self.parents.insert(child.clone(), parent.clone());
            }
        }
    }

    /// The root of `frame`'s tree, with `root_from_frame`. A loop ends after one round.
    fn root(&self, frame: &str) -> (String, Isometry3<f64>) {
        let (mut at, mut root_from_frame) = (frame.to_owned(), Isometry3::identity());
        for _ in 0..self.parents.len() {
            let Some((parent, parent_from_child)) = self.parents.get(&at) else {
                break;
            };
            root_from_frame = parent_from_child * root_from_frame;
            at.clone_from(parent);
        }
        (at, root_from_frame)
    }

    /// `base_from_frame`, through any number of frames. None when they are not connected.
    fn transform(&self, base: &str, frame: &str) -> Option<Isometry3<f64>> {
        let (base_root, root_from_base) = self.root(bare(base));
        let (frame_root, root_from_frame) = self.root(bare(frame));
        (base_root == frame_root).then(|| root_from_base.inverse() * root_from_frame)
    }

    /// How a sensor in `frame` is turned on `base`. None when they are not connected.
    pub fn rotation(&self, base: &str, frame: &str) -> Option<UnitQuaternion<f64>> {
        self.transform(base, frame).map(|transform| transform.rotation)
    }

    /// How `laser` is mounted on `base`. None when they are not connected.
    pub fn mount(&self, base: &str, laser: &str) -> Option<Mount> {
        let base_from_laser = self.transform(base, laser)?;
        let forward = base_from_laser.rotation * Vector3::x();
        let up = base_from_laser.rotation * Vector3::z();
        Some(Mount {
            base_link_from_laser: Pose::new(
                base_from_laser.translation.x,
                base_from_laser.translation.y,
                forward.y.atan2(forward.x),
            ),
            upside_down: up.z < 0.0,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros2::messages::{Header, Orientation, RosPose, Vector3 as Position};

    fn transform(parent: &str, child: &str, x: f64, orientation: Orientation) -> TransformStamped {
        TransformStamped {
            header: Header {
                frame_id: parent.into(),
                ..Header::default()
            },
            child_frame_id: child.into(),
            transform: RosPose {
                position: Position { x, y: 0.0, z: 0.1 },
                orientation,
            },
        }
    }

    #[test]
    fn chains_through_siblings_and_leading_slashes() {
        let mut frames = Frames::default();
        frames.insert(&transform(
            "chassis",
            "/base_link",
            -0.1,
            Orientation::from_yaw(0.0),
        ));
        frames.insert(&transform("/chassis", "mast", 0.1, Orientation::from_yaw(1.0)));
        frames.insert(&transform("mast", "laser", 0.0, Orientation::from_yaw(-1.0)));
        let mount = frames.mount("base_link", "/laser").expect("connected");
        assert!(mount.base_link_from_laser.distance(Pose::new(0.2, 0.0, 0.0)) < 1e-9);
        assert!(mount.base_link_from_laser.heading.abs() < 1e-9);
        assert!(!mount.upside_down);
        assert!(frames.mount("base_link", "camera").is_none());
    }

    #[test]
    fn a_laser_that_is_upside_down_is_detected() {
        let mut frames = Frames::default();
        let roll_half_turn = Orientation {
            x: 1.0,
            y: 0.0,
            z: 0.0,
            w: 0.0,
        };
        frames.insert(&transform("base_link", "laser", 0.27, roll_half_turn));
        let mount = frames.mount("base_link", "laser").expect("connected");
        assert!(mount.upside_down);
        assert!(mount.base_link_from_laser.heading.abs() < 1e-9);
    }

    #[test]
    fn a_sensor_on_its_side_is_turned() {
        let mut frames = Frames::default();
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let pitched = Orientation {
            x: 0.0,
            y: half,
            z: 0.0,
            w: half,
        };
        frames.insert(&transform("base_link", "imu", 0.1, pitched));
        let rotation = frames.rotation("base_link", "/imu").expect("connected");
        // Its x axis points down: a turn about it, to the right.
        assert!((rotation * Vector3::x()).z < -0.999);
        assert!(frames.rotation("base_link", "camera").is_none());
    }

    #[test]
    fn a_loop_of_frames_ends() {
        let mut frames = Frames::default();
        frames.insert(&transform("a", "b", 1.0, Orientation::default()));
        frames.insert(&transform("b", "a", 1.0, Orientation::default()));
        assert!(frames.mount("a", "laser").is_none());
    }
}
