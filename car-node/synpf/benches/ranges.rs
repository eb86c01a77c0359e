//! The methods that predict ranges, as tables: `cargo bench -p synpf -- ranges` compares time, memory and error on three maps,
//! `cargo bench -p synpf -- particles` how weighing grows with the number of particles. With `--features gpu` the graphics
//! card is among the methods; its name is printed.
//!
//! Times are the least of several runs on one thread; the graphics card's driver uses what it likes.
#![allow(clippy::print_stdout, reason = "a benchmark prints its results")]

use std::hint::black_box;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use maps::{Cell, OccupancyGrid, Pose};
use synpf::TrackMap;
use synpf::parts::{RangeCaster, RangeSource, ScanWeigher, free_lasers, ranges_to_faces};

/// Rays whose errors are measured, and whose times.
const MEASURED: usize = 1000;
const TIMED: usize = 20_000;

/// Greatest range \[m\].
const LONGEST: f64 = 20.0;

/// Particles and beams whose weighing is timed.
const CLOUD: [usize; 2] = [3000, 21];

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with('-')).collect();
    let wanted = |name: &str| arguments.is_empty() || arguments.iter().any(|a| name.contains(a.as_str()));
    if wanted("ranges") {
        for (name, grid) in [("club", club()), ("5 mm cells", fine()), ("building", building())] {
            ranges(name, &grid);
        }
    }
    if wanted("particles") {
        particles();
    }
}

/// The bundled track.
fn club() -> OccupancyGrid {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../maps/tracks/club/map.yaml");
    OccupancyGrid::load(&file).expect("it ships")
}

/// An oval of 8 x 5 m, 1.2 m wide, in cells of 5 mm.
fn fine() -> OccupancyGrid {
    let cell = 0.005;
    OccupancyGrid::from_fn(1640, 1040, cell, Pose::IDENTITY, |column, row| {
        let (x, y) = (column as f64 * cell - 4.1, row as f64 * cell - 2.6);
        // Distance from the middle line: two half circles of 1.9 m, and straights of 3 m between them.
        let off = (x.abs() - 1.5).max(0.0).hypot(y) - 1.9;
        match off.abs() {
            d if d < 0.6 => Cell::Free,
            d if d < 0.65 => Cell::Occupied,
            _ => Cell::Unknown,
        }
    })
}

/// A building of 100 x 60 m in cells of 5 cm: rooms of 7 x 9 m with doors and a cupboard along corridors.
fn building() -> OccupancyGrid {
    let cell = 0.05;
    OccupancyGrid::from_fn(2000, 1200, cell, Pose::IDENTITY, |column, row| {
        let (x, y) = (column as f64 * cell, row as f64 * cell);
        let outside = x.min(y).min(100.0 - x).min(60.0 - y) < 0.2;
        // Across: a corridor of 2.5 m, and a row of rooms on either side. Along: a room every 8 m.
        let (across, along) = (y % 20.0, x % 8.0);
        let corridor = (9.0..11.5).contains(&across);
        let wall = (across - 8.9).abs() < 0.1 || (across - 11.6).abs() < 0.1 || across < 0.1;
        let door = (3.0..4.0).contains(&along) && across > 0.1;
        let partition = along < 0.15 && !corridor;
        let cupboard = (5.0..6.5).contains(&along) && (3.0..3.6).contains(&across);
        if outside || (wall && !door) || partition || cupboard {
            Cell::Occupied
        } else {
            Cell::Free
        }
    })
}

/// The least time of one run, among those of half a second \[s\].
fn least_time(mut run: impl FnMut()) -> f64 {
    let (begin, mut least) = (Instant::now(), f64::INFINITY);
    loop {
        let start = Instant::now();
        run();
        least = least.min(start.elapsed().as_secs_f64());
        if begin.elapsed() > Duration::from_millis(500) {
            return least;
        }
    }
}

