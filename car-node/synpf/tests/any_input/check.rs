//! A localizer under whatever sensors and operators can send: it neither panics nor gives a pose that is not finite.
//!
//! Shared by the test, which rolls dice, and by the fuzz target, which looks where the dice do not fall.

use std::sync::{Arc, OnceLock};

use arbitrary::{Arbitrary, Unstructured};
use maps::{Cell, OccupancyGrid, Pose};
use synpf::{Localizer, Odometry, Parameters, Scan, Stamp, SynPf, TrackMap, Twist, YawRate};

/// What can happen to a localizer. Floats come with all their bits: NaN, infinities, subnormals.
#[derive(Debug, Arbitrary)]
enum Event {
    Odometry {
        ahead_ms: i16,
        pose: [f64; 3],
        twist: [f64; 3],
    },
    /// A motion that makes sense, so that scans get further than the checks.
    Drive {
        centimetres: u8,
        turn: i8,
    },
    YawRate {
        ahead_ms: i16,
        rate: f64,
    },
    /// Any numbers in a scan's header.
    Raw {
        ahead_ms: i16,
        header: [f64; 5],
        ranges: Vec<f32>,
    },
    /// A scan as a laser makes it, with some readings overwritten.
    Scan {
        beams: u16,
        range: u8,
        odd: Vec<(u16, f32)>,
        sweep: bool,
    },
    Initialize([f64; 3]),
    /// Somewhere on the map.
    Place(u8, u8, i8),
    Relocalize,
    Set(u8),
    /// A parameter with any number.
    Put(u8, f64),
}

/// A ring of 6 m x 4 m in cells of 10 cm, open at one side so that beams may leave the map.
fn map() -> &'static Arc<TrackMap> {
    static MAP: OnceLock<Arc<TrackMap>> = OnceLock::new();
    MAP.get_or_init(|| {
        let origin = Pose::new(-1.0, 2.0, 0.3);
        let grid = OccupancyGrid::from_fn(60, 40, 0.1, origin, |column, row| match (column, row) {
            (0, _) | (_, 0 | 39) | (20..=40, 15..=25) => Cell::Occupied,
            (59, row) if row % 7 == 0 => Cell::Unknown,
            _ => Cell::Free,
        });
        Arc::new(TrackMap::new(grid).expect("has free cells"))
    })
}

/// Most events of one try: what needs more is found by trying more often.
const MOST_EVENTS: usize = 64;

