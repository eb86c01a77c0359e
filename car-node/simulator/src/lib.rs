//! A seeded simulator of 1:10 race cars: vehicle, lidar, odometry and driver.
//!
//! It is a test bench for localizers and the built-in data source of `car-node`. The caller advances time with
//! [`World::step`], receives the sensors' messages, and passes a localizer's estimates to the driver with
//! [`World::guide`]. The same seed and the same estimates give the same race, byte for byte. The crate also generates
//! tracks ([`TrackSpec`]).
//!
//! It never reads a clock, never opens a socket, and does not depend on a localizer. Only [`Track::load`],
//! [`Track::find`] and [`Track::save`] touch files.
//!
//! The cars drive between [`Walls`], which are line segments. The localizer gets a map that was drawn from noisy laser
//! scans of these walls, so it has the errors of a real map.
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
//!             // A localizer would use these; here the truth takes its place.
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
mod car;
mod car_setup;
mod check;
mod contact_timer;
mod contour;
mod driver;
mod driver_params;
mod estimate;
mod generator;
mod grip;
mod grip_test;
mod lidar;
mod manoeuvre;
mod obstacle;
mod odometry;
mod output;
mod pursuit;
mod recovery_crew;
mod speed_profile;
mod steady_turn;
mod tick;
mod tire;
mod track;
mod vehicle;
mod vehicle_params;
mod vehicle_state;
mod wall;
mod wall_file;
mod walls;
mod world;

pub use car_setup::{CarSetup, Guidance};
pub use check::TrackReport;
pub use driver::Driver;
pub use driver_params::DriverParams;
pub use estimate::Estimate;
pub use generator::{BlackStretch, Block, LineError, MappingParams, TrackSpec, draw_map, minimum_curvature};
pub use grip::Grip;
pub use grip_test::GripTest;
pub use lidar::{Lidar, LidarParams, Scan};
pub use manoeuvre::Manoeuvre;
pub use obstacle::Obstacle;
pub use odometry::{Gyro, Motion, Odometry, OdometryParams, OdometrySensor, YawSource};
pub use output::{Contact, Lap, Message, Output, Truth};
pub use pursuit::Ahead;
pub use speed_profile::{SpeedParams, slowed_to, speed_profile};
pub use steady_turn::Turn;
pub use tick::TICK;
pub use tire::TireParams;
pub use track::{BUNDLED, Track};
pub use vehicle::{Controls, Vehicle};
pub use vehicle_params::{VehicleParams, outline};
pub use vehicle_state::VehicleState;
pub use wall::{Hit, Surface, Wall};
pub use walls::Walls;
pub use world::World;
