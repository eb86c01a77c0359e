//! Ranges and weights of a graphics card against exact casting on the CPU; with the cargo feature `gpu`.
//!
//! Mesa's lavapipe is enough of a graphics card. Without any adapter these tests pass with a message, unless lavapipe is
//! installed.

#[allow(dead_code, reason = "the module is shared with other tests")]
mod common;

use std::f64::consts::PI;
use std::path::Path;
use std::sync::Arc;

use common::{BASE_LINK_FROM_LASER, odometry, ring, scan, truth};
use maps::{Cell, OccupancyGrid, Pose};
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};
use synpf::parts::{RangeSource, ScanWeigher, gpu_adapter, gpu_ranges};
use synpf::{Parameters, RangeMethod, SynPf};

/// Whether there is an adapter.
fn adapter() -> bool {
    match gpu_adapter() {
        Ok(name) => {
            eprintln!("on {name}");
            true
        }
        Err(error) => {
            let drivers = Path::new("/usr/share/vulkan/icd.d");
            let lavapipe = ["lvp_icd.x86_64.json", "lvp_icd.aarch64.json", "lvp_icd.json"];
            let installed = lavapipe.iter().any(|file| drivers.join(file).exists());
            assert!(!installed, "lavapipe is installed, but {error}");
            eprintln!("skipped: {error}");
            false
        }
    }
}

/// Free cells with occupied and unknown ones among them.
fn random_grid(width: usize, height: usize, random: &mut SmallRng) -> OccupancyGrid {
    let origin = Pose::new(-3.0, 2.0, 0.3);
    let cells = (0..width * height).map(|_| match random.random_range(0..100) {
        0..4 => Cell::Occupied,
        4..8 => Cell::Unknown,
        _ => Cell::Free,
    });
    OccupancyGrid::new(width, height, 0.05, origin, cells.collect())
}

fn random_rays(grid: &OccupancyGrid, count: usize, random: &mut SmallRng) -> Vec<Pose> {
    let size = [grid.width as f64, grid.height as f64].map(|cells| cells * grid.resolution);
    (0..count)
        .map(|_| {
            let at = |metres: f64, random: &mut SmallRng| random.random_range(0.0..metres);
            let place = Pose::new(
                at(size[0], random),
                at(size[1], random),
                random.random_range(-PI..PI),
            );
            grid.origin * place
        })
        .collect()
}

/// A range from the card is that of an exact ray which starts at most so far beside it \[cells\]; `f32` rounds the start.
fn beside(grid: &OccupancyGrid) -> f64 {
    1e-3 + grid.width.max(grid.height) as f64 * f64::from(f32::EPSILON)
}

/// Asserts that the ranges are exact but for rounding, and returns how many rays rounding let pass on the other side of a
/// corner.
fn compare(grid: &OccupancyGrid, rays: &[Pose], max_range: f64) -> usize {
    let ranges = gpu_ranges(grid, rays, max_range).expect("an adapter");
    assert_eq!(ranges.len(), rays.len());
    let tolerance = 4.0 * beside(grid) * grid.resolution;
    let mut grazing = 0;
    for (ray, range) in rays.iter().zip(ranges) {
        if (range - grid.cast(*ray, max_range)).abs() <= tolerance {
            continue;
        }
        grazing += 1;
        let shift = beside(grid) * grid.resolution;
        let beside = [
            [0.0, -1.0],
            [0.0, 1.0],
            [-1.0, 0.0],
            [1.0, 0.0],
            [1.0, 1.0],
            [1.0, -1.0],
            [-1.0, 1.0],
            [-1.0, -1.0],
        ]
        .map(|[x, y]| grid.cast(*ray * Pose::new(x * shift, y * shift, 0.0), max_range));
        assert!(
            beside.iter().any(|exact| (range - exact).abs() <= tolerance),
            "{range} m along {ray:?}; exact beside it {beside:?}"
        );
    }
    grazing
}

#[test]
fn ranges_are_those_of_exact_casting() {
    if !adapter() {
        return;
    }
    let mut random = SmallRng::seed_from_u64(1);
    let (mut grazing, mut all) = (0, 0);
    for (width, height) in [(200, 120), (37, 301), (513, 64)] {
        let grid = random_grid(width, height, &mut random);
        let rays = random_rays(&grid, 20_000, &mut random);
        grazing += compare(&grid, &rays, 20.0);
        all += rays.len();
    }
    assert!(
        grazing * 500 < all,
        "{grazing} of {all} rays pass a corner on the other side"
    );
}

