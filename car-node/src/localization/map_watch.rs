//! Where the map differs from what the laser sees, pass after pass.
//!
//! The map is divided into square places. While a car passes a place, its end points there lie on the walls that the map
//! draws, or they do not, or beams go through a drawn wall. A place where most of them disagree on most passes is wrong on the
//! map: a wall was moved, taken away or put up. Another car is somewhere else on the next pass.

use std::collections::HashMap;

use maps::Pose;
use synpf::{Scan, Stamp, TrackMap};

/// Compares the scans of a localized car with the map.
#[derive(Debug, Default)]
pub(super) struct MapWatch {
    places: HashMap<[i32; 2], Place>,
    latest: Option<Stamp>,
    /// Length of the stretches that were found \[m\].
    found: f64,
}

/// What was seen at a place.
#[derive(Debug, Clone, Copy)]
struct Place {
    /// When it was seen last.
    seen: Stamp,
    /// On this pass: end points on a wall, off all walls, and beams through a wall.
    on: u32,
    off: u32,
    through: u32,
    /// Passes so far, those on which it was wrong, and those of them on which beams went through.
    passes: u32,
    wrong: u32,
    gone: u32,
    /// Whether it belongs to a stretch that was told.
    told: bool,
}

/// A stretch where the map is wrong.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Stretch {
    /// Its middle in `map` \[m\].
    pub(super) middle: [f64; 2],
    /// Its extent \[m\].
    pub(super) length: f64,
    /// Whether a wall of the map is not there; else something stands where the map draws no wall.
    pub(super) gone: bool,
    /// The most passes on which a place of it was wrong.
    pub(super) passes: u32,
}

/// Edge of a place \[m\].
const PLACE: f64 = 0.5;

/// Time from one scan that is compared to the next \[s\].
const PERIOD: f64 = 0.1;

/// A place that is not seen for so long has been passed \[s\].
const PASSED: f64 = 2.0;

/// Beams compared of a scan.
const BEAMS: usize = 120;

/// End points farther away than this are not compared [m]: a heading that errs by half a degree puts them 7 cm off.
const REACH: f64 = 8.0;

/// End points nearer to a wall than this, or than a cell, are on it \[m\].
const ON_WALL: f64 = 0.15;

/// A beam longer than the map says by more than this goes through a wall \[m\].
const THROUGH: f64 = 0.3;

/// Share of a scan's end points that lie on walls where the pose is to be trusted and not the map doubted.
const TRUSTED: f64 = 0.5;

/// Fewest readings that judge a place on a pass.
const FEWEST: u32 = 4;

/// Fewest passes on which a wrong place is wrong, and the least share of all passes.
const WRONG: (u32, f64) = (2, 0.6);

/// Most places that are kept: a track of a kilometre has 8 000 along its walls.
const MOST: usize = 20_000;

impl MapWatch {
    /// Compares a scan that was taken from `map_from_laser` by a localized car. Returns the stretches that are found to be wrong.
    pub(super) fn on_scan(&mut self, scan: &Scan, map_from_laser: Pose, map: &TrackMap) -> Vec<Stretch> {
        let now = scan.stamp;
        if self
            .latest
            .is_some_and(|latest| (0.0..PERIOD).contains(&now.since(latest)))
        {
            return Vec::new();
        }
        self.latest = Some(now);
        let tolerance = ON_WALL.max(map.grid().resolution);
        let step = scan.ranges.len().div_ceil(BEAMS).max(1);
        let reach = scan.range_max.min(REACH);
        let mut readings = Vec::with_capacity(BEAMS);
        let (mut on_walls, mut beams) = (0, 0);
        for (beam, range) in scan.ranges.iter().enumerate().step_by(step) {
            let range = f64::from(*range);
            if !(scan.nearest()..reach).contains(&range) {
                continue;
            }
            let along =
                map_from_laser * Pose::new(0.0, 0.0, scan.angle_min + scan.angle_increment * beam as f64);
            let end = along.transform([range, 0.0]);
            beams += 1;
            let wall = map.range(along, reach);
            if range > wall + THROUGH {
                readings.push((along.transform([wall, 0.0]), Reading::Through));
            }
            let on_wall = map.distance(end).abs() < tolerance;
            on_walls += u32::from(on_wall && range < wall + THROUGH);
            readings.push((end, if on_wall { Reading::On } else { Reading::Off }));
        }
        if f64::from(on_walls) < TRUSTED * f64::from(beams) {
            return Vec::new();
        }
        for (point, reading) in readings {
            self.note(now, point, reading);
        }
        self.judge(now)
    }

