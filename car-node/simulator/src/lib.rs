//! A seeded simulator of 1:10 race cars: vehicle, lidar, odometry and driver.
//!
//! The crate is a test bench for localizers and the built-in source of `car-node`. It reads no clock, opens no socket and
//! knows no localizer: the caller moves time on with [`World::step`], takes the sensors' messages as they arrive, and
//! gives the driver the estimates that a localizer made of them. Only [`Track::load`] and [`Track::save`] touch files.
//! The same seed and the same estimates give the same race, byte for byte.
//!
//! What is true (the [`Walls`], line segments) is not what the localizer is given (the map, a grid that was drawn by
//! driving past those walls with a noisy laser), so map error is real here as it is on a track.
//!
//! ```
//! use std::sync::Arc;
//! use simulator::{CarSetup, Estimate, Message, Surface, Track, Wall, Walls, World};
//! # use maps::{Cell, OccupancyGrid, Pose, Raceline};
//! # let circle = |radius: f64| -> Vec<[f64; 2]> {
//! #     (0..=60).map(|i| std::f64::consts::TAU * f64::from(i) / 60.0)
//! #         .map(|a| [radius * a.cos(), radius * a.sin()]).collect()
//! # };
//! # let grid = OccupancyGrid::new(1, 1, 0.05, Pose::IDENTITY, vec![Cell::Free]);
//! # let wall = |radius| Wall { surface: Surface::Plain, points: circle(radius) };
//! # let track = Track { name: "ring".into(), grid, raceline: Raceline::through(&circle(4.0)[..60], 3.0)?,
//! #     walls: Walls::new(vec![wall(3.0), wall(5.0)]) };
//! // let track = Track::load("maps/tracks/club", None)?;
//! let mut world = World::new(Arc::new(track), &[CarSetup::default()], 42);
//! let mut laps = 0;
//! while laps < 2 {
//!     for output in world.step() {
//!         match output.message {
//!             // A localizer would take these in; the truth stands in for it here.
//!             Message::Scan(scan) => assert_eq!(scan.ranges.len(), 1081),
//!             Message::Odometry(odometry) => {
//!                 let truth = world.truth(output.car);
//!                 let estimate = Estimate {
//!                     time: truth.stamp,
//!                     pose: truth.pose,
//!                     speed: odometry.speed,
//!                     yaw_rate: odometry.yaw_rate,
//!                 };
//!                 world.guide(output.car, estimate);
//!             }
//!             Message::Lap(lap) => laps = lap.number,
//!             _ => {}
//!         }
//!     }
//! }
//! # Ok::<(), maps::RacelineFault>(())
//! ```
mod check;
mod contour;
mod driver;
mod generator;
mod lidar;
mod odometry;
mod tire;
mod track;
mod vehicle;
mod walls;
mod world;

pub use check::TrackReport;
pub use driver::{Ahead, Driver, DriverParams, Estimate, Manoeuvre};
pub use generator::{
    BUNDLED, BlackStretch, Block, LineError, MappingParams, SpeedParams, TrackSpec, draw_map,
    minimum_curvature, slowed_to, speed_profile,
};
pub use lidar::{Lidar, LidarParams, Obstacle, Scan};
pub use odometry::{Gyro, Motion, Odometry, OdometryParams, OdometrySensor, YawSource};
pub use tire::TireParams;
pub use track::Track;
pub use vehicle::{Controls, Grip, Turn, Vehicle, VehicleParams, VehicleState, outline};
pub use walls::{Hit, Surface, Wall, Walls};
pub use world::{CarSetup, Crash, Guidance, Lap, Message, Output, TICK, Truth, World};
