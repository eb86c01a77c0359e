//! Localizes over a bag and prints a pose per scan: `stamp_s,x_m,y_m,heading_rad` of `base_link` in `map`.
//!
//! ```sh
//! cargo run --release -p examples --bin localize-bag -- map.yaml drive.mcap 1.2 -0.4 3.1
//! ```
#![allow(clippy::print_stdout, reason = "poses are what it prints")]

use std::env;
use std::path::Path;
use std::sync::Arc;

use anyhow::Context;
use car_node::sensors::bag::{Bag, SensorEvent, Topics};
use car_node::sensors::frames::Mount;
use maps::{OccupancyGrid, Pose};
use synpf::{Parameters, SynPf, TrackMap};

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = env::args().skip(1).collect();
    let [map, bag, start @ ..] = &arguments[..] else {
        anyhow::bail!("usage: localize-bag MAP.yaml BAG.mcap [X Y HEADING]");
    };
    let log = Bag::read(Path::new(bag))?.sensors(&Topics::default(), None)?;
    let mount = log.mount.unwrap_or_else(Mount::typical);
    let map = Arc::new(TrackMap::new(OccupancyGrid::load(map)?)?);
    let parameters = Parameters::named("hq").context("a set that ships")?;
    let mut localizer = SynPf::new(map, mount.base_link_from_laser, parameters, 0)?;
    match start {
        [x, y, heading] => localizer.initialize(Pose::new(x.parse()?, y.parse()?, heading.parse()?))?,
        _ => localizer.relocalize(),
    }
    for arrival in &log.arrivals {
        // A message that is dropped, such as a scan before the first odometry, costs one pose and no more.
        match &arrival.event {
            SensorEvent::Odometry(odometry) => localizer.on_odometry(odometry).unwrap_or_default(),
            SensorEvent::YawRate(yaw_rate) => localizer.on_yaw_rate(yaw_rate).unwrap_or_default(),
            // Of another localizer; SynPF has its own.
            SensorEvent::Pose(_) => {}
            SensorEvent::Scan(scan) => {
                if let Ok(update) = localizer.on_scan(scan) {
                    let Pose { x, y, heading } = update.pose;
                    println!("{:.6},{x:.4},{y:.4},{heading:.5}", update.stamp.0 as f64 * 1e-9);
                }
            }
        }
    }
    Ok(())
}