/// Lets all that these bytes stand for happen to a new localizer, and checks what comes of it. Returns the number of
/// updates.
#[expect(clippy::too_many_lines, reason = "an arm for each event, and each is short")]
pub(crate) fn check(bytes: &[u8]) -> usize {
    let mut dice = Unstructured::new(bytes);
    let seed = dice.arbitrary().unwrap_or_default();
    let mut set = Parameters::default();
    set.particles.max_particles = 64;
    set.particles.min_particles = 16;
    let keys: Vec<String> = set.to_values().into_keys().collect();
    let mut localizer =
        SynPf::new(Arc::clone(map()), Pose::new(0.27, 0.0, 0.0), set, seed).expect("a sound set");
    let (mut now, mut odom) = (1_000_000_000_i64, Pose::IDENTITY);
    let ahead = |now: i64, ms: i16| Stamp(now + i64::from(ms) * 1_000_000);
    let (mut events, mut updates) = (0, 0);
    while !dice.is_empty() && events < MOST_EVENTS {
        let Ok(event) = dice.arbitrary() else { break };
        events += 1;
        match event {
            Event::Odometry {
                ahead_ms,
                pose: [x, y, heading],
                twist: [linear_x, linear_y, angular],
            } => {
                localizer
                    .on_odometry(&Odometry {
                        stamp: ahead(now, ahead_ms),
                        pose: Pose::new(x, y, heading),
                        twist: Twist {
                            linear_x,
                            linear_y,
                            angular,
                        },
                    })
                    .ok();
            }
            Event::Drive { centimetres, turn } => {
                now += 20_000_000;
                odom = odom * Pose::new(f64::from(centimetres) * 0.01, 0.0, f64::from(turn) * 0.01);
                localizer
                    .on_odometry(&Odometry {
                        stamp: Stamp(now),
                        pose: odom,
                        twist: Twist::default(),
                    })
                    .ok();
            }
            Event::YawRate { ahead_ms, rate } => {
                localizer
                    .on_yaw_rate(&YawRate {
                        stamp: ahead(now, ahead_ms),
                        rate,
                    })
                    .ok();
            }
            Event::Raw {
                ahead_ms,
                header,
                ranges,
            } => {
                let [angle_min, angle_increment, time_increment, range_min, range_max] = header;
                let stamp = ahead(now, ahead_ms);
                updates += usize::from(take(
                    &mut localizer,
                    &Scan {
                        stamp,
                        angle_min,
                        angle_increment,
                        time_increment,
                        scan_time: Some(range_min),
                        angle_max: Some(range_max),
                        range_min,
                        range_max,
                        ranges,
                    },
                ));
            }
            Event::Scan {
                beams,
                range,
                odd,
                sweep,
            } => {
                now += 1_000_000;
                let count = usize::from(beams % 1200) + 1;
                let mut ranges = vec![f32::from(range) * 0.05; count];
                for (at, value) in odd {
                    ranges[usize::from(at) % count] = value;
                }
                updates += usize::from(take(
                    &mut localizer,
                    &Scan {
                        stamp: Stamp(now),
                        angle_min: -2.3,
                        angle_increment: 4.6 / count as f64,
                        time_increment: if sweep { 0.018 / count as f64 } else { 0.0 },
                        scan_time: Some(0.025),
                        angle_max: None,
                        range_min: 0.05,
                        range_max: 30.0,
                        ranges,
                    },
                ));
            }
            Event::Initialize([x, y, heading]) => {
                localizer.initialize(Pose::new(x, y, heading)).ok();
            }
            Event::Place(x, y, heading) => {
                let at = Pose::new(
                    f64::from(x) * 0.02,
                    f64::from(y) * 0.015,
                    f64::from(heading) * 0.025,
                );
                localizer.initialize(map().grid().origin * at).ok();
            }
            Event::Relocalize => localizer.relocalize(),
            Event::Set(which) => {
                let name = Parameters::NAMES[usize::from(which) % Parameters::NAMES.len()];
                let mut set = Parameters::named(name).expect("ships");
                set.particles.max_particles = 64;
                set.particles.min_particles = 16;
                localizer.set_parameters(set).ok();
            }
            Event::Put(which, value) => {
                let key = keys[usize::from(which) % keys.len()].clone();
                if let Ok((set, _)) = localizer.parameters().with_values([(key, value.into())])
                    && set.particles.max_particles <= 200
                {
                    localizer.set_parameters(set).ok();
                }
            }
        }
        if let Some(pose) = localizer.predict(Stamp(now)) {
            assert!(pose.is_finite(), "{pose:?}");
        }
    }
    updates
}

/// Takes in a scan; true when it led to an update.
fn take(localizer: &mut SynPf, scan: &Scan) -> bool {
    let mut updated = false;
    if let Ok(update) = localizer.on_scan(scan) {
        updated = true;
        assert!(update.pose.is_finite(), "{update:?}");
        assert!(update.covariance.iter().all(|v| v.is_finite()), "{update:?}");
        let shares = [
            update.alignment,
            update.short_beams,
            update.long_beams,
            update.no_return,
            update.ess_ratio,
        ];
        assert!(
            shares.iter().all(|share| (0.0..=1.0).contains(share)),
            "{update:?}"
        );
        assert!(
            update.residual.is_finite() && update.innovation.iter().all(|v| v.is_finite()),
            "{update:?}"
        );
        assert!(
            update.slip.is_finite() && update.yaw_rate_residual.is_finite(),
            "{update:?}"
        );
        assert!(
            update.w_ratio.is_finite() && update.spread.iter().all(|v| v.is_finite()),
            "{update:?}"
        );
    }
    for particle in localizer.particles().take(8) {
        assert!(
            particle.pose.is_finite() && particle.weight.is_finite(),
            "{particle:?}"
        );
    }
    updated
}
