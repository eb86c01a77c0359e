//! An update asks the allocator for nothing: a laser is not waited for by a heap.

mod common;

use allocation_counter::measure;
use common::{BASE_LINK_FROM_LASER, odometry, ring, scan, truth};
use synpf::{Parameters, Scan, SynPf};

/// Updates until every buffer has its size.
const WARM: usize = 400;
const MEASURED: usize = 200;

/// Allocations of so many updates in mid-drive, with the odometry between them.
fn allocations(set: &str) -> u64 {
    let map = ring();
    let parameters = Parameters::named(set).expect("ships");
    let mut localizer = SynPf::new(map.clone(), BASE_LINK_FROM_LASER, parameters, 1).expect("a sound set");
    localizer.on_odometry(&odometry(0.0, 1.02)).expect("sound");
    localizer.initialize(truth(0.0)).expect("finite");
    let scans: Vec<Scan> = (1..=WARM + MEASURED)
        .map(|k| scan(&map, k as f64 * 0.025))
        .collect();
    let mut drive = |scans: &[Scan], first: usize| {
        for (k, scan) in scans.iter().enumerate() {
            // 50 Hz beside 40 Hz.
            let from = (first + k) * 5 / 4;
            for step in from + 1..=(first + k + 1) * 5 / 4 {
                localizer
                    .on_odometry(&odometry(step as f64 * 0.02, 1.02))
                    .expect("sound");
            }
            localizer.on_scan(scan).expect("an update");
        }
    };
    drive(&scans[..WARM], 0);
    measure(|| drive(&scans[WARM..], WARM)).count_total
}

#[test]
fn an_update_does_not_allocate() {
    for set in ["hq", "lq", "adaptive"] {
        assert_eq!(allocations(set), 0, "{set}");
    }
}