/// Indices are computed from the map's size: the smallest and the largest maps, and rays from outside, from the edges and from
/// nowhere.
#[test]
fn no_map_and_no_ray_reads_out_of_bounds() {
    if !adapter() {
        return;
    }
    let mut random = SmallRng::seed_from_u64(2);
    for (width, height) in [(1, 1), (1, 40), (40, 1), (15, 3), (16, 16), (17, 2), (8192, 8192)] {
        let mut grid = if width < 8192 {
            random_grid(width, height, &mut random)
        } else {
            // Walls at the edges, and a post here and there.
            OccupancyGrid::from_fn(width, height, 0.05, Pose::IDENTITY, |column, row| {
                let edge = [column, row].into_iter().any(|i| i == 0 || i == 8191);
                if edge || (column % 511 == 0 && row % 379 == 0) {
                    Cell::Occupied
                } else {
                    Cell::Free
                }
            })
        };
        if width * height == 1 {
            grid.cells[0] = Cell::Free;
        }
        let rays = random_rays(&grid, 3000, &mut random);
        compare(&grid, &rays, 1000.0);
        let size = [width as f64, height as f64].map(|cells| cells * grid.resolution);
        let edges = [
            -1e30,
            -1e6,
            -0.05,
            0.0,
            1e-9,
            0.05,
            1e6,
            1e30,
            f64::NAN,
            f64::INFINITY,
        ];
        let mut odd = Vec::new();
        for x in edges.into_iter().chain([size[0], size[0] - 1e-9, size[0] + 0.05]) {
            for y in edges.into_iter().chain([size[1], size[1] - 1e-9, size[1] + 0.05]) {
                for heading in [0.0, PI / 2.0, PI, -PI / 2.0, PI / 4.0, 1e-12, f64::NAN] {
                    odd.push(grid.origin * Pose::new(x, y, heading));
                }
            }
        }
        for range in gpu_ranges(&grid, &odd, 1000.0).expect("an adapter") {
            assert!((0.0..=1000.0).contains(&range), "{range} m on {width} x {height}");
        }
    }
}

#[test]
fn weights_are_those_of_exact_ranges() {
    if !adapter() {
        return;
    }
    let map = ring();
    for (particles, beams) in [(1, 3), (7, 8), (3000, 21), (20_001, 61)] {
        let weigh = |source| {
            let weigher = ScanWeigher::new(&map, source, particles, beams, truth(1.0));
            weigher.expect("an adapter").weigh().to_vec()
        };
        let (gpu, exact) = (weigh(RangeSource::Gpu), weigh(RangeSource::Exact));
        assert_eq!(gpu.len(), particles);
        // A range that rounding moves over the edge of a step of 2 cm changes the likelihood of its beam by a step.
        let off: Vec<f32> = gpu.iter().zip(&exact).map(|(a, b)| (a - b).abs()).collect();
        let differ = off.iter().filter(|off| **off > 0.02 * beams as f32).count();
        assert!(
            differ * 100 <= particles,
            "{differ} of {particles} particles with {beams} beams differ"
        );
        let mean = off.iter().sum::<f32>() / particles as f32;
        assert!(mean < 2e-3 * beams as f32, "{mean} on average, {beams} beams");
    }
}

#[test]
fn a_localizer_follows_the_track_on_it() {
    if !adapter() {
        return;
    }
    let map = ring();
    let mut set = on_the_card();
    // The particles alone, without the refinement that would cover for them.
    set.refinement.refine = false;
    let mut localizer = SynPf::new(Arc::clone(&map), BASE_LINK_FROM_LASER, set, 2).expect("an adapter");
    localizer.on_odometry(&odometry(0.0, 1.0)).expect("sound");
    localizer.initialize(truth(0.0)).expect("finite");
    let (mut odom, mut worst) = (0.0, 0f64);
    for k in 1..=80 {
        let at = f64::from(k) * 0.025;
        while odom + 0.02 <= at {
            odom += 0.02;
            localizer.on_odometry(&odometry(odom, 1.0)).expect("sound");
        }
        let update = localizer.on_scan(&scan(&map, at)).expect("an update");
        let off = update.pose.distance(truth(at));
        if k > 20 {
            worst = worst.max(off);
        }
    }
    assert!(worst < 0.35, "{worst}");
}

fn on_the_card() -> Parameters {
    let mut set = Parameters::named("hq").expect("ships");
    set.sensor.range_method = RangeMethod::Gpu;
    set
}

#[test]
fn without_an_adapter_the_set_is_refused() {
    // The loader looks for drivers once in a process, so this takes another one.
    let ended = std::process::Command::new(std::env::current_exe().expect("a path"))
        .args(["--exact", "refused_without_an_adapter", "--ignored"])
        .env("VK_DRIVER_FILES", "/nonexistent")
        .env("VK_ICD_FILENAMES", "/nonexistent")
        .output()
        .expect("it starts");
    let said = String::from_utf8_lossy(&ended.stdout);
    assert!(ended.status.success() && said.contains("1 passed"), "{said}");
}

#[test]
#[ignore = "run by another test, in a process without drivers"]
fn refused_without_an_adapter() {
    let refused = SynPf::new(ring(), BASE_LINK_FROM_LASER, on_the_card(), 1).expect_err("no adapter");
    let said = refused.to_string();
    assert!(
        said.contains("range_method: gpu: no graphics adapter with Vulkan"),
        "{said}"
    );
}
