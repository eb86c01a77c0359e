//! Where scans and the map disagree, lap after lap.
//!
//! Every end point of a scan is projected onto the raceline, which gives its place `s` and its side. On each lap, a place
//! is wrong if most of the end points there lie off the walls that the map draws. A beam that goes on behind a drawn wall
//! counts at the place of that wall. What is wrong on most laps is a fault of the map. Another car is not: on the same
//! lap, more beams at that place end at the wall beside it.

use std::sync::Arc;

use protocol::{EndPointKind, ScanView};
use serde::Serialize;

use super::TrackLine;

/// Compares the scans of one car with the map.
#[derive(Debug, Clone)]
pub struct MapCheck {
    line: Arc<TrackLine>,
    places: usize,
    /// This lap, both sides of each place.
    lap: Vec<Seen>,
    /// All laps before.
    votes: Vec<Vote>,
    /// Arc length of the last pose \[m\].
    s: Option<f64>,
}

/// The end points at a place on one lap.
#[derive(Debug, Clone, Copy, Default)]
struct Seen {
    on_wall: u16,
    off_wall: u16,
    through: u16,
    /// Sum of the distances of those off a wall from the drawn one \[m\].
    offsets: f32,
    /// The last end point off a wall.
    point: Option<[f32; 2]>,
}

/// The laps at a place.
#[derive(Debug, Clone, Copy, Default)]
struct Vote {
    seen: u16,
    wrong: u16,
    through: u16,
    offsets: f32,
    /// When it was wrong first \[unix ns\].
    since: i64,
    points: [Option<[f32; 2]>; 3],
}

/// A stretch of the track where the map is wrong.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MapFinding {
    /// The track, see [`TrackLine::key`].
    pub track: String,
    /// Begin \[m\]. It exceeds `to_s` for a stretch over the start line.
    pub from_s: f64,
    /// End \[m\].
    pub to_s: f64,
    /// Length along the track \[m\].
    pub length_m: f64,
    /// Side of the raceline.
    pub side: Side,
    /// What is wrong.
    pub disagreement: Disagreement,
    /// Mean distance of what is seen from what is drawn, at most [`TrackLine::FAR`] \[m\].
    pub offset_m: f64,
    /// Laps on which it was wrong.
    pub laps: u32,
    /// Laps on which it was seen.
    pub of_laps: u32,
    /// Number of cars that saw it.
    pub cars: u32,
    /// The first time \[unix ns\].
    pub since: i64,
    /// Some of the end points \[m\].
    pub seen: Vec<[f32; 2]>,
}

/// Side of the raceline in the direction of travel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Side {
    /// Left.
    Left,
    /// Right.
    Right,
}

/// How scans and map disagree.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Disagreement {
    /// A wall is seen near a drawn one.
    Moved,
    /// A wall is seen where none is drawn.
    NotDrawn,
    /// A wall is drawn where beams pass.
    NotThere,
}

impl Disagreement {
    /// In words.
    pub fn words(self) -> &'static str {
        match self {
            Self::Moved => "the wall stands elsewhere",
            Self::NotDrawn => "a wall is missing in the map",
            Self::NotThere => "the map draws a wall that is not there",
        }
    }
}

impl MapCheck {
    /// Length of a place \[m\].
    const PLACE: f64 = 0.1;
    /// An end point further from a drawn wall than this is off it \[m\]: the tolerance of the alignment, and half a cell of
    /// a usual map.
    const OFF: f64 = 0.125;
    /// End points further from the raceline than this are not used \[m\].
    const REACH: f64 = 4.0;
    /// A scan is used if this share of its end points lies on walls. Otherwise the pose is in doubt and not the map.
    const TRUSTED: f64 = 0.5;
    /// Fewest end points at a place that judge it.
    const FEWEST: u16 = 3;
    /// Fewest laps that judge a place.
    const LAPS: u32 = 2;
    /// Share of the laps on which a wrong place must be wrong.
    const MOST: f64 = 0.6;
    /// Shortest stretch \[m\].
    const SHORTEST: f64 = 0.4;
    /// Stretches closer than this are one \[m\].
    const GAP: f64 = 0.35;
    /// A wall further off than this is another wall \[m\].
    const ELSEWHERE: f64 = 0.45;

    /// A check on the map of `line`.
    pub fn new(line: Arc<TrackLine>) -> Self {
        let places = ((line.length / Self::PLACE).round() as usize).clamp(1, 20_000);
        Self {
            lap: vec![Seen::default(); 2 * places],
            votes: vec![Vote::default(); 2 * places],
            places,
            line,
            s: None,
        }
    }

