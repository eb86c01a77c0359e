//! The bundled tracks: whole, and what their descriptions make.

use std::path::PathBuf;

use maps::{Cell, OccupancyGrid};
use simulator::{BUNDLED, Track, TrackSpec};

fn folder(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
        .join("../../maps/tracks")
        .join(name)
}

#[test]
fn every_bundled_track_can_be_raced_on() {
    for name in BUNDLED {
        let track = Track::load(folder(name), None).expect("a bundled track");
        assert_eq!(track.name, name);
        for p in track.raceline.points() {
            assert_eq!(track.grid.at([p.x, p.y]), Cell::Free, "{name}: {p:?}");
            // Half a car's width and a hand's breadth.
            for i in 0..24 {
                let (sin, cos) = (f64::from(i) * 0.2618).sin_cos();
                let hit = track.walls.cast([p.x, p.y], [cos, sin], 0.24);
                assert!(hit.is_none(), "{name}: {p:?}");
            }
        }
    }
}

#[test]
fn the_bundled_club_is_what_its_description_makes() {
    let path = folder("club").join("track.yaml");
    let yaml = std::fs::read_to_string(&path).expect("a bundled track");
    let made = TrackSpec::parse("club", &yaml)
        .expect("a valid description")
        .generate()
        .expect("room enough");
    let kept = Track::load(folder("club"), None).expect("a bundled track");
    // As read back, because the bytes of a PNG depend on the compressor that the build has picked.
    let made_grid = OccupancyGrid::from_parts(&made.grid.to_yaml("map.png"), &made.grid.to_png());
    assert!(
        made_grid.expect("just written") == kept.grid,
        "maps/tracks/club/map.png is not what track.yaml makes"
    );
    assert_eq!(made.raceline.to_csv(), kept.raceline.to_csv());
    assert_eq!(made.walls.to_csv(), kept.walls.to_csv());
}
