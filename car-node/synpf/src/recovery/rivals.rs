//! Poses beside the one that is followed, which explain what it does not: followed beside it, and held against it.
//!
//! Each rival is moved by odometry, fitted to every scan and compared with the incumbent beam by beam. Of a beam that ends on a
//! wall at one of the two and not at the other, the wall speaks for the one. Each piece of wall counts once, however many
//! beams and scans show it.

use maps::Pose;

use super::scan_likelihood::{Explained, Pieces, explain, score};
use crate::estimate::{Estimate, are_near};
use crate::global_search::{Candidate, SearchSettings, averaging, same};
use crate::preprocessed_scan::PreprocessedScan;
use crate::track_map::TrackMap;

/// The rivals of the pose that is followed.
#[derive(Debug, Clone, Default)]
pub(crate) struct Rivals {
    list: Vec<Rival>,
    /// The incumbent's score, averaged like a rival's, over so many scans and so long \[s\].
    own: f64,
    scans: u32,
    seconds: f64,
    driven: f64,
    /// What the incumbent explains of the scan.
    explained: Vec<Explained>,
}

/// A pose beside the one that is followed.
#[derive(Debug, Clone)]
pub(crate) struct Rival {
    pub(crate) candidate: Candidate,
    /// How far the car has driven since it joined \[m\].
    pub(crate) driven: f64,
    /// Pieces of wall that it explains and the incumbent does not, and the other way round.
    pieces: [Pieces; 2],
    explained: Vec<Explained>,
}

impl Rival {
    /// By how many pieces of wall it leads.
    pub(crate) fn lead(&self) -> f64 {
        let [gained, lost] = &self.pieces;
        gained.count() - lost.count()
    }
}

/// Most that are followed.
const MOST: usize = 8;

/// A rival whose scan fits worse than the incumbent's by this is none (a fifth of the fit).
const WORSE: f64 = 4.0;

/// A rival that is behind by so many pieces is dropped.
const BEHIND: f64 = 8.0;

/// Nearer than this a pose is the same place, and the filter's to mend \[m\].
const NEARBY: f64 = 0.5;

/// Evidence older than this way is forgotten [m]: a wrong pose shows itself within 8 m.
const WINDOW: f64 = 10.0;

/// An opponent may stand in front of a wall: a piece of wall that it would explain counts so much.
const BLOCKED: f32 = 0.5;

/// What the incumbent is, for a scan.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Incumbent<'a> {
    pub(crate) map: &'a TrackMap,
    pub(crate) scan: &'a PreprocessedScan,
    pub(crate) pose: Pose,
    /// How far from a wall an end point may lie \[m\].
    pub(crate) reach: f32,
}

impl Rivals {
    /// Candidates of a global check join, those that explain the scan as well as the incumbent does.
    pub(crate) fn add(&mut self, incumbent: Incumbent<'_>, mut candidates: Vec<Candidate>) {
        let own = score(incumbent.map, incumbent.scan, incumbent.pose);
        if self.list.is_empty() {
            (self.own, self.scans, self.seconds, self.driven) = (own, 1, 0.0, 0.0);
        }
        candidates.sort_by(|a, b| b.score.total_cmp(&a.score));
        for candidate in candidates {
            let pose = candidate.estimate.pose;
            let known = self
                .list
                .iter()
                .any(|rival| same(rival.candidate.estimate.pose, pose));
            if self.list.len() >= MOST || candidate.score < own - WORSE {
                break;
            }
            if !known && !nearby(pose, incumbent.pose) {
                self.list.push(Rival {
                    candidate,
                    driven: 0.0,
                    pieces: Default::default(),
                    explained: Vec::new(),
                });
            }
        }
    }