fn ranges(name: &str, grid: &OccupancyGrid) {
    let size = [grid.width, grid.height];
    let free = grid.cells.iter().filter(|cell| **cell == Cell::Free).count();
    println!(
        "\nranges on {name}: {} x {} cells of {} m, {free} free",
        size[0], size[1], grid.resolution
    );
    println!(
        "{:<13} {:>9} {:>10} {:>11} {:>11} {:>12} {:>11}",
        "method", "build, ms", "memory, MB", "ray, ns", "cloud, ns", "median, cm", "99 %, cm"
    );
    let map = Arc::new(TrackMap::new(grid.clone()).expect("free space"));
    let rays = free_lasers(&map, TIMED, 1);
    let truth: Vec<Option<f64>> = ranges_to_faces(&map, &rays[..MEASURED])
        .into_iter()
        .map(|range| range.filter(|range| *range < LONGEST))
        .collect();
    let in_the_middle = *rays
        .iter()
        .max_by(|a, b| map.distance([a.x, a.y]).total_cmp(&map.distance([b.x, b.y])))
        .expect("some rays");
    let mut adapter = None;
    for source in RangeSource::ALL {
        // Building counts with a map of its own, whose tables are not there yet.
        let fresh = Arc::new(TrackMap::new(grid.clone()).expect("free space"));
        if source == RangeSource::Gpu {
            // Opening the adapter belongs to the program, not to a map.
            RangeCaster::new(&map, source).ok();
        }
        let begin = Instant::now();
        let caster = match RangeCaster::new(&fresh, source) {
            Ok(caster) => caster,
            Err(error) => {
                println!("{:<13} {error}", source.name());
                continue;
            }
        };
        let build = begin.elapsed().as_secs_f64();
        let found = caster.ranges(&rays[..MEASURED], LONGEST).expect("ranges");
        let mut errors: Vec<f64> = found
            .iter()
            .zip(&truth)
            .filter_map(|(range, truth)| Some(100.0 * (range - (*truth)?).abs()))
            .collect();
        errors.sort_by(f64::total_cmp);
        let error = |share: f64| errors[((errors.len() - 1) as f64 * share) as usize];
        let scattered = least_time(|| {
            black_box(caster.ranges(&rays, LONGEST).expect("ranges"));
        });
        let cloud = ScanWeigher::new(&fresh, source, CLOUD[0], CLOUD[1], in_the_middle);
        let cloud = cloud.map_or("-".into(), |mut weigher| {
            let time = least_time(|| {
                black_box(weigher.weigh());
            });
            format!("{:.1}", 1e9 * time / (CLOUD[0] * CLOUD[1]) as f64)
        });
        println!(
            "{:<13} {:>9.1} {:>10.2} {:>11.1} {:>11} {:>12.2} {:>11.1}",
            source.name(),
            1e3 * build,
            caster.bytes() as f64 / 1e6,
            1e9 * scattered / TIMED as f64,
            cloud,
            error(0.5),
            error(0.99)
        );
        adapter = adapter.or(caster.adapter().map(str::to_owned));
    }
    if let Some(adapter) = adapter {
        println!("gpu: {adapter}");
    }
}

/// The time to weigh a scan of 21 beams, by the number of particles.
fn particles() {
    let map = Arc::new(TrackMap::new(club()).expect("free space"));
    let at = *free_lasers(&map, 1000, 1)
        .iter()
        .max_by(|a, b| map.distance([a.x, a.y]).total_cmp(&map.distance([b.x, b.y])))
        .expect("some rays");
    println!(
        "\nparticles: time to weigh a scan of {} beams on club, ms",
        CLOUD[1]
    );
    let counts = [3_000, 30_000, 300_000, 3_000_000];
    println!(
        "{:<13} {:>10} {:>10} {:>10} {:>10} {:>16}",
        "method", counts[0], counts[1], counts[2], counts[3], "ns a ray, 3e6"
    );
    let mut adapter = None;
    for source in RangeSource::ALL {
        match RangeCaster::new(&map, source) {
            Err(error) => {
                println!("{:<13} {error}", source.name());
                continue;
            }
            Ok(caster) => adapter = adapter.or(caster.adapter().map(str::to_owned)),
        }
        let times = counts.map(|count| {
            let mut weigher = ScanWeigher::new(&map, source, count, CLOUD[1], at).expect("as above");
            // The buffers of the graphics card come with the first run.
            black_box(weigher.weigh());
            least_time(|| {
                black_box(weigher.weigh());
            })
        });
        let shown = times.map(|time| format!("{:.2}", 1e3 * time));
        println!(
            "{:<13} {:>10} {:>10} {:>10} {:>10} {:>16.1}",
            source.name(),
            shown[0],
            shown[1],
            shown[2],
            shown[3],
            1e9 * times[3] / (counts[3] * CLOUD[1]) as f64
        );
    }
    match adapter {
        Some(adapter) => println!("gpu: {adapter}"),
        None => println!("gpu: not measured"),
    }
}
