//! Records a race of simulated cars as the pit wall would, as fast as the machine computes it.
//!
//! ```text
//! race-session FILE MINUTES CARS SET[,SET...] [KIND:GRADE...]    a heat for each set, of the same length; defects as for
//!                                                                `car-node race --faults`
//! ```

#![allow(clippy::print_stdout, reason = "this is the program's output")]

use std::path::Path;

use anyhow::{Context, bail};
use car_node::race::Quality;
use car_node::stress::DefectChoice;
use system_tests::RaceSession;

/// A lap of `club` \[s\].
const LAP_S: f64 = 9.4;

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [file, minutes, cars, sets, faults @ ..] = &arguments[..] else {
        bail!("usage: race-session FILE MINUTES CARS SET[,SET...] [KIND:GRADE...]");
    };
    let minutes: f64 = minutes.parse().context("MINUTES")?;
    let sets: Vec<&str> = sets.split(',').collect();
    let laps = (minutes * 60.0 / LAP_S / sets.len() as f64).ceil() as u32;
    let session = RaceSession {
        track: "club".into(),
        cars: cars.parse().context("CARS")?,
        heats: sets
            .iter()
            .map(|set| ((*set).to_owned(), Quality::Hq, laps))
            .collect(),
        seed: 1,
        defects: faults
            .iter()
            .map(|text| Ok(text.parse::<DefectChoice>().map_err(anyhow::Error::msg)?.one()))
            .collect::<anyhow::Result<_>>()?,
        scans: true,
    };
    let (results, summary) = session.record(Path::new(file))?;
    for (set, heat) in sets.iter().zip(&results) {
        for (number, car) in (1..).zip(heat) {
            println!(
                "{set} car-{number}: {} laps, {} crashes, {} spins",
                car.laps.len(),
                car.crashes,
                car.spins
            );
        }
    }
    println!(
        "{file}: {:.0} s, {} messages",
        summary.duration_s, summary.messages
    );
    Ok(())
}