    /// The track.
    pub fn line(&self) -> &Arc<TrackLine> {
        &self.line
    }

    /// The car is at arc length `s` \[m\] at `at` \[unix ns\]. At the start line the lap is judged.
    pub fn on_pose(&mut self, s: f64, at: i64) {
        if self
            .s
            .replace(s)
            .is_some_and(|before| s < before - self.line.length / 2.0)
        {
            self.judge(at);
        }
    }

    /// Adds a scan that a trusted pose belongs to.
    pub fn on_scan(&mut self, scan: &ScanView) {
        let on_wall = scan
            .points
            .iter()
            .filter(|point| point.kind == EndPointKind::OnWall)
            .count();
        if (on_wall as f64) < Self::TRUSTED * scan.points.len() as f64 {
            return;
        }
        for &end in &scan.points {
            let point = scan.point(end);
            if let Some(distance) = self.line.from_wall(point)
                && let Some(place) = self.place(point)
            {
                let seen = &mut self.lap[place];
                if distance > Self::OFF {
                    seen.off_wall = seen.off_wall.saturating_add(1);
                    seen.offsets += distance as f32;
                    seen.point = Some(point.map(|v| v as f32));
                } else {
                    seen.on_wall = seen.on_wall.saturating_add(1);
                }
            }
            if end.kind == EndPointKind::Long
                && let Some(wall) = self.first_wall(scan.centre, point)
                && let Some(place) = self.place(wall)
            {
                let seen = &mut self.lap[place];
                seen.through = seen.through.saturating_add(1);
            }
        }
    }

    /// The place and side of a point.
    fn place(&self, point: [f64; 2]) -> Option<usize> {
        let at = self.line.project(point);
        if at.d.abs() > Self::REACH {
            return None;
        }
        let place = (at.s / self.line.length * self.places as f64) as usize;
        Some(2 * place.min(self.places - 1) + usize::from(at.d < 0.0))
    }

    /// Where a beam meets the first drawn wall, if that is clearly before its end.
    fn first_wall(&self, from: [f64; 2], to: [f64; 2]) -> Option<[f64; 2]> {
        const STEP: f64 = 0.03;
        let [dx, dy] = [to[0] - from[0], to[1] - from[1]];
        let range = dx.hypot(dy);
        let steps = ((range - 0.25) / STEP) as usize;
        (1..steps.min(2000))
            .map(|i| {
                let share = i as f64 * STEP / range;
                [from[0] + share * dx, from[1] + share * dy]
            })
            .find(|point| {
                self.line
                    .from_wall(*point)
                    .is_some_and(|distance| distance < 0.5 * STEP)
            })
    }

    /// Adds this lap to the votes.
    fn judge(&mut self, at: i64) {
        for (seen, vote) in self.lap.iter_mut().zip(&mut self.votes) {
            let wrong = seen.off_wall.saturating_add(seen.through);
            if wrong.saturating_add(seen.on_wall) >= Self::FEWEST {
                vote.seen = vote.seen.saturating_add(1);
                if wrong > seen.on_wall {
                    if vote.wrong == 0 {
                        vote.since = at;
                    }
                    vote.points[usize::from(vote.wrong) % vote.points.len()] = seen.point;
                    vote.wrong = vote.wrong.saturating_add(1);
                    vote.through = vote
                        .through
                        .saturating_add(u16::from(u32::from(seen.through) * 2 > u32::from(seen.off_wall)));
                    vote.offsets += seen.offsets / f32::from(seen.off_wall.max(1));
                }
            }
            *seen = Seen::default();
        }
    }

    /// The wrong stretches of a track, from all cars on it.
    pub fn findings<'a>(checks: impl IntoIterator<Item = &'a Self>) -> Vec<MapFinding> {
        let checks: Vec<_> = checks.into_iter().collect();
        let mut tracks: Vec<&str> = checks.iter().map(|check| check.line.key.as_str()).collect();
        tracks.sort_unstable();
        tracks.dedup();
        let mut found = Vec::new();
        for track in tracks {
            let cars: Vec<&Self> = checks
                .iter()
                .filter(|check| check.line.key == track)
                .copied()
                .collect();
            for side in [Side::Left, Side::Right] {
                found.extend(stretches(&cars, side));
            }
        }
        found.sort_by(|a, b| b.length_m.total_cmp(&a.length_m));
        found
    }

    fn vote(&self, place: usize, side: Side) -> &Vote {
        &self.votes[2 * place + usize::from(side == Side::Right)]
    }
}

