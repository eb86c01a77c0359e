//! What an update costs, stage by stage and as a whole, beside the least that it can cost: a bare loop that looks
//! up ranges and sums log-likelihoods for 3000 particles and 21 beams.
//!
//! `cargo bench -p synpf`. Quote ratios to `bare kernel` of the same run.
#![allow(missing_docs, reason = "criterion's macros make undocumented functions")]

#[path = "../tests/common/mod.rs"]
#[allow(dead_code, reason = "the module is shared with the tests")]
mod common;

use std::hint::black_box;
use std::sync::Arc;
use std::time::Duration;

use common::{BASE_LINK_FROM_LASER, odometry, ring, scan, truth};
use criterion::{BatchSize, BenchmarkId, Criterion, criterion_group, criterion_main};
use maps::DistanceField;
use synpf::{Parameters, Scan, Stage, SynPf, TrackMap};

/// A localizer with a drive that never ends, one update per call.
struct Drive {
    localizer: SynPf,
    scans: Vec<Scan>,
    /// Between two scans \[s\].
    period: f64,
    step: usize,
    odom: f64,
}

impl Drive {
    fn new(map: &Arc<TrackMap>, parameters: Parameters) -> Self {
        let mut localizer =
            SynPf::new(Arc::clone(map), BASE_LINK_FROM_LASER, parameters, 1).expect("a sound set");
        localizer.on_odometry(&odometry(0.0, 1.0)).expect("sound");
        localizer.initialize(truth(0.0)).expect("finite");
        // One lap in whole scans, which the benchmark goes around again and again.
        let count = (common::lap() / 0.025).round() as usize;
        let period = common::lap() / count as f64;
        let scans = (1..=count).map(|k| scan(map, k as f64 * period)).collect();
        let mut drive = Self {
            localizer,
            scans,
            period,
            step: 0,
            odom: 0.0,
        };
        (0..100).for_each(|_| drive.update());
        drive
    }

    fn update(&mut self) {
        self.step += 1;
        let at = self.step as f64 * self.period;
        while self.odom + 0.02 <= at {
            self.odom += 0.02;
            self.localizer
                .on_odometry(&odometry(self.odom, 1.0))
                .expect("sound");
        }
        let count = self.scans.len();
        let scan = &mut self.scans[(self.step - 1) % count];
        scan.stamp = common::stamp(at);
        black_box(self.localizer.on_scan(scan).expect("an update"));
    }
}

fn whole_update(criterion: &mut Criterion) {
    let map = ring();
    let mut group = criterion.benchmark_group("update");
    group.measurement_time(Duration::from_secs(4));
    bare_kernel(&mut group);
    for name in Parameters::NAMES {
        let mut drive = Drive::new(&map, Parameters::named(name).expect("ships"));
        group.bench_function(BenchmarkId::new("set", name), |bencher| {
            bencher.iter(|| drive.update());
        });
    }
    for particles in [500, 1500, 3000] {
        for beams in [21, 61] {
            let mut set = Parameters::named("hq").expect("ships");
            set.particles.max_particles = particles;
            set.particles.min_particles = particles;
            set.beams.beams = beams;
            set.refinement.refine = false;
            let mut drive = Drive::new(&map, set);
            let id = BenchmarkId::new("without refinement", format!("{particles} x {beams}"));
            group.bench_function(id, |bencher| bencher.iter(|| drive.update()));
        }
    }
    group.finish();
}

/// What each stage costs: particles and beams swept where the stage depends on them.
fn stages(criterion: &mut Criterion) {
    let map = ring();
    let mut group = criterion.benchmark_group("stage");
    group.sample_size(50);
    for (particles, beams) in [(500, 21), (1500, 21), (3000, 21), (3000, 61)] {
        let mut set = Parameters::named("hq").expect("ships");
        set.particles.max_particles = particles;
        set.particles.min_particles = particles;
        set.beams.beams = beams;
        let drive = Drive::new(&map, set);
        let scan = &drive.scans[drive.step % drive.scans.len()];
        for stage in Stage::ALL {
            let id = BenchmarkId::new(format!("{stage:?}"), format!("{particles} x {beams}"));
            group.bench_function(id, |bencher| {
                bencher.iter_batched_ref(
                    || drive.localizer.clone(),
                    |localizer| localizer.run_stage(stage, scan),
                    BatchSize::SmallInput,
                );
            });
        }
    }
    group.finish();
}

/// The least: a table of free cells only, the beams' rows of log-likelihoods chosen before the loop.
fn bare_kernel(group: &mut criterion::BenchmarkGroup<'_, criterion::measurement::WallTime>) {
    const DIRECTIONS: usize = 256;
    const CELLS: usize = 40_000;
    const STEPS: usize = 1001;
    let mut state = 1u32;
    let mut random = || {
        // Marsaglia's xorshift: any numbers do here.
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        state
    };
    let table: Vec<u16> = (0..CELLS * DIRECTIONS)
        .map(|_| (random() % 1000) as u16)
        .collect();
    let rows: Vec<Vec<f32>> = (0..21)
        .map(|_| (0..STEPS).map(|_| (random() % 100) as f32 * -0.01).collect())
        .collect();
    // A cloud like a localized car's: a few hundred cells.
    let particles: Vec<(usize, usize)> = (0..3000)
        .map(|_| ((20_000 + random() % 400) as usize, (random() % 24) as usize))
        .collect();
    let mut sums = vec![0.0f32; particles.len()];
    group.bench_function("bare kernel, 3000 x 21", |bencher| {
        bencher.iter(|| {
            for (sum, &(cell, heading)) in sums.iter_mut().zip(&particles) {
                let ranges = &table[cell * DIRECTIONS..(cell + 1) * DIRECTIONS];
                *sum = 0.0;
                for (k, row) in rows.iter().enumerate() {
                    *sum += row[ranges[(heading + 9 * k) & (DIRECTIONS - 1)] as usize];
                }
            }
            black_box(&sums);
        });
    });
}

fn map_building(criterion: &mut Criterion) {
    let grid = ring().grid().clone();
    let mut group = criterion.benchmark_group("map");
    group.sample_size(10);
    group.bench_function("distance field", |bencher| {
        bencher.iter(|| DistanceField::new(black_box(&grid)));
    });
    group.bench_function("range table", |bencher| {
        bencher.iter_with_setup(
            || TrackMap::new(grid.clone()).expect("free"),
            |map| {
                map.prepare(None, &Parameters::named("hq").expect("ships"));
                map
            },
        );
    });
    let drive = Drive::new(&ring(), Parameters::named("hq").expect("ships"));
    let scan = &drive.scans[drive.step % drive.scans.len()];
    group.bench_function("look for the scan on the whole map", |bencher| {
        bencher.iter_batched_ref(
            || drive.localizer.clone(),
            |localizer| localizer.run_stage(Stage::Search, scan),
            BatchSize::SmallInput,
        );
    });
    group.finish();
}

criterion_group!(benches, whole_update, stages, map_building);
criterion_main!(benches);