    /// Length of the stretches that were found so far \[m\].
    pub(super) fn found(&self) -> f64 {
        self.found
    }

    fn note(&mut self, now: Stamp, point: [f64; 2], reading: Reading) {
        let key = point.map(|v| (v / PLACE).floor() as i32);
        if self.places.len() >= MOST && !self.places.contains_key(&key) {
            return;
        }
        let place = self.places.entry(key).or_insert(Place {
            seen: now,
            on: 0,
            off: 0,
            through: 0,
            passes: 0,
            wrong: 0,
            gone: 0,
            told: false,
        });
        place.seen = now;
        let count = match reading {
            Reading::On => &mut place.on,
            Reading::Off => &mut place.off,
            Reading::Through => &mut place.through,
        };
        *count = count.saturating_add(1);
    }

    /// Judges the places that have been passed, and joins those that are wrong to stretches.
    fn judge(&mut self, now: Stamp) -> Vec<Stretch> {
        let mut wrong = Vec::new();
        for (key, place) in &mut self.places {
            if now.since(place.seen) < PASSED {
                continue;
            }
            place.end_pass();
            if place.is_wrong() && !place.told {
                wrong.push(*key);
            }
        }
        // The order of a hash map is another in each run.
        wrong.sort_unstable();
        let mut stretches = Vec::new();
        for key in wrong {
            let Some(stretch) = self.join(key, now) else {
                continue;
            };
            self.found += stretch.length;
            stretches.push(stretch);
        }
        stretches
    }

    /// The stretch around a wrong place. None if it was told already, or a part of it is still in view.
    fn join(&mut self, from: [i32; 2], now: Stamp) -> Option<Stretch> {
        let mut open = vec![from];
        let mut joined = Vec::new();
        while let Some(key) = open.pop() {
            let Some(place) = self.places.get_mut(&key) else {
                continue;
            };
            if now.since(place.seen) < PASSED {
                // It is told once it has been passed.
                for key in joined {
                    self.tell(key, false);
                }
                return None;
            }
            if place.told || !place.is_wrong() {
                continue;
            }
            place.told = true;
            joined.push(key);
            for dx in -1..=1 {
                for dy in -1..=1 {
                    open.push([key[0].saturating_add(dx), key[1].saturating_add(dy)]);
                }
            }
        }
        let places = || joined.iter().filter_map(|key| self.places.get(key));
        let gone = places().filter(|place| 2 * place.gone > place.wrong).count();
        let ends = |axis: usize| {
            let along = joined.iter().map(|key| f64::from(key[axis]) * PLACE);
            along.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
                (low.min(v), high.max(v))
            })
        };
        let ((left, right), (low, high)) = (ends(0), ends(1));
        (!joined.is_empty()).then(|| Stretch {
            middle: [0.5 * (left + right + PLACE), 0.5 * (low + high + PLACE)],
            // From the middle of the first place to that of the last: walls end in them anywhere.
            length: (right - left).hypot(high - low).max(PLACE),
            gone: 2 * gone > joined.len(),
            passes: places().map(|place| place.wrong).max().unwrap_or_default(),
        })
    }

    fn tell(&mut self, key: [i32; 2], told: bool) {
        if let Some(place) = self.places.get_mut(&key) {
            place.told = told;
        }
    }
}

/// How a beam compares with the map at a place.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Reading {
    /// It ends on a wall there.
    On,
    /// It ends there, off all walls.
    Off,
    /// It goes through a wall there.
    Through,
}

impl Place {
    fn end_pass(&mut self) {
        let against = self.off + self.through;
        if self.on + against >= FEWEST {
            self.passes = self.passes.saturating_add(1);
            if against > self.on {
                self.wrong = self.wrong.saturating_add(1);
                self.gone = self.gone.saturating_add(u32::from(self.through > self.off));
            }
        }
        (self.on, self.off, self.through) = (0, 0, 0);
    }

    fn is_wrong(&self) -> bool {
        let (fewest, share) = WRONG;
        self.wrong >= fewest && f64::from(self.wrong) >= share * f64::from(self.passes)
    }
}