/// The wrong stretches on one side of one track.
fn stretches(cars: &[&MapCheck], side: Side) -> Vec<MapFinding> {
    let Some(first) = cars.first() else {
        return Vec::new();
    };
    let places = first.places;
    let cars: Vec<_> = cars.iter().filter(|check| check.places == places).collect();
    let cell = first.line.length / places as f64;
    let votes = |place: usize| cars.iter().map(move |check| check.vote(place, side));
    let wrong: Vec<Option<bool>> = (0..places)
        .map(|place| {
            let seen: u32 = votes(place).map(|vote| u32::from(vote.seen)).sum();
            let wrong: u32 = votes(place).map(|vote| u32::from(vote.wrong)).sum();
            (seen >= MapCheck::LAPS)
                .then(|| wrong >= MapCheck::LAPS && f64::from(wrong) >= MapCheck::MOST * f64::from(seen))
        })
        .collect();
    // Start where nothing is wrong for a while, so that no stretch is split at the start line.
    let gap = (MapCheck::GAP / cell).round() as usize;
    let calm = |from: usize| (0..gap).all(|i| wrong[(from + i) % places] != Some(true));
    let start = (0..places).find(|from| calm(*from)).unwrap_or(0);
    let mut groups: Vec<(usize, usize)> = Vec::new();
    for i in (start..start + places).filter(|i| wrong[i % places] == Some(true)) {
        match groups.last_mut() {
            Some((_, to)) if i - *to <= gap => *to = i,
            _ => groups.push((i, i)),
        }
    }
    groups
        .into_iter()
        .filter(|(from, to)| {
            let count = (*from..=*to).filter(|i| wrong[i % places] == Some(true)).count();
            let span = to - from + 1;
            span as f64 * cell >= MapCheck::SHORTEST && 2 * count > span
        })
        .map(|(from, to)| {
            let inside = || {
                (from..=to)
                    .flat_map(|i| votes(i % places))
                    .filter(|vote| vote.wrong > 0)
            };
            let sum = |value: &dyn Fn(&Vote) -> f64| inside().map(value).sum::<f64>();
            let votes_wrong = sum(&|vote| f64::from(vote.wrong));
            let through = sum(&|vote| f64::from(vote.through));
            let offset = sum(&|vote| f64::from(vote.offsets)) / (votes_wrong - through).max(1.0);
            let disagreement = if through > 0.5 * votes_wrong {
                Disagreement::NotThere
            } else if offset > MapCheck::ELSEWHERE {
                Disagreement::NotDrawn
            } else {
                Disagreement::Moved
            };
            let most = |value: &dyn Fn(&Vote) -> u16| -> u32 {
                let of_car = |check: &&MapCheck| {
                    let laps = (from..=to).map(|i| value(check.vote(i % places, side))).max();
                    u32::from(laps.unwrap_or(0))
                };
                cars.iter().map(|check| of_car(check)).sum()
            };
            let saw = |check: &&&MapCheck| (from..=to).any(|i| check.vote(i % places, side).wrong > 0);
            let points: Vec<[f32; 2]> = inside().flat_map(|vote| vote.points).flatten().collect();
            let most_points = 120;
            MapFinding {
                track: first.line.key.clone(),
                from_s: (from % places) as f64 * cell,
                to_s: ((to % places) + 1) as f64 * cell,
                length_m: (to - from + 1) as f64 * cell,
                side,
                disagreement,
                offset_m: offset.min(TrackLine::FAR),
                laps: most(&|vote| vote.wrong),
                of_laps: most(&|vote| vote.seen),
                cars: cars.iter().filter(|check| saw(check)).count() as u32,
                since: inside().map(|vote| vote.since).min().unwrap_or(0),
                seen: points
                    .iter()
                    .step_by(points.len() / most_points + 1)
                    .copied()
                    .collect(),
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::super::track_line::tests::ring;
    use super::*;
    use protocol::EndPoint;
    use std::f64::consts::TAU;

    /// Drives round a ring whose walls are at 2 and 4 m; `wall(angle)` is the distance by which the true outer wall is
    /// further out. `drawn` removes walls of the map.
    fn drive(laps: u32, gone: impl Fn([f64; 2]) -> bool, wall: impl Fn(f64) -> f64) -> MapCheck {
        let line = Arc::new(TrackLine::of(&ring(gone)).expect("a line"));
        let mut check = MapCheck::new(line);
        for step in 0..=laps * 90 {
            let way = f64::from(step) / 90.0 * TAU;
            let (sin, cos) = way.sin_cos();
            let centre = [3.0 * cos, 3.0 * sin];
            check.on_pose(3.0 * way.rem_euclid(TAU), i64::from(step));
            let points = (0..120)
                .map(|i| {
                    let ahead = way + (f64::from(i % 60) - 30.0) * 0.02;
                    let r = if i < 60 {
                        2.02
                    } else {
                        3.98 + wall(ahead.rem_euclid(TAU))
                    };
                    let point = [r * ahead.cos(), r * ahead.sin()];
                    let kind = if i >= 60 && wall(ahead.rem_euclid(TAU)) > 0.3 {
                        EndPointKind::Long
                    } else {
                        EndPointKind::OnWall
                    };
                    EndPoint::quantise(point, centre, kind)
                })
                .collect();
            check.on_scan(&ScanView {
                update: 1,
                centre,
                points,
            });
        }
        check
    }

    fn between(angle: f64, from: f64, to: f64) -> bool {
        (from..to).contains(&angle)
    }

    #[test]
    fn nothing_is_found_where_the_map_is_right() {
        assert_eq!(MapCheck::findings([&drive(3, |_| false, |_| 0.0)]), []);
    }

    #[test]
    fn a_moved_a_missing_and_a_vanished_wall_are_found_at_their_places() {
        let angle = |[x, y]: [f64; 2]| y.atan2(x).rem_euclid(TAU);
        // The map lacks the outer wall from 1 to 1.5 rad. The true wall stands 20 cm further out from 3 to 3.5 rad, and
        // 60 cm from 5 to 5.5 rad.
        let gone = |point: [f64; 2]| point[0].hypot(point[1]) > 3.5 && between(angle(point), 1.0, 1.5);
        let wall = |a: f64| {
            if between(a, 3.0, 3.5) {
                0.2
            } else if between(a, 5.0, 5.5) {
                0.6
            } else {
                0.0
            }
        };
        let checks = [drive(3, gone, wall), drive(2, gone, wall)];
        let mut found = MapCheck::findings(&checks);
        found.sort_by(|a, b| a.from_s.total_cmp(&b.from_s));
        let kinds: Vec<_> = found.iter().map(|finding| finding.disagreement).collect();
        assert_eq!(
            kinds,
            [
                Disagreement::NotDrawn,
                Disagreement::Moved,
                Disagreement::NotThere
            ],
            "{found:#?}"
        );
        for (finding, from) in found.iter().zip([1.0, 3.0, 5.0]) {
            assert!((finding.from_s - 3.0 * from).abs() < 0.2, "{finding:?}");
            assert!((finding.to_s - 3.0 * (from + 0.5)).abs() < 0.2, "{finding:?}");
            assert_eq!((finding.side, finding.cars), (Side::Right, 2));
            assert!(
                finding.laps >= 4 && finding.laps <= finding.of_laps,
                "{finding:?}"
            );
        }
        assert!((found[1].offset_m - 0.2).abs() < 0.05, "{}", found[1].offset_m);
    }

    #[test]
    fn what_stands_in_view_on_one_lap_only_is_no_fault_of_the_map() {
        let mut check = drive(1, |_| false, |a| if between(a, 2.0, 2.4) { -0.5 } else { 0.0 });
        assert_eq!(MapCheck::findings([&check]), []);
        check.on_pose(10.0, 1);
        check.on_pose(0.0, 2);
        assert_eq!(MapCheck::findings([&check]), []);
    }

    #[test]
    fn a_stretch_over_the_start_line_is_one() {
        let check = drive(
            3,
            |_| false,
            |a| {
                if between(a, 0.0, 0.3) || a > TAU - 0.3 {
                    0.2
                } else {
                    0.0
                }
            },
        );
        let found = MapCheck::findings([&check]);
        assert_eq!(found.len(), 1, "{found:#?}");
        assert!(found[0].from_s > found[0].to_s && (found[0].length_m - 1.8).abs() < 0.4);
    }

    #[test]
    fn scans_of_a_wrong_pose_do_not_count() {
        let mut check = MapCheck::new(Arc::new(TrackLine::of(&ring(|_| false)).expect("a line")));
        let points = vec![EndPoint::quantise([3.0, 0.0], [3.0, 0.0], EndPointKind::OffWall); 100];
        for lap in 0..4 {
            check.on_scan(&ScanView {
                update: 1,
                centre: [3.0, 0.0],
                points: points.clone(),
            });
            check.on_pose(18.0, lap);
            check.on_pose(0.1, lap);
        }
        assert_eq!(MapCheck::findings([&check]), []);
    }
}