    /// Follows every rival to the next scan, and holds it against the incumbent.
    pub(crate) fn follow(
        &mut self,
        incumbent: Incumbent<'_>,
        motion: Pose,
        seconds: f64,
        settings: &SearchSettings,
    ) {
        if self.list.is_empty() {
            return;
        }
        let Incumbent {
            map,
            scan,
            pose,
            reach,
        } = incumbent;
        let way = motion.x.hypot(motion.y);
        self.driven += way;
        self.seconds += seconds;
        self.scans = self.scans.saturating_add(1);
        self.own += averaging(seconds, self.scans) * (score(map, scan, pose) - self.own);
        explain(map, scan, pose, reach, &mut self.explained);
        let (own, driven) = (&self.explained, self.driven as f32);
        for rival in &mut self.list {
            rival.driven += way;
            rival.candidate.follow(map, scan, motion, seconds, settings);
            explain(
                map,
                scan,
                rival.candidate.estimate.pose,
                reach,
                &mut rival.explained,
            );
            let [gained, lost] = &mut rival.pieces;
            for pair in own.iter().zip(&rival.explained) {
                match pair {
                    (Explained::Blocked, Explained::Wall(piece)) => gained.add(*piece, BLOCKED, driven),
                    (Explained::Not, Explained::Wall(piece)) => gained.add(*piece, 1.0, driven),
                    (Explained::Wall(piece), Explained::Blocked) => lost.add(*piece, BLOCKED, driven),
                    (Explained::Wall(piece), Explained::Not) => lost.add(*piece, 1.0, driven),
                    _ => {}
                }
            }
            gained.forget_before(driven - WINDOW as f32);
            lost.forget_before(driven - WINDOW as f32);
        }
        let own = self.own;
        self.list.retain(|rival| {
            !nearby(rival.candidate.estimate.pose, pose)
                && rival.lead() > -BEHIND
                && rival.candidate.score > own - 2.0 * WORSE
        });
        self.list.sort_by(|a, b| b.lead().total_cmp(&a.lead()));
        let mut kept: Vec<Rival> = Vec::with_capacity(self.list.len());
        for rival in self.list.drain(..) {
            let at = rival.candidate.estimate.pose;
            if !kept.iter().any(|other| same(other.candidate.estimate.pose, at)) {
                kept.push(rival);
            }
        }
        self.list = kept;
    }

    /// The one that leads most.
    pub(crate) fn best(&self) -> Option<&Rival> {
        self.list.first()
    }

    /// How long they have been followed \[s\].
    pub(crate) fn seconds(&self) -> f64 {
        self.seconds
    }

    /// All as candidates of a search, the incumbent among them, and how far the car has driven with them \[m\].
    pub(crate) fn take(&mut self, incumbent: &Estimate) -> (Vec<Candidate>, f64) {
        let own = Candidate::followed(*incumbent, self.own, self.scans, self.seconds);
        let driven = self.driven;
        let rivals = self.list.drain(..).map(|rival| rival.candidate);
        (rivals.chain([own]).collect(), driven)
    }

    pub(crate) fn clear(&mut self) {
        self.list.clear();
    }
}

fn nearby(a: Pose, b: Pose) -> bool {
    are_near(a, b, [NEARBY, 0.35])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::quality::tests::{room, scan};
    use nalgebra::Matrix3;

    /// Follows `rival` beside `incumbent` over so many scans from the truth, 0.1 m apart; by how much it leads.
    fn lead(truth: Pose, incumbent: Pose, rival: Pose, scans: usize) -> Option<f64> {
        let map = room();
        let estimate = |pose| Estimate {
            pose,
            covariance: Matrix3::identity() * 1e-4,
        };
        let mut rivals = Rivals::default();
        let motion = Pose::new(0.05, 0.0, 0.0);
        let (mut truth, mut incumbent) = (truth, incumbent);
        for step in 0..=scans {
            let scan = scan(&map, truth);
            let seen = Incumbent {
                map: &map,
                scan: &scan,
                pose: incumbent,
                reach: 0.1,
            };
            if step == 0 {
                rivals.add(seen, vec![Candidate::new(&map, &scan, estimate(rival))]);
            } else {
                rivals.follow(seen, motion, 0.025, &SearchSettings::default());
            }
            truth = truth * motion;
            incumbent = incumbent * motion;
        }
        rivals.best().map(Rival::lead)
    }

    #[test]
    fn the_right_rival_of_a_wrong_pose_leads_and_a_wrong_one_of_the_right_pose_is_dropped() {
        let (truth, wrong) = (Pose::new(8.0, 4.0, 0.3), Pose::new(4.0, 3.0, 1.9));
        let right = lead(truth, wrong, truth, 8).expect("followed");
        assert!(right > 10.0, "{right}");
        assert_eq!(lead(truth, truth, wrong, 8), None);
    }

    #[test]
    fn a_car_that_stands_gathers_no_more_evidence() {
        let map = room();
        let (truth, wrong) = (Pose::new(8.0, 4.0, 0.3), Pose::new(4.0, 3.0, 1.9));
        let scan = scan(&map, truth);
        let seen = Incumbent {
            map: &map,
            scan: &scan,
            pose: wrong,
            reach: 0.1,
        };
        let estimate = Estimate {
            pose: truth,
            covariance: Matrix3::identity() * 1e-4,
        };
        let mut rivals = Rivals::default();
        rivals.add(seen, vec![Candidate::new(&map, &scan, estimate)]);
        let mut leads = (0..50).map(|_| {
            rivals.follow(seen, Pose::IDENTITY, 0.025, &SearchSettings::default());
            rivals.best().map_or(0.0, Rival::lead)
        });
        let early = leads.by_ref().nth(4).unwrap_or_default();
        let late = leads.last().unwrap_or_default();
        assert!(early > 5.0 && late <= early + 2.0, "{early} {late}");
    }
}