impl std::fmt::Display for Stretch {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [x, y] = self.middle;
        let what = if self.gone {
            "a wall of the map is not there"
        } else {
            "something stands where the map has no wall"
        };
        write!(
            f,
            "the map differs at ({x:.1}, {y:.1}) m over {:.1} m: {what}, seen on {} passes",
            self.length, self.passes
        )
    }
}

#[cfg(test)]
mod tests {
    use maps::{Cell, OccupancyGrid};

    use super::*;

    /// A corridor of 20 x 4 m between y = 1 and 5 m, in a hall whose wall is at y = 0; the lower wall may be open from 8 to 11 m, and a
    /// board of 2 m may stand 0.5 m inside the upper one.
    fn corridor(open: bool, board: bool) -> TrackMap {
        let cell = move |column: usize, row: usize| {
            let gap = open && (160..220).contains(&column);
            let on_board = board && (260..300).contains(&column) && row == 89;
            match (column, row) {
                (0 | 399, _) | (_, 0 | 99) => Cell::Occupied,
                (_, 20) if !gap => Cell::Occupied,
                _ if on_board => Cell::Occupied,
                _ => Cell::Free,
            }
        };
        TrackMap::new(OccupancyGrid::from_fn(400, 100, 0.05, Pose::IDENTITY, cell)).expect("a map")
    }

    fn scan(world: &TrackMap, at: Pose, seconds: f64) -> Scan {
        let ranges = (0..360)
            .map(|i| {
                let angle = f64::from(i).to_radians();
                world.range(at * Pose::new(0.0, 0.0, angle), 10.0) as f32
            })
            .collect();
        Scan {
            stamp: Stamp(0).plus(seconds),
            angle_min: 0.0,
            angle_increment: 1f64.to_radians(),
            time_increment: 0.0,
            scan_time: None,
            angle_max: None,
            range_min: 0.05,
            range_max: 10.0,
            ranges,
        }
    }

    /// Drives along once in each of these worlds, with this map.
    fn drive(map: &TrackMap, worlds: &[&TrackMap]) -> Vec<Stretch> {
        let mut watch = MapWatch::default();
        let mut found = Vec::new();
        let mut seconds = 0.0;
        for world in worlds {
            for step in 0..170 {
                let at = Pose::new(1.5 + 0.1 * f64::from(step), 3.0, 0.0);
                seconds += 0.1001;
                found.extend(watch.on_scan(&scan(world, at, seconds), at, map));
            }
            // The way back is out of sight.
            seconds += 10.0;
        }
        // Everything is out of sight.
        let at = Pose::new(1.5, 3.0, 0.0);
        let nothing = Scan {
            range_max: 1.0,
            ..scan(map, at, seconds)
        };
        found.extend(watch.on_scan(&nothing, at, map));
        found
    }

    #[test]
    fn a_wall_that_is_missing_in_the_world_is_found_with_its_place_and_size() {
        let (map, world) = (corridor(false, false), corridor(true, false));
        assert_eq!(drive(&map, &[&world]), [], "one pass may be an error of the pose");
        let found = drive(&map, &[&world, &world]);
        let [stretch] = found[..] else { panic!("{found:?}") };
        assert!(stretch.gone && stretch.passes == 2, "{stretch:?}");
        assert!(
            (stretch.middle[0] - 9.5).abs() < 0.5 && (stretch.middle[1] - 1.0).abs() < 0.6,
            "{stretch:?}"
        );
        assert!((stretch.length - 3.0).abs() < 0.8, "{stretch:?}");
    }

    #[test]
    fn a_board_that_the_map_does_not_have_is_found() {
        let (map, world) = (corridor(false, false), corridor(false, true));
        let found = drive(&map, &[&world, &world]);
        let [stretch] = found[..] else { panic!("{found:?}") };
        assert!(!stretch.gone, "{stretch:?}");
        assert!((stretch.middle[0] - 14.0).abs() < 0.6, "{stretch:?}");
    }

    #[test]
    fn what_stands_there_on_one_pass_alone_is_no_fault_of_the_map() {
        let (map, world) = (corridor(false, false), corridor(false, true));
        assert_eq!(drive(&map, &[&map, &world, &map, &map]), []);
        assert_eq!(drive(&map, &[&map, &map, &map]), []);
    }
}
